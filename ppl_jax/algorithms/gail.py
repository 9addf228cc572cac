"""Generative Adversarial Imitation Learning (Ho and Ermon 2016), with PPO."""

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
from ppl_jax.distributions import gaussian_log_prob, log_likelihood
from ppl_jax.fields import setting
from ppl_jax.gates import never
from ppl_jax.losses import Metrics
from ppl_jax.networks import Layers, layers, make_critic, make_policy, make_raw
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
    """What updates change.

    Attributes:
        policy: `Learned` of {"mean": network, "log_std": [A]}.
        value: Of the state value.
        discriminator: Of the logit of D, the probability that (s, a) is the expert's.
    """

    policy: Learned
    value: Learned
    discriminator: Learned


@flax.struct.dataclass
class GAILState:
    """What is learnt, and from what.

    Attributes:
        learned: `GAILLearned`.
        human_buffer: Demonstrations (observation, action).
        rollout: The novice's steps since the last update, in order.
    """

    learned: GAILLearned
    human_buffer: RingBuffer
    rollout: RingBuffer


def discriminator_loss(expert_logit: jax.Array, novice_logit: jax.Array) -> jax.Array:
    """Binary cross-entropy -E_expert[log D] - E_novice[log(1 - D)], D = sigmoid(logit)."""
    return jnp.mean(jax.nn.softplus(-expert_logit)) + jnp.mean(jax.nn.softplus(novice_logit))


def imitation_reward(logit: jax.Array, correction: jax.Array | float) -> jax.Array:
    """-log(1 - D) + correction log D.

    The published reward, -log(1 - D), is never negative: an episode that ends earns less than one
    that loiters, so that where solving the task ends it, it is better not to (survival bias). With
    correction 1 the reward is log D - log(1 - D), the logit (Fu et al. 2018).
    """
    return jax.nn.softplus(logit) - correction * jax.nn.softplus(-logit)


def make_gail(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """GAIL: a discriminator between demonstrations and the novice is the reward of PPO.

    Nobody takes over. With `offline_updates` the policy's mean clones the demonstrations first.
    """
    policy, value = make_policy(spec, config.hidden), make_raw(spec, config.hidden, 1)
    discriminator = make_critic(spec, config.hidden, 1)
    size, batches = config.batch_size, max(config.method.rollout_steps // config.batch_size, 1)

    def init(key: jax.Array) -> GAILState:
        key_policy, key_value, key_disc = jax.random.split(key, 3)
        observation, action = jnp.zeros(spec.observation_size), jnp.zeros(spec.action_size)
        no = jnp.zeros((), bool)
        start = {
            "mean": policy.init(key_policy),
            "log_std": jnp.full(spec.action_size, INITIAL_LOG_STD),
        }
        return GAILState(
            learned=GAILLearned(
                init_learned(start),
                init_learned(value.init(key_value)),
                init_learned(discriminator.init(key_disc)),
            ),
            human_buffer=buffers.init_buffer((observation, action), max(config.demonstrations, 1)),
            rollout=buffers.init_buffer(
                OnPolicyStep(observation, action, observation, no, no), config.method.rollout_steps
            ),
        )

    def act(state: GAILState, key: jax.Array, observation: jax.Array) -> jax.Array:
        params = state.learned.policy.params
        mean = policy.apply(params["mean"], observation)
        return mean + jnp.exp(params["log_std"]) * jax.random.normal(key, mean.shape)

    def store(state: GAILState, step: Interaction, hparams: HParams) -> GAILState:
        del hparams
        shown = (step.observation[None], step.expert_action[None])
        made = OnPolicyStep(
            step.observation,
            step.novice_action,
            step.next_observation,
            step.terminated,
            step.terminated | step.truncated,
        )
        return dataclasses.replace(
            state,
            human_buffer=buffers.add(state.human_buffer, shown, step.takeover[None]),
            rollout=buffers.add(
                state.rollout, jax.tree.map(lambda x: x[None], made), ~step.takeover[None]
            ),
        )

    def logit(params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        return discriminator.apply(params, observation, jnp.clip(action, -1.0, 1.0))[0]

    def log_prob(params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        mean = policy.apply(params["mean"], observation)
        return gaussian_log_prob(mean, params["log_std"], action)

    def discriminate(
        state: GAILState, learned: Learned, key: jax.Array, hparams: HParams
    ) -> tuple[Learned, jax.Array]:
        def step(learned: Learned, key: jax.Array) -> tuple[Learned, jax.Array]:
            key_human, key_made = jax.random.split(key)
            shown, action = buffers.sample(state.human_buffer, key_human, size)
            made = buffers.sample(state.rollout, key_made, size)

            def loss(params: Any) -> jax.Array:
                return discriminator_loss(
                    logit(params, shown, action), logit(params, made.observation, made.action)
                )

            value, grads = jax.value_and_grad(loss)(learned.params)
            return adam_step(learned, grads, hparams.method.discriminator_rate), value

        keys = jax.random.split(key, DISCRIMINATOR_UPDATES)
        learned, losses = jax.lax.scan(step, learned, keys)
        return learned, losses[-1]

    def improve(
        learned: GAILLearned, steps: OnPolicyStep, reward: jax.Array, key: jax.Array, hparams: Any
    ) -> tuple[GAILLearned, jax.Array]:
        """PPO's epochs over one rollout."""
        before = value.apply(learned.value.params, steps.observation)[..., 0]
        after = value.apply(learned.value.params, steps.next_observation)[..., 0]
        advantage = advantages(
            reward, before, after, steps.terminated, steps.done, hparams.method.discount, GAE_LAMBDA
        )
        returns = advantage + before
        advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
        old = log_prob(learned.policy.params, steps.observation, steps.action)

        def minibatch(learned: GAILLearned, rows: jax.Array) -> tuple[GAILLearned, jax.Array]:
            observation, action = steps.observation[rows], steps.action[rows]

            def policy_loss(params: Any) -> jax.Array:
                new = log_prob(params, observation, action)
                return clipped_loss(new, old[rows], advantage[rows])

            def value_loss(params: Any) -> jax.Array:
                return jnp.mean((value.apply(params, observation)[..., 0] - returns[rows]) ** 2)

            loss, grads = jax.value_and_grad(value_loss)(learned.value.params)
            learned = dataclasses.replace(
                learned,
                policy=adam_step(
                    learned.policy,
                    jax.grad(policy_loss)(learned.policy.params),
                    hparams.learning_rate,
                ),
                value=adam_step(learned.value, grads, hparams.learning_rate),
            )
            return learned, loss

        def epoch(learned: GAILLearned, key: jax.Array) -> tuple[GAILLearned, jax.Array]:
            order = jax.random.permutation(key, config.method.rollout_steps)
            rows = order[: batches * size].reshape(batches, -1)
            return jax.lax.scan(minibatch, learned, rows)

        learned, losses = jax.lax.scan(epoch, learned, jax.random.split(key, EPOCHS))
        return learned, jnp.mean(losses)

    def update(state: GAILState, key: jax.Array, hparams: HParams) -> tuple[GAILState, Metrics]:
        key_disc, key_policy = jax.random.split(key)
        steps: OnPolicyStep = state.rollout.data  # full and in order: it is as long as a round
        disc, loss = discriminate(state, state.learned.discriminator, key_disc, hparams)
        novice_logit = logit(disc.params, steps.observation, steps.action)
        reward = imitation_reward(novice_logit, hparams.method.survival_correction)
        learned = dataclasses.replace(state.learned, discriminator=disc)
        learned, value_loss = improve(learned, steps, reward, key_policy, hparams)
        return dataclasses.replace(state, learned=learned), {
            "loss_discriminator": loss,
            "loss_value": value_loss,
            "imitation_reward": jnp.mean(reward),
        }

    def fit(state: GAILState, key: jax.Array, hparams: HParams) -> tuple[GAILState, Metrics]:
        observation, action = buffers.sample(state.human_buffer, key, size)

        def loss(params: Any) -> jax.Array:
            mean = policy.apply(params["mean"], observation)
            return -jnp.mean(log_likelihood(mean, action, config.likelihood))

        value, grads = jax.value_and_grad(loss)(state.learned.policy.params)
        learned = dataclasses.replace(
            state.learned, policy=adam_step(state.learned.policy, grads, hparams.learning_rate)
        )
        return dataclasses.replace(state, learned=learned), {"loss_bc": value}

    def policy_layers(state: GAILState) -> Layers:
        return layers(state.learned.policy.average["mean"])

    return Algorithm(
        name="gail",
        init=init,
        act=act,
        decide=never,
        store=store,
        update=update,
        policy=policy_layers,
        update_every=config.method.rollout_steps,
        fit=fit,
    )
