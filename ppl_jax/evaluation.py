"""Evaluation: every scenario of a pool exactly once, all at the same time."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ppl_jax.types import Env, in_single

Act = Callable[[jax.Array, Any, jax.Array, Any], jax.Array]
"""`act(key, state, observation, params) -> action`."""


class Episodes(NamedTuple):
    """One entry per scenario, [S].

    Attributes:
        success: Whether the task was solved.
        episodic_return, episodic_cost: Sums of reward and cost.
        progress: Share of the task done at the end (route completion in driving).
        length: Steps.
    """

    success: jax.Array
    episodic_return: jax.Array
    episodic_cost: jax.Array
    progress: jax.Array
    length: jax.Array


def make_evaluate(
    env: Env, act: Act, *, one_by_one: bool | None = None
) -> Callable[[Any, jax.Array], Episodes]:
    """`evaluate(params, key) -> Episodes`, pure and jittable.

    Episodes run in lock step until the last has ended.

    Args:
        env: The environment.
        act: The policy; it takes all scenarios at once and never sees anything of the expert.
        one_by_one: Step the scenarios one after another, those that have ended left out, instead
            of side by side. None: on a CPU, where a batch of environments gains little.
    """
    if one_by_one is None:
        one_by_one = jax.default_backend() == "cpu"

    def evaluate(params: Any, key: jax.Array) -> Episodes:
        count = env.scenario_count(params)
        key_reset, key_run = jax.random.split(key)
        states = jax.vmap(env.reset_to, in_axes=(0, 0, None))(
            jnp.arange(count, dtype=jnp.int32), jax.random.split(key_reset, count), params
        )
        zero = jnp.zeros(count, jnp.float32)
        start = Episodes(
            success=jnp.zeros(count, bool),
            episodic_return=zero,
            episodic_cost=zero,
            progress=zero,
            length=jnp.zeros(count, jnp.int32),
        )

        def observe(state: Any) -> jax.Array:
            return env.observe(state, params)

        def one(key: jax.Array, state: Any, action: jax.Array) -> Any:
            state, outcome = env.transition(key, state, action, params)
            return state, observe(state), outcome

        def one_if(lane: Any) -> Any:
            alive, key, state, observation, action = lane
            nothing = jax.tree.map(
                lambda leaf: jnp.zeros(leaf.shape, leaf.dtype),
                jax.eval_shape(env.transition, key, state, action, params)[1],
            )
            return jax.lax.cond(
                alive,
                one,
                lambda key, state, action: (state, observation, nothing),
                *(key, state, action),
            )

        def step(carry: Any) -> Any:
            key, states, observations, alive, so_far, time = carry
            key, key_step = jax.random.split(key)
            keys = jax.vmap(jax.random.split)(jax.random.split(key_step, count))
            actions = jax.vmap(act, in_axes=(0, 0, 0, None))(
                keys[:, 0], states, observations, params
            )
            if one_by_one:
                lanes = (alive, keys[:, 1], states, observations, actions)
                states, observations, out = jax.lax.map(one_if, lanes)
            else:
                states, observations, out = jax.vmap(one)(keys[:, 1], states, actions)
            out = in_single(out)
            so_far = Episodes(
                success=so_far.success | (alive & out.success),
                episodic_return=so_far.episodic_return + jnp.where(alive, out.reward, 0.0),
                episodic_cost=so_far.episodic_cost + jnp.where(alive, out.cost, 0.0),
                progress=jnp.where(alive, out.progress, so_far.progress),
                length=so_far.length + alive.astype(jnp.int32),
            )
            alive = alive & ~(out.terminated | out.truncated)
            return key, states, observations, alive, so_far, time + 1

        def running(carry: Any) -> jax.Array:
            *_, alive, _, time = carry
            return jnp.any(alive) & (time < env.max_episode_steps)

        first = jax.lax.map(observe, states) if one_by_one else jax.vmap(observe)(states)
        alive = jnp.ones(count, bool)
        carry = (key_run, states, first, alive, start, jnp.zeros((), jnp.int32))
        *_, episodes, _ = jax.lax.while_loop(running, step, carry)
        return episodes

    return evaluate


@functools.partial(jax.jit, static_argnums=(0, 1))
def _evaluate(env: Env, act: Act, params: Any, key: jax.Array) -> Episodes:
    return make_evaluate(env, act)(params, key)


def evaluate(env: Env, act: Act, params: Any, key: jax.Array) -> Episodes:
    """Play every scenario of `params` once (compiled per `env` and `act`)."""
    return _evaluate(env, act, params, key)
