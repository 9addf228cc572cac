"""Thrifty-DAgger (Hoque et al. 2021): ask for help where it is novel, or risky."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import chex
import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm
from ppl_jax.algorithms.ensemble_dagger import (
    Bootstrap,
    add_human,
    clone_members,
    ensemble_variance,
    init_bootstrap,
)
from ppl_jax.buffers import RingBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.fields import setting
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import Metrics
from ppl_jax.networks import Ensemble, Network, ensemble_layers, make_critic, make_ensemble
from ppl_jax.types import DecisionPoint, EnvSpec, Interaction

RISK_DISCOUNT = 0.9999  # of the probability of success
GOAL_SHARE = 0.1  # of a batch that are steps which solved the task, once there are any
GOALS = 256  # such steps kept
RECENT = 500  # steps of the novice whose ensemble_variance and safety set the thresholds
ENOUGH = 25  # of them, before which the initial thresholds hold
UNSAFE, SAFE = 0.48, 0.495  # initial thresholds of safety: ask, and hand back
SAMPLE = 256  # demonstrated states whose ensemble_variance sets the initial threshold of novelty


@flax.struct.dataclass
class ThriftyDAggerHParams:
    """Traced settings of Thrifty-DAgger."""

    switch_rate: jax.Array | float = setting(
        0.1,
        "alpha: share of the novice's states that each of the two tests hands to the expert.",
        low=0,
        high=1,
        common=True,
    )
    polyak_tau: jax.Array | float = setting(0.005, "tau of the target networks.", low=0, high=1)


class Networks(NamedTuple):
    """The networks.

    Attributes:
        ensemble: Policies.
        critic: Twin logits of the probability of success.
    """

    ensemble: Ensemble
    critic: Network


@flax.struct.dataclass
class RiskStep:
    """A step from which the estimate of success learns."""

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    terminated: jax.Array
    success: jax.Array


@flax.struct.dataclass
class ThriftyLearned:
    """All that updates change.

    Attributes:
        policies: `Learned` of the ensemble.
        risk: `Learned` of twin estimates of the probability of success, with target networks.
        discrepancy: Mean |a - a_h|^2 on the demonstrations, as the updates before the first step
            left it: hands control back.
    """

    policies: Learned
    risk: Learned
    discrepancy: jax.Array


@flax.struct.dataclass
class ThriftyState:
    """The policies, the estimate of success and their data.

    Attributes:
        learned: `ThriftyLearned`.
        human: Steps under the expert's control, with a bootstrap per member.
        steps, goals: `RiskStep` of everybody; of those that solved the task.
        recent: (ensemble_variance, safety) of the novice's last steps.
    """

    learned: ThriftyLearned
    human: Bootstrap
    steps: RingBuffer
    goals: RingBuffer
    recent: RingBuffer


def quantile(buffer: RingBuffer, values: jax.Array, share: jax.Array | float) -> jax.Array:
    """Quantile over the filled rows of one of a buffer's arrays, [C] -> []."""
    held = buffers.size(buffer)
    filled = jnp.where(jnp.arange(values.shape[0], dtype=jnp.int32) < held, values, jnp.inf)
    row = jnp.floor(share * (held.astype(jnp.float32) - 1)).astype(jnp.int32)
    return jnp.sort(filled)[jnp.clip(row, 0, values.shape[0] - 1)]


def risk_target(success: jax.Array, terminated: jax.Array, following: jax.Array) -> jax.Array:
    """Probability of success: 1 where solved, else gamma (1 - terminated) times the next one's."""
    chex.assert_equal_shape([success, terminated, following])
    return jnp.where(
        success, 1.0, RISK_DISCOUNT * (1.0 - jnp.asarray(terminated, jnp.float32)) * following
    )


def risk_loss(params: Any, batch: RiskStep, target: jax.Array, critic: Network) -> jax.Array:
    """E[(Q(s, a) - y)^2] of both estimates of success; `target` is [B]."""
    value = jax.nn.sigmoid(critic.apply(params, batch.observation, batch.action))
    chex.assert_shape(value, (None, *target.shape))
    return jnp.mean((value - target) ** 2)


def safety(params: Any, observation: jax.Array, action: jax.Array, critic: Network) -> jax.Array:
    """Estimated probability of success, the smaller of two, [..., O], [..., A] -> [...]."""
    return jnp.min(jax.nn.sigmoid(critic.apply(params, observation, action)), 0)


def init_state(
    key: jax.Array, networks: Networks, spec: EnvSpec, config: TrainConfig
) -> ThriftyState:
    """Before the first step."""
    key_params, key_risk, key_data = jax.random.split(key, 3)
    observation, action = spec.zeros()
    no = jnp.zeros((), bool)
    item = RiskStep(
        observation=observation,
        action=action,
        next_observation=observation,
        terminated=no,
        success=no,
    )
    return ThriftyState(
        learned=ThriftyLearned(
            policies=init_learned(networks.ensemble.init(key_params)),
            risk=init_learned(networks.critic.init(key_risk)),
            discrepancy=jnp.zeros((), jnp.float32),
        ),
        human=init_bootstrap(key_data, spec, config),
        steps=buffers.init_buffer(item, config.human_rows),
        goals=buffers.init_buffer(item, GOALS),
        recent=buffers.init_buffer(
            (jnp.zeros((), jnp.float32), jnp.zeros((), jnp.float32)), RECENT
        ),
    )


def decide(
    state: ThriftyState, point: DecisionPoint, hparams: HParams, networks: Networks
) -> jax.Array:
    """The two tests of `make_thrifty_dagger`."""
    policies, recent = state.learned.policies.params, state.recent
    held = buffers.size(recent)
    doubts, safeties = recent.data
    shown = state.human.buffer
    rows = jnp.arange(SAMPLE, dtype=jnp.int32) % jnp.maximum(buffers.size(shown), 1)
    at_first = jnp.quantile(
        ensemble_variance(networks.ensemble, policies, shown.data[0][rows]),
        1.0 - hparams.method.switch_rate,
    )
    few = held < ENOUGH
    novel = jnp.where(few, at_first, quantile(recent, doubts, 1.0 - hparams.method.switch_rate))
    unsafe = jnp.where(few, UNSAFE, quantile(recent, safeties, hparams.method.switch_rate))
    safe = jnp.where(few, SAFE, quantile(recent, safeties, 0.5))
    risk = state.learned.risk.params
    now = safety(risk, point.observation, point.novice_action, networks.critic)
    doubt = ensemble_variance(networks.ensemble, policies, point.observation)
    ask = (doubt > novel) | (now < unsafe)
    apart = jnp.sum((point.novice_action - point.expert_action) ** 2)
    hand_back = (apart < state.learned.discrepancy) & (now > safe)
    return jnp.where(point.takeover, ~hand_back, ask)


def store(
    state: ThriftyState, step: Interaction, hparams: HParams, networks: Networks
) -> ThriftyState:
    """Keep a step for the estimate of success, and for cloning or the thresholds."""
    del hparams
    item = RiskStep(
        observation=step.observation,
        action=step.executed_action,
        next_observation=step.next_observation,
        terminated=step.terminated,
        success=step.success,
    )
    row = jax.tree.map(lambda leaf: leaf[None], item)
    policies, risk = state.learned.policies.params, state.learned.risk.params
    seen = (
        ensemble_variance(networks.ensemble, policies, step.observation)[None],
        safety(risk, step.observation, step.novice_action, networks.critic)[None],
    )
    return dataclasses.replace(
        state,
        human=add_human(state.human, step),
        steps=buffers.add(state.steps, row, jnp.ones(1, bool)),
        goals=buffers.add(state.goals, row, step.success[None]),
        recent=buffers.add(state.recent, seen, ~step.takeover[None]),
    )


def sample_steps(state: ThriftyState, key: jax.Array, key_goals: jax.Array, count: int) -> RiskStep:
    """A batch [count] with a share of steps that solved the task, once there are any."""
    batch = buffers.sample(state.steps, key, count)
    goals = buffers.sample(state.goals, key_goals, count)
    share = jnp.arange(count, dtype=jnp.float32) < GOAL_SHARE * count
    is_goal = share & (buffers.size(state.goals) > 0)
    return jax.tree.map(
        lambda goal, step: jnp.where(is_goal.reshape(-1, *[1] * (goal.ndim - 1)), goal, step),
        goals,
        batch,
    )


def update(
    state: ThriftyState,
    key: jax.Array,
    hparams: HParams,
    *,
    networks: Networks,
    config: TrainConfig,
) -> tuple[ThriftyState, Metrics]:
    """One step of Adam for policies and estimates of success."""
    key_clone, key_steps, key_goals = jax.random.split(key, 3)
    ensemble, critic = networks
    learned = state.learned
    policies, metrics = clone_members(
        learned.policies, state.human, key_clone, hparams, ensemble=ensemble, config=config
    )
    batch = sample_steps(state, key_steps, key_goals, config.batch_size)
    action = ensemble.apply(learned.policies.params, batch.next_observation)
    following = safety(learned.risk.average, batch.next_observation, action, critic)
    target = risk_target(batch.success, batch.terminated, following)
    loss, grads = jax.value_and_grad(risk_loss)(learned.risk.params, batch, target, critic)
    risk = adam_step(
        learned.risk,
        grads,
        hparams.learning_rate,
        buffers.size(state.steps) > 0,
        polyak_tau=hparams.method.polyak_tau,
    )
    learned = dataclasses.replace(learned, policies=policies, risk=risk)
    return dataclasses.replace(state, learned=learned), metrics | {"loss_risk": loss}


def fit(
    state: ThriftyState,
    key: jax.Array,
    hparams: HParams,
    *,
    networks: Networks,
    config: TrainConfig,
) -> tuple[ThriftyState, Metrics]:
    """An update on demonstrations that keeps their mean discrepancy, too."""
    state, metrics = update(state, key, hparams, networks=networks, config=config)
    observation, action = buffers.sample(state.human.buffer, key, config.batch_size)
    mean = networks.ensemble.apply(state.learned.policies.params, observation)
    apart = jnp.mean(jnp.sum((mean - action) ** 2, -1))
    # averaged over the last hundred or so updates
    first = state.learned.policies.updates <= 1
    kept = jnp.where(first, apart, 0.99 * state.learned.discrepancy + 0.01 * apart)
    learned = dataclasses.replace(state.learned, discrepancy=kept)
    return dataclasses.replace(state, learned=learned), metrics


def make_thrifty_dagger(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """Thrifty-DAgger: two tests, each with a budget.

        to the expert:  ensemble_variance(s) > delta_h  or  Q(s, a_n) < beta_h
        back:           |a_n - a_h|^2 < delta_r  and  Q(s, a_n) > beta_r

    Q is the estimated probability of success (the smaller of two). delta_h is the (1 - alpha)
    quantile of the ensemble's variance and beta_h the alpha quantile of Q over the novice's recent
    steps (alpha = `switch_rate`), beta_r the median of Q, delta_r the mean discrepancy on the
    demonstrations. Q learns from every step and from whether the task was solved, which no other
    method here gets to know.

    Updated at every step, as all methods here are, where the published code retrains from scratch
    after every 2000 steps (and forgets to do so with the target networks).
    """
    ensemble = make_ensemble(spec, config.hidden, config.method.members)
    networks = Networks(ensemble=ensemble, critic=make_critic(spec, config.hidden, 2))
    parts = {"networks": networks, "config": config}
    return Algorithm(
        name="thrifty_dagger",
        init=functools.partial(init_state, spec=spec, **parts),
        act=lambda state, key, observation: ensemble.apply(
            state.learned.policies.params, observation
        ),
        decide=functools.partial(decide, networks=networks),
        store=functools.partial(store, networks=networks),
        update=functools.partial(update, **parts),
        policy=lambda state: ensemble_layers(state.learned.policies.average),
        fit=functools.partial(fit, **parts),
    )
