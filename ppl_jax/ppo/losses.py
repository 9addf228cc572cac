"""Parts of PPO-Lagrangian: advantages, objective, divergence, statistics, multiplier."""

from __future__ import annotations

from typing import Any

import chex
import flax.struct
import jax
import jax.numpy as jnp
import optax

from ppl_jax.types import PyTree

CLIP = 0.2  # epsilon


def advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    *,
    done: jax.Array,
    discount: jax.Array | float,
    gae_lambda: jax.Array | float,
) -> jax.Array:
    """Generalised advantages (Schulman et al. 2016), [T, ...]; time limits are bootstrapped.

        delta_t = r_t + gamma (1 - terminated_t) V(s_{t+1}) - V(s_t)
        A_t     = delta_t + gamma lambda (1 - done_t) A_{t+1}

    Args:
        reward, value: Reward of each step, and value of the state before it.
        next_value: Value of the state after it, before any reset.
        terminated: The task ended there; done: or time was up.
        discount, gae_lambda: gamma and lambda.
    """
    chex.assert_equal_shape([reward, value, next_value])
    delta = reward + discount * (1.0 - jnp.asarray(terminated, jnp.float32)) * next_value - value

    def step(following: jax.Array, at: Any) -> tuple[jax.Array, jax.Array]:
        delta, done = at
        advantage = delta + discount * gae_lambda * (1.0 - done) * following
        return advantage, advantage

    steps = (delta, jnp.asarray(done, jnp.float32))
    return jax.lax.scan(step, jnp.zeros_like(delta[0]), steps, reverse=True)[1]


def clipped_loss(
    log_prob: jax.Array,
    old_log_prob: jax.Array,
    advantage: jax.Array,
    clip: jax.Array | float = CLIP,
) -> jax.Array:
    """-E[min(rho A, clip(rho, 1 - e, 1 + e) A)], rho = pi / pi_old (Schulman et al. 2017)."""
    chex.assert_equal_shape([log_prob, old_log_prob, advantage])
    ratio = jnp.exp(log_prob - old_log_prob)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))


def gaussian_divergence(
    old_mean: jax.Array, old_log_std: jax.Array, mean: jax.Array, log_std: jax.Array
) -> jax.Array:
    """KL(old || new) of diagonal Gaussians, [..., A] -> [...].

    sum log(s / s_old) + (s_old^2 + (m_old - m)^2) / (2 s^2) - 1/2
    """
    variance = jnp.exp(2 * log_std)
    spread = jnp.exp(2 * old_log_std) + (old_mean - mean) ** 2
    return jnp.sum(log_std - old_log_std + spread / (2 * variance) - 0.5, -1)


def clip_grads(grads: PyTree, norm: jax.Array | float) -> PyTree:
    """Gradients with their norm clipped."""
    clipped, _ = optax.clip_by_global_norm(norm).update(grads, optax.EmptyState())  # pyright: ignore
    return clipped


def mean_of_ended(values: jax.Array, done: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean over the episodes that ended (0 where none did), and whether any did."""
    count = jnp.sum(done, dtype=jnp.float32)
    total = jnp.sum(jnp.where(done, values.astype(jnp.float32), 0.0))
    return total / jnp.maximum(count, 1.0), count > 0


@flax.struct.dataclass
class RunningStats:
    """Mean and variance of everything seen, merged batch by batch (Chan et al. 1979).

    Attributes:
        count: Values seen.
        mean, square: Mean, and sum of squared deviations from it.
    """

    count: jax.Array
    mean: jax.Array
    square: jax.Array

    def add(self, values: jax.Array) -> RunningStats:
        """With `values` [N, ...] as well."""
        count, mean = values.shape[0], jnp.mean(values, 0)
        square = jnp.sum((values - mean) ** 2, 0)
        total, away = self.count + count, mean - self.mean
        return RunningStats(
            count=total,
            mean=self.mean + away * (count / total),
            square=self.square + square + away**2 * (self.count / total * count),
        )

    @property
    def variance(self) -> jax.Array:
        """Variance of the population; 0 before anything was seen."""
        return self.square / jnp.maximum(self.count, 1.0)


def init_running_stats(shape: tuple[int, ...]) -> RunningStats:
    """Empty running statistics."""
    zero = jnp.zeros(shape, jnp.float32)
    return RunningStats(count=jnp.zeros((), jnp.float32), mean=zero, square=zero)


@flax.struct.dataclass
class Multiplier:
    """lambda = softplus(p), with p's Adam.

    Attributes:
        p: Scalar.
        opt_state: State of Adam.
    """

    p: jax.Array
    opt_state: PyTree

    @property
    def value(self) -> jax.Array:
        """lambda, >= 0."""
        return jax.nn.softplus(self.p)


_ADAM = optax.scale_by_adam()


def init_multiplier(value: jax.Array | float) -> Multiplier:
    """A multiplier that starts at `value` > 0: p = log(e^value - 1)."""
    p = jnp.log(jnp.expm1(jnp.asarray(value, jnp.float32)))
    return Multiplier(p, _ADAM.init(p))


def update_multiplier(
    multiplier: Multiplier,
    cost: jax.Array,
    limit: jax.Array | float,
    rate: jax.Array | float,
    *,
    known: jax.Array,
) -> Multiplier:
    """One step of Adam up the gradient J_C - d of p (J_C - d), where `known`.

    Args:
        multiplier: Before.
        cost, limit: J_C, mean cost of the episodes that ended, and d.
        rate: Adam's.
        known: Whether any episode ended.
    """
    with jax.numpy_dtype_promotion("standard"):  # as in `ppl_jax.learned.adam_step`
        step, opt_state = _ADAM.update(limit - cost, multiplier.opt_state)
    moved = Multiplier(multiplier.p - rate * jnp.asarray(step), opt_state)
    return jax.tree.map(lambda new, old: jnp.where(known, new, old), moved, multiplier)
