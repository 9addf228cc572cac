"""Behaviour cloning of demonstrations that the expert made all by itself."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm
from ppl_jax.buffers import RingBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.fields import setting
from ppl_jax.gates import never
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import Metrics, bc_loss
from ppl_jax.policies import Novice, make_novice
from ppl_jax.types import DecisionPoint, EnvSpec, Interaction


@flax.struct.dataclass
class ClonerHParams:
    """Traced settings of methods that only clone."""

    bc_weight: jax.Array | float = setting(1.0, "Weight of the behaviour-cloning loss.", low=0)


@flax.struct.dataclass
class ClonerState:
    """The policy and its data.

    Attributes:
        learned: The policy.
        human_buffer: D_h of (observation [O], expert action [A]).
    """

    learned: Learned
    human_buffer: RingBuffer


def init_state(key: jax.Array, policy: Novice, spec: EnvSpec, config: TrainConfig) -> ClonerState:
    """Before the first step."""
    item = spec.zeros()
    rows = config.human_rows
    return ClonerState(
        learned=init_learned(policy.init(key)), human_buffer=buffers.init_buffer(item, rows)
    )


def store(state: ClonerState, step: Interaction, hparams: HParams) -> ClonerState:
    """Keep a step under the expert's control."""
    del hparams
    item = (step.observation[None], step.expert_action[None])
    human = buffers.add(state.human_buffer, item, step.takeover[None])
    return dataclasses.replace(state, human_buffer=human)


def cloning_loss(
    params: Any,
    cloned: tuple[jax.Array, jax.Array],
    hparams: HParams,
    *,
    policy: Novice,
    config: TrainConfig,
) -> tuple[jax.Array, Metrics]:
    """bc_weight L_bc on a batch of observations [B, O] and expert actions [B, A]."""
    observation, action = cloned
    output, likelihood = policy.output(params, observation), policy.likelihood(hparams)
    bc, metrics = bc_loss(output, action, likelihood, config.bc_reduction)
    return hparams.method.bc_weight * bc, metrics


def update(
    state: ClonerState, key: jax.Array, hparams: HParams, *, policy: Novice, config: TrainConfig
) -> tuple[ClonerState, Metrics]:
    """One step of Adam on a batch of the expert's steps."""
    cloned = buffers.sample(state.human_buffer, key, config.batch_size, hparams.recency)
    has_data = buffers.size(state.human_buffer) > 0
    loss = functools.partial(cloning_loss, policy=policy, config=config)
    grads, metrics = jax.grad(loss, has_aux=True)(state.learned.params, cloned, hparams)
    learned = adam_step(state.learned, grads, hparams.learning_rate, has_data)
    return dataclasses.replace(state, learned=learned), metrics


def make_bc(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """BC: `demonstrations` steps of the expert, then `offline_updates`, and nothing else."""
    return make_cloner("bc", spec, config, never)


def make_cloner(
    name: str,
    spec: EnvSpec,
    config: TrainConfig,
    decide: Callable[[Any, DecisionPoint, HParams], jax.Array] | None,
) -> Algorithm:
    """A policy that clones every step under the expert's control, however it came to be.

        L = -E_{D_h}[ log pi(a_h|s) ]

    Args:
        name: The method's name.
        spec: The environment's sizes and scales.
        config: Static settings.
        decide: See `Algorithm.decide`.
    """
    policy = make_novice(spec, config)
    return Algorithm(
        name=name,
        init=functools.partial(init_state, policy=policy, spec=spec, config=config),
        act=lambda state, key, observation: policy.act(state.learned.params, key, observation),
        decide=decide,
        store=store,
        update=functools.partial(update, policy=policy, config=config),
        policy=lambda state: policy.layers(state.learned.average),
    )
