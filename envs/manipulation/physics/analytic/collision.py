"""Whether the arm hits something: its links as capsules, against the table, its mount and itself.

Contact of a link ends a wiping episode, so that only the test is needed, once per control step.
Shapes are fitted to the extents of robosuite's collision meshes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import Frames
from ppl_jax.types import Array

# body (index into Frames.links; 6 is the hand), ends in its frame, radius, m
_CAPSULES = (
    (0, (0.0, 0.0, 0.0), (0.0, 0.015, 0.0), 0.060),  # shoulder
    (1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.425), 0.058),  # upper arm
    (2, (0.0, 0.0, 0.02), (0.0, 0.0, 0.385), 0.048),  # forearm
    (3, (0.0, 0.09, 0.0), (0.0, 0.127, 0.0), 0.040),  # wrist 1
    (4, (0.0, 0.0, 0.08), (0.0, 0.0, 0.1), 0.040),  # wrist 2
    (5, (0.0, 0.06, 0.0), (0.0, 0.08, 0.0), 0.036),  # wrist 3
)
_MOUNT = ((0.0, 0.0, -0.6), (0.0, 0.0, 0.03), 0.075)  # base and pedestal, in the base's frame
_TOOL_RADIUS = 0.015
# pairs (mover, other) of capsules; 6 is the tool, 7 the mount
_PAIRS = np.array(
    [(6, 2), (6, 1), (6, 0), (6, 7), (5, 2), (5, 1), (5, 0), (5, 7), (4, 1), (4, 0), (4, 7),
     (3, 1), (3, 0), (3, 7), (2, 0), (2, 7)], np.int32
)  # fmt: skip


def _segment_distance(p: jax.Array, q: jax.Array, r: jax.Array, s: jax.Array) -> jax.Array:
    """Distance between segments p-q and r-s, [K, 3] each."""
    u, v, w = q - p, s - r, p - r
    a, b, c = jnp.sum(u * u, -1), jnp.sum(u * v, -1), jnp.sum(v * v, -1)
    d, e = jnp.sum(u * w, -1), jnp.sum(v * w, -1)
    det = a * c - b * b
    along = jnp.where(det > 1e-9, jnp.clip((b * e - c * d) / jnp.maximum(det, 1e-9), 0, 1), 0.0)
    other = jnp.clip((b * along + e) / jnp.maximum(c, 1e-9), 0, 1)
    along = jnp.clip((b * other - d) / jnp.maximum(a, 1e-9), 0, 1)
    gap = w + along[:, None] * u - other[:, None] * v
    return jnp.sqrt(jnp.sum(gap * gap, -1) + 1e-12)


def arm_hits(
    at: Frames,
    tool_ends: tuple[tuple[float, float, float], tuple[float, float, float]],
    table: tuple[Array, Array, Array | float],
) -> jax.Array:
    """Whether a link touches the table, the mount or another link, or the tool the arm.

    Args:
        at: Kinematics.
        tool_ends: Ends of the tool's capsule, in the grip site's frame, m.
        table: Centre [2], half size [2] and height of its top, in the base's frame.
    """
    first, second, radius = [], [], []
    for body, a, b, r in _CAPSULES:
        position, columns = at.links[body]
        origin = jnp.stack(position)
        turn = unrolled_linalg.array(columns)  # rows are the axes
        first.append(origin + jnp.array(a, jnp.float32) @ turn)
        second.append(origin + jnp.array(b, jnp.float32) @ turn)
        radius.append(r)
    site = jnp.stack(at.position)
    turn = unrolled_linalg.array(at.rotation)
    first += [site + jnp.array(tool_ends[0], jnp.float32) @ turn, jnp.array(_MOUNT[0], jnp.float32)]
    second += [
        site + jnp.array(tool_ends[1], jnp.float32) @ turn,
        jnp.array(_MOUNT[1], jnp.float32),
    ]
    p, q, r = jnp.stack(first), jnp.stack(second), np.array([*radius, _TOOL_RADIUS, _MOUNT[2]])
    i, j = _PAIRS.T
    own = _segment_distance(p[i], q[i], p[j], q[j]) < (r[i] + r[j]).astype(np.float32)
    centre, half, top = table
    ends = jnp.concatenate([p[1:6], q[1:6]])
    reach = np.concatenate([r[1:6], r[1:6]])
    over = jnp.all(jnp.abs(ends[:, :2] - centre) < np.float32(half + reach[:, None]), -1)
    return jnp.any(own) | jnp.any(over & (ends[:, 2] - np.float32(reach) < top))
