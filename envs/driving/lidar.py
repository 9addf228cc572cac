"""Lidar: 240 rays against rectangles and circles, analytically."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

RAYS = 240
RANGE = 50.0  # m

_ANGLES = np.arange(RAYS) * (2 * np.pi / RAYS)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)]).astype(np.float32)  # [2, RAYS]
_MISS = 1e9


def box_distances(pose: jax.Array, boxes: jax.Array, half: jax.Array) -> jax.Array:
    """Distance along each ray to the nearest rectangle, m, [RAYS]; large where none is hit.

    Slab method in each rectangle's own frame: a ray enters at the last and leaves at the first
    of its crossings of the two pairs of sides.

    Args:
        pose: [3] x, y, heading of the sensor; ray i points `1.5 i` degrees anticlockwise of it.
        boxes: [K, 3] x, y, heading.
        half: [K, 2] half length and half width, m.
    """
    relative = pose[2] - boxes[:, 2]
    c, s = jnp.cos(relative)[:, None], jnp.sin(relative)[:, None]
    along = c * _DIRECTIONS[0] - s * _DIRECTIONS[1]  # ray directions in each box's frame, [K, R]
    across = s * _DIRECTIONS[0] + c * _DIRECTIONS[1]
    offset = pose[:2] - boxes[:, :2]
    ch, sh = jnp.cos(boxes[:, 2]), jnp.sin(boxes[:, 2])
    x = (ch * offset[:, 0] + sh * offset[:, 1])[:, None]
    y = (-sh * offset[:, 0] + ch * offset[:, 1])[:, None]
    inverse_along = 1.0 / jnp.where(jnp.abs(along) < 1e-9, 1e-9, along)
    inverse_across = 1.0 / jnp.where(jnp.abs(across) < 1e-9, 1e-9, across)
    reach_x, reach_y = half[:, :1] * jnp.abs(inverse_along), half[:, 1:] * jnp.abs(inverse_across)
    middle_x, middle_y = -x * inverse_along, -y * inverse_across
    enter = jnp.maximum(middle_x - reach_x, middle_y - reach_y)
    leave = jnp.minimum(middle_x + reach_x, middle_y + reach_y)
    return jnp.min(jnp.where((enter <= leave) & (enter >= 0), enter, _MISS), 0)


def circle_distances(pose: jax.Array, circles: jax.Array) -> jax.Array:
    """Distance along each ray to the nearest circle, m, [RAYS]; large where none is hit.

    Args:
        pose: [3] x, y, heading.
        circles: [C, 3] x, y, radius.
    """
    offset = circles[:, :2] - pose[:2]
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x = (c * offset[:, 0] + s * offset[:, 1])[:, None]
    y = (-s * offset[:, 0] + c * offset[:, 1])[:, None]
    along = x * _DIRECTIONS[0] + y * _DIRECTIONS[1]
    across = x * _DIRECTIONS[1] - y * _DIRECTIONS[0]
    inside = circles[:, 2:] ** 2 - across**2
    enter = along - jnp.sqrt(jnp.maximum(inside, 0.0))
    return jnp.min(jnp.where((inside >= 0) & (enter >= 0), enter, _MISS), 0)


def scan(pose: jax.Array, boxes: jax.Array, half: jax.Array, circles: jax.Array) -> jax.Array:
    """The lidar reading: distance / 50 m, 1 where nothing is hit, [RAYS]."""
    nearest = jnp.minimum(box_distances(pose, boxes, half), circle_distances(pose, circles))
    return jnp.minimum(nearest / RANGE, 1.0)
