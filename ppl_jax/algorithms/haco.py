"""Human-AI Copilot Optimization (Li et al. 2022)."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.algorithms.base import Algorithm, Learned, adam_step, init_learned
from ppl_jax.algorithms.replay import ReplayStep, add_step, init_replay, td_loss, td_target
from ppl_jax.buffers import SplitBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.distributions import squashed_gaussian
from ppl_jax.fields import setting
from ppl_jax.losses import Metrics
from ppl_jax.networks import Layers, layers, make_critic, make_raw
from ppl_jax.types import EnvSpec, Interaction


@flax.struct.dataclass
class HACOHParams:
    """Traced settings of HACO."""

    discount: jax.Array | float = setting(0.99, "gamma.", low=0, high=1, common=True)
    polyak_tau: jax.Array | float = setting(0.005, "tau of the target networks.", low=0, high=1)
    conservative_weight: jax.Array | float = setting(
        10.0,
        "c: weight of raising the expert's action values over the novice's.",
        low=0,
        common=True,
    )


@flax.struct.dataclass
class HACOLearned:
    """What updates change.

    Attributes:
        actor: `Learned` of a squashed Gaussian: its network gives mean and log standard deviation.
        value: Of twin proxy values Q, with target networks.
        cost: Of twin values Q_int of the intervention cost, with target networks.
        log_alpha: Of the entropy's temperature.
    """

    actor: Learned
    value: Learned
    cost: Learned
    log_alpha: Learned


@flax.struct.dataclass
class HACOState:
    """What is learnt, and from what."""

    learned: HACOLearned
    replay: SplitBuffer


def intervention_cost(expert_action: jax.Array, novice_action: jax.Array) -> jax.Array:
    """C = 1 - cos(a_h, a_n) in [0, 2]; 0 where either is zero. [..., A] -> [...]."""
    norms = jnp.linalg.norm(expert_action, axis=-1) * jnp.linalg.norm(novice_action, axis=-1)
    dot = jnp.sum(expert_action * novice_action, -1)
    return jnp.where(norms < 1e-6, 0.0, 1.0 - dot / jnp.maximum(norms, 1e-6))


def proxy_loss(
    executed_value: jax.Array,
    novice_value: jax.Array,
    target: jax.Array,
    takeover: jax.Array,
    weight: jax.Array,
    conservative_weight: jax.Array | float,
) -> jax.Array:
    """E[1/2 (Q(s, a_b) - y)^2 - c I (Q(s, a_b) - Q(s, a_n))], summed over critics [K, B]."""
    raised = jnp.mean(weight * takeover * (executed_value - novice_value), -1)
    return 0.5 * td_loss(executed_value, target, weight) - conservative_weight * jnp.sum(raised)


def policy_loss(
    log_pi: jax.Array,
    values: jax.Array,
    costs: jax.Array,
    alpha: jax.Array | float,
    weight: jax.Array,
) -> jax.Array:
    """E[alpha log pi(a|s) - min_k Q_k(s, a) + min_k Qint_k(s, a)], [B], [K, B], [K, B]."""
    return jnp.mean(weight * (alpha * log_pi - jnp.min(values, 0) + jnp.min(costs, 0)))


def make_haco(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """HACO: soft actor-critic without a reward, and a price on being overruled.

        y     = gamma (1 - terminated) [min_k Q'_k(s', a') - alpha log pi(a'|s')],  a' ~ pi(s')
        y_int = C + gamma (1 - terminated) min_k Q'int_k(s', a')
        L_Q   = E[1/2 (Q(s, a_b) - y)^2 - c I (Q(s, a_b) - Q(s, a_n))]
        L_int = E[1/2 (Q_int(s, a_n) - y_int)^2]
        L_pi  = E[alpha log pi(a|s) - min_k Q_k(s, a) + min_k Qint_k(s, a)],  a ~ pi(s)

    C = 1 - cos(a_h, a_n) is paid where the expert takes over, in that step alone. Batches are one
    half of the expert's steps and one half of the novice's. alpha is tuned to an entropy of -A.
    """
    return _make("haco", spec, config, ported=False)


def make_haco_port(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """HACO as the PVP4Real repository ports it.

    C is paid in every step under the expert's control, Q_int is learnt at the executed action,
    batches are drawn from all steps alike (and c is 1: `conservative_weight`).
    """
    return _make("haco_port", spec, config, ported=True)


def _make(name: str, spec: EnvSpec, config: TrainConfig, ported: bool) -> Algorithm:
    actions = spec.action_size
    network = make_raw(spec, config.hidden, 2 * actions)
    critic = make_critic(spec, config.hidden, 2)
    sample = buffers.sample_both if ported else buffers.sample_split

    def init(key: jax.Array) -> HACOState:
        key_actor, key_value, key_cost = jax.random.split(key, 3)
        learned = HACOLearned(
            actor=init_learned(network.init(key_actor)),
            value=init_learned(critic.init(key_value)),
            cost=init_learned(critic.init(key_cost)),
            log_alpha=init_learned(jnp.zeros(())),
        )
        return HACOState(learned, init_replay(spec, config))

    def sample_novice_action(
        params: Any, key: jax.Array, observation: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        mean, log_std = jnp.split(network.apply(params, observation), 2, -1)
        return squashed_gaussian(key, mean, log_std)

    def act(state: HACOState, key: jax.Array, observation: jax.Array) -> jax.Array:
        return sample_novice_action(state.learned.actor.params, key, observation)[0]

    def store(state: HACOState, step: Interaction, hparams: HParams) -> HACOState:
        del hparams
        return dataclasses.replace(state, replay=add_step(state.replay, step))

    def value_loss(
        params: Any, batch: ReplayStep, target: jax.Array, weight: jax.Array, hparams: HParams
    ) -> jax.Array:
        executed = critic.apply(params, batch.observation, batch.executed_action)
        novices = critic.apply(params, batch.observation, batch.novice_action)
        return proxy_loss(
            executed, novices, target, batch.takeover, weight, hparams.method.conservative_weight
        )

    def cost_loss(
        params: Any, batch: ReplayStep, target: jax.Array, weight: jax.Array
    ) -> jax.Array:
        at = batch.executed_action if ported else batch.novice_action
        value = critic.apply(params, batch.observation, at)
        return 0.5 * td_loss(value, target, weight)

    def actor_loss(
        params: Any,
        learned: HACOLearned,
        key: jax.Array,
        observation: jax.Array,
        weight: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        action, log_pi = sample_novice_action(params, key, observation)
        values = critic.apply(learned.value.params, observation, action)
        costs = critic.apply(learned.cost.params, observation, action)
        alpha = jnp.exp(learned.log_alpha.params)
        return policy_loss(log_pi, values, costs, alpha, weight), jnp.mean(weight * log_pi)

    def update(state: HACOState, key: jax.Array, hparams: HParams) -> tuple[HACOState, Metrics]:
        key_batch, key_next, key_actor = jax.random.split(key, 3)
        batch, weight = sample(state.replay, key_batch, config.batch_size)
        has_data = buffers.size(state.replay.human) > 0
        learned = state.learned
        step = functools.partial(adam_step, learning_rate=hparams.learning_rate, do=has_data)
        action, log_pi = sample_novice_action(
            learned.actor.params, key_next, batch.next_observation
        )
        alpha = jnp.exp(learned.log_alpha.params)
        values = critic.apply(learned.value.average, batch.next_observation, action)
        costs = critic.apply(learned.cost.average, batch.next_observation, action)
        paid = batch.takeover if ported else batch.takeover_start
        price = paid * intervention_cost(batch.expert_action, batch.novice_action)
        loss_value, grads = jax.value_and_grad(value_loss)(
            learned.value.params,
            batch,
            td_target(values, batch.terminated, hparams.method.discount, entropy=-alpha * log_pi),
            weight,
            hparams,
        )
        value = step(learned.value, grads, polyak_tau=hparams.method.polyak_tau)
        loss_cost, grads = jax.value_and_grad(cost_loss)(
            learned.cost.params,
            batch,
            td_target(costs, batch.terminated, hparams.method.discount, paid=price),
            weight,
        )
        cost = step(learned.cost, grads, polyak_tau=hparams.method.polyak_tau)
        learned = dataclasses.replace(learned, value=value, cost=cost)
        (loss_actor, mean_log_pi), grads = jax.value_and_grad(actor_loss, has_aux=True)(
            learned.actor.params, learned, key_actor, batch.observation, weight
        )
        actor = step(learned.actor, grads)
        # alpha grows while the entropy is below -A: d/d log_alpha of -log_alpha (log pi - A)
        log_alpha = step(learned.log_alpha, -(mean_log_pi - actions))
        learned = dataclasses.replace(learned, actor=actor, log_alpha=log_alpha)
        metrics = {"loss_value": loss_value, "loss_cost": loss_cost, "loss_actor": loss_actor}
        return dataclasses.replace(state, learned=learned), metrics | {"alpha": alpha}

    def policy_layers(state: HACOState) -> Layers:
        *before, (w, b) = layers(state.learned.actor.average)
        return [*before, (w[:, :actions], b[:actions])]  # the mean alone

    return Algorithm(
        name=name,
        init=init,
        act=act,
        store=store,
        update=update,
        policy=policy_layers,
    )
