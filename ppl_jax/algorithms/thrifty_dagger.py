"""Thrifty-DAgger (Hoque et al. 2021): ask for help where it is novel, or risky."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm, Learned, adam_step, init_learned
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
from ppl_jax.losses import Metrics
from ppl_jax.networks import Layers, ensemble_layers, make_critic, make_ensemble
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


@flax.struct.dataclass
class RiskStep:
    """What the estimate of success learns from."""

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    terminated: jax.Array
    success: jax.Array


@flax.struct.dataclass
class ThriftyLearned:
    """What updates change.

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
    """What is learnt, and from what.

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
    filled = jnp.where(jnp.arange(values.shape[0]) < held, values, jnp.inf)
    row = jnp.floor(share * (held - 1)).astype(jnp.int32)
    return jnp.sort(filled)[jnp.clip(row, 0, values.shape[0] - 1)]


def risk_target(success: jax.Array, terminated: jax.Array, following: jax.Array) -> jax.Array:
    """Probability of success: 1 where solved, else gamma (1 - terminated) times the next one's."""
    return jnp.where(success, 1.0, RISK_DISCOUNT * (1.0 - terminated) * following)


def make_thrifty_dagger(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """Thrifty-DAgger: two tests, each with a budget.

        to the expert:  ensemble_variance(s) > delta_h  or  Q(s, a_n) < beta_h
        back:           |a_n - a_h|^2 < delta_r  and  Q(s, a_n) > beta_r

    ensemble_variance is the variance of the ensemble, Q the estimated probability of success (the smaller of
    two). delta_h is the (1 - alpha) quantile of the ensemble_variance and beta_h the alpha quantile of Q over
    the novice's recent steps (alpha = `switch_rate`), beta_r the median of Q, delta_r the mean
    discrepancy on the demonstrations. Q learns from every step and from whether the task was
    solved, which no other method here gets to know.

    Updated at every step, as all methods here are, where the published code retrains from scratch
    after every 2000 steps (and forgets to do so with the target networks).
    """
    ensemble = make_ensemble(spec, config.hidden, config.method.members)
    critic = make_critic(spec, config.hidden, 2)

    def safety(params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.min(jax.nn.sigmoid(critic.apply(params, observation, action)), 0)

    def init(key: jax.Array) -> ThriftyState:
        key_params, key_risk, key_data = jax.random.split(key, 3)
        observation, action = jnp.zeros(spec.observation_size), jnp.zeros(spec.action_size)
        no = jnp.zeros((), bool)
        item = RiskStep(observation, action, observation, no, no)
        return ThriftyState(
            learned=ThriftyLearned(
                init_learned(ensemble.init(key_params)),
                init_learned(critic.init(key_risk)),
                jnp.zeros(()),
            ),
            human=init_bootstrap(key_data, spec, config),
            steps=buffers.init_buffer(item, min(config.human_capacity, config.total_steps)),
            goals=buffers.init_buffer(item, GOALS),
            recent=buffers.init_buffer((jnp.zeros(()), jnp.zeros(())), RECENT),
        )

    def act(state: ThriftyState, key: jax.Array, observation: jax.Array) -> jax.Array:
        del key
        return ensemble.apply(state.learned.policies.params, observation)

    def decide(state: ThriftyState, point: DecisionPoint, hparams: HParams) -> jax.Array:
        policies, recent = state.learned.policies.params, state.recent
        held = buffers.size(recent)
        doubts, safeties = recent.data
        shown = state.human.buffer
        rows = jnp.arange(SAMPLE) % jnp.maximum(buffers.size(shown), 1)
        at_first = jnp.quantile(
            ensemble_variance(ensemble, policies, shown.data[0][rows]),
            1.0 - hparams.method.switch_rate,
        )
        few = held < ENOUGH
        novel = jnp.where(few, at_first, quantile(recent, doubts, 1.0 - hparams.method.switch_rate))
        unsafe = jnp.where(few, UNSAFE, quantile(recent, safeties, hparams.method.switch_rate))
        safe = jnp.where(few, SAFE, quantile(recent, safeties, 0.5))
        now = safety(state.learned.risk.params, point.observation, point.novice_action)
        ask = (ensemble_variance(ensemble, policies, point.observation) > novel) | (now < unsafe)
        apart = jnp.sum((point.novice_action - point.expert_action) ** 2)
        hand_back = (apart < state.learned.discrepancy) & (now > safe)
        return jnp.where(point.takeover, ~hand_back, ask)

    def store(state: ThriftyState, step: Interaction, hparams: HParams) -> ThriftyState:
        del hparams
        item = RiskStep(
            step.observation,
            step.executed_action,
            step.next_observation,
            step.terminated,
            step.success,
        )
        row = jax.tree.map(lambda leaf: leaf[None], item)
        seen = (
            ensemble_variance(ensemble, state.learned.policies.params, step.observation)[None],
            safety(state.learned.risk.params, step.observation, step.novice_action)[None],
        )
        return dataclasses.replace(
            state,
            human=add_human(state.human, step),
            steps=buffers.add(state.steps, row, jnp.ones(1, bool)),
            goals=buffers.add(state.goals, row, step.success[None]),
            recent=buffers.add(state.recent, seen, ~step.takeover[None]),
        )

    def risk_loss(params: Any, batch: RiskStep, target: jax.Array) -> jax.Array:
        value = jax.nn.sigmoid(critic.apply(params, batch.observation, batch.action))
        return jnp.mean((value - target) ** 2)

    def update(
        state: ThriftyState, key: jax.Array, hparams: HParams
    ) -> tuple[ThriftyState, Metrics]:
        key_clone, key_steps, key_goals = jax.random.split(key, 3)
        learned = state.learned
        policies, metrics = clone_members(
            ensemble, learned.policies, state.human, key_clone, hparams, config
        )
        batch = buffers.sample(state.steps, key_steps, config.batch_size)
        goals = buffers.sample(state.goals, key_goals, config.batch_size)
        is_goal = (jnp.arange(config.batch_size) < GOAL_SHARE * config.batch_size) & (
            buffers.size(state.goals) > 0
        )
        batch = jax.tree.map(
            lambda goal, step: jnp.where(is_goal.reshape(-1, *[1] * (goal.ndim - 1)), goal, step),
            goals,
            batch,
        )
        action = ensemble.apply(learned.policies.params, batch.next_observation)
        following = safety(learned.risk.average, batch.next_observation, action)
        target = risk_target(batch.success, batch.terminated, following)
        loss, grads = jax.value_and_grad(risk_loss)(learned.risk.params, batch, target)
        risk = adam_step(
            learned.risk,
            grads,
            hparams.learning_rate,
            buffers.size(state.steps) > 0,
            hparams.method.polyak_tau,
        )
        learned = dataclasses.replace(learned, policies=policies, risk=risk)
        return dataclasses.replace(state, learned=learned), metrics | {"loss_risk": loss}

    def fit(state: ThriftyState, key: jax.Array, hparams: HParams) -> tuple[ThriftyState, Metrics]:
        state, metrics = update(state, key, hparams)
        observation, action = buffers.sample(state.human.buffer, key, config.batch_size)
        mean = ensemble.apply(state.learned.policies.params, observation)
        apart = jnp.mean(jnp.sum((mean - action) ** 2, -1))
        # averaged over the last hundred or so updates
        first = state.learned.policies.updates <= 1
        kept = jnp.where(first, apart, 0.99 * state.learned.discrepancy + 0.01 * apart)
        learned = dataclasses.replace(state.learned, discrepancy=kept)
        return dataclasses.replace(state, learned=learned), metrics

    def policy_layers(state: ThriftyState) -> Layers:
        return ensemble_layers(state.learned.policies.average)

    return Algorithm(
        name="thrifty_dagger",
        init=init,
        act=act,
        decide=decide,
        store=store,
        update=update,
        policy=policy_layers,
        fit=fit,
    )
