"""Quaternions as robosuite reports them: the sign is that of MuJoCo's chain of products."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from envs.manipulation.scenes.model import LINKS

Scalar = Any
Quaternion = tuple[Scalar, Scalar, Scalar, Scalar]  # w, x, y, z
_HALF_TURN = 0.5**0.5


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The product a b: first b, then a."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def hand_quaternion(joints: list[Scalar]) -> jax.Array:
    """Orientation of the hand's frame, [4] x y z w, with MuJoCo's sign."""
    total: Quaternion = (1.0, 0.0, 0.0, 0.0)
    for angle, link in zip(joints, LINKS, strict=True):
        if link.turned:
            total = multiply(total, (_HALF_TURN, 0.0, _HALF_TURN, 0.0))
        cosine, sine = jnp.cos(0.5 * angle), jnp.sin(0.5 * angle)
        turn = (cosine, 0.0, sine, 0.0) if link.axis == "y" else (cosine, 0.0, 0.0, sine)
        total = multiply(total, turn)
    w, x, y, z = multiply(total, (_HALF_TURN, -_HALF_TURN, 0.0, 0.0))
    return jnp.stack([x, y, z, w])


def rotation_matrix(quaternion: jax.Array) -> jax.Array:
    """[3, 3] of w x y z; columns are the axes."""
    w, x, y, z = quaternion
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def turned(quaternion: jax.Array, spin: jax.Array, time: float) -> jax.Array:
    """Quaternion after turning by `spin` (world axes) for `time`."""
    angle = jnp.sqrt(jnp.sum(spin * spin) + 1e-20)
    half = 0.5 * time * angle
    axis = jnp.sin(half) / angle * spin
    new = jnp.stack(multiply((jnp.cos(half), *axis), tuple(quaternion)))
    return new / jnp.sqrt(jnp.sum(new * new))
