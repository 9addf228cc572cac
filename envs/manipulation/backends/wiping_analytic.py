"""Table wiping on the hand-written physics: the fast path on a CPU."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from envs.manipulation.control import operational_space
from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import bias_torque, frames
from envs.manipulation.physics.analytic.wipe_contact import FRICTION, press
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import SUBSTEPS, TIMESTEP, WIPER
from envs.manipulation.tasks.wiping import Moved, WipingState


class WipingAnalytic:
    """25 steps of 2 ms: the arm in closed form, the wiper's 56 points by Newton's method."""

    name = "analytic"

    def advance(self, state: WipingState, action: jax.Array, factors: Factors = NOMINAL) -> Moved:
        """The arm after one control step of 0.05 s.

        Args:
            state: State.
            action: [6] in [-1, 1].
            factors: Of the scenario on the nominal world.
        """
        tool = WIPER.heavier(factors.mass)
        at = unrolled_linalg.materialize(frames(list(state.joints), tool))
        first, second, third = state.goal_rotation
        held = (tuple(first), tuple(second), tuple(third))
        goal = unrolled_linalg.materialize(
            operational_space.new_goal(list(action), at.position, at.rotation, held)
        )
        weight = unrolled_linalg.materialize(bias_torque(at, tool, list(state.speeds)))
        friction = FRICTION * factors.friction

        def step(carry: Any, _: None) -> tuple[Any, None]:
            joints, speeds, acceleration, _ = carry
            motion = operational_space.free_motion(
                list(joints), list(speeds), goal=goal, tool=tool, weight=weight, factors=factors
            )
            touch = press(motion, acceleration, friction)
            speeds = speeds + TIMESTEP * touch.acceleration
            return (joints + TIMESTEP * speeds, speeds, touch.acceleration, touch.force), None

        carry = (state.joints, state.speeds, state.acceleration, jnp.zeros(3, jnp.float32))
        joints, speeds, acceleration, force = jax.lax.scan(step, carry, None, length=SUBSTEPS)[0]
        return Moved(
            joints=joints,
            speeds=speeds,
            acceleration=acceleration,
            goal_rotation=unrolled_linalg.array(goal[1]),
            push=force,
        )
