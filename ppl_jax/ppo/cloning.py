"""Demonstrations under noise, and the policy that is cloned from them.

The expert acts under noise, as in DART (Laskey et al. 2017); its action without the noise, which
shows the way back, is cloned. In every round after the first the clone acts under the same noise
and the expert labels; the clone learns from all rounds so far (DAgger; Ross et al. 2011).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from ppl_jax.distributions import log_likelihood
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import Metrics
from ppl_jax.ppo.losses import RunningStats, mean_of_ended
from ppl_jax.ppo.rollout import (
    PPOLearner,
    Problem,
    query_expert,
    scaled,
    start_envs,
    step_envs,
)

CLONING_RATE = 1e-3  # Adam, falling to 0
CLONING_BATCH = 1024


class Round(NamedTuple):
    """Fixed while one round is shown: its number, the clone, the input statistics."""

    problem: Problem
    number: jax.Array
    cloned: Learned
    inputs: RunningStats


def length_of_round(problem: Problem) -> int:
    """Labelled steps of each environment that one round keeps."""
    config = problem.config
    shared = config.num_envs * config.demonstration_rounds * config.demonstration_stride
    return -(-config.demonstrations // shared)


def show(at: Round, learner: PPOLearner, _: None) -> Any:
    """One labelled step of every environment; how far the clone is from the expert, [W]."""
    problem = at.problem
    key, key_expert, key_noise, key_step = jax.random.split(learner.key, 4)
    observation = learner.observation
    shown = query_expert(problem, key_expert, learner.env_state, observation)
    own = problem.policy.apply(at.cloned.average["mean"], scaled(problem, at.inputs, observation))
    chex.assert_equal_shape([shown, own])
    action = jnp.where(at.number == 0, shown, own)
    noise = learner.hparams.demonstration_noise * jax.random.normal(
        key_noise, action.shape, jnp.float32
    )
    learner = dataclasses.replace(learner, key=key)
    learner, row = step_envs(problem, key_step, learner, action + noise)
    apart = jnp.sum(jnp.abs(jnp.clip(own, -1.0, 1.0) - shown), -1)
    return learner, (apart, observation, shown, row[3].success, row[2])


def show_stride(at: Round, learner: PPOLearner, _: None) -> Any:
    """A stride of steps, keeping the one at which the clone is furthest from the expert."""
    learner, (apart, *pairs, success, done) = jax.lax.scan(
        functools.partial(show, at), learner, None, length=at.problem.config.demonstration_stride
    )
    most = jnp.argmax(apart, 0)[None, :, None]
    pairs = (jnp.take_along_axis(x, most, 0)[0] for x in pairs)
    return learner, (*pairs, success, done)


def cloning_loss(network: Any, problem: Problem, inputs: jax.Array, action: jax.Array) -> jax.Array:
    """-E[log pi(action)] of the cloned likelihood; inputs [N, O] scaled, actions [N, A]."""
    mean = problem.policy.apply(network["mean"], inputs)
    chex.assert_equal_shape([mean, action])
    return -jnp.mean(log_likelihood(mean, action, problem.config.cloning))


def one_round(problem: Problem, carry: Any, number: jax.Array) -> Any:
    """One round: demonstrations, then updates of the clone on all rounds so far."""
    learner, cloned, inputs, kept = carry
    config, length = problem.config, length_of_round(problem)
    updates = config.cloning_updates // config.demonstration_rounds
    at = Round(problem=problem, number=number, cloned=cloned, inputs=inputs)
    learner, (*pairs, success, done) = jax.lax.scan(
        functools.partial(show_stride, at), learner, None, length=length
    )
    inputs = inputs.add(jnp.reshape(pairs[0], (-1, problem.env.spec.observation_size)))
    kept = [
        jax.lax.dynamic_update_slice_in_dim(to, jnp.reshape(x, (-1, x.shape[-1])), row, 0)
        for to, x, row in zip(kept, pairs, 2 * [number * length * config.num_envs], strict=True)
    ]
    count = (number + 1) * length * config.num_envs

    def update(learned: Learned, at: Any) -> tuple[Learned, jax.Array]:
        key, progress = at
        chosen = jax.random.randint(key, (CLONING_BATCH,), 0, count, jnp.int32)
        seen, action = scaled(problem, inputs, kept[0][chosen]), kept[1][chosen]
        value, grads = jax.value_and_grad(cloning_loss)(learned.params, problem, seen, action)
        return adam_step(learned, grads, CLONING_RATE * (1.0 - progress)), value

    key, key_updates = jax.random.split(learner.key)
    learner = dataclasses.replace(learner, key=key)
    share = jnp.arange(updates, dtype=jnp.float32) / max(updates, 1)
    progress = (number.astype(jnp.float32) + share) / config.demonstration_rounds
    each = (jax.random.split(key_updates, updates), progress)
    cloned, losses = jax.lax.scan(update, cloned, each)
    return (learner, cloned, inputs, kept), {
        "loss": jnp.sum(losses) / max(updates, 1),
        "success_rate": mean_of_ended(success, done)[0],
    }


def clone(problem: Problem, learner: PPOLearner) -> tuple[PPOLearner, Metrics]:
    """All rounds; the learner then starts PPO with the cloned policy in fresh environments."""
    config, spec = problem.config, problem.env.spec
    rounds = config.demonstration_rounds
    total = rounds * length_of_round(problem) * config.num_envs
    kept = [
        jnp.zeros((total, width), jnp.float32)
        for width in (spec.observation_size, spec.action_size)
    ]
    carry = (learner, learner.learned.policy, learner.learned.inputs, kept)
    carry, metrics = jax.lax.scan(
        functools.partial(one_round, problem), carry, jnp.arange(rounds, dtype=jnp.int32)
    )
    learner, cloned, inputs, _ = carry
    start = init_learned(cloned.average)  # PPO's Adam starts anew
    learned = dataclasses.replace(learner.learned, policy=start, inputs=inputs)
    learner = dataclasses.replace(learner, learned=learned, **start_envs(problem, learner.key))
    return learner, {
        "clone/loss": metrics["loss"][-1],
        "clone/success_rate": metrics["success_rate"][0],
        "clone/last_success_rate": metrics["success_rate"][-1],
    }
