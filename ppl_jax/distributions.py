"""The likelihood that the losses and `beta` refer to.

A policy outputs mu(s) in [-1, 1]^A. Its action distribution for learning is a Gaussian in action
space with fixed variance 1/2 around mu(s), so that up to a constant that cancels

    log pi(a | s) = -|a - mu(s)|^2

This is the surrogate of the released code. It is finite with finite gradients everywhere on the
action box, its corners included, where the expert's clipped actions lie. A Gaussian with standard
deviation sigma in its place would be the same as multiplying `beta` by 1 / (2 sigma^2).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def log_likelihood(mean: jax.Array, action: jax.Array) -> jax.Array:
    """log pi(action | mean) up to a constant, [..., A], [..., A] -> [...]."""
    return -jnp.sum((action - mean) ** 2, -1)
