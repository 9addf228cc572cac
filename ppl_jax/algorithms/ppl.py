"""Predictive Preference Learning (the paper's Algorithm 1), and its BC-only ablation."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm, Learned, adam_step, init_learned
from ppl_jax.buffers import RingBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.intervention import COMPARING, RULES
from ppl_jax.losses import Metrics, bc_loss, cpo_loss
from ppl_jax.networks import make_policy
from ppl_jax.preference import preference_pairs
from ppl_jax.types import Interaction, PreferenceBatch, Trajectory, WorldSpec


@flax.struct.dataclass
class PPLState:
    """What is learnt and the two data sets.

    Attributes:
        learned: Parameters of the policy, its optimiser and its average.
        human_buffer: D_h of (observation [O], expert action [A]).
        preference_buffer: D_pref of `PreferenceBatch`.
    """

    learned: Learned
    human_buffer: RingBuffer
    preference_buffer: RingBuffer


def make_ppl(spec: WorldSpec, config: TrainConfig) -> Algorithm:
    """PPL."""
    return _make("ppl", spec, config, with_preferences=True)


def make_bc_only(spec: WorldSpec, config: TrainConfig) -> Algorithm:
    """PPL without its preference loss: the same gate, data and cloning loss."""
    return _make("bc_only", spec, config, with_preferences=False)


def _make(name: str, spec: WorldSpec, config: TrainConfig, with_preferences: bool) -> Algorithm:
    policy = make_policy(spec, config.hidden)
    rule = RULES[config.gate]
    shifted = config.pair_states == "shifted"

    def init(key: jax.Array) -> PPLState:
        observation, action = jnp.zeros(spec.observation_size), jnp.zeros(spec.action_size)
        pair = PreferenceBatch(observation, action, action, observation if shifted else None)
        return PPLState(
            learned=init_learned(policy.init(key)),
            human_buffer=buffers.init_buffer(
                (observation, action), min(config.human_capacity, config.total_steps)
            ),
            preference_buffer=buffers.init_buffer(
                pair, config.preference_capacity if with_preferences else 1
            ),
        )

    def act(state: PPLState, observation: jax.Array) -> jax.Array:
        return policy.apply(state.learned.params, observation)

    def decide(
        state: PPLState, trajectory: Trajectory, experts: Trajectory | None, hparams: HParams
    ) -> jax.Array:
        return rule(trajectory, experts, hparams, spec.observation_scale)

    def store(state: PPLState, step: Interaction, hparams: HParams) -> PPLState:
        human = buffers.add(
            state.human_buffer,
            (step.observation[None], step.expert_action[None]),
            step.takeover[None],
        )
        if not with_preferences:
            return dataclasses.replace(state, human_buffer=human)
        pairs, mask = preference_pairs(step, hparams.preference_horizon, config.pair_states)
        return dataclasses.replace(
            state,
            human_buffer=human,
            preference_buffer=buffers.add(state.preference_buffer, pairs, mask),
        )

    def loss(
        params: Any, cloned: Any, pairs: PreferenceBatch, has_pairs: jax.Array, hparams: HParams
    ) -> tuple[jax.Array, Metrics]:
        observation, action = cloned
        # two separate forward passes: XLA runs them side by side on a CPU
        bc, metrics = bc_loss(
            policy.apply(params, observation), action, config.likelihood, config.bc_reduction
        )
        total = hparams.bc_weight * bc
        if with_preferences:
            mean = policy.apply(params, pairs.observation)
            rejected = mean
            if pairs.rejected_observation is not None:
                rejected = policy.apply(params, pairs.rejected_observation)
            preference, more = cpo_loss(
                mean,
                pairs.preferred_action,
                rejected,
                pairs.rejected_action,
                hparams.beta,
                hparams.preference_bias,
                config.likelihood,
            )
            total = total + hparams.preference_weight * has_pairs * preference
            metrics = metrics | more
        return total, metrics

    def update(state: PPLState, key: jax.Array, hparams: HParams) -> tuple[PPLState, Metrics]:
        key_human, key_pairs = jax.random.split(key)
        cloned = buffers.sample(state.human_buffer, key_human, config.batch_size)
        pairs = buffers.sample(state.preference_buffer, key_pairs, config.batch_size)
        has_data = buffers.size(state.human_buffer) > 0
        has_pairs = buffers.size(state.preference_buffer) > 0
        grads, metrics = jax.grad(loss, has_aux=True)(
            state.learned.params, cloned, pairs, has_pairs.astype(jnp.float32), hparams
        )
        learned = adam_step(state.learned, grads, hparams.learning_rate, has_data)
        return dataclasses.replace(state, learned=learned), metrics

    def policy_params(state: PPLState) -> Any:
        return state.learned.average

    compares = config.gate in COMPARING
    return Algorithm(
        name, init, act, decide, store, update, policy_params, with_preferences, compares
    )
