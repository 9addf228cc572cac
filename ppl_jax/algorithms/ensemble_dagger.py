"""Ensemble-DAgger (Menda et al. 2019): the novice itself asks for help."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm
from ppl_jax.buffers import RingBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.fields import setting
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import Metrics, bc_loss
from ppl_jax.networks import Ensemble, ensemble_layers, make_ensemble
from ppl_jax.policies import likelihood_of
from ppl_jax.types import DecisionPoint, EnvSpec, Interaction


@dataclasses.dataclass(frozen=True)
class EnsembleConfig:
    """Static settings of methods with an ensemble of policies."""

    members: int = setting(5, "Policies of the ensemble.", low=1, common=True)


@flax.struct.dataclass
class EnsembleDAggerHParams:
    """Traced settings of Ensemble-DAgger."""

    max_ensemble_variance: jax.Array | float = setting(
        0.01,
        "Variance of the members' actions above which the expert acts.",
        low=0,
        common=True,
    )
    max_discrepancy: jax.Array | float = setting(
        0.05,
        "Squared distance between the novice's and the expert's action above which it acts.",
        low=0,
        common=True,
    )


@flax.struct.dataclass
class Bootstrap:
    """Data of an ensemble whose members each have a data set of their own.

    Attributes:
        buffer: Rows (observation [O], expert action [A]).
        copies: [C, K] how often row c is in member k's data set: Poisson(1), the limit of
            drawing as many rows with replacement (online bagging, Oza and Russell 2001).
    """

    buffer: RingBuffer
    copies: jax.Array


@flax.struct.dataclass
class EnsembleState:
    """The policies and their data.

    Attributes:
        learned: Policies with a leading [K] axis.
        human: D_h with its bootstraps.
    """

    learned: Learned
    human: Bootstrap


def init_bootstrap(key: jax.Array, spec: EnvSpec, config: TrainConfig) -> Bootstrap:
    """Empty data sets; which row goes to which member how often is drawn beforehand."""
    item = spec.zeros()
    rows = config.human_rows
    copies = jax.random.poisson(key, 1.0, (rows, config.method.members)).astype(jnp.float32)
    return Bootstrap(buffer=buffers.init_buffer(item, rows), copies=copies)


def add_human(human: Bootstrap, step: Interaction) -> Bootstrap:
    """Store a step if the expert is in control."""
    item = (step.observation[None], step.expert_action[None])
    return dataclasses.replace(human, buffer=buffers.add(human.buffer, item, step.takeover[None]))


def members_loss(
    params: Any,
    observation: jax.Array,
    action: jax.Array,
    weight: jax.Array,
    hparams: HParams,
    *,
    ensemble: Ensemble,
    config: TrainConfig,
) -> tuple[jax.Array, Metrics]:
    """Sum of the members' cloning losses, each on a batch of its own.

    Args:
        params: The ensemble's.
        observation, action: [K, B, O], [K, B, A].
        weight: [K, B].
        hparams: The likelihood's scale.
        ensemble: K members.
        config: Static settings.
    """
    mean = ensemble.each(params, observation)
    likelihood = likelihood_of(config, hparams)
    each, metrics = bc_loss(mean, action, likelihood, config.bc_reduction, weight=weight)
    return config.method.members * each, metrics  # a member's gradient is that of it alone


def clone_members(
    learned: Learned,
    human: Bootstrap,
    key: jax.Array,
    hparams: HParams,
    *,
    ensemble: Ensemble,
    config: TrainConfig,
) -> tuple[Learned, Metrics]:
    """One update: every member draws a batch of its own from a data set of its own.

    A member's batch is half a `batch_size`, near the published 100.
    """
    count = buffers.size(human.buffer)
    shape = (config.method.members, max(config.batch_size // 2, 1))
    rows = buffers.draw(human.buffer, key, shape, hparams.recency)
    observation, action = jax.tree.map(lambda leaf: leaf[rows], human.buffer.data)  # [K, B, ...]
    weight = jnp.take_along_axis(human.copies.T, rows, axis=1)
    weight = weight / jnp.maximum(jnp.mean(weight, -1, keepdims=True), 1e-9)
    loss = functools.partial(members_loss, ensemble=ensemble, config=config)
    grads, metrics = jax.grad(loss, has_aux=True)(
        learned.params, observation, action, weight, hparams
    )
    return adam_step(learned, grads, hparams.learning_rate, count > 0), metrics


def ensemble_variance(ensemble: Ensemble, params: Any, observation: jax.Array) -> jax.Array:
    """Variance of the members' actions, averaged over action dimensions, [..., O] -> [...]."""
    return jnp.mean(jnp.var(ensemble.members(params, observation), axis=0), -1)


def init_state(
    key: jax.Array, ensemble: Ensemble, spec: EnvSpec, config: TrainConfig
) -> EnsembleState:
    """Before the first step."""
    key_params, key_data = jax.random.split(key)
    return EnsembleState(
        learned=init_learned(ensemble.init(key_params)),
        human=init_bootstrap(key_data, spec, config),
    )


def decide(
    state: EnsembleState, point: DecisionPoint, hparams: HParams, ensemble: Ensemble
) -> jax.Array:
    """Hand over where the ensemble is unsure or far from the expert."""
    unsure = (
        ensemble_variance(ensemble, state.learned.params, point.observation)
        > hparams.method.max_ensemble_variance
    )
    apart = jnp.sum((point.novice_action - point.expert_action) ** 2)
    return unsure | (apart > hparams.method.max_discrepancy)


def store(state: EnsembleState, step: Interaction, hparams: HParams) -> EnsembleState:
    """Keep a step under the expert's control."""
    del hparams
    return dataclasses.replace(state, human=add_human(state.human, step))


def update(
    state: EnsembleState,
    key: jax.Array,
    hparams: HParams,
    *,
    ensemble: Ensemble,
    config: TrainConfig,
) -> tuple[EnsembleState, Metrics]:
    """One step of Adam for every member."""
    learned, metrics = clone_members(
        state.learned, state.human, key, hparams, ensemble=ensemble, config=config
    )
    return dataclasses.replace(state, learned=learned), metrics


def make_ensemble_dagger(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """Ensemble-DAgger: the novice acts where it is sure and agrees with the expert.

        novice in control  iff  ensemble_variance(s) <= max_ensemble_variance
                                and  |a_n - a_h|^2 <= max_discrepancy

    with a_n the ensemble's action. Only steps under the expert's control are learnt from, the
    demonstrations at the start included, and count as human data.
    """
    ensemble = make_ensemble(spec, config.hidden, config.method.members)
    return Algorithm(
        name="ensemble_dagger",
        init=functools.partial(init_state, ensemble=ensemble, spec=spec, config=config),
        act=lambda state, key, observation: ensemble.apply(state.learned.params, observation),
        decide=functools.partial(decide, ensemble=ensemble),
        store=store,
        update=functools.partial(update, ensemble=ensemble, config=config),
        policy=lambda state: ensemble_layers(state.learned.average),
    )
