"""The base of every environment: stepping with an automatic reset that draws a NEW start."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from ppl_jax.cards import EnvCard, card
from ppl_jax.types import EnvSpec, Expert, Outcome, StepInfo, Transition


class Environment:
    """Base class of environments: fill in `reset_to`, `transition`, `observe`, `scenario_count`.

    The shape is gymnax 1.0's. See `ppl_jax.types.Env` for the methods' contracts and attributes. A
    method `scripted_expert(key, state, observation, params)`, where a class has one, becomes
    `experts["scripted"]`; an environment with several experts sets `experts` itself.
    """

    name: str
    spec: EnvSpec
    max_episode_steps: int
    default_params: Any
    held_out_params: Any

    if TYPE_CHECKING:  # a protocol's attribute cannot be a cached property to a type checker
        experts: Mapping[str, Expert]
        predictors: Mapping[str, Transition]
    else:

        @functools.cached_property
        def experts(self) -> Mapping[str, Expert]:
            """Experts by name; empty where there is none."""
            scripted = getattr(self, "scripted_expert", None)
            return {} if scripted is None else {"scripted": scripted}

        @functools.cached_property
        def predictors(self) -> Mapping[str, Transition]:
            """Steps that the predictor may roll forward, by name: "simulator" is the true one."""
            return {"simulator": self.transition}

    @property
    def card(self) -> EnvCard:
        """Facts that are known without building it."""
        return card(self.name)

    def reset_to(self, index: jax.Array, key: jax.Array, params: Any) -> Any:
        """The start of scenario `index`."""
        raise NotImplementedError(f"{type(self).__name__}.reset_to")

    def transition(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any
    ) -> tuple[Any, Outcome]:
        """One raw step."""
        raise NotImplementedError(f"{type(self).__name__}.transition")

    def observe(self, state: Any, params: Any) -> jax.Array:
        """The observation, [O]."""
        raise NotImplementedError(f"{type(self).__name__}.observe")

    def scenario_count(self, params: Any) -> int:
        """Number of scenarios in `params`."""
        raise NotImplementedError(f"{type(self).__name__}.scenario_count")

    def scenario_numbers(self, params: Any) -> jax.Array:
        """Number that results name each scenario by, [S]: 0, 1, 2, ... unless overridden."""
        return jnp.arange(self.scenario_count(params), dtype=jnp.int32)

    def readings(self, state: Any) -> list[tuple[str, str]]:
        """Figures of a concrete state to show a person, as (label, text); none by default."""
        del state
        return []

    def reset(self, key: jax.Array, params: Any) -> tuple[jax.Array, Any]:
        """Draw a scenario and start it."""
        key_index, key_start = jax.random.split(key)
        index = jax.random.randint(key_index, (), 0, self.scenario_count(params), jnp.int32)
        state = self.reset_to(index, key_start, params)
        return self.observe(state, params), state

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, StepInfo]:
        """One step; where the episode ends, the returned state and observation are a new start's.

        `info.final_observation` keeps the observation before the reset.
        """
        key_step, key_reset = jax.random.split(key)
        state, outcome = self.transition(key_step, state, action, params)
        final = self.observe(state, params)
        observation, state = self.auto_reset(
            key_reset, outcome.terminated | outcome.truncated, state, final, params=params
        )
        info = StepInfo(
            cost=outcome.cost,
            success=outcome.success,
            unsafe=outcome.unsafe,
            progress=outcome.progress,
            speed=outcome.speed,
            final_observation=final,
        )
        return observation, state, outcome.reward, outcome.terminated, outcome.truncated, info

    def auto_reset(
        self, key: jax.Array, done: jax.Array, state: Any, observation: jax.Array, *, params: Any
    ) -> tuple[jax.Array, Any]:
        """(observation, state) to continue from: a new random start where `done`."""

        def restart(_: Any) -> tuple[jax.Array, Any]:
            return self.reset(key, params)

        # a scalar condition really branches; under vmap it becomes a select
        return jax.lax.cond(
            done, restart, lambda _: (observation, state), jnp.zeros((), jnp.float32)
        )
