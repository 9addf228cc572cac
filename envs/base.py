"""What every world shares: stepping with an automatic reset that draws a NEW start."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from ppl_jax.types import EnvSpec, Outcome, StepInfo


class Environment:
    """Base class of worlds: fill in `reset_to`, `transition`, `observe`, `scenario_count`.

    The shape is gymnax 1.0's. See `ppl_jax.types.Env` for the methods' contracts and attributes.
    """

    name: str
    spec: EnvSpec
    max_episode_steps: int
    sequential_on_cpu: bool = False

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

    @property
    def predictors(self) -> Mapping[str, Any]:
        """Transitions that predictions may use, by name; "simulator" is the environment's own."""
        return {"simulator": self.transition}

    def scenario_count(self, params: Any) -> int:
        """Number of scenarios in `params`."""
        raise NotImplementedError(f"{type(self).__name__}.scenario_count")

    def reset(self, key: jax.Array, params: Any) -> tuple[jax.Array, Any]:
        """Draw a scenario and start it."""
        key_index, key_start = jax.random.split(key)
        index = jax.random.randint(key_index, (), 0, self.scenario_count(params))
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
            key_reset, outcome.terminated | outcome.truncated, state, final, params
        )
        info = StepInfo(
            outcome.cost, outcome.success, outcome.unsafe, outcome.progress, outcome.speed, final
        )
        return observation, state, outcome.reward, outcome.terminated, outcome.truncated, info

    def auto_reset(
        self, key: jax.Array, done: jax.Array, state: Any, observation: jax.Array, params: Any
    ) -> tuple[jax.Array, Any]:
        """(observation, state) to go on from: a new random start where `done`."""

        def restart(_: Any) -> tuple[jax.Array, Any]:
            return self.reset(key, params)

        # a scalar condition really branches; under vmap it becomes a select
        return jax.lax.cond(done, restart, lambda _: (observation, state), jnp.zeros(()))
