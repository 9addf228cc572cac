"""Proxy Value Propagation (Peng et al. 2023)."""

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
from ppl_jax.distributions import Likelihood
from ppl_jax.fields import setting
from ppl_jax.learned import ActorCritic, Learned, adam_step, init_learned
from ppl_jax.losses import Metrics
from ppl_jax.networks import Network, layers, make_critic, make_policy
from ppl_jax.policies import likelihood_of
from ppl_jax.types import EnvSpec, Interaction

TARGET_NOISE, NOISE_CLIP = 0.2, 0.5  # TD3's, on the target policy's action
POLICY_DELAY = 2  # TD3's: updates of the critic per update of the actor


@flax.struct.dataclass
class PVPHParams:
    """Traced settings of PVP."""

    bc_weight: jax.Array | float = setting(
        0.0, "Weight of the cloning term: 0 in PVP, 1 in PVP4Real.", low=0, common=True
    )
    discount: jax.Array | float = setting(0.99, "gamma.", low=0, high=1, common=True)
    polyak_tau: jax.Array | float = setting(0.005, "tau of the target networks.", low=0, high=1)


class Networks(NamedTuple):
    """The networks: a policy and twin action values."""

    policy: Network
    critic: Network


@flax.struct.dataclass
class PVPState:
    """Policy and values, and their data.

    Attributes:
        learned: Policy and twin proxy values.
        replay: Steps of the expert and of the novice.
    """

    learned: ActorCritic
    replay: SplitBuffer


def proxy_value_loss(
    expert_value: jax.Array, novice_value: jax.Array, takeover: jax.Array, weight: jax.Array
) -> jax.Array:
    """L_PV = E[ I ((Q(s, a_h) - 1)^2 + (Q(s, a_n) + 1)^2) ], summed over critics [K, B].

    The mean is over the whole batch, the novice's steps (I = 0) included.
    """
    chex.assert_equal_shape([expert_value, novice_value])
    chex.assert_equal_shape([takeover, weight])
    chex.assert_shape(expert_value, (None, *takeover.shape))
    each = (expert_value - 1.0) ** 2 + (novice_value + 1.0) ** 2
    return jnp.sum(jnp.mean(weight * takeover.astype(jnp.float32) * each, -1))


def policy_loss(
    value: jax.Array,
    log_pi: jax.Array,
    takeover: jax.Array,
    weight: jax.Array,
    *,
    bc_weight: jax.Array | float,
) -> jax.Array:
    """-E[Q_1(s, mu(s)) + bc_weight I log pi(a_h|s)], [B] each; the mean is over the whole batch."""
    chex.assert_equal_shape([value, log_pi, takeover, weight])
    return -jnp.mean(weight * (value + bc_weight * takeover.astype(jnp.float32) * log_pi))


def init_state(key: jax.Array, networks: Networks, spec: EnvSpec, config: TrainConfig) -> PVPState:
    """Before the first step."""
    key_actor, key_critic = jax.random.split(key)
    learned = ActorCritic(
        actor=init_learned(networks.policy.init(key_actor)),
        critic=init_learned(networks.critic.init(key_critic)),
    )
    return PVPState(learned=learned, replay=init_replay(spec, config))


def store(state: PVPState, step: Interaction, hparams: HParams) -> PVPState:
    """Keep a step."""
    del hparams
    return dataclasses.replace(state, replay=add_step(state.replay, step))


def smoothed_target(
    learned: ActorCritic,
    batch: ReplayStep,
    key: jax.Array,
    discount: jax.Array | float,
    *,
    networks: Networks,
) -> jax.Array:
    """TD3's target (Fujimoto et al. 2018): the target policy's action with clipped noise, [B]."""
    noise = TARGET_NOISE * jax.random.normal(key, batch.executed_action.shape, jnp.float32)
    following = networks.policy.apply(learned.actor.average, batch.next_observation)
    following = following + jnp.clip(noise, -NOISE_CLIP, NOISE_CLIP)
    values = networks.critic.apply(
        learned.critic.average, batch.next_observation, jnp.clip(following, -1.0, 1.0)
    )
    return td_target(values, batch.terminated, discount)


def critic_loss(
    params: Any, batch: ReplayStep, target: jax.Array, weight: jax.Array, *, critic: Network
) -> tuple[jax.Array, Metrics]:
    """L_Q of a batch with targets and weights [B]."""
    executed = critic.apply(params, batch.observation, batch.executed_action)
    novices = critic.apply(params, batch.observation, batch.novice_action)
    # where the expert is in control, its action is the one that is executed
    proxy = proxy_value_loss(executed, novices, batch.takeover, weight)
    td = td_loss(executed, target, weight)
    return proxy + td, {"loss_proxy_value": proxy, "loss_td": td}


def actor_loss(
    params: Any,
    critics: Any,
    batch: ReplayStep,
    weight: jax.Array,
    *,
    hparams: HParams,
    networks: Networks,
    likelihood: Likelihood,
) -> jax.Array:
    """L_mu of a batch with weights [B]; `critics` are the parameters of the values."""
    action = networks.policy.apply(params, batch.observation)
    value = networks.critic.apply(critics, batch.observation, action)[0]
    log_pi = likelihood.log_prob(action, batch.expert_action)
    return policy_loss(value, log_pi, batch.takeover, weight, bc_weight=hparams.method.bc_weight)


def update(
    state: PVPState, key: jax.Array, hparams: HParams, *, networks: Networks, config: TrainConfig
) -> tuple[PVPState, Metrics]:
    """One step of Adam for the values, and every second time for the policy."""
    key_batch, key_noise = jax.random.split(key)
    batch, weight = buffers.sample_split(
        state.replay, key_batch, config.batch_size, hparams.recency
    )
    has_data = buffers.size(state.replay.human) > 0
    actor, critics = state.learned.actor, state.learned.critic
    target = smoothed_target(
        state.learned, batch, key_noise, hparams.method.discount, networks=networks
    )
    loss = functools.partial(critic_loss, critic=networks.critic)
    grads, metrics = jax.grad(loss, has_aux=True)(critics.params, batch, target, weight)
    critics = adam_step(
        critics, grads, hparams.learning_rate, has_data, polyak_tau=hparams.method.polyak_tau
    )

    def improve(actor: Learned) -> Learned:
        likelihood = likelihood_of(config, hparams)
        loss = functools.partial(
            actor_loss,
            hparams=hparams,
            networks=networks,
            likelihood=likelihood,
        )
        grads = jax.grad(loss)(actor.params, critics.params, batch, weight)
        return adam_step(actor, grads, hparams.learning_rate)

    turn = has_data & (critics.updates % POLICY_DELAY == 0)
    actor = jax.lax.cond(turn, improve, lambda actor: actor, actor)
    learned = ActorCritic(actor=actor, critic=critics)
    return dataclasses.replace(state, learned=learned), metrics


def make_pvp(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """PVP on TD3: the expert's actions are worth 1, those it overruled -1, and values spread.

        L_Q  = L_PV + E[(Q(s, a_b) - y)^2],   y = gamma (1 - terminated) min_k Q'_k(s', mu'(s') + e)
        L_mu = -E[ Q_1(s, mu(s)) ] + bc_weight E[ -I log pi(a_h|s) ]

    No reward. Batches are one half of the expert's steps and one half of the novice's. The paper
    has no cloning term (`bc_weight` 0); "PVP4Real" is PVP with `bc_weight` 1.
    """
    networks = Networks(
        policy=make_policy(spec, config.hidden), critic=make_critic(spec, config.hidden, 2)
    )
    return Algorithm(
        name="pvp",
        init=functools.partial(init_state, networks=networks, spec=spec, config=config),
        act=lambda state, key, observation: networks.policy.apply(
            state.learned.actor.params, observation
        ),
        store=store,
        update=functools.partial(update, networks=networks, config=config),
        policy=lambda state: layers(state.learned.actor.average),
    )


def make_pvp4real(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """PVP as the PVP4Real repository runs it: with a cloning term, `bc_weight` 1."""
    return make_pvp(spec, config)
