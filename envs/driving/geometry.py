"""Lane coordinates, rectangles and their overlaps, for one point or body at a time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from envs.driving.scenario import SIDEWALK, Lanes
from ppl_jax.types import Array


def wrap(angle: Array) -> Array:
    """Wrap to [-pi, pi), with a floor: a remainder is a call per number on a CPU."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))


# atan(x) / x as a polynomial in x^2 on [0, 1], Chebyshev fit, error below 1e-7
_X = np.cos(np.pi * (np.arange(64) + 0.5) / 64) / 2 + 0.5
_FIT = np.polynomial.Polynomial.fit(_X, np.arctan(np.sqrt(_X)) / np.sqrt(_X), 9)
_ATAN = _FIT.convert().coef.tolist()


def arctan2(y: Array, x: Array) -> jax.Array:
    """`jnp.arctan2` to 2e-7 rad; XLA's own runs one number at a time on a CPU (4 times slower)."""
    ax, ay = jnp.abs(x), jnp.abs(y)
    low, high = jnp.minimum(ax, ay), jnp.maximum(ax, ay)
    ratio = low / jnp.maximum(high, 1e-15)  # whose square is a number, for the derivative
    square = ratio * ratio
    series = jnp.full_like(square, _ATAN[-1])
    for coefficient in _ATAN[-2::-1]:
        series = series * square + coefficient
    angle = ratio * series
    angle = jnp.where(ay > ax, jnp.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, jnp.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def unit(heading: Array) -> jax.Array:
    """Unit vector of a heading, [...] -> [..., 2]."""
    return jnp.stack([jnp.cos(heading), jnp.sin(heading)], -1)


def to_body(vector: Array, heading: Array) -> jax.Array:
    """World vectors in a body frame (x forward, y left), [..., 2]."""
    c, s = jnp.cos(heading), jnp.sin(heading)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([c * x + s * y, -s * x + c * y], -1)


def lane_coordinates(lanes: Lanes, position: Array) -> tuple[jax.Array, jax.Array]:
    """(long, lateral) of a point on each lane; lateral is positive to the right.

    Args:
        lanes: `Lanes`, any leading shape that broadcasts with `position[..., 0]`.
        position: [..., 2] m.
    """
    delta = position - lanes.start
    straight_long = jnp.sum(delta * lanes.forward, -1)
    straight_lateral = delta[..., 0] * lanes.forward[..., 1] - delta[..., 1] * lanes.forward[..., 0]
    radial = position - lanes.center
    distance = jnp.sqrt(jnp.sum(radial * radial, -1) + 1e-12)
    phi = lanes.turn * (arctan2(radial[..., 1], radial[..., 0]) - lanes.phase)
    # an arc's ends part the circle: a point belongs to the nearer one
    arc_long = (wrap(phi - lanes.angle / 2) + lanes.angle / 2) * lanes.radius
    is_arc = lanes.turn != 0
    return (
        jnp.where(is_arc, arc_long, straight_long),
        jnp.where(is_arc, lanes.turn * (distance - lanes.radius), straight_lateral),
    )


def lane_heading(lanes: Lanes, long: Array) -> jax.Array:
    """Heading of the centre line at `long`, rad."""
    straight = arctan2(lanes.forward[..., 1], lanes.forward[..., 0])
    return jnp.where(
        lanes.turn != 0, lanes.phase + lanes.turn * (long / lanes.radius + jnp.pi / 2), straight
    )


def runs_along(lanes: Lanes, pose: Array) -> jax.Array:
    """Which lanes run within 90 degrees of the heading at the pose [3], bool."""
    ahead = unit(pose[2])
    radial = pose[:2] - lanes.center
    tangent = jnp.stack([-radial[..., 1], radial[..., 0]], -1) * lanes.turn[..., None]
    direction = jnp.where((lanes.turn != 0)[..., None], tangent, lanes.forward)
    return jnp.sum(direction * ahead, -1) > 0


def lane_position(lanes: Lanes, long: Array, lateral: Array) -> jax.Array:
    """World position of (long, lateral), [..., 2]."""
    right = jnp.stack([lanes.forward[..., 1], -lanes.forward[..., 0]], -1)
    straight = lanes.start + long[..., None] * lanes.forward + lateral[..., None] * right
    phi = lanes.turn * long / lanes.radius + lanes.phase
    curved = lanes.center + (lanes.radius + lateral * lanes.turn)[..., None] * unit(phi)
    return jnp.where((lanes.turn != 0)[..., None], curved, straight)


def on_lanes(lanes: Lanes, long: jax.Array, lateral: jax.Array) -> jax.Array:
    """Which lanes hold the point (long, lateral), given in each lane's coordinates, bool."""
    share = long / lanes.length
    right_edge = jnp.where(
        lanes.taper == 0,
        lanes.width / 2,
        jnp.where(lanes.taper == 1, 0.5 - share, share - 0.5) * lanes.width,
    )
    return (
        (long >= lanes.begin)
        & (long <= lanes.reach)
        & (lateral >= -lanes.width / 2)
        & (lateral <= right_edge)
    )


_OUTLINE = np.array(
    [[1.0, 1.0], [1.0, -1.0], [0.0, 1.0], [0.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]], np.float32
)


def touches_sidewalk(lanes: Lanes, kerbs: Array, pose: Array, half: Array) -> jax.Array:
    """Whether a rectangle touches a sidewalk, bool scalar.

    Its corners and the middles of its long sides are looked at: between them the side lies within
    0.1 m of the sharpest kerb.

    Args:
        lanes: [M].
        kerbs: [W] indices of the lanes with a kerb, -1 padding.
        pose: [3] x, y, heading.
        half: [2] half length and half width, m.
    """
    ahead = unit(pose[2])
    left = jnp.stack([-ahead[1], ahead[0]])
    points = pose[:2] + _OUTLINE[:, :1] * half[0] * ahead + _OUTLINE[:, 1:] * half[1] * left
    beside = jax.tree.map(lambda leaf: leaf[kerbs], lanes)
    long, lateral = lane_coordinates(beside, points[:, None])
    edge = beside.width / 2
    return jnp.any(
        (kerbs >= 0)
        & (lateral >= edge + SIDEWALK[0])
        & (lateral <= edge + SIDEWALK[1])
        & (long >= 0)
        & (long <= beside.length)
    )


def box_contact(
    pose: Array, half: Array, others: Array, other_half: Array
) -> tuple[jax.Array, jax.Array]:
    """Overlap of a rectangle with others by separating axes.

    Args:
        pose, half: [3] and [2].
        others, other_half: [K, 3] and [K, 2].

    Returns:
        Depth [K] (m, positive when they overlap) and the direction out of the other, [K, 2]
        (world).
    """
    delta = pose[:2] - others[:, :2]
    relative = pose[2] - others[:, 2]
    c, s = jnp.abs(jnp.cos(relative)), jnp.abs(jnp.sin(relative))
    mine = to_body(delta, pose[2])
    theirs = to_body(delta, others[:, 2])
    swap = jnp.array([1, 0], jnp.int32)
    on_mine = half + other_half * c[:, None] + other_half[:, swap] * s[:, None] - jnp.abs(mine)
    on_theirs = other_half + half * c[:, None] + half[swap] * s[:, None] - jnp.abs(theirs)
    depths = jnp.concatenate([on_mine, on_theirs], -1)
    best = jnp.argmin(depths, -1)
    ahead = unit(jnp.stack([jnp.broadcast_to(pose[2], others[:, 2].shape), others[:, 2]], -1))
    left = jnp.stack([-ahead[..., 1], ahead[..., 0]], -1)
    axes = jnp.stack([ahead[:, 0], left[:, 0], ahead[:, 1], left[:, 1]], 1)
    signs = jnp.sign(jnp.concatenate([mine, theirs], -1))
    axis = jnp.take_along_axis(axes, best[:, None, None], 1)[:, 0]
    sign = jnp.take_along_axis(signs, best[:, None], 1)
    return jnp.min(depths, -1), axis * sign


def circle_depth(pose: Array, half: Array, circles: Array) -> Array:
    """Overlap of a rectangle with circles, m, positive when they overlap, [C].

    Args:
        pose, half: [3] and [2].
        circles: [C, 3] x, y, radius.
    """
    local = jnp.abs(to_body(circles[:, :2] - pose[:2], pose[2]))
    gap = jnp.maximum(local - half, 0.0)
    return circles[:, 2] - jnp.sqrt(jnp.sum(gap * gap, -1))
