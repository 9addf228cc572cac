"""The likelihood that the losses and `beta` mean.

A policy outputs mu(s) in [-1, 1]^A; the paper does not say which density around it its log pi
means, and `beta` means nothing without one. Two are offered; constants that cancel are left out.

`laplace`: log pi(a | s) = -(sqrt(|a - mu|^2 + w^2) - w) / b, with b = w = 0.1. A smoothed
multivariate Laplace density: quadratic within w of mu (there it is a Gaussian of standard deviation
0.1), linear beyond. The linear tail matters: along the line from a- through a+ it makes

    log pi(a+|s) - log pi(a-|s)

stop growing once mu has reached a+, so the paper's preference loss has its optimum there.

`gaussian` (default): log pi(a | s) = -|a - mu|^2, variance 1/2, the released code's surrogate.
With it that difference is linear in mu: the loss has no optimum inside the action box and pushes
mu past a+ to a corner, unless the rejected term is scaled down (the released code's 0.5).

Both are finite with finite gradients everywhere on the action box, its corners included, where the
expert's clipped actions lie. Another b is the same as `beta` divided by it.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp

from ppl_jax.checks import check_name

LIKELIHOODS = ("gaussian", "laplace")
LAPLACE_SCALE = 0.1  # b
LAPLACE_CORE = 0.1  # w


def log_likelihood(mean: jax.Array, action: jax.Array, kind: str = "gaussian") -> jax.Array:
    """Log pi(action | mean) up to a constant, [..., A], [..., A] -> [...].

        gaussian    -|a - mu|^2
        laplace     -(sqrt(|a - mu|^2 + w^2) - w) / b

    Args:
        mean, action: [..., A] of the same shape, in [-1, 1].
        kind: "gaussian" or "laplace".

    Raises:
        ValueError: If there is no such likelihood.
        AssertionError: If the shapes differ.
    """
    check_name("likelihood", kind, LIKELIHOODS)
    chex.assert_equal_shape([mean, action], custom_message="mean and action")
    square = jnp.sum((action - mean) ** 2, -1)
    if kind == "gaussian":
        return -square
    return -(jnp.sqrt(square + LAPLACE_CORE**2) - LAPLACE_CORE) / LAPLACE_SCALE


def gaussian_log_prob(mean: jax.Array, log_std: jax.Array, action: jax.Array) -> jax.Array:
    """Log-density of a diagonal Gaussian without squashing (PPO's), [..., A] -> [...].

        log N(a) = sum -((a - mu) / s)^2 / 2 - log s - log(2 pi) / 2

    Args:
        mean, action: [..., A] of the same shape.
        log_std: log s, [..., A] or [A].
    """
    chex.assert_equal_shape([mean, action], custom_message="mean and action")
    chex.assert_is_broadcastable(jnp.shape(log_std), jnp.shape(mean))
    scaled = (action - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * scaled**2 - log_std - 0.5 * jnp.log(2 * jnp.pi), -1)


def squashed_gaussian(
    key: jax.Array, mean: jax.Array, log_std: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A reparameterised sample a = tanh(u), u ~ N(mean, std), and its log-density.

        log pi(a) = log N(u) - sum 2 (log 2 - u - softplus(-2 u))

    It is soft actor-critic's (Haarnoja et al. 2018, appendix C). The density is taken at u, so that
    nothing is inverted where tanh saturates.

    Args:
        key: Random key.
        mean: [..., A].
        log_std: [..., A], clipped to [-20, 2].

    Returns:
        [..., A] in [-1, 1], [...].
    """
    chex.assert_equal_shape([mean, log_std], custom_message="mean and log_std")
    log_std = jnp.clip(log_std, -20.0, 2.0)
    u = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
    squashing = jnp.sum(2.0 * (jnp.log(2.0) - u - jax.nn.softplus(-2.0 * u)), -1)
    return jnp.tanh(u), gaussian_log_prob(mean, log_std, u) - squashing
