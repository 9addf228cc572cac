"""The base of the arm tasks: a pool of starts, experts, and where the grip site is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import Frames, frames, jacobian, twist_of
from envs.manipulation.scenes.model import TIMESTEP, Tool
from ppl_jax.types import Expert


class ArmTask(Environment):
    """Base of the arm tasks: parameters are pools of starts with a field `number`, [S].

    Attributes:
        tool: In the hand.
        base: [3] of the arm in world axes, m.
        default_params, held_out_params: Starts to train on and to evaluate on.
    """

    tool: Tool
    base: np.ndarray
    sequential_on_cpu = True

    def __init__(self, default_params: Any, held_out_params: Any, experts: Mapping[str, Expert]):
        """Hold the pools of starts and the experts.

        Args:
            default_params, held_out_params: Starts to train on and to evaluate on.
            experts: By name; "scripted" is the usual one.
        """
        self.default_params = default_params
        self.held_out_params = held_out_params
        self.experts = experts

    @property
    def scripted_expert(self) -> Expert:
        """The expert "scripted"."""
        return self.experts["scripted"]

    def scenario_numbers(self, params: Any) -> jax.Array:
        """Numbers of the pool's scenarios, [S]."""
        return params.number

    def scenario_count(self, params: Any) -> int:
        """Number of scenarios in the pool."""
        return params.number.shape[0]

    def grip_position(self, state: Any) -> jax.Array:
        """Where the grip site is, [3] m in world axes."""
        return jnp.stack(lagged_frames(state, self.tool).position) + self.base

    def grip_velocity(self, state: Any) -> jax.Array:
        """Velocity of the grip site, [3] m/s."""
        at = lagged_frames(state, self.tool)
        return jnp.stack(twist_of(jacobian(at), list(state.speeds))[0])


def site_rotation(joints: jax.Array, tool: Tool) -> jax.Array:
    """Axes of the grip site as rows, [3, 3]: the orientation goal at the start of an episode."""
    return unrolled_linalg.array(frames(list(joints), tool).rotation)


def lagged_frames(state: Any, tool: Tool) -> Frames:
    """Kinematics one physics step ago: what robosuite observes and rewards.

    MuJoCo's poses are those of the start of its last step; q - h dq is exactly that state.
    """
    return unrolled_linalg.materialize(frames(list(state.joints - TIMESTEP * state.speeds), tool))
