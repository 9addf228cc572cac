"""The likelihood that the losses and `beta` mean.

A deterministic policy outputs mu(s) in [-1, 1]^A; the paper does not say which density around it
its log pi means, and `beta` means nothing without one. Two are offered; constants that cancel are
left out. A policy that samples brings its own density (`squashed_log_prob`).

`laplace`, the default of runs: log pi(a | s) = -(sqrt(|a - mu|^2 + w^2) - w) / b, with b = w = 0.3
unless set. A smoothed multivariate Laplace density: quadratic within w of mu (there it is a
Gaussian of variance b w), linear beyond. The linear tail matters twice. It makes cloning a robust
regression: an expert that jitters pulls no harder the farther off it is. And along the line from
a- through a+

    log pi(a+|s) - log pi(a-|s)

has little left to gain once mu has reached a+, w / b at most, so that the paper's preference loss
holds mu near it.

`gaussian`: log pi(a | s) = -|a - mu|^2, variance 1/2, the released code's surrogate. With it that
difference is linear in mu: the loss has no optimum inside the action box and pushes mu past a+ to a
corner, unless the rejected term is scaled down (the released code's 0.5).

All are finite with finite gradients everywhere on the action box, its corners included, where the
expert's clipped actions lie. Another b is the same as `beta` and `bc_weight` divided by it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from ppl_jax.checks import check_name
from ppl_jax.types import Array

LIKELIHOODS = ("gaussian", "laplace")
LAPLACE_SCALE = 0.3  # b
LAPLACE_CORE = 0.3  # w
LOG_STD = (-5.0, 2.0)  # range of a learned log standard deviation, before squashing
EDGE = 1e-3  # a squashed density is that of actions at least so far from the box's edge


class Likelihood(NamedTuple):
    """How a policy's output and an action make log pi.

    Attributes:
        log_prob: `log_prob(output [..., D], action [..., A]) -> [...]`.
        attaining: `attaining(output, action) -> output` whose most likely action is `action`.
    """

    log_prob: Callable[[Array, Array], jax.Array]
    attaining: Callable[[Array, Array], Array]


def log_likelihood(
    mean: Array,
    action: Array,
    kind: str = "gaussian",
    *,
    scale: jax.Array | float = LAPLACE_SCALE,
    core: jax.Array | float = LAPLACE_CORE,
) -> jax.Array:
    """Log pi(action | mean) up to a constant, [..., A], [..., A] -> [...].

        gaussian    -|a - mu|^2
        laplace     -(sqrt(|a - mu|^2 + w^2) - w) / b

    Args:
        mean, action: [..., A] of the same shape, in [-1, 1].
        kind: "gaussian" or "laplace".
        scale, core: b and w of laplace.

    Raises:
        ValueError: If there is no such likelihood.
        AssertionError: If the shapes differ.
    """
    check_name("likelihood", kind, LIKELIHOODS)
    chex.assert_equal_shape([mean, action], custom_message="mean and action")
    square = jnp.sum((action - mean) ** 2, -1)
    if kind == "gaussian":
        return -square
    return -(jnp.sqrt(square + core**2) - core) / scale


def surrogate(
    kind: str,
    scale: jax.Array | float = LAPLACE_SCALE,
    core: jax.Array | float = LAPLACE_CORE,
) -> Likelihood:
    """The likelihood of a deterministic policy, whose output is its action; see `log_likelihood`.

    Raises:
        ValueError: If there is no such likelihood.
    """
    check_name("likelihood", kind, LIKELIHOODS)
    return Likelihood(
        log_prob=functools.partial(log_likelihood, kind=kind, scale=scale, core=core),
        attaining=lambda output, action: action,
    )


def gaussian_log_prob(mean: Array, log_std: Array, action: Array) -> jax.Array:
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


def mean_and_log_std(output: Array) -> tuple[jax.Array, jax.Array]:
    """The two halves of a squashed Gaussian's output, [..., 2 A] -> [..., A], [..., A].

    The second half is squashed into the range `LOG_STD`, so that its gradient never vanishes
    altogether and no density degenerates.
    """
    mean, spread = jnp.split(jnp.asarray(output), 2, -1)
    low, high = LOG_STD
    return mean, low + 0.5 * (high - low) * (jnp.tanh(spread) + 1.0)


def squashed_log_prob(output: Array, action: Array) -> jax.Array:
    """Log-density of a = tanh(u), u ~ N(mean, std), at given actions, [..., A] -> [...].

        log pi(a) = log N(atanh a) - sum log(1 - a^2)

    At |a| > 1 - `EDGE` it is that of the nearest action within: u is infinite at the edge.

    Args:
        output: [..., 2 A], see `mean_and_log_std`.
        action: [..., A] in [-1, 1].

    Raises:
        AssertionError: If the shapes do not fit.
    """
    mean, log_std = mean_and_log_std(output)
    chex.assert_equal_shape([mean, action], custom_message="mean and action")
    inside = _inside(action)
    squashing = jnp.sum(jnp.log1p(-(inside**2)), -1)
    return gaussian_log_prob(mean, log_std, jnp.arctanh(inside)) - squashing


def _inside(action: Array) -> jax.Array:
    """The nearest action at least `EDGE` from the box's edge, where atanh is finite."""
    return jnp.clip(action, EDGE - 1.0, 1.0 - EDGE)


def _squashed_attaining(output: Array, action: Array) -> jax.Array:
    """`Likelihood.attaining`: tanh of the mean is the action, the spread stays."""
    spread = jnp.split(jnp.asarray(output), 2, -1)[1]
    return jnp.concatenate([jnp.arctanh(_inside(action)), spread], -1)


SQUASHED = Likelihood(log_prob=squashed_log_prob, attaining=_squashed_attaining)
"""The likelihood of a policy that samples; its output is [..., 2 A]."""


def squashed_gaussian(key: jax.Array, mean: Array, log_std: Array) -> tuple[jax.Array, jax.Array]:
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
    u = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, jnp.float32)
    squashing = jnp.sum(2.0 * (jnp.log(2.0) - u - jax.nn.softplus(-2.0 * u)), -1)
    return jnp.tanh(u), gaussian_log_prob(mean, log_std, u) - squashing
