"""Evaluation: every scenario of a pool exactly once, all at the same time."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ppl_jax.types import Env

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


def make_evaluate(env: Env, act: Act) -> Callable[[Any, jax.Array], Episodes]:
    """`evaluate(params, key) -> Episodes`, pure and jittable.

    `act` is called on one environment at a time; it never sees anything of the expert. Episodes run
    in lock step until the last has ended.
    """
    sequential_on_cpu = env.sequential_on_cpu and jax.default_backend() == "cpu"

    def evaluate(params: Any, key: jax.Array) -> Episodes:
        count = env.scenario_count(params)
        key_reset, key_run = jax.random.split(key)
        states = jax.vmap(env.reset_to, in_axes=(0, 0, None))(
            jnp.arange(count), jax.random.split(key_reset, count), params
        )
        zero = jnp.zeros(count)
        start = Episodes(
            success=jnp.zeros(count, bool),
            episodic_return=zero,
            episodic_cost=zero,
            progress=zero,
            length=jnp.zeros(count, jnp.int32),
        )

        def one(key: jax.Array, state: Any) -> Any:
            key_act, key_step = jax.random.split(key)
            action = act(key_act, state, env.observe(state, params), params)
            return env.transition(key_step, state, action, params)

        def one_if(lane: Any) -> Any:
            alive, key, state = lane
            nothing = jax.tree.map(
                lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, key, state)[1]
            )
            return jax.lax.cond(alive, one, lambda _, state: (state, nothing), key, state)

        def step(carry: Any) -> Any:
            key, states, alive, so_far, time = carry
            key, key_step = jax.random.split(key)
            keys = jax.random.split(key_step, count)
            if sequential_on_cpu:
                states, out = jax.lax.map(one_if, (alive, keys, states))
            else:
                states, out = jax.vmap(one)(keys, states)
            so_far = Episodes(
                success=so_far.success | (alive & out.success),
                episodic_return=so_far.episodic_return + alive * out.reward,
                episodic_cost=so_far.episodic_cost + alive * out.cost,
                progress=jnp.where(alive, out.progress, so_far.progress),
                length=so_far.length + alive,
            )
            alive = alive & ~(out.terminated | out.truncated)
            return key, states, alive, so_far, time + 1

        def running(carry: Any) -> jax.Array:
            return jnp.any(carry[2]) & (carry[4] < env.max_episode_steps)

        carry = (key_run, states, jnp.ones(count, bool), start, jnp.zeros((), jnp.int32))
        return jax.lax.while_loop(running, step, carry)[3]

    return evaluate


@functools.partial(jax.jit, static_argnums=(0, 1))
def _evaluate(env: Env, act: Act, params: Any, key: jax.Array) -> Episodes:
    return make_evaluate(env, act)(params, key)


def evaluate(env: Env, act: Act, params: Any, key: jax.Array) -> Episodes:
    """Play every scenario of `params` once (compiled per `env` and `act`)."""
    return _evaluate(env, act, params, key)
