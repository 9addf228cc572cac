"""The same two worlds in C MuJoCo: for watching, for a person at the controls, and as the oracle.

Same MJCF, same controller law, but MuJoCo's own kinematics, dynamics, collision detection and
contact solver, in double precision. `Twin(env)` has the world's interface; only `transition` is not
a JAX function (one world at a time, no `jit`, no `vmap`).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.control import gripper
from envs.manipulation.control.operational_space import (
    DAMPING_RATE,
    POSITION_STEP,
    ROTATION_STEP,
    STIFFNESS,
)
from envs.manipulation.physics.analytic import grasp_contact, wipe_contact
from envs.manipulation.scenes.model import (
    FRICTION_LOSS,
    SUBSTEPS,
    TIMESTEP,
    TORQUE_LIMIT,
    WIPING_TABLE,
    nut_scene,
    wiping_scene,
)
from envs.manipulation.tasks import nut, wiping
from ppl_jax.types import Outcome


def wiping_xml(markers: int = 100) -> str:
    """MJCF of table wiping with this package's contact parameters."""
    low, high, width = wipe_contact.IMPEDANCE
    stiff = wipe_contact.DEPTH_SCALE / wipe_contact.TIME_CONSTANT**2
    soft = (
        f'solref="{-stiff:.9g} {-2 / wipe_contact.TIME_CONSTANT:.9g}" '
        f'solimp="{low} {high} {width / wipe_contact.DEPTH_SCALE}"'
    )
    return wiping_scene(wipe_contact.POINTS, soft, wipe_contact.FRICTION, markers)


def nut_xml() -> str:
    """MJCF of nut assembly with this package's contact parameters."""
    d = grasp_contact.IMPEDANCE
    soft = f'solref="{-grasp_contact.STIFF * d * d:.9g} {-grasp_contact.DAMP * d:.9g}" solimp="{d} {d} 0.001"'
    return nut_scene(
        grasp_contact.BEADS,
        grasp_contact.FEET,
        2 * len(gripper.PAD_ROWS),
        soft,
        grasp_contact.FRICTION,
    )


def _turn(vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _single(value: Any) -> jax.Array:
    return jnp.asarray(np.array(value), jnp.float32)  # a copy: MuJoCo goes on in its own


class _Arm:
    """MuJoCo's model and data, and operational-space control on what they say."""

    def __init__(self, xml: str):
        try:
            import mujoco
        except ImportError as error:
            raise ImportError(
                "the C MuJoCo twin needs mujoco: pip install ppl-jax[manipulation]"
            ) from error
        self.mujoco = mujoco
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site("grip").id

    def begin(
        self, action: Any, held: jax.Array
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """The clipped action, and the controller's goal for it: position, rotation (columns).

        `held` is the last goal's rotation, its axes as rows. MuJoCo's data is in the state.
        """
        action = np.clip(np.asarray(action, float), -1, 1)
        self.mujoco.mj_forward(self.model, self.data)
        place = self.data.site_xpos[self.site] + POSITION_STEP * action[:3]
        if not np.any(action[3:6]):
            return action, (place, np.asarray(held, float).T)
        now = self.data.site_xmat[self.site].reshape(3, 3)
        return action, (place, _turn(ROTATION_STEP * action[3:6]) @ now)

    def torque(self, goal: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Joint torques of `control.free_motion`, friction in the joints taken off."""
        model, data = self.model, self.data
        jac = np.zeros((6, model.nv))
        self.mujoco.mj_jacSite(model, data, jac[:3], jac[3:], self.site)
        full = np.zeros((model.nv, model.nv))
        self.mujoco.mj_fullM(model, full, data.qM) if hasattr(data, "qM") else (
            self.mujoco.mj_fullM(model, data, full)
        )
        jac, mass, speed = jac[:, :6], full[:6, :6], data.qvel[:6]
        twist = jac @ speed
        now = data.site_xmat[self.site].reshape(3, 3)
        off = goal[0] - data.site_xpos[self.site]
        turned = 0.5 * np.cross(now.T, goal[1].T).sum(0)
        inverse = np.linalg.inv(mass)
        total = np.zeros(6)
        for part, error in ((slice(0, 3), off), (slice(3, 6), turned)):
            wanted = STIFFNESS * error - DAMPING_RATE * twist[part]
            inertia = np.linalg.inv(jac[part] @ inverse @ jac[part].T)
            total += jac[part].T @ inertia @ wanted
        bias = data.qfrc_bias[:6]
        applied = np.clip(total + bias, -TORQUE_LIMIT, TORQUE_LIMIT)
        return applied - FRICTION_LOSS * np.tanh(speed / 1e-3)


class WipingTwin(wiping.TableWiping):
    """Table wiping whose physics is C MuJoCo's."""

    def __init__(self, env: wiping.TableWiping):
        super().__init__(env.default_params, env.held_out_params)
        self.arm = _Arm(wiping_xml())
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
        _, goal = arm.begin(action, state.goal_rotation)
        for _ in range(SUBSTEPS):
            mujoco.mj_step1(model, data)
            data.qfrc_applied[:6] = arm.torque(goal)
            mujoco.mj_step2(model, data)
        push = np.zeros(3)
        for index in range(data.ncon):
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, index, force)
            frame = data.contact[index].frame.reshape(3, 3)
            push += force[:3] @ frame  # the wiper's point is the pair's second geom
        moved = (data.qpos[:6], data.qvel[:6], data.qacc[:6], goal[1].T, push)
        return self._finish(state, *map(_single, moved), params)


class NutTwin(nut.NutAssembly):
    """Nut assembly whose physics is C MuJoCo's."""

    def __init__(self, env: nut.NutAssembly):
        super().__init__(env.default_params, env.held_out_params)
        arm = self.arm = _Arm(nut_xml())
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
        action, goal = arm.begin(action, state.goal_rotation)
        fingers = np.asarray(state.fingers, float).copy()
        speeds = np.asarray(state.finger_speeds, float).copy()
        dofs, ring, at = self._knuckles, self._ring, self._ring_at
        command, touching = float(state.command), False
        damp = gripper.STIFFNESS * gripper.LAG
        for _ in range(SUBSTEPS):
            command = float(np.clip(command + gripper.RAMP * np.sign(action[6]), -1, 1))
            self._pose_fingers(fingers[1::3])
            mujoco.mj_step1(model, data)
            data.qfrc_applied[:6] = arm.torque(goal)
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

        moved = state.replace(
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


def make_twin(env: Any) -> Any:
    """The C MuJoCo twin of a manipulation world.

    Raises:
        ValueError: For another world.
        ImportError: Without MuJoCo.
    """
    twins = {"table_wiping": WipingTwin, "nut_assembly": NutTwin}
    if env.name not in twins:
        raise ValueError(f"no C MuJoCo twin of {env.name!r}: only of {', '.join(twins)}")
    return twins[env.name](env)
