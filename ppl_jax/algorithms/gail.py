"""Generative Adversarial Imitation Learning (Ho and Ermon 2016), with PPO."""

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
from ppl_jax.buffers import RingBuffer
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.distributions import gaussian_log_prob
from ppl_jax.fields import setting
from ppl_jax.gates import never
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import Metrics
from ppl_jax.networks import Network, layers, make_critic, make_policy, make_raw
from ppl_jax.policies import likelihood_of
from ppl_jax.ppo.losses import advantages, clipped_loss
from ppl_jax.types import EnvSpec, Interaction

GAE_LAMBDA = 0.95
EPOCHS = 5
DISCRIMINATOR_UPDATES = 8  # per rollout
INITIAL_LOG_STD = -0.7


@dataclasses.dataclass(frozen=True)
class GAILConfig:
    """Static settings of GAIL."""

    rollout_steps: int = setting(2000, "Steps between updates.", low=1, common=True)


@flax.struct.dataclass
class GAILHParams:
    """Traced settings of GAIL."""

    discount: jax.Array | float = setting(0.99, "gamma.", low=0, high=1, common=True)
    discriminator_rate: jax.Array | float = setting(
        3e-4, "Adam's learning rate of the discriminator.", low=0, common=True
    )
    survival_correction: jax.Array | float = setting(
        1.0,
        "1 for the reward log D - log(1 - D), 0 for -log(1 - D).",
        low=0,
        high=1,
        common=True,
    )


class Networks(NamedTuple):
    """The networks: the policy's mean, the state value and the discriminator's logit."""

    policy: Network
    value: Network
    discriminator: Network


@flax.struct.dataclass
class OnPolicyStep:
    """A step of the novice."""

    observation: jax.Array
    action: jax.Array
    next_observation: jax.Array
    terminated: jax.Array
    done: jax.Array


@flax.struct.dataclass
class GAILLearned:
    """All that updates change.

    Attributes:
        policy: `Learned` of {"mean": network, "log_std": [A]}.
        value: `Learned` of the state value.
        discriminator: `Learned` of the logit of D, the probability that (s, a) is the expert's.
    """

    policy: Learned
    value: Learned
    discriminator: Learned


@flax.struct.dataclass
class GAILState:
    """The networks' parameters and their data.

    Attributes:
        learned: `GAILLearned`.
        human_buffer: Demonstrations (observation, action).
        rollout: The novice's steps since the last update, in order.
    """

    learned: GAILLearned
    human_buffer: RingBuffer
    rollout: RingBuffer


def discriminator_loss(expert_logit: jax.Array, novice_logit: jax.Array) -> jax.Array:
    """Binary cross-entropy -E_expert[log D] - E_novice[log(1 - D)], D = sigmoid(logit) [B]."""
    chex.assert_rank([expert_logit, novice_logit], 1)
    return jnp.mean(jax.nn.softplus(-expert_logit)) + jnp.mean(jax.nn.softplus(novice_logit))


def imitation_reward(logit: jax.Array, correction: jax.Array | float) -> jax.Array:
    """-log(1 - D) + correction log D.

    The published reward, -log(1 - D), is never negative: an episode that ends earns less than one
    that loiters, so that where solving the task ends it, it is better not to (survival bias). With
    correction 1 the reward is log D - log(1 - D), the logit (Fu et al. 2018).
    """
    return jax.nn.softplus(logit) - correction * jax.nn.softplus(-logit)


def init_state(key: jax.Array, networks: Networks, spec: EnvSpec, config: TrainConfig) -> GAILState:
    """Before the first step."""
    key_policy, key_value, key_disc = jax.random.split(key, 3)
    observation, action = spec.zeros()
    no = jnp.zeros((), bool)
    start = {
        "mean": networks.policy.init(key_policy),
        "log_std": jnp.full(spec.action_size, INITIAL_LOG_STD, jnp.float32),
    }
    step = OnPolicyStep(
        observation=observation,
        action=action,
        next_observation=observation,
        terminated=no,
        done=no,
    )
    return GAILState(
        learned=GAILLearned(
            policy=init_learned(start),
            value=init_learned(networks.value.init(key_value)),
            discriminator=init_learned(networks.discriminator.init(key_disc)),
        ),
        human_buffer=buffers.init_buffer((observation, action), max(config.demonstrations, 1)),
        rollout=buffers.init_buffer(step, config.method.rollout_steps),
    )


def act(state: GAILState, key: jax.Array, observation: jax.Array, networks: Networks) -> jax.Array:
    """An action of the Gaussian policy."""
    params = state.learned.policy.params
    mean = networks.policy.apply(params["mean"], observation)
    return mean + jnp.exp(params["log_std"]) * jax.random.normal(key, mean.shape, jnp.float32)


def store(state: GAILState, step: Interaction, hparams: HParams) -> GAILState:
    """Keep a step with the demonstrations or with the novice's rollout."""
    del hparams
    shown = (step.observation[None], step.expert_action[None])
    made = OnPolicyStep(
        observation=step.observation,
        action=step.novice_action,
        next_observation=step.next_observation,
        terminated=step.terminated,
        done=step.terminated | step.truncated,
    )
    return dataclasses.replace(
        state,
        human_buffer=buffers.add(state.human_buffer, shown, step.takeover[None]),
        rollout=buffers.add(
            state.rollout, jax.tree.map(lambda x: x[None], made), ~step.takeover[None]
        ),
    )


def logit(params: Any, observation: jax.Array, action: jax.Array, networks: Networks) -> jax.Array:
    """The discriminator's logit, [..., O], [..., A] -> [...]."""
    return networks.discriminator.apply(params, observation, jnp.clip(action, -1.0, 1.0))[0]


def log_prob(
    params: Any, observation: jax.Array, action: jax.Array, networks: Networks
) -> jax.Array:
    """Log-density of actions under the policy, [..., O], [..., A] -> [...]."""
    mean = networks.policy.apply(params["mean"], observation)
    return gaussian_log_prob(mean, params["log_std"], action)


def discriminate(
    state: GAILState, key: jax.Array, hparams: HParams, *, networks: Networks, config: TrainConfig
) -> tuple[Learned, jax.Array]:
    """The discriminator after its updates of one round, and the last of its losses."""

    def step(learned: Learned, key: jax.Array) -> tuple[Learned, jax.Array]:
        key_human, key_made = jax.random.split(key)
        shown, action = buffers.sample(state.human_buffer, key_human, config.batch_size)
        made = buffers.sample(state.rollout, key_made, config.batch_size)

        def loss(params: Any) -> jax.Array:
            return discriminator_loss(
                logit(params, shown, action, networks),
                logit(params, made.observation, made.action, networks),
            )

        value, grads = jax.value_and_grad(loss)(learned.params)
        return adam_step(learned, grads, hparams.method.discriminator_rate), value

    keys = jax.random.split(key, DISCRIMINATOR_UPDATES)
    learned, losses = jax.lax.scan(step, state.learned.discriminator, keys)
    return learned, losses[-1]


class PPOBatch(NamedTuple):
    """Steps of a rollout as PPO sees them, [B].

    Attributes:
        observation, action: [B, O], [B, A].
        log_prob: Log-density of the actions when they were made.
        advantage: Normalised.
        returns: Targets of the value.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    returns: jax.Array


def ppo_batch(
    learned: GAILLearned,
    steps: OnPolicyStep,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    networks: Networks,
) -> PPOBatch:
    """A whole rollout [T] with its advantages, from rewards [T]."""
    before = networks.value.apply(learned.value.params, steps.observation)[..., 0]
    after = networks.value.apply(learned.value.params, steps.next_observation)[..., 0]
    advantage = advantages(
        reward,
        before,
        after,
        steps.terminated,
        done=steps.done,
        discount=discount,
        gae_lambda=GAE_LAMBDA,
    )
    returns = advantage + before
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    old = log_prob(learned.policy.params, steps.observation, steps.action, networks)
    return PPOBatch(
        observation=steps.observation,
        action=steps.action,
        log_prob=old,
        advantage=advantage,
        returns=returns,
    )


def policy_loss(params: Any, batch: PPOBatch, networks: Networks) -> jax.Array:
    """PPO's clipped objective, negated."""
    new = log_prob(params, batch.observation, batch.action, networks)
    return clipped_loss(new, batch.log_prob, batch.advantage)


def value_loss(params: Any, batch: PPOBatch, networks: Networks) -> jax.Array:
    """Mean squared error of the state value."""
    return jnp.mean((networks.value.apply(params, batch.observation)[..., 0] - batch.returns) ** 2)


def improve(
    learned: GAILLearned,
    rollout: PPOBatch,
    key: jax.Array,
    learning_rate: jax.Array | float,
    *,
    networks: Networks,
    batch_size: int,
) -> tuple[GAILLearned, jax.Array]:
    """PPO's epochs over one rollout: all that was learned, and the mean loss of the value."""
    count = rollout.action.shape[0]
    batches = max(count // batch_size, 1)

    def minibatch(learned: GAILLearned, rows: jax.Array) -> tuple[GAILLearned, jax.Array]:
        batch = jax.tree.map(lambda leaf: leaf[rows], rollout)
        policy, value = learned.policy, learned.value
        loss, grads = jax.value_and_grad(value_loss)(value.params, batch, networks)
        learned = dataclasses.replace(
            learned,
            policy=adam_step(
                policy, jax.grad(policy_loss)(policy.params, batch, networks), learning_rate
            ),
            value=adam_step(value, grads, learning_rate),
        )
        return learned, loss

    def epoch(learned: GAILLearned, key: jax.Array) -> tuple[GAILLearned, jax.Array]:
        order = jax.random.permutation(key, count)
        rows = order[: batches * batch_size].reshape(batches, -1)
        return jax.lax.scan(minibatch, learned, rows)

    learned, losses = jax.lax.scan(epoch, learned, jax.random.split(key, EPOCHS))
    return learned, jnp.mean(losses)


def update(
    state: GAILState, key: jax.Array, hparams: HParams, *, networks: Networks, config: TrainConfig
) -> tuple[GAILState, Metrics]:
    """One round: the discriminator, then PPO on its reward."""
    key_disc, key_policy = jax.random.split(key)
    steps: OnPolicyStep = state.rollout.data  # full and in order: it is as long as a round
    disc, loss = discriminate(state, key_disc, hparams, networks=networks, config=config)
    novice_logit = logit(disc.params, steps.observation, steps.action, networks)
    reward = imitation_reward(novice_logit, hparams.method.survival_correction)
    learned = dataclasses.replace(state.learned, discriminator=disc)
    rollout = ppo_batch(learned, steps, reward, hparams.method.discount, networks=networks)
    learned, loss_value = improve(
        learned,
        rollout,
        key_policy,
        hparams.learning_rate,
        networks=networks,
        batch_size=config.batch_size,
    )
    return dataclasses.replace(state, learned=learned), {
        "loss_discriminator": loss,
        "loss_value": loss_value,
        "imitation_reward": jnp.mean(reward),
    }


def fit(
    state: GAILState, key: jax.Array, hparams: HParams, *, networks: Networks, config: TrainConfig
) -> tuple[GAILState, Metrics]:
    """One update of the policy's mean that clones the demonstrations."""
    observation, action = buffers.sample(state.human_buffer, key, config.batch_size)

    def loss(params: Any) -> jax.Array:
        mean = networks.policy.apply(params["mean"], observation)
        return -jnp.mean(likelihood_of(config, hparams).log_prob(mean, action))

    value, grads = jax.value_and_grad(loss)(state.learned.policy.params)
    learned = dataclasses.replace(
        state.learned, policy=adam_step(state.learned.policy, grads, hparams.learning_rate)
    )
    return dataclasses.replace(state, learned=learned), {"loss_bc": value}


def make_gail(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """GAIL: a discriminator between demonstrations and the novice is the reward of PPO.

    Nobody takes over. With `offline_updates` the policy's mean clones the demonstrations first.
    """
    networks = Networks(
        policy=make_policy(spec, config.hidden),
        value=make_raw(spec, config.hidden, 1),
        discriminator=make_critic(spec, config.hidden, 1),
    )
    parts = {"networks": networks, "config": config}
    return Algorithm(
        name="gail",
        init=functools.partial(init_state, spec=spec, **parts),
        act=functools.partial(act, networks=networks),
        decide=never,
        store=store,
        update=functools.partial(update, **parts),
        policy=lambda state: layers(state.learned.policy.average["mean"]),
        update_every=config.method.rollout_steps,
        fit=functools.partial(fit, **parts),
    )
