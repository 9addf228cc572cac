"""Behaviour cloning of demonstrations that the expert made all by itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm, Learned, adam_step, init_learned
from ppl_jax.buffers import RingBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.fields import setting
from ppl_jax.gates import never
from ppl_jax.losses import Metrics, bc_loss
from ppl_jax.networks import Layers, layers, make_policy
from ppl_jax.types import EnvSpec, Interaction


@flax.struct.dataclass
class ClonerHParams:
    """Traced settings of methods that only clone."""

    bc_weight: jax.Array | float = setting(1.0, "Weight of the behaviour-cloning loss.", low=0)


@flax.struct.dataclass
class ClonerState:
    """What is learnt, and from what.

    Attributes:
        learned: The policy.
        human_buffer: D_h of (observation [O], expert action [A]).
    """

    learned: Learned
    human_buffer: RingBuffer


def make_bc(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """BC: `demonstrations` steps of the expert, then `offline_updates`, and that is all."""
    return make_cloner("bc", spec, config, never)


def make_cloner(
    name: str, spec: EnvSpec, config: TrainConfig, decide: Callable[..., jax.Array] | None
) -> Algorithm:
    """A policy that clones every step under the expert's control, whoever gave it control.

    L = -E_{D_h}[ log pi(a_h|s) ]
    """
    policy = make_policy(spec, config.hidden)

    def init(key: jax.Array) -> ClonerState:
        item = (jnp.zeros(spec.observation_size), jnp.zeros(spec.action_size))
        rows = min(config.human_capacity, config.total_steps)
        return ClonerState(init_learned(policy.init(key)), buffers.init_buffer(item, rows))

    def act(state: ClonerState, key: jax.Array, observation: jax.Array) -> jax.Array:
        del key
        return policy.apply(state.learned.params, observation)

    def store(state: ClonerState, step: Interaction, hparams: HParams) -> ClonerState:
        del hparams
        item = (step.observation[None], step.expert_action[None])
        human = buffers.add(state.human_buffer, item, step.takeover[None])
        return dataclasses.replace(state, human_buffer=human)

    def loss(params: Any, cloned: Any, hparams: HParams) -> tuple[jax.Array, Metrics]:
        observation, action = cloned
        mean = policy.apply(params, observation)
        bc, metrics = bc_loss(mean, action, config.likelihood, config.bc_reduction)
        return hparams.method.bc_weight * bc, metrics

    def update(state: ClonerState, key: jax.Array, hparams: HParams) -> tuple[ClonerState, Metrics]:
        cloned = buffers.sample(state.human_buffer, key, config.batch_size)
        has_data = buffers.size(state.human_buffer) > 0
        grads, metrics = jax.grad(loss, has_aux=True)(state.learned.params, cloned, hparams)
        learned = adam_step(state.learned, grads, hparams.learning_rate, has_data)
        return dataclasses.replace(state, learned=learned), metrics

    def policy_layers(state: ClonerState) -> Layers:
        return layers(state.learned.average)

    return Algorithm(
        name=name,
        init=init,
        act=act,
        decide=decide,
        store=store,
        update=update,
        policy=policy_layers,
    )
