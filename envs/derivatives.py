"""What worlds compute so that its derivative is finite wherever its value is."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def length(vector: jax.Array) -> jax.Array:
    """|v| over the last axis, [..., D] -> [...]; its derivative at zero is zero, not NaN."""
    return _root(jnp.sum(vector * vector, -1))


# a rule for the derivative alone: the program of the value stays as it is
@jax.custom_jvp
def _root(square: jax.Array) -> jax.Array:
    return jnp.sqrt(square)


@_root.defjvp
def _root_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    root = jnp.sqrt(primals[0])
    slope = jnp.where(root == 0, 0.0, 0.5 / jnp.where(root == 0, 1.0, root))
    return root, slope * tangents[0]
