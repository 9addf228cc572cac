"""Intervention Weighted Regression (Mandlekar et al. 2020)."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm, Learned, adam_step, init_learned
from ppl_jax.buffers import SplitBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.losses import Metrics, bc_loss
from ppl_jax.networks import Layers, layers, make_policy
from ppl_jax.types import EnvSpec, Interaction


@flax.struct.dataclass
class IWRState:
    """What is learnt, and from what.

    Attributes:
        learned: The policy.
        steps: D_I and D_R of (observation [O], executed action [A]).
    """

    learned: Learned
    steps: SplitBuffer


def make_iwr(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """IWR: clone interventions and the novice's own steps, both with the same mass.

        L = -1/2 E_{D_I}[ log pi(a_h|s) ] - 1/2 E_{D_R}[ log pi(a_n|s) ]

    The novice's steps that nobody corrected count as good; they keep the policy where it works.
    Without demonstrations at the start (`demonstrations`, in D_I) they are those of a policy that
    has learnt nothing.
    """
    policy = make_policy(spec, config.hidden)

    def init(key: jax.Array) -> IWRState:
        item = (jnp.zeros(spec.observation_size), jnp.zeros(spec.action_size))
        rows = min(config.human_capacity, config.total_steps)
        return IWRState(init_learned(policy.init(key)), buffers.init_split(item, rows, rows))

    def act(state: IWRState, key: jax.Array, observation: jax.Array) -> jax.Array:
        del key
        return policy.apply(state.learned.params, observation)

    def store(state: IWRState, step: Interaction, hparams: HParams) -> IWRState:
        del hparams
        item = (step.observation, step.executed_action)
        return dataclasses.replace(state, steps=buffers.add_split(state.steps, item, step.takeover))

    def loss(params: Any, items: Any, weight: jax.Array) -> tuple[jax.Array, Metrics]:
        observation, action = items
        mean = policy.apply(params, observation)
        return bc_loss(mean, action, config.likelihood, config.bc_reduction, weight)

    def update(state: IWRState, key: jax.Array, hparams: HParams) -> tuple[IWRState, Metrics]:
        items, weight = buffers.sample_split(state.steps, key, config.batch_size)
        # nothing is learnt before the expert has shown anything
        has_data = buffers.size(state.steps.human) > 0
        grads, metrics = jax.grad(loss, has_aux=True)(state.learned.params, items, weight)
        learned = adam_step(state.learned, grads, hparams.learning_rate, has_data)
        return dataclasses.replace(state, learned=learned), metrics

    def policy_layers(state: IWRState) -> Layers:
        return layers(state.learned.average)

    return Algorithm(
        name="iwr",
        init=init,
        act=act,
        store=store,
        update=update,
        policy=policy_layers,
    )
