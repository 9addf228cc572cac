"""Lidar: 240 rays against rectangles and circles, analytically."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.types import Array

RAYS = 240
RANGE = 50.0  # m

_ANGLES = np.arange(RAYS) * (2 * np.pi / RAYS)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)]).astype(np.float32)  # [2, RAYS]
_MISS = 1e9
_GRAZING = 1e-12  # m^2, of half a chord: below it the root's derivative would not be finite


def box_distances(pose: Array, boxes: Array, half: Array) -> jax.Array:
    """Distance along each ray to the nearest rectangle, m, [RAYS]; large where none is hit.

    Slab method in each rectangle's own frame: a ray enters at the last and leaves at the first
    of its crossings of the two pairs of sides.

    Args:
        pose: [3] x, y, heading of the sensor; ray i points `1.5 i` degrees anticlockwise of it.
        boxes: [K, 3] x, y, heading.
        half: [K, 2] half length and half width, m.
    """
    relative = pose[2] - boxes[:, 2]
    c, s = jnp.cos(relative), jnp.sin(relative)
    offset = pose[:2] - boxes[:, :2]
    ch, sh = jnp.cos(boxes[:, 2]), jnp.sin(boxes[:, 2])
    x = ch * offset[:, 0] + sh * offset[:, 1]
    y = -sh * offset[:, 0] + ch * offset[:, 1]
    nearest = jnp.full(RAYS, _MISS, jnp.float32)
    # unrolled: XLA then keeps the rays in vector registers (15 times faster for a single world)
    for k in range(boxes.shape[0]):
        along = c[k] * _DIRECTIONS[0] - s[k] * _DIRECTIONS[1]  # ray directions in the box's frame
        across = s[k] * _DIRECTIONS[0] + c[k] * _DIRECTIONS[1]
        inverse_along = 1.0 / jnp.where(jnp.abs(along) < 1e-9, 1e-9, along)
        inverse_across = 1.0 / jnp.where(jnp.abs(across) < 1e-9, 1e-9, across)
        reach_x = half[k, 0] * jnp.abs(inverse_along)
        reach_y = half[k, 1] * jnp.abs(inverse_across)
        middle_x, middle_y = -x[k] * inverse_along, -y[k] * inverse_across
        enter = jnp.maximum(middle_x - reach_x, middle_y - reach_y)
        leave = jnp.minimum(middle_x + reach_x, middle_y + reach_y)
        hit = (enter <= leave) & (enter >= 0)
        nearest = jnp.minimum(nearest, jnp.where(hit, enter, _MISS))
    return nearest


def circle_distances(pose: Array, circles: Array) -> jax.Array:
    """Distance along each ray to the nearest circle, m, [RAYS]; large where none is hit.

    Args:
        pose: [3] x, y, heading.
        circles: [C, 3] x, y, radius.
    """
    offset = circles[:, :2] - pose[:2]
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x = c * offset[:, 0] + s * offset[:, 1]
    y = -s * offset[:, 0] + c * offset[:, 1]
    square = circles[:, 2] ** 2
    nearest = jnp.full(RAYS, _MISS, jnp.float32)
    for k in range(circles.shape[0]):
        along = x[k] * _DIRECTIONS[0] + y[k] * _DIRECTIONS[1]
        across = x[k] * _DIRECTIONS[1] - y[k] * _DIRECTIONS[0]
        inside = square[k] - across * across
        enter = along - jnp.sqrt(jnp.maximum(inside, _GRAZING))
        hit = (inside >= 0) & (enter >= 0)
        nearest = jnp.minimum(nearest, jnp.where(hit, enter, _MISS))
    return nearest


def scan(pose: Array, boxes: Array, half: Array, circles: Array) -> jax.Array:
    """The lidar reading: distance / 50 m, 1 where nothing is hit, [RAYS]."""
    nearest = jnp.minimum(box_distances(pose, boxes, half), circle_distances(pose, circles))
    return jnp.minimum(nearest / RANGE, 1.0)
