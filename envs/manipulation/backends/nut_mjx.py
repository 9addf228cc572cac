"""Nut assembly on MJX: the twin's MJCF; the gripper's law moves the pads' spheres."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.backends.wiping_mjx import without_air
from envs.manipulation.control.on_mjx import OperationalSpace
from envs.manipulation.physics.analytic import gripper
from envs.manipulation.physics.analytic.quaternion import rotation_matrix
from envs.manipulation.physics.mjx.scene import Bodies, Scene
from envs.manipulation.physics.mujoco_c import nut_xml
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import (
    ARM_JOINTS,
    FRICTION_LOSS,
    GRIPPER,
    TIMESTEP,
    TORQUE_LIMIT,
)
from envs.manipulation.tasks.nut import NutState

KNUCKLES = tuple(f"{side}_knuckle" for side in gripper.SIDES)


class Fingers(NamedTuple):
    """What the gripper's law carries between physics steps.

    Attributes:
        inner, outer: [2] inner fingers and inner knuckles, rad.
        inner_speed, outer_speed: [2] rad/s.
        command: Of the gripper, -1 open to 1 closed.
        touching: Both pads touch the ring.
    """

    inner: jax.Array
    outer: jax.Array
    inner_speed: jax.Array
    outer_speed: jax.Array
    command: jax.Array
    touching: jax.Array


class NutMjx:
    """25 steps of 2 ms: arm, fingers and ring with their contacts."""

    name = "mjx"
    sequential_on_cpu = False

    def __init__(self, solver: str | None = None):
        """Compile the scene.

        Args:
            solver: Of contacts; see `Scene`.
        """
        scene = self.scene = Scene(without_air(nut_xml()), solver=solver)
        self.arm = OperationalSpace(
            scene,
            joints=ARM_JOINTS,
            site="grip",
            torque_limit=TORQUE_LIMIT,
            friction=FRICTION_LOSS,
            tool=GRIPPER,
        )
        self.knuckles_at, self.knuckles = scene.joints(KNUCKLES)
        self.ring_at, self.ring_dofs = scene.free_joint("ring")
        self.ring = scene.body("ring")
        self.spheres = np.array(
            [[scene.geom(n) for n in (*gripper.PADS[s], *gripper.TIPS[s])] for s in gripper.SIDES]
        )
        self.on_handle = [scene.contacts(f"{side}_", "handle") for side in gripper.SIDES]

    def bodies(self, state: NutState) -> Bodies:
        """MuJoCo's state of a task's state."""
        model, turn = self.scene.model, rotation_matrix(state.quaternion)
        qpos, qvel, warm = jnp.zeros(model.nq), jnp.zeros(model.nv), jnp.zeros(model.nv)
        last = state.acceleration
        ring = jnp.concatenate([state.position, state.quaternion])
        qpos = qpos.at[self.arm.qpos].set(state.joints).at[self.ring_at].set(ring)
        qpos = qpos.at[self.knuckles_at].set(state.fingers[::3])
        motion = jnp.concatenate([state.velocity, turn.T @ state.spin])
        qvel = qvel.at[self.arm.dofs].set(state.speeds).at[self.ring_dofs].set(motion)
        qvel = qvel.at[self.knuckles].set(state.finger_speeds[::3])
        motion = jnp.concatenate([last[8:11], turn.T @ last[11:]])
        warm = warm.at[self.arm.dofs].set(last[:6]).at[self.ring_dofs].set(motion)
        warm = warm.at[self.knuckles].set(last[6:8])
        return self.scene.start(qpos).replace(qvel=qvel, warm=warm)

    def advance(
        self, state: NutState, action: jax.Array, factors: Factors = NOMINAL
    ) -> NutState:
        """The state after one control step of 0.05 s; see `NutAnalytic.advance`."""
        scene, arm = self.scene, self.arm
        put, bodies = scene.varied(factors, [self.ring]), self.bodies(state)
        goal = arm.goal(scene.placed(bodies, put), action, state.goal_rotation.T)
        grip = gripper.RAMP * jnp.sign(action[6])

        def step(carry: tuple[Bodies, Fingers], _: None) -> tuple[tuple[Bodies, Fingers], None]:
            bodies, fingers = carry
            command = jnp.clip(fingers.command + grip, -1.0, 1.0)
            spheres = gripper.pad_spheres(bodies.qpos[self.knuckles_at], fingers.inner)
            posed = put.replace(geom_pos=put.geom_pos.at[self.spheres].set(spheres))

            def control(data: Any) -> Any:
                servo = gripper.servo(
                    command, data.qpos[self.knuckles_at], data.qvel[self.knuckles]
                )
                torque = jnp.zeros_like(data.qvel).at[self.knuckles].set(servo)
                torque = torque.at[arm.dofs].set(arm.torque(data, goal, factors))
                return data.replace(qfrc_applied=torque)

            data = scene.step(scene.data(bodies), control, posed)
            squeeze = jnp.stack([jnp.sum(scene.normal(data, rows)) for rows in self.on_handle])
            touching = [scene.touching(data, rows) for rows in self.on_handle]
            inner_speed, outer_speed = gripper.follow(
                data.qpos[self.knuckles_at], fingers.inner, fingers.outer, squeeze
            )
            fingers = Fingers(
                inner=fingers.inner + TIMESTEP * inner_speed,
                outer=fingers.outer + TIMESTEP * outer_speed,
                inner_speed=inner_speed,
                outer_speed=outer_speed,
                command=command,
                touching=touching[0] & touching[1],
            )
            return (scene.kept(bodies, data), fingers), None

        fingers = Fingers(
            inner=state.fingers[1::3],
            outer=state.fingers[2::3],
            inner_speed=state.finger_speeds[1::3],
            outer_speed=state.finger_speeds[2::3],
            command=state.command,
            touching=state.touching,
        )
        (bodies, fingers), _ = jax.lax.scan(step, (bodies, fingers), None, length=scene.substeps)
        return self.state(state, bodies, fingers, goal.rotation)

    def state(
        self, before: NutState, bodies: Bodies, fingers: Fingers, goal: jax.Array
    ) -> NutState:
        """The task's state of MuJoCo's."""
        ring, motion = bodies.qpos[self.ring_at], bodies.qvel[self.ring_dofs]
        turn, last = rotation_matrix(ring[3:]), bodies.warm[self.ring_dofs]
        knuckles, speeds = bodies.qpos[self.knuckles_at], bodies.qvel[self.knuckles]
        return before.replace(  # pyright: ignore[reportAttributeAccessIssue]
            joints=bodies.qpos[self.arm.qpos],
            speeds=bodies.qvel[self.arm.dofs],
            acceleration=jnp.concatenate(
                [
                    bodies.warm[self.arm.dofs],
                    bodies.warm[self.knuckles],
                    last[:3],
                    turn @ last[3:],
                ]
            ),
            goal_rotation=goal.T,
            fingers=jnp.stack([knuckles, fingers.inner, fingers.outer], -1).reshape(6),
            finger_speeds=jnp.stack(
                [speeds, fingers.inner_speed, fingers.outer_speed], -1
            ).reshape(6),
            command=fingers.command,
            touching=fingers.touching,
            position=ring[:3],
            quaternion=ring[3:],
            velocity=motion[:3],
            spin=turn @ motion[3:],
        )
