"""What PPO is made of: generalised advantages, the clipped objective, Gaussian divergences."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

CLIP = 0.2  # epsilon


def advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    discount: jax.Array | float,
    smoothing: jax.Array | float,
) -> jax.Array:
    """Generalised advantages (Schulman et al. 2016), [T, ...]; time limits are bootstrapped.

        delta_t = r_t + gamma (1 - terminated_t) V(s_{t+1}) - V(s_t)
        A_t     = delta_t + gamma lambda (1 - done_t) A_{t+1}

    Args:
        reward, value: Of each step and of the state before it.
        next_value: Of the state after it, before any reset.
        terminated: The task ended there; done: or time was up.
        discount, smoothing: gamma and lambda.
    """
    delta = reward + discount * (1.0 - terminated) * next_value - value

    def step(following: jax.Array, at: Any) -> tuple[jax.Array, jax.Array]:
        delta, done = at
        advantage = delta + discount * smoothing * (1.0 - done) * following
        return advantage, advantage

    return jax.lax.scan(step, jnp.zeros_like(delta[0]), (delta, done), reverse=True)[1]


def clipped_loss(
    log_prob: jax.Array,
    old_log_prob: jax.Array,
    advantage: jax.Array,
    clip: jax.Array | float = CLIP,
) -> jax.Array:
    """-E[min(rho A, clip(rho, 1 - e, 1 + e) A)], rho = pi / pi_old (Schulman et al. 2017)."""
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
