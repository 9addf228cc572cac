"""What worlds compute so that its derivative is finite wherever its value is."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def length(vector: jax.Array) -> jax.Array:
    """|v| over the last axis, [..., D] -> [...]; its derivative at zero is zero, not NaN."""
    square = jnp.sum(vector * vector, -1)
    at_zero = square == 0
    return jnp.where(at_zero, 0.0, jnp.sqrt(jnp.where(at_zero, 1.0, square)))
