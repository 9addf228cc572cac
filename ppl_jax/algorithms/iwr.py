"""Intervention Weighted Regression (Mandlekar et al. 2020)."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm
from ppl_jax.buffers import SplitBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import Metrics, bc_loss
from ppl_jax.policies import Novice, make_novice
from ppl_jax.types import EnvSpec, Interaction


@flax.struct.dataclass
class IWRState:
    """The policy and its data.

    Attributes:
        learned: The policy.
        steps: D_I and D_R of (observation [O], executed action [A]).
    """

    learned: Learned
    steps: SplitBuffer


def init_state(key: jax.Array, policy: Novice, spec: EnvSpec, config: TrainConfig) -> IWRState:
    """Before the first step."""
    item = spec.zeros()
    rows = config.human_rows
    return IWRState(
        learned=init_learned(policy.init(key)), steps=buffers.init_split(item, rows, rows)
    )


def store(state: IWRState, step: Interaction, hparams: HParams) -> IWRState:
    """Keep a step with those of the party that was in control."""
    del hparams
    item = (step.observation, step.executed_action)
    return dataclasses.replace(state, steps=buffers.add_split(state.steps, item, step.takeover))


def weighted_loss(
    params: Any,
    items: tuple[jax.Array, jax.Array],
    weight: jax.Array,
    hparams: HParams,
    *,
    policy: Novice,
    config: TrainConfig,
) -> tuple[jax.Array, Metrics]:
    """Cloning of executed actions [B, A] at observations [B, O], weighted by [B]."""
    observation, action = items
    output, likelihood = policy.output(params, observation), policy.likelihood(hparams)
    return bc_loss(output, action, likelihood, config.bc_reduction, weight=weight)


def update(
    state: IWRState, key: jax.Array, hparams: HParams, *, policy: Novice, config: TrainConfig
) -> tuple[IWRState, Metrics]:
    """One step of Adam on a balanced batch."""
    items, weight = buffers.sample_split(state.steps, key, config.batch_size, hparams.recency)
    # nothing is learnt before the expert has shown anything
    has_data = buffers.size(state.steps.human) > 0
    loss = functools.partial(weighted_loss, policy=policy, config=config)
    grads, metrics = jax.grad(loss, has_aux=True)(state.learned.params, items, weight, hparams)
    learned = adam_step(state.learned, grads, hparams.learning_rate, has_data)
    return dataclasses.replace(state, learned=learned), metrics


def make_iwr(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """IWR: clone interventions and the novice's own steps, both with the same mass.

        L = -1/2 E_{D_I}[ log pi(a_h|s) ] - 1/2 E_{D_R}[ log pi(a_n|s) ]

    The novice's steps that nobody corrected count as good; they keep the policy where it works.
    Without demonstrations at the start (`demonstrations`, in D_I) they are those of a policy that
    has learnt nothing.
    """
    policy = make_novice(spec, config)
    return Algorithm(
        name="iwr",
        init=functools.partial(init_state, policy=policy, spec=spec, config=config),
        act=lambda state, key, observation: policy.act(state.learned.params, key, observation),
        store=store,
        update=functools.partial(update, policy=policy, config=config),
        policy=lambda state: policy.layers(state.learned.average),
    )
