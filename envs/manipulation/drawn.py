"""What draws any task on a `Scene`: C MuJoCo's model of all that the MJCF shows."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np

from envs.manipulation.physics.analytic.gripper import SIDES
from envs.manipulation.physics.mujoco_c import import_mujoco


class DrawnArm(NamedTuple):
    """MuJoCo's module, `MjModel` and `MjData`, and the index of the arm's site."""

    mujoco: Any
    model: Any
    data: Any
    site: int


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
        model, data = self.arm.model, self.arm.data
        bodies, fingers = state.bodies, state.fingers
        data.qpos[:], data.qvel[:] = np.asarray(bodies.qpos), np.asarray(bodies.qvel)
        if bodies.mocap is not None:
            data.mocap_pos[:] = np.asarray(bodies.mocap[:, :3])
            data.mocap_quat[:] = np.asarray(bodies.mocap[:, 3:])
        if fingers is not None:
            for side, angle in zip(SIDES, np.asarray(fingers.inner), strict=True):
                model.body(f"{side}_finger").quat[:] = [np.cos(angle / 2), np.sin(angle / 2), 0, 0]
