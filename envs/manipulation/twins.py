"""The arm environments in C MuJoCo: for watching, for a person at the controls, and as the oracle.

Same MJCF, same controller law, but MuJoCo's own physics. A twin has its environment's interface;
only `transition` is not a JAX function (one environment at a time, no `jit`, no `vmap`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.control.on_mujoco_c import begin, torque
from envs.manipulation.physics.analytic import grasp_contact, gripper
from envs.manipulation.physics.mujoco_c import MujocoArm, nut_xml, wiping_xml
from envs.manipulation.scenes.model import SUBSTEPS, TIMESTEP, WIPING_TABLE
from envs.manipulation.tasks import nut, wiping
from ppl_jax.types import Outcome


def _single(value: Any) -> jax.Array:
    return jnp.asarray(np.array(value), jnp.float32)  # a copy: MuJoCo goes on in its own


class WipingTwin(wiping.TableWiping):
    """Table wiping whose physics is C MuJoCo's."""

    def __init__(self, env: wiping.TableWiping):
        super().__init__(env.default_params, env.held_out_params, env.experts)
        self.arm = MujocoArm(wiping_xml())
        self._finish = jax.jit(self.finish)

    def place(self, state: wiping.WipingState) -> None:
        """Put MuJoCo's data into a state."""
        data = self.arm.data
        data.qpos[:6], data.qvel[:6] = np.asarray(state.joints), np.asarray(state.speeds)
        data.qacc_warmstart[:] = np.asarray(state.acceleration)
        data.mocap_pos[:, :2] = np.asarray(state.markers)
        data.mocap_pos[:, 2] = np.where(state.wiped, -1.0, WIPING_TABLE[2])

    def transition(
        self, key: Any, state: wiping.WipingState, action: jax.Array, params: wiping.WipingParams
    ) -> tuple[wiping.WipingState, Outcome]:
        """One control step of 0.05 s, without reset."""
        del key
        self.place(state)
        arm = self.arm
        model, data, mujoco = arm.model, arm.data, arm.mujoco
        _, goal = begin(arm, action, state.goal_rotation)
        for _ in range(SUBSTEPS):
            mujoco.mj_step1(model, data)
            data.qfrc_applied[:6] = torque(arm, goal)
            mujoco.mj_step2(model, data)
        push = np.zeros(3)
        for index in range(data.ncon):
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, force)
            frame = data.contact[index].frame.reshape(3, 3)
            push += force[:3] @ frame  # the wiper's point is the pair's second geom
        moved = wiping.Moved(
            joints=_single(data.qpos[:6]),
            speeds=_single(data.qvel[:6]),
            acceleration=_single(data.qacc[:6]),
            goal_rotation=_single(goal[1].T),
            push=_single(push),
        )
        return self._finish(state, moved, params)


class NutTwin(nut.NutAssembly):
    """Nut assembly whose physics is C MuJoCo's."""

    def __init__(self, env: nut.NutAssembly):
        super().__init__(env.default_params, env.held_out_params, env.experts)
        arm = self.arm = MujocoArm(nut_xml())
        model = arm.model
        self._finish = jax.jit(self.finish)
        # MuJoCo numbers joints by their place in the tree: arm, left, right, ring
        self._knuckles = [
            int(model.joint(f"{side}_knuckle").dofadr[0]) for side in ("left", "right")
        ]
        self._ring = int(model.joint("ring").dofadr[0])
        self._ring_at = int(model.joint("ring").qposadr[0])
        damp = gripper.STIFFNESS * gripper.LAG
        mass = gripper.INERTIA + TIMESTEP * damp + TIMESTEP**2 * gripper.STIFFNESS
        model.dof_armature[self._knuckles] = mass
        model.dof_damping[self._ring : self._ring + 6] = grasp_contact.RING_DAMPING

    def place(self, state: nut.NutState) -> None:
        """Put MuJoCo's data into a state."""
        data, dofs, ring, at = self.arm.data, self._knuckles, self._ring, self._ring_at
        fingers = np.asarray(state.fingers, float)
        turn = np.asarray(nut.rotation_matrix(state.quaternion), float)
        data.qpos[:6], data.qvel[:6] = np.asarray(state.joints), np.asarray(state.speeds)
        data.qpos[dofs] = fingers[::3]
        data.qvel[dofs] = np.asarray(state.finger_speeds)[::3]
        data.qpos[at : at + 3] = np.asarray(state.position)
        data.qpos[at + 3 : at + 7] = np.asarray(state.quaternion)
        data.qvel[ring : ring + 3] = np.asarray(state.velocity)
        data.qvel[ring + 3 : ring + 6] = turn.T @ np.asarray(state.spin)
        self._pose_fingers(fingers[1::3])

    def _pose_fingers(self, inner: np.ndarray) -> None:
        """Turn the inner fingers and put the pads' points where the gripper's geometry says."""
        model = self.arm.model
        for index, side in enumerate(("left", "right")):
            half = 0.5 * inner[index]
            model.body(f"{side}_finger").quat[:] = [np.cos(half), np.sin(half), 0, 0]
            phi = inner[index]
            along = gripper.TIP + gripper.PAD_ROWS
            # rows of the pad in the frame of the knuckle's body
            y = gripper.FINGER[0] + gripper.FACE * np.cos(phi) - along * np.sin(phi)
            z = gripper.FINGER[1] + gripper.FACE * np.sin(phi) + along * np.cos(phi)
            rows = len(y)
            for point in range(2 * rows):
                x = gripper.PAD_HALF * (1 if point >= rows else -1)
                # spheres of 1 mm whose surface is the pad's face
                model.body(f"{side}_pad_{point}").pos[:] = [
                    x,
                    y[point % rows] + 0.001,
                    z[point % rows],
                ]

    def transition(
        self, key: Any, state: nut.NutState, action: jax.Array, params: nut.NutParams
    ) -> tuple[nut.NutState, Outcome]:
        """One control step of 0.05 s, without reset."""
        del key
        self.place(state)
        arm = self.arm
        model, data, mujoco = arm.model, arm.data, arm.mujoco
        clipped, goal = begin(arm, action, state.goal_rotation)
        fingers = np.asarray(state.fingers, float).copy()
        speeds = np.asarray(state.finger_speeds, float).copy()
        dofs, ring, at = self._knuckles, self._ring, self._ring_at
        command, touching = float(state.command), False
        damp = gripper.STIFFNESS * gripper.LAG
        for _ in range(SUBSTEPS):
            command = float(np.clip(command + gripper.RAMP * np.sign(clipped[6]), -1, 1))
            self._pose_fingers(fingers[1::3])
            mujoco.mj_step1(model, data)
            data.qfrc_applied[:6] = torque(arm, goal)
            target = gripper.command_to_control(command)
            rest = float(np.interp(target, gripper.COMMANDS, gripper.KNUCKLE_REST))
            pull = rest - data.qpos[dofs] - TIMESTEP * data.qvel[dofs]
            data.qfrc_applied[dofs] = gripper.STIFFNESS * pull - damp * data.qvel[dofs]
            mujoco.mj_step2(model, data)
            squeeze, sides = self._squeeze()
            touching = all(sides)
            finger_rest, outer_rest = gripper.following_rest(
                jnp.asarray(data.qpos[dofs], jnp.float32), jnp.asarray(squeeze, jnp.float32)
            )
            speeds[1::3] = (np.asarray(finger_rest) - fingers[1::3]) / gripper.FOLLOW
            speeds[2::3] = (np.asarray(outer_rest) - fingers[2::3]) / gripper.FOLLOW
            fingers[1::3] += TIMESTEP * speeds[1::3]
            fingers[2::3] += TIMESTEP * speeds[2::3]
        fingers[::3], speeds[::3] = data.qpos[dofs], data.qvel[dofs]
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, data.qpos[at + 3 : at + 7])

        moved = dataclasses.replace(
            state,
            joints=_single(data.qpos[:6]),
            speeds=_single(data.qvel[:6]),
            goal_rotation=_single(goal[1].T),
            fingers=_single(fingers),
            finger_speeds=_single(speeds),
            command=_single(command),
            touching=jnp.asarray(touching),
            position=_single(data.qpos[at : at + 3]),
            quaternion=_single(data.qpos[at + 3 : at + 7]),
            velocity=_single(data.qvel[ring : ring + 3]),
            spin=_single(turn.reshape(3, 3) @ data.qvel[ring + 3 : ring + 6]),
            time=state.time + 1,
        )
        return self._finish(state, moved, params)

    def _squeeze(self) -> tuple[np.ndarray, list[bool]]:
        """Normal force of each pad on the handle, N, and whether it touches."""
        model, data, mujoco = self.arm.model, self.arm.data, self.arm.mujoco
        total, sides = np.zeros(2), [False, False]
        for index in range(data.ncon):
            one = data.contact[index]
            name = model.geom(one.geom1).name + model.geom(one.geom2).name
            for side, word in enumerate(("left", "right")):
                if word in name:
                    force = np.zeros(6)
                    mujoco.mj_contactForce(model, data, index, force)
                    total[side] += force[0]
                    sides[side] = True
        return total, sides


class DrawnScene:
    """A scene of one's own in C MuJoCo, to be drawn: the arm's joints and what `place` moves.

    Attributes:
        arm: MuJoCo's model and data.
    """

    def __init__(self, env: Any, xml: str, place: Callable[[Any, Any], None]):
        """Compile the scene.

        Args:
            env: The environment; its states have `joints`, [6] rad.
            xml: MJCF (see `scenes.model.arm_scene`).
            place: `place(data, state)` puts the rest of a state into MuJoCo's `MjData`.

        Raises:
            ImportError: Without MuJoCo.
        """
        self.env, self.arm, self._place = env, MujocoArm(xml), place

    def place(self, state: Any) -> None:
        """Put MuJoCo's data into a state."""
        self.arm.data.qpos[:6] = np.asarray(state.joints)
        self._place(self.arm.data, state)


_TWINS: dict[str, Callable[[Any], Any]] = {"table_wiping": WipingTwin, "nut_assembly": NutTwin}


def register_twin(name: str, maker: Callable[[Any], Any]) -> None:
    """Make `make_twin` of the environment `name` call `maker(env)`: a `DrawnScene`, or more.

    Raises:
        ValueError: If the name is taken.
    """
    if name in _TWINS:
        raise ValueError(f"environment {name!r} has a C MuJoCo twin already")
    _TWINS[name] = maker


def make_twin(env: Any) -> Any:
    """The C MuJoCo twin of an arm environment.

    Raises:
        ValueError: For another environment.
        ImportError: Without MuJoCo.
    """
    if env.name not in _TWINS:
        raise ValueError(f"no C MuJoCo twin of {env.name!r}: only of {', '.join(_TWINS)}")
    return _TWINS[env.name](env)
