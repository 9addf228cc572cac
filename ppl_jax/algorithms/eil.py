"""Expert Intervention Learning (Spencer et al. 2020)."""

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
from ppl_jax.distributions import Likelihood
from ppl_jax.fields import setting
from ppl_jax.learned import ActorCritic, Learned, adam_step, init_learned
from ppl_jax.losses import Metrics
from ppl_jax.networks import Network, layers, make_critic, make_policy
from ppl_jax.policies import likelihood_of
from ppl_jax.types import EnvSpec, Interaction

OTHERS = 3  # uniform random actions that the expert's is held against
POLICY_DELAY = 2


@flax.struct.dataclass
class EILHParams:
    """Traced settings of EIL."""

    bc_weight: jax.Array | float = setting(
        0.0, "Weight of the behaviour-cloning loss; the publication has none.", low=0, common=True
    )
    margin: jax.Array | float = setting(
        0.1, "Hinge margins of the action values.", low=0, common=True
    )


class Networks(NamedTuple):
    """The networks: a policy and twin action values."""

    policy: Network
    critic: Network


@flax.struct.dataclass
class LabelledSteps:
    """Steps of the novice: `good` if no intervention followed within the window."""

    observation: jax.Array
    action: jax.Array
    good: jax.Array


@flax.struct.dataclass
class PendingSteps:
    """The novice's last steps, not judged yet, newest last.

    Attributes:
        observation, action: [W, O], [W, A].
        count: How many of the last rows are filled.
    """

    observation: jax.Array
    action: jax.Array
    count: jax.Array


class Batch(NamedTuple):
    """One half of the expert's steps, one half of the novice's: B each.

    Attributes:
        observation, expert_action: [B, O], [B, A] of the expert's steps.
        others: [OTHERS + 1, B, A] actions that the expert's is held against.
        labelled: The novice's, [B].
        weight: 0 while there are none of these, else 1.
    """

    observation: jax.Array
    expert_action: jax.Array
    others: jax.Array
    labelled: LabelledSteps
    weight: jax.Array


@flax.struct.dataclass
class EILState:
    """Policy and values, and their data.

    Attributes:
        learned: Policy and twin action values (without targets: nothing is bootstrapped).
        human_buffer: (observation, expert's action, novice's action) under the expert's control.
        robot_buffer: `LabelledSteps`.
        waiting: Those still to be judged.
    """

    learned: ActorCritic
    human_buffer: RingBuffer
    robot_buffer: RingBuffer
    waiting: PendingSteps


def judge(
    robot: RingBuffer, waiting: PendingSteps, step: Interaction
) -> tuple[RingBuffer, PendingSteps]:
    """Take one step in: the last W before an intervention are bad, all others good.

    A step is judged once W more have gone by, its episode has ended, or the expert has taken over.
    """
    window = waiting.action.shape[0]
    rows = jnp.arange(window + 1, dtype=jnp.int32)
    filled = (rows >= window - waiting.count) & (rows < window)
    done = step.terminated | step.truncated
    novice = ~step.takeover
    oldest = filled & (rows == 0)
    ended = filled | (rows == window)  # the present step too
    chosen = jnp.where(step.takeover_start, filled, novice & jnp.where(done, ended, oldest))
    observation = jnp.concatenate([waiting.observation, step.observation[None]])
    action = jnp.concatenate([waiting.action, step.executed_action[None]])
    good = jnp.broadcast_to(~step.takeover_start, chosen.shape)
    robot = buffers.add(
        robot, LabelledSteps(observation=observation, action=action, good=good), chosen
    )
    count = jnp.where(novice & ~done, jnp.minimum(waiting.count + 1, window), 0)
    kept = PendingSteps(
        observation=jnp.where(novice, observation[1:], waiting.observation),
        action=jnp.where(novice, action[1:], waiting.action),
        count=count,
    )
    return robot, kept


def hinge_losses(
    judged_value: jax.Array,
    good: jax.Array,
    expert_value: jax.Array,
    other_values: jax.Array,
    *,
    distance: jax.Array,
    margin: jax.Array | float,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The three terms, summed over critics; values count as good, where EIL's are costs.

        l_good = E[ good max(0, m - Q(s, a)) ]
        l_bad  = E[ (1 - good) max(0, m + Q(s, a)) ]
        l_C    = E[ max(0, m |a_h - a'| - (Q(s, a_h) - Q(s, a'))) ],  a' the novice's and random

    With m = 0, Q = 0 has no loss and nothing is learnt (a public port does that). The margin of the
    last grows with the distance because actions here are continuous: near ones are as good.

    Args:
        judged_value: [K, B] of the novice's steps.
        good: [B].
        expert_value: [K, B] of the expert's steps.
        other_values, distance: [K, N, B] and [N, B], of the actions a'.
        margin: m.
    """
    chex.assert_shape(judged_value, (None, *good.shape))
    chex.assert_shape(other_values, (expert_value.shape[0], *distance.shape))
    chex.assert_shape(expert_value, (None, distance.shape[-1]))
    good = good.astype(jnp.float32)
    good_loss = jnp.sum(jnp.mean(good * jax.nn.relu(margin - judged_value), -1))
    bad_loss = jnp.sum(jnp.mean((1.0 - good) * jax.nn.relu(margin + judged_value), -1))
    gap = expert_value[:, None] - other_values
    compared = jnp.sum(jnp.mean(jax.nn.relu(margin * distance - gap), (-2, -1)))
    return good_loss, bad_loss, compared


def init_state(key: jax.Array, networks: Networks, spec: EnvSpec, config: TrainConfig) -> EILState:
    """Before the first step."""
    key_actor, key_critic = jax.random.split(key)
    observation, action = spec.zeros()
    rows, window = config.human_rows, config.decision_interval
    labelled = LabelledSteps(observation=observation, action=action, good=jnp.zeros((), bool))
    return EILState(
        learned=ActorCritic(
            actor=init_learned(networks.policy.init(key_actor)),
            critic=init_learned(networks.critic.init(key_critic)),
        ),
        human_buffer=buffers.init_buffer((observation, action, action), rows),
        robot_buffer=buffers.init_buffer(labelled, rows),
        waiting=PendingSteps(
            observation=jnp.zeros((window, spec.observation_size), jnp.float32),
            action=jnp.zeros((window, spec.action_size), jnp.float32),
            count=jnp.zeros((), jnp.int32),
        ),
    )


def store(state: EILState, step: Interaction, hparams: HParams) -> EILState:
    """Keep a step of the expert, or judge one of the novice."""
    del hparams
    item = (step.observation[None], step.expert_action[None], step.novice_action[None])
    robot, waiting = judge(state.robot_buffer, state.waiting, step)
    return dataclasses.replace(
        state,
        human_buffer=buffers.add(state.human_buffer, item, step.takeover[None]),
        robot_buffer=robot,
        waiting=waiting,
    )


def sample_batch(
    state: EILState, key: jax.Array, half: int, recency: jax.Array | float = 0.0
) -> Batch:
    """`half` steps of either party, and the actions that the expert's are held against."""
    key_human, key_robot, key_others = jax.random.split(key, 3)
    observation, action, novices = buffers.sample(state.human_buffer, key_human, half, recency)
    labelled = buffers.sample(state.robot_buffer, key_robot, half, recency)
    random = jax.random.uniform(
        key_others, (OTHERS, *action.shape), jnp.float32, minval=-1.0, maxval=1.0
    )
    return Batch(
        observation=observation,
        expert_action=action,
        others=jnp.concatenate([novices[None], random]),
        labelled=labelled,
        weight=(buffers.size(state.robot_buffer) > 0).astype(jnp.float32),
    )


def critic_loss(
    params: Any, batch: Batch, margin: jax.Array | float, critic: Network
) -> tuple[jax.Array, Metrics]:
    """L_Q of a batch."""
    observation, others, labelled = batch.observation, batch.others, batch.labelled
    size = (others.shape[0], *observation.shape)
    good, bad, compared = hinge_losses(
        critic.apply(params, labelled.observation, labelled.action),
        labelled.good,
        critic.apply(params, observation, batch.expert_action),
        critic.apply(params, jnp.broadcast_to(observation, size), others),
        distance=jnp.sqrt(jnp.sum((others - batch.expert_action) ** 2, -1)),
        margin=margin,
    )
    metrics = {"loss_good": good, "loss_bad": bad, "loss_compared": compared}
    return batch.weight * (good + bad) + compared, metrics


def actor_loss(
    params: Any,
    critics: Any,
    batch: Batch,
    *,
    bc_weight: jax.Array | float,
    networks: Networks,
    likelihood: Likelihood,
) -> jax.Array:
    """L_mu of a batch; `critics` are the parameters of the values."""
    half = batch.expert_action.shape[0]
    observation = jnp.concatenate([batch.observation, batch.labelled.observation])
    weight = jnp.concatenate(
        [jnp.ones(half, jnp.float32), batch.weight * jnp.ones(half, jnp.float32)]
    )
    action = networks.policy.apply(params, observation)
    value = networks.critic.apply(critics, observation, action)[0]
    cloned = jnp.mean(likelihood.log_prob(action[:half], batch.expert_action))
    return -jnp.mean(weight * value) - bc_weight * cloned


def update(
    state: EILState, key: jax.Array, hparams: HParams, *, networks: Networks, config: TrainConfig
) -> tuple[EILState, Metrics]:
    """One step of Adam for the values, and every second time for the policy."""
    batch = sample_batch(state, key, config.batch_size // 2, hparams.recency)
    has_human = buffers.size(state.human_buffer) > 0
    actor, critics = state.learned.actor, state.learned.critic
    grads, metrics = jax.grad(critic_loss, has_aux=True)(
        critics.params, batch, hparams.method.margin, networks.critic
    )
    critics = adam_step(critics, grads, hparams.learning_rate, has_human, polyak_tau=1.0)

    def improve(actor: Learned) -> Learned:
        loss = functools.partial(
            actor_loss,
            bc_weight=hparams.method.bc_weight,
            networks=networks,
            likelihood=likelihood_of(config, hparams),
        )
        grads = jax.grad(loss)(actor.params, critics.params, batch)
        return adam_step(actor, grads, hparams.learning_rate)

    turn = has_human & (critics.updates % POLICY_DELAY == 0)
    actor = jax.lax.cond(turn, improve, lambda actor: actor, actor)
    learned = ActorCritic(actor=actor, critic=critics)
    return dataclasses.replace(state, learned=learned), metrics


def make_eil(spec: EnvSpec, config: TrainConfig) -> Algorithm:
    """EIL: being left alone says that a step was good enough, an intervention that it was not.

        L_Q = l_good + l_bad + l_C (`hinge_losses`),  L_mu = -E[ Q_1(s, mu(s)) ]

    The window before an intervention that counts as bad is one decision interval. The published
    method picks from a library of actions; here the policy climbs Q, and l_C compares with random
    actions in the library's place.
    """
    networks = Networks(
        policy=make_policy(spec, config.hidden), critic=make_critic(spec, config.hidden, 2)
    )
    return Algorithm(
        name="eil",
        init=functools.partial(init_state, networks=networks, spec=spec, config=config),
        act=lambda state, key, observation: networks.policy.apply(
            state.learned.actor.params, observation
        ),
        store=store,
        update=functools.partial(update, networks=networks, config=config),
        policy=lambda state: layers(state.learned.actor.average),
    )
