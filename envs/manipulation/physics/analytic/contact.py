"""MuJoCo's soft contact with friction: the cost of one elliptic cone."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Friction = jax.Array | np.ndarray | float

IMPEDANCE_RATIO = 20.0  # of the normal's regularisation to friction's: robosuite's impratio


def impedance(depth: jax.Array, low: float, high: float, width: float) -> jax.Array:
    """MuJoCo's impedance d at a depth, m: a smooth step from `low` at 0 to `high` at `width`."""
    x = jnp.clip(depth / width, 0.0, 1.0)
    y = jnp.where(x < 0.5, 2 * x * x, 1 - 2 * (1 - x) * (1 - x))
    return low + (high - low) * y


def _zones(residual: jax.Array, weight: jax.Array, friction: Friction, ratio: float):
    """mu, |r_xy|, the sliding zone's weight, its gap n - mu t, and where the point sticks."""
    x, y, z = residual
    mu = friction / ratio**0.5
    slide = jnp.sqrt(x * x + y * y + 1e-12)
    normal, tangent = mu * z, friction * slide
    middle = weight / (mu * mu * (1 + mu * mu))
    return mu, slide, middle, normal - mu * tangent, mu * normal + tangent <= 0


def cone_cost(
    residual: jax.Array, weight: jax.Array, friction: Friction, ratio: float = IMPEDANCE_RATIO
) -> jax.Array:
    """The elliptic cones' cost, summed over the points; arguments as for `cone`."""
    _, slide, middle, gap, stuck = _zones(residual, weight, friction, ratio)
    held = 0.5 * weight * (residual[2] ** 2 + ratio * slide * slide)
    return jnp.sum(jnp.where(stuck, held, jnp.where(gap < 0, 0.5 * middle * gap * gap, 0.0)))


def cone_force(
    residual: jax.Array, weight: jax.Array, friction: Friction, ratio: float = IMPEDANCE_RATIO
) -> jax.Array:
    """Force of the elliptic cones, [3, ..., P]; arguments as for `cone`, which gives it too."""
    mu, slide, middle, gap, stuck = _zones(residual, weight, friction, ratio)
    x, y, z = residual
    fz = jnp.where(stuck, -weight * z, jnp.where(gap < 0, -middle * gap * mu, 0.0))
    pull = jnp.where(stuck, -weight * ratio * slide, -friction * fz)
    return jnp.stack([pull * x / slide, pull * y / slide, fz])


def cone(
    residual: jax.Array, weight: jax.Array, friction: Friction, ratio: float = IMPEDANCE_RATIO
) -> tuple[jax.Array, jax.Array]:
    """Force and second derivative of the elliptic cone's cost.

    With n = mu r_z, t = friction |r_xy|: no force where n >= mu t; 1/2 weight (20 r_xy^2 + r_z^2)
    where mu n + t <= 0 (the point sticks); else 1/2 middle (n - mu t)^2 (it slides).

    Args:
        residual: [3, P] J a - aref, z the normal.
        weight: [P] 1/R of the normal; 0 for points in the air.
        friction: Coefficient, or [P] of them.
        ratio: Of the friction rows' weight to the normal's (MuJoCo's impratio).

    Returns:
        [3, P] force, and xx, xy, yy, xz, yz, zz of the second derivative, [6, P].
    """
    mu, slide, middle, gap, stuck = _zones(residual, weight, friction, ratio)
    tx, ty = residual[0] / slide, residual[1] / slide
    sliding = (gap < 0) & ~stuck
    held = weight * ratio
    steep = middle * mu * mu
    bent = -middle * gap * mu * friction / slide

    def both(when_stuck: Any, when_sliding: Any) -> jax.Array:
        return jnp.where(stuck, when_stuck, jnp.where(sliding, when_sliding, 0.0))

    hessian = [
        both(held, steep * friction**2 * tx * tx + bent * (1 - tx * tx)),
        both(0.0, (steep * friction**2 - bent) * tx * ty),
        both(held, steep * friction**2 * ty * ty + bent * (1 - ty * ty)),
        both(0.0, -steep * friction * tx),
        both(0.0, -steep * friction * ty),
        both(weight, steep),
    ]
    return cone_force(residual, weight, friction, ratio), jnp.stack(hessian)
