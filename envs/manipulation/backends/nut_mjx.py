"""Nut assembly on MJX: the twin's MJCF; the gripper's law moves the pads' spheres."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from envs.manipulation.backends.wiping_mjx import without_air
from envs.manipulation.control.gripper_on_mjx import Fingers, TwoFingerGripper
from envs.manipulation.control.on_mjx import ur5e
from envs.manipulation.physics.analytic.quaternion import rotation_matrix
from envs.manipulation.physics.lanes import one_after_another
from envs.manipulation.physics.may_close import on_long_sides
from envs.manipulation.physics.mjx.places import with_values
from envs.manipulation.physics.mjx.scene import Bodies, Scene
from envs.manipulation.physics.mujoco_c import nut_xml
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import (
    GRIPPER,
)
from envs.manipulation.tasks.nut import NutState


class NutMjx:
    """25 steps of 2 ms: arm, fingers and ring with their contacts."""

    name = "mjx"

    def __init__(self, solver: str | None = None):
        """Compile the scene.

        Args:
            solver: Of contacts; see `Scene`.
        """
        scene = self.scene = Scene(without_air(nut_xml()), solver=solver, may_close=on_long_sides)
        self.arm = ur5e(scene, GRIPPER)
        self.gripper = TwoFingerGripper(scene, holds="handle")
        self.ring_at, self.ring_dofs = scene.free_joint("ring")
        self.ring = scene.body("ring")

    def bodies(self, state: NutState) -> Bodies:
        """MuJoCo's state of a task's state."""
        model, turn = self.scene.model, rotation_matrix(state.quaternion)
        qpos = jnp.zeros(model.nq, jnp.float32)
        qvel = warm = jnp.zeros(model.nv, jnp.float32)
        last = state.acceleration
        ring = jnp.concatenate([state.position, state.quaternion])
        qpos = qpos.at[self.arm.qpos].set(state.joints).at[self.ring_at].set(ring)
        qpos = qpos.at[self.gripper.at].set(state.fingers[::3])
        motion = jnp.concatenate([state.velocity, turn.T @ state.spin])
        qvel = qvel.at[self.arm.dofs].set(state.speeds).at[self.ring_dofs].set(motion)
        qvel = qvel.at[self.gripper.dofs].set(state.finger_speeds[::3])
        motion = jnp.concatenate([last[8:11], turn.T @ last[11:]])
        warm = warm.at[self.arm.dofs].set(last[:6]).at[self.ring_dofs].set(motion)
        warm = warm.at[self.gripper.dofs].set(last[6:8])
        return dataclasses.replace(self.scene.start(qpos), qvel=qvel, warm=warm)

    def advance(self, state: NutState, action: jax.Array, factors: Factors = NOMINAL) -> NutState:
        """The state after one control step of 0.05 s; see `NutAnalytic.advance`."""
        return one_after_another(self._advance, state, action, factors)

    def _advance(self, state: NutState, action: jax.Array, factors: Factors) -> NutState:
        scene, arm = self.scene, self.arm
        put, bodies = scene.varied(factors, [self.ring]), self.bodies(state)
        goal = arm.goal(scene.placed(bodies, put), action, state.goal_rotation.T)

        def torque(data: Any) -> jax.Array:
            own = arm.torque(data, goal, factors)
            return with_values(jnp.zeros_like(data.qvel), arm.dofs, own)

        def step(carry: tuple[Bodies, Fingers], _: None) -> tuple[tuple[Bodies, Fingers], None]:
            moved = self.gripper.step(*carry, action=action[6], torque=torque, put=put)
            return moved[:2], None

        fingers = Fingers(
            inner=state.fingers[1::3],
            outer=state.fingers[2::3],
            inner_speed=state.finger_speeds[1::3],
            outer_speed=state.finger_speeds[2::3],
            command=state.command,
            touching=jnp.broadcast_to(state.touching, 2),
        )
        (bodies, fingers), _ = jax.lax.scan(step, (bodies, fingers), None, length=scene.substeps)
        return self.state(state, bodies, fingers, goal.rotation)

    def state(
        self, before: NutState, bodies: Bodies, fingers: Fingers, goal: jax.Array
    ) -> NutState:
        """The task's state of MuJoCo's."""
        ring, motion = bodies.qpos[self.ring_at], bodies.qvel[self.ring_dofs]
        turn, last = rotation_matrix(ring[3:]), bodies.warm[self.ring_dofs]
        joints, speeds = self.gripper.joints(bodies, fingers)
        return dataclasses.replace(
            before,
            joints=bodies.qpos[self.arm.qpos],
            speeds=bodies.qvel[self.arm.dofs],
            acceleration=jnp.concatenate(
                [
                    bodies.warm[self.arm.dofs],
                    bodies.warm[self.gripper.dofs],
                    last[:3],
                    turn @ last[3:],
                ]
            ),
            goal_rotation=goal.T,
            fingers=joints,
            finger_speeds=speeds,
            command=fingers.command,
            touching=jnp.all(fingers.touching),
            position=ring[:3],
            quaternion=ring[3:],
            velocity=motion[:3],
            spin=turn @ motion[3:],
        )
