"""Human-AI Copilot Optimization (Li et al. 2022)."""

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
from ppl_jax.algorithms.replay import ReplayStep, add_step, init_replay, td_loss, td_target
from ppl_jax.buffers import SplitBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.distributions import squashed_gaussian
from ppl_jax.fields import setting
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import Metrics
from ppl_jax.networks import Layers, Network, layers, make_critic, make_raw
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


class Networks(NamedTuple):
    """The networks, and the variant.

    Attributes:
        actor: Gives mean and log standard deviation, side by side.
        critic: Twin action values.
        ported: See `make_haco_port`.
    """

    actor: Network
    critic: Network
    ported: bool


@flax.struct.dataclass
class HACOLearned:
    """All that updates change.

    Attributes:
        actor: `Learned` of a squashed Gaussian: its network gives mean and log standard deviation.
        value: `Learned` of twin proxy values Q, with target networks.
        cost: `Learned` of twin values Q_int of the intervention cost, with target networks.
        log_alpha: `Learned` of the logarithm of the entropy's temperature.
    """

    actor: Learned
    value: Learned
    cost: Learned
    log_alpha: Learned


@flax.struct.dataclass
class HACOState:
    """Policy and values, and their data."""

    learned: HACOLearned
    replay: SplitBuffer


def intervention_cost(expert_action: jax.Array, novice_action: jax.Array) -> jax.Array:
    """C = 1 - cos(a_h, a_n) in [0, 2]; 0 where either is zero. [..., A] -> [...]."""
    chex.assert_equal_shape([expert_action, novice_action])
    norms = jnp.linalg.norm(expert_action, axis=-1) * jnp.linalg.norm(novice_action, axis=-1)
    dot = jnp.sum(expert_action * novice_action, -1)
    return jnp.where(norms < 1e-6, 0.0, 1.0 - dot / jnp.maximum(norms, 1e-6))


def proxy_loss(
    executed_value: jax.Array,
    novice_value: jax.Array,
    target: jax.Array,
    takeover: jax.Array,
    *,
    weight: jax.Array,
    conservative_weight: jax.Array | float,
) -> jax.Array:
    """E[1/2 (Q(s, a_b) - y)^2 - c I (Q(s, a_b) - Q(s, a_n))], summed over critics [K, B]."""
    chex.assert_equal_shape([executed_value, novice_value])
    chex.assert_equal_shape([target, takeover, weight])
    raised = jnp.mean(weight * takeover.astype(jnp.float32) * (executed_value - novice_value), -1)
    return 0.5 * td_loss(executed_value, target, weight) - conservative_weight * jnp.sum(raised)


def policy_loss(
    log_pi: jax.Array,
    values: jax.Array,
    costs: jax.Array,
    alpha: jax.Array | float,
    *,
    weight: jax.Array,
) -> jax.Array:
    """E[alpha log pi(a|s) - min_k Q_k(s, a) + min_k Qint_k(s, a)], [B], [K, B], [K, B]."""
    chex.assert_equal_shape([log_pi, weight], custom_message="log_pi and weight")
    chex.assert_shape([values, costs], (None, *log_pi.shape))
    return jnp.mean(weight * (alpha * log_pi - jnp.min(values, 0) + jnp.min(costs, 0)))


def init_state(key: jax.Array, networks: Networks, spec: EnvSpec, config: TrainConfig) -> HACOState:
    """Before the first step."""
    key_actor, key_value, key_cost = jax.random.split(key, 3)
    learned = HACOLearned(
        actor=init_learned(networks.actor.init(key_actor)),
        value=init_learned(networks.critic.init(key_value)),
        cost=init_learned(networks.critic.init(key_cost)),
        log_alpha=init_learned(jnp.zeros((), jnp.float32)),
    )
    return HACOState(learned=learned, replay=init_replay(spec, config))


def sample_action(
    params: Any, key: jax.Array, observation: jax.Array, actor: Network
) -> tuple[jax.Array, jax.Array]:
    """An action of the policy and its log-density, [..., O] -> [..., A], [...]."""
    mean, log_std = jnp.split(actor.apply(params, observation), 2, -1)
    return squashed_gaussian(key, mean, log_std)


def store(state: HACOState, step: Interaction, hparams: HParams) -> HACOState:
    """Keep a step."""
    del hparams
    return dataclasses.replace(state, replay=add_step(state.replay, step))


def value_loss(
    params: Any,
    batch: ReplayStep,
    target: jax.Array,
    weight: jax.Array,
    *,
    conservative_weight: jax.Array | float,
    networks: Networks,
) -> jax.Array:
    """L_Q of a batch with targets and weights [B]."""
    executed = networks.critic.apply(params, batch.observation, batch.executed_action)
    novices = networks.critic.apply(params, batch.observation, batch.novice_action)
    return proxy_loss(
        executed,
        novices,
        target,
        batch.takeover,
        weight=weight,
        conservative_weight=conservative_weight,
    )


def cost_loss(
    params: Any, batch: ReplayStep, target: jax.Array, weight: jax.Array, *, networks: Networks
) -> jax.Array:
    """L_int of a batch with targets and weights [B]."""
    at = batch.executed_action if networks.ported else batch.novice_action
    value = networks.critic.apply(params, batch.observation, at)
    return 0.5 * td_loss(value, target, weight)


def actor_loss(
    params: Any,
    learned: HACOLearned,
    key: jax.Array,
    observation: jax.Array,
    *,
    weight: jax.Array,
    networks: Networks,
) -> tuple[jax.Array, jax.Array]:
    """L_pi at observations [B, O] with weights [B], and the mean log-density."""
    action, log_pi = sample_action(params, key, observation, networks.actor)
    values = networks.critic.apply(learned.value.params, observation, action)
    costs = networks.critic.apply(learned.cost.params, observation, action)
    alpha = jnp.exp(learned.log_alpha.params)
    loss = policy_loss(log_pi, values, costs, alpha, weight=weight)
    return loss, jnp.mean(weight * log_pi)


def update(
    state: HACOState, key: jax.Array, hparams: HParams, *, networks: Networks, config: TrainConfig
) -> tuple[HACOState, Metrics]:
    """One step of Adam for both values, then for the policy and the temperature."""
    key_batch, key_next, key_actor = jax.random.split(key, 3)
    replay, count = state.replay, config.batch_size
    if networks.ported:
        batch, weight = buffers.sample_both(replay, key_batch, count)
    else:
        batch, weight = buffers.sample_split(replay, key_batch, count, hparams.recency)
    has_data = buffers.size(state.replay.human) > 0
    learned, discount = state.learned, hparams.method.discount
    step = functools.partial(adam_step, learning_rate=hparams.learning_rate, do=has_data)
    step_critic = functools.partial(step, polyak_tau=hparams.method.polyak_tau)
    action, log_pi = sample_action(
        learned.actor.params, key_next, batch.next_observation, networks.actor
    )
    alpha = jnp.exp(learned.log_alpha.params)
    values = networks.critic.apply(learned.value.average, batch.next_observation, action)
    costs = networks.critic.apply(learned.cost.average, batch.next_observation, action)
    paid = batch.takeover if networks.ported else batch.takeover_start
    price = intervention_cost(batch.expert_action, batch.novice_action)
    price = paid.astype(jnp.float32) * price
    loss = functools.partial(
        value_loss, conservative_weight=hparams.method.conservative_weight, networks=networks
    )
    loss_value, grads = jax.value_and_grad(loss)(
        learned.value.params,
        batch,
        td_target(values, batch.terminated, discount, entropy=-alpha * log_pi),
        weight,
    )
    value = step_critic(learned.value, grads)
    loss_cost, grads = jax.value_and_grad(functools.partial(cost_loss, networks=networks))(
        learned.cost.params,
        batch,
        td_target(costs, batch.terminated, discount, paid=price),
        weight,
    )
    cost = step_critic(learned.cost, grads)
    learned = dataclasses.replace(learned, value=value, cost=cost)
    loss = functools.partial(actor_loss, weight=weight, networks=networks)
    (loss_actor, mean_log_pi), grads = jax.value_and_grad(loss, has_aux=True)(
        learned.actor.params, learned, key_actor, batch.observation
    )
    actor = step(learned.actor, grads)
    # alpha grows while the entropy is below -A: d/d log_alpha of -log_alpha (log pi - A)
    log_alpha = step(learned.log_alpha, -(mean_log_pi - batch.novice_action.shape[-1]))
    learned = dataclasses.replace(learned, actor=actor, log_alpha=log_alpha)
    metrics = {"loss_value": loss_value, "loss_cost": loss_cost, "loss_actor": loss_actor}
    return dataclasses.replace(state, learned=learned), metrics | {"alpha": alpha}


def mean_layers(state: HACOState) -> Layers:
    """The layers of the policy's mean alone."""
    *before, (w, b) = layers(state.learned.actor.average)
    actions = b.shape[0] // 2
    return [*before, (w[:, :actions], b[:actions])]


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
    networks = Networks(
        actor=make_raw(spec, config.hidden, 2 * spec.action_size),
        critic=make_critic(spec, config.hidden, 2),
        ported=ported,
    )
    return Algorithm(
        name=name,
        init=functools.partial(init_state, networks=networks, spec=spec, config=config),
        act=lambda state, key, observation: sample_action(
            state.learned.actor.params, key, observation, networks.actor
        )[0],
        store=store,
        update=functools.partial(update, networks=networks, config=config),
        policy=mean_layers,
    )
