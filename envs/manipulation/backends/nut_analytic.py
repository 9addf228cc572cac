"""Nut assembly on the hand-written physics: the fast path on a CPU."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.control import operational_space
from envs.manipulation.physics.analytic import gripper, unrolled_linalg
from envs.manipulation.physics.analytic.arm import bias_torque, frames
from envs.manipulation.physics.analytic.grasp_contact import Ring, hold
from envs.manipulation.physics.analytic.quaternion import rotation_matrix, turned
from envs.manipulation.physics.lanes import one_after_another
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import GRIPPER, NUT_BASE, SUBSTEPS, TIMESTEP
from envs.manipulation.tasks.nut import NutState

_BASE = np.array(NUT_BASE, np.float32)


class NutAnalytic:
    """25 steps of 2 ms: arm, fingers and ring with their contacts as one convex problem."""

    name = "analytic"

    def advance(self, state: NutState, action: jax.Array, factors: Factors = NOMINAL) -> NutState:
        """The state after one control step of 0.05 s, contact flag included.

        Args:
            state: State.
            action: [7] in [-1, 1].
            factors: Of the scenario on the nominal world.
        """
        return one_after_another(_advance, state, action, factors)


def _advance(state: NutState, action: jax.Array, factors: Factors) -> NutState:
    at = unrolled_linalg.materialize(frames(list(state.joints), GRIPPER))
    first, second, third = state.goal_rotation
    held = (tuple(first), tuple(second), tuple(third))
    goal = unrolled_linalg.materialize(
        operational_space.new_goal(list(action[:6]), at.position, at.rotation, held)
    )
    weight = unrolled_linalg.materialize(bias_torque(at, GRIPPER, list(state.speeds)))
    grip = gripper.RAMP * jnp.sign(action[6])

    def step(s: NutState, _: None) -> tuple[NutState, None]:
        command = jnp.clip(s.command + grip, -1.0, 1.0)
        motion = operational_space.free_motion(
            list(s.joints),
            list(s.speeds),
            goal=goal,
            tool=GRIPPER,
            weight=weight,
            factors=factors,
        )
        ring = Ring(
            position=s.position - _BASE,
            rotation=rotation_matrix(s.quaternion),
            velocity=s.velocity,
            spin=s.spin,
        )
        knuckles, inner, outer = s.fingers[::3], s.fingers[1::3], s.fingers[2::3]
        result = hold(
            motion,
            ring,
            fingers=knuckles,
            finger_speeds=s.finger_speeds[::3],
            inner=inner,
            command=command,
            start=s.acceleration,
            factors=factors,
        )
        a = result.acceleration
        speeds = s.speeds + TIMESTEP * a[:6]
        knuckle_speeds = s.finger_speeds[::3] + TIMESTEP * a[6:8]
        knuckles = knuckles + TIMESTEP * knuckle_speeds
        inner_speeds, outer_speeds = gripper.follow(knuckles, inner, outer, result.squeeze)
        velocity, spin = s.velocity + TIMESTEP * a[8:11], s.spin + TIMESTEP * a[11:]
        return dataclasses.replace(
            s,
            joints=s.joints + TIMESTEP * speeds,
            speeds=speeds,
            acceleration=a,
            fingers=jnp.stack(
                [knuckles, inner + TIMESTEP * inner_speeds, outer + TIMESTEP * outer_speeds], -1
            ).reshape(6),
            finger_speeds=jnp.stack([knuckle_speeds, inner_speeds, outer_speeds], -1).reshape(6),
            command=command,
            touching=jnp.all(result.touching),
            position=s.position + TIMESTEP * velocity,
            quaternion=turned(s.quaternion, spin, TIMESTEP),
            velocity=velocity,
            spin=spin,
        ), None

    start = dataclasses.replace(state, goal_rotation=unrolled_linalg.array(goal[1]))
    return jax.lax.scan(step, start, None, length=SUBSTEPS)[0]
