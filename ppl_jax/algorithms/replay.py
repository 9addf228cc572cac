"""Steps as methods with action values store them, and the losses of these values."""

from __future__ import annotations

import chex
import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax import buffers
from ppl_jax.buffers import SplitBuffer
from ppl_jax.config import TrainConfig
from ppl_jax.types import EnvSpec, Interaction


@flax.struct.dataclass
class ReplayStep:
    """A step; the fields are `Interaction`'s.

    Attributes:
        next_observation: That of the same episode, at its last step too.
        terminated: A value has nothing to follow; a step cut off by time has.
    """

    observation: jax.Array
    next_observation: jax.Array
    novice_action: jax.Array
    expert_action: jax.Array
    executed_action: jax.Array
    takeover: jax.Array
    takeover_start: jax.Array
    terminated: jax.Array


def td_target(
    next_values: jax.Array,
    terminated: jax.Array,
    discount: jax.Array | float,
    *,
    paid: jax.Array | float = 0.0,
    entropy: jax.Array | float = 0.0,
) -> jax.Array:
    """Target y = paid + gamma (1 - terminated) (min_k Q'_k + entropy), [K, B] -> [B].

    Args:
        next_values: The target networks' at (s', a').
        terminated: Not where an episode was cut off by time.
        discount: gamma.
        paid: Reward or cost of the step, [B]; there is no reward here.
        entropy: -alpha log pi(a'|s'), [B], of methods that have one.
    """
    chex.assert_shape(next_values, (None, *terminated.shape))
    for each in (paid, entropy):
        chex.assert_is_broadcastable(jnp.shape(each), terminated.shape)
    goes_on = 1.0 - terminated.astype(jnp.float32)
    return paid + discount * goes_on * (jnp.min(next_values, 0) + entropy)


def td_loss(value: jax.Array, target: jax.Array, weight: jax.Array) -> jax.Array:
    """E[(Q(s, a) - y)^2], summed over critics [K, B]; `target` [B] gets no gradient."""
    chex.assert_equal_shape([target, weight], custom_message="target and weight")
    chex.assert_shape(value, (None, *target.shape))
    return jnp.sum(jnp.mean(weight * (value - jax.lax.stop_gradient(target)) ** 2, -1))


def init_replay(spec: EnvSpec, config: TrainConfig) -> SplitBuffer:
    """Empty buffers of the expert's and the novice's steps."""
    observation, action = spec.zeros()
    no = jnp.zeros((), bool)
    item = ReplayStep(
        observation=observation,
        next_observation=observation,
        novice_action=action,
        expert_action=action,
        executed_action=action,
        takeover=no,
        takeover_start=no,
        terminated=no,
    )
    rows = config.human_rows
    return buffers.init_split(item, rows, rows)


def add_step(replay: SplitBuffer, step: Interaction) -> SplitBuffer:
    """Store a step with those of the party that was in control."""
    item = ReplayStep(
        observation=step.observation,
        next_observation=step.next_observation,
        novice_action=jnp.clip(step.novice_action, -1.0, 1.0),
        expert_action=step.expert_action,
        executed_action=step.executed_action,
        takeover=step.takeover,
        takeover_start=step.takeover_start,
        terminated=step.terminated,
    )
    return buffers.add_split(replay, item, step.takeover)
