"""The base of the arm tasks: a pool of starts, experts, and where the grip site is."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import Frames, frames, jacobian, twist_of
from envs.manipulation.randomisation import (
    NOMINAL,
    Factors,
    Ranges,
    draw_factors,
    sensed,
    start_offset,
)
from envs.manipulation.scenes.model import INITIAL_JOINTS, INITIAL_NOISE, TIMESTEP, Tool
from ppl_jax.types import Expert

TRAINING_SCENARIOS = range(1000)
HELD_OUT_SCENARIOS = range(1000, 1050)


class Backend(Protocol):
    """The physics of a task.

    Attributes:
        name: "analytic", "mjx" or "mujoco_c".
    """

    name: str

    def advance(self, state: Any, action: jax.Array, factors: Factors = NOMINAL) -> Any:
        """What a control step with an action in [-1, 1] does to the bodies of a state.

        What is returned is the task's to say: the moved parts of its state, and what was sensed.
        """
        ...


class ArmTask(Environment):
    """Base of the arm tasks: parameters are pools of starts with a field `number`, [S].

    Attributes:
        tool: In the hand.
        base: [3] of the arm in world axes, m.
        default_params, held_out_params: Starts to train on and to evaluate on.
        backend: Physics; None where the task moves the arm itself.
    """

    tool: Tool
    base: np.ndarray

    def __init__(
        self,
        default_params: Any,
        held_out_params: Any,
        experts: Mapping[str, Expert],
        backend: Any = None,
    ):
        """Hold the pools of starts, the experts and the physics.

        Args:
            default_params, held_out_params: Starts to train on and to evaluate on.
            experts: By name; "scripted" is the usual one.
            backend: A `Backend`.
        """
        self.default_params = default_params
        self.held_out_params = held_out_params
        self.experts = experts
        self.backend = backend

    @property
    def physics(self) -> str:
        """Name of the back end."""
        return "analytic" if self.backend is None else self.backend.name

    def with_ranges(self, params: Any, ranges: Ranges | None) -> Any:
        """Parameters whose scenarios are randomised within `ranges`."""
        return dataclasses.replace(params, ranges=ranges)

    def factors(self, state: Any, params: Any) -> Factors:
        """The factors of a state's scenario on the nominal world."""
        if params.ranges is None:
            return NOMINAL
        return draw_factors(params.ranges, params.number[state.scenario])

    def first_joints(self, joints: jax.Array, index: jax.Array, params: Any) -> jax.Array:
        """The joints of scenario `index` at its start, [J] rad, with any start noise."""
        if params.ranges is None:
            return joints
        return joints + start_offset(params.ranges, params.number[index], joints.shape[0])

    def with_sensor_noise(self, observation: jax.Array, state: Any, params: Any) -> jax.Array:
        """The observation [O] of a state as its sensors give it."""
        if params.ranges is None:
            return observation
        return sensed(
            params.ranges,
            observation,
            number=params.number[state.scenario],
            time=state.time,
            scale=self.spec.observation_scale,
        )

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


def first_pose(key: jax.Array) -> jax.Array:
    """The pose at a start, robosuite's with its noise, [6] rad."""
    noise = INITIAL_NOISE * jax.random.normal(key, (6,), jnp.float32)
    return jnp.asarray(INITIAL_JOINTS, jnp.float32) + noise


def lagged_frames(state: Any, tool: Tool) -> Frames:
    """Kinematics one physics step ago: what robosuite observes and rewards.

    MuJoCo's poses are those of the start of its last step; q - h dq is exactly that state.
    """
    return unrolled_linalg.materialize(frames(list(state.joints - TIMESTEP * state.speeds), tool))
