"""What draws the arm environments: C MuJoCo's model of all that an MJCF shows, put into a state."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from envs.manipulation.physics.analytic.gripper import SIDES
from envs.manipulation.physics.mujoco_c import import_mujoco, nut_xml, wiping_xml
from envs.manipulation.scenes.model import WIPING_TABLE


class DrawnArm(NamedTuple):
    """MuJoCo's module, `MjModel` and `MjData`, and the index of the arm's site."""

    mujoco: Any
    model: Any
    data: Any
    site: int


def arm_of(xml: str) -> DrawnArm:
    """A compiled MJCF with a site `grip`."""
    mujoco = import_mujoco()
    model = mujoco.MjModel.from_xml_string(xml)
    return DrawnArm(mujoco, model, mujoco.MjData(model), model.site("grip").id)


class DrawnWiping:
    """Table wiping to be drawn."""

    def __init__(self) -> None:
        """Compile the MJCF with its markers."""
        self.arm = arm_of(wiping_xml())

    def place(self, state: Any) -> None:
        """Put MuJoCo's data into a state."""
        data = self.arm.data
        data.qpos[:6] = np.asarray(state.joints)
        data.mocap_pos[:, :2] = np.asarray(state.markers)
        data.mocap_pos[:, 2] = np.where(state.wiped, -1.0, WIPING_TABLE[2])


class DrawnNut:
    """Nut assembly to be drawn."""

    def __init__(self) -> None:
        """Compile the MJCF."""
        self.arm = arm_of(nut_xml())
        at = [self.arm.model.joint(f"{side}_knuckle").qposadr[0] for side in SIDES]
        self._knuckles, self._ring = at, int(self.arm.model.joint("ring").qposadr[0])

    def place(self, state: Any) -> None:
        """Put MuJoCo's data into a state."""
        data, at, fingers = self.arm.data, self._ring, np.asarray(state.fingers)
        data.qpos[:6], data.qpos[self._knuckles] = np.asarray(state.joints), fingers[::3]
        data.qpos[at : at + 3] = np.asarray(state.position)
        data.qpos[at + 3 : at + 7] = np.asarray(state.quaternion)
        _turn_fingers(self.arm.model, fingers[1::3])


class DrawnTask:
    """A `SceneTask` to be drawn.

    Attributes:
        arm: MuJoCo's model and data.
    """

    def __init__(self, env: Any):
        """Take the scene's complete model.

        Args:
            env: A `SceneTask`.
        """
        mujoco, scene = import_mujoco(), env.scene
        model = copy.copy(scene.full)  # drawing turns the inner fingers in it
        site = model.site(scene.model.site(env.arm.site).name).id
        self.arm = DrawnArm(mujoco, model, mujoco.MjData(model), site)

    def place(self, state: Any) -> None:
        """Put MuJoCo's data into a state."""
        data, bodies = self.arm.data, state.bodies
        data.qpos[:], data.qvel[:] = np.asarray(bodies.qpos), np.asarray(bodies.qvel)
        if bodies.mocap is not None:
            data.mocap_pos[:] = np.asarray(bodies.mocap[:, :3])
            data.mocap_quat[:] = np.asarray(bodies.mocap[:, 3:])
        if state.fingers is not None:
            _turn_fingers(self.arm.model, np.asarray(state.fingers.inner))


def _turn_fingers(model: Any, inner: np.ndarray) -> None:
    for side, angle in zip(SIDES, inner, strict=True):
        model.body(f"{side}_finger").quat[:] = [np.cos(angle / 2), np.sin(angle / 2), 0, 0]


_DRAWN: dict[str, Callable[[], Any]] = {"table_wiping": DrawnWiping, "nut_assembly": DrawnNut}


def drawn(env: Any) -> Any:
    """What draws an environment: an object with `arm` (a `DrawnArm`) and `place(state)`.

    An environment of one's own is a `SceneTask`, or has a method `drawn()` that makes one.

    Raises:
        ValueError: For an environment that nothing draws.
        ImportError: Without MuJoCo.
    """
    if hasattr(env, "drawn"):
        return env.drawn()
    if hasattr(env, "scene"):
        return DrawnTask(env)
    if env.name not in _DRAWN:
        raise ValueError(
            f"nothing draws {env.name!r}: make it a SceneTask, or give it a method drawn()"
        )
    return _DRAWN[env.name]()
