"""Brax environments as ours, and ours as brax environments. Imports brax, lazily.

brax's own training loops start every later episode of a lane from its first, cached start. Ours
draw a new start each time, in both directions.
"""

from __future__ import annotations

import dataclasses
import importlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from ppl_jax.types import Env, EnvSpec, Outcome

TRAINING_SCENARIOS = range(1000)
HELD_OUT_SCENARIOS = range(1_000_000, 1_000_050)


def _brax() -> Any:
    """The module `brax.envs`; seconds at first.

    Raises:
        ValueError: If brax is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of its own dependencies
            return importlib.import_module("brax.envs")
    except ImportError as error:
        raise ValueError(
            f'environments of brax need the package brax ({error}): pip install "ppl-jax[brax]"'
        ) from error


@flax.struct.dataclass
class BraxParams:
    """Numbers of the scenarios, [S]: each is the seed of a start."""

    number: jax.Array


@flax.struct.dataclass
class BraxState:
    """brax's state and the steps so far."""

    inner: Any
    time: jax.Array


def _nothing(state: Any) -> jax.Array:
    return jnp.zeros((), jnp.float32)


class FromBrax(Environment):
    """A brax environment as one of our environments.

    brax knows no success, cost or time limit. By default nothing costs, and to last until time is
    up is to succeed (`Outcome.terminated` is brax's `done`).
    """

    def __init__(
        self,
        inner: Any,
        name: str,
        max_episode_steps: int = 1000,
        cost: Callable[[Any], jax.Array] = _nothing,
        success: Callable[[Any], jax.Array] | None = None,
        training: Sequence[int] = TRAINING_SCENARIOS,
        held_out: Sequence[int] = HELD_OUT_SCENARIOS,
    ):
        """Wrap `inner`, without brax's own wrappers.

        Args:
            inner: A `brax.envs.Env` whose observation is one array and whose actions lie in
                [-1, 1].
            name: As in results.
            max_episode_steps: Time limit.
            cost, success: Functions of brax's state after a step.
            training, held_out: Seeds of the starts to train and to evaluate on.

        Raises:
            ValueError: If the observation is not one flat array.
        """
        self.inner, self.name, self.max_episode_steps = inner, name, max_episode_steps
        self._cost, self._success = cost, success
        observation = jax.eval_shape(inner.reset, jax.random.key(0)).obs
        if not hasattr(observation, "shape") or len(observation.shape) != 1:
            raise ValueError(f"{name}: the observation must be one flat array, got {observation}")
        size = observation.shape[0]
        zeros, ones = np.zeros(size, np.float32), np.ones(size, np.float32)
        self.spec = EnvSpec(
            observation_size=size,
            action_size=inner.action_size,
            observation_mean=zeros,
            observation_scale=ones,
        )
        self.default_params = BraxParams(jnp.asarray(training, jnp.int32))
        self.held_out_params = BraxParams(jnp.asarray(held_out, jnp.int32))

    def scenario_numbers(self, params: BraxParams) -> jax.Array:
        """Seeds of the pool, [S]."""
        return params.number

    def scenario_count(self, params: BraxParams) -> int:
        """Number of scenarios in the pool."""
        return params.number.shape[0]

    def reset_to(self, index: jax.Array, key: jax.Array, params: BraxParams) -> BraxState:
        """The start of scenario `index`."""
        del key  # a scenario is deterministic
        state = self.inner.reset(jax.random.key(params.number[index]))
        return BraxState(state, jnp.zeros((), jnp.int32))

    def transition(
        self, key: jax.Array, state: BraxState, action: jax.Array, params: BraxParams
    ) -> tuple[BraxState, Outcome]:
        """One step of brax, without reset."""
        del key, params
        inner, time = self.inner.step(state.inner, action), state.time + 1
        terminated, over = inner.done > 0, time >= self.max_episode_steps
        lasted = over & ~terminated
        cost = jnp.asarray(self._cost(inner), jnp.float32)
        return BraxState(inner, time), Outcome(
            reward=inner.reward,
            terminated=terminated,
            truncated=over,
            cost=cost,
            success=lasted if self._success is None else jnp.asarray(self._success(inner), bool),
            unsafe=cost > 0,
            progress=time / self.max_episode_steps,
            speed=jnp.zeros((), jnp.float32),
        )

    def observe(self, state: BraxState, params: BraxParams) -> jax.Array:
        """The observation, as it is in brax."""
        del params
        return state.inner.obs


def make_brax(name: str, **options: Any) -> FromBrax:
    """A registered brax environment, such as "inverted_pendulum"; options as of `FromBrax`.

    Raises:
        ValueError: If brax is missing or knows no such environment.
    """
    module = _brax()
    known = sorted(module._envs)
    if name not in known:
        raise ValueError(f"unknown brax environment {name!r}: choose one of {', '.join(known)}")
    return FromBrax(module.get_environment(name), f"brax:{name}", **options)


def to_brax(env: Env, params: Any = None, auto_reset: bool = True) -> Any:
    """One of our environments as a `brax.envs.Env`.

    `metrics` has cost, success and progress. With `auto_reset` the state after an episode's end is
    a new start (`done` and `info["truncation"]` tell, `info["final_observation"]` keeps the last
    observation), so it goes under brax's `VmapWrapper` alone. Without, it is for `wrappers.wrap`,
    which adds brax's time limit and its cached resets.

    Args:
        env: The environment.
        params: Its parameters; its training ones where None.
        auto_reset: Start anew where an episode ends.

    Raises:
        ValueError: If brax is missing.
    """
    module = _brax()
    given = env.default_params if params is None else params

    class ToBrax(module.Env):
        """See `to_brax`."""

        def reset(self, rng: jax.Array) -> Any:
            key, key_start = jax.random.split(rng)
            observation, state = env.reset(key_start, given)
            zero = jnp.zeros((), jnp.float32)
            return module.State(
                state,
                observation,
                zero,
                zero,
                {"cost": zero, "success": zero, "progress": zero},
                {"key": key, "truncation": zero, "final_observation": observation},
            )

        def step(self, state: Any, action: jax.Array) -> Any:
            key, key_step = jax.random.split(state.info["key"])
            before = state.pipeline_state
            if auto_reset:
                made = env.step(key_step, before, action, given)
                observation, after, reward, terminated, truncated, outcome = made
                final = outcome.final_observation
            else:
                after, outcome = env.transition(key_step, before, action, given)
                observation = final = env.observe(after, given)
                reward, terminated = outcome.reward, outcome.terminated
                truncated = outcome.truncated
            metrics = {
                name: 1.0 * getattr(outcome, name) for name in ("cost", "success", "progress")
            }
            info = {
                "key": key,
                "truncation": 1.0 * (truncated & ~terminated),
                "final_observation": final,
            }
            return dataclasses.replace(
                state,
                pipeline_state=after,
                obs=observation,
                reward=reward,
                done=1.0 * (terminated | truncated),
                metrics=state.metrics | metrics,
                info=state.info | info,
            )

        @property
        def observation_size(self) -> int:
            return env.spec.observation_size

        @property
        def action_size(self) -> int:
            return env.spec.action_size

        @property
        def backend(self) -> str:
            return "ppl_jax"

    return ToBrax()
