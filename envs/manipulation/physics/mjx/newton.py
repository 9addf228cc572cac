"""Constraint forces of a physics step by Newton's method on MuJoCo's own convex cost.

    min_a  1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - aref_i)

(MuJoCo documentation, "Computation", constraint model). MJX's own solver does the same; its
elliptic cones scatter every contact into one dense matrix, its line search is a loop within the
loop and its factors are LAPACK's: three quarters of a step on a CPU. Here

- the Hessian is summed over the contacts in eights, which a CPU adds at once, where a product of
  two small matrices in a loop is one number at a time (seven times slower);
- no line search looks ahead: each iteration evaluates the cost's slope where the last one went,
  and goes back along the same line where that was too far;
- a matrix of more than eight rows is eliminated in a loop: unrolled, its code takes ten times
  longer to compile.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.contact import cone, cone_force

CONVERGED = 1e-4  # energy of a step to stop at, J/s^2
TOO_FAR = 0.3  # slope behind a step, as a share of that before it, from which it is shortened
_UNROLLED = 8  # degrees of freedom up to which a factor is unrolled
_LANES = 8  # numbers that a CPU adds at once

TWO_SIDED, ONE_SIDED, DRY = 0, 1, 2  # kinds of a row: equality; limit, bare contact; friction


class Rows(NamedTuple):
    """Constraints of one row each.

    Attributes:
        jacobian: [R, nv]. reference: [R] aref. weight: [R] 1/R, 0 where it does not act.
        bound: [R] largest force of dry friction, N or N m.
        kind: [R] of TWO_SIDED, ONE_SIDED, DRY.
    """

    jacobian: jax.Array
    reference: jax.Array
    weight: jax.Array
    bound: jax.Array
    kind: np.ndarray


class Cones(NamedTuple):
    """Elliptic contacts with friction in the plane; z is the normal.

    Attributes:
        jacobian: [nv, 3, C] of x, y, z. reference: [3, C] aref. weight: [C] 1/R of the normal, 0
            in the air. friction: [C].
        ratio: Of the friction rows' weight to the normal's (impratio).
    """

    jacobian: jax.Array
    reference: jax.Array
    weight: jax.Array
    friction: jax.Array
    ratio: float


class Solution(NamedTuple):
    """Acceleration [nv], forces of the rows [R], and of the cones [3, C] (x, y, z)."""

    acceleration: jax.Array
    rows: Any
    cones: Any


def solve_spd(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """matrix^-1 right, [n], for a symmetric positive definite matrix [n, n], without LAPACK."""
    size = right.shape[0]
    if size <= _UNROLLED:
        return unrolled_linalg.solve_array(matrix, right)
    augmented = _in_lanes(jnp.concatenate([matrix, right[:, None]], 1))

    def eliminate(k: Any, augmented: jax.Array) -> jax.Array:
        row = jax.lax.dynamic_index_in_dim(augmented, k, 0, keepdims=False)
        row = row / jax.lax.dynamic_index_in_dim(row, k, 0, keepdims=False)
        column = jax.lax.dynamic_index_in_dim(augmented, k, 1, keepdims=False)
        return jax.lax.dynamic_update_index_in_dim(augmented - column[:, None] * row, row, k, 0)

    return jax.lax.fori_loop(0, size, eliminate, augmented)[:, size]


def _in_lanes(rows: jax.Array) -> jax.Array:
    """The last axis filled up with zeros to whole lanes."""
    missing = -rows.shape[-1] % _LANES
    return jnp.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, missing)])


def _curvature(jacobian: Any, bend: jax.Array) -> jax.Array:
    """sum_c J_c' H_c J_c, [nv, nv], of contacts in whole lanes.

    Args:
        jacobian: [nv, 3, C], C a multiple of `_LANES`.
        bend: [6, C] H's xx, xy, yy, xz, yz, zz.
    """
    (x, y, z), h = (jacobian[:, axis] for axis in range(3)), bend
    bent = (h[0] * x + h[1] * y + h[3] * z, h[1] * x + h[2] * y + h[4] * z)
    bent = jax.lax.optimization_barrier((*bent, h[3] * x + h[4] * y + h[5] * z))  # [nv, C] each
    total: Any = 0.0
    for first in range(0, jacobian.shape[-1], _LANES):
        lanes = slice(first, first + _LANES)
        for own, other in zip((x, y, z), bent, strict=True):
            total = total + own[:, None, lanes] * other[None, :, lanes]
    return jnp.sum(jax.lax.optimization_barrier(total), -1)


def _pull(jacobian: Any, force: jax.Array) -> jax.Array:
    """sum_c J_c' f_c, [nv], of contacts in whole lanes; force is [3, C]."""
    total: Any = 0.0
    for first in range(0, jacobian.shape[-1], _LANES):
        lanes = slice(first, first + _LANES)
        for axis in range(3):
            total = total + jacobian[:, axis, lanes] * force[axis, lanes]
    return jnp.sum(jax.lax.optimization_barrier(total), -1)


class _Search(NamedTuple):
    """Where the search for the least cost stands.

    Attributes:
        a: [nv] acceleration to try next.
        origin, move, length: It is origin + length * move: [nv], [nv], a share.
        steepness: Slope downwards along `move` at `origin`, J/s^2.
        energy: Of the last step of Newton's method.
        turns: Evaluations so far.
    """

    a: jax.Array
    origin: jax.Array
    move: jax.Array
    steepness: jax.Array
    length: jax.Array
    energy: jax.Array
    turns: jax.Array


def _row_force(rows: Rows, residual: jax.Array) -> jax.Array:
    force = -rows.weight * residual
    one_sided = jnp.where(rows.kind == ONE_SIDED, jnp.maximum(force, 0.0), force)
    return jnp.where(rows.kind == DRY, jnp.clip(force, -rows.bound, rows.bound), one_sided)


def _row_bend(rows: Rows, residual: jax.Array) -> jax.Array:
    pushes = (rows.kind == TWO_SIDED) | ((rows.kind == ONE_SIDED) & (residual < 0))
    sticks = (rows.kind == DRY) & (jnp.abs(rows.weight * residual) < rows.bound)
    return jnp.where(pushes | sticks, rows.weight, 0.0)


def solve(
    mass: jax.Array,
    free: jax.Array,
    start: jax.Array,
    *,
    rows: Rows | None,
    cones: Cones | None,
    iterations: int,
) -> Solution:
    """Acceleration and forces that minimise the cost.

    Args:
        mass: [nv, nv] joint-space inertia M.
        free: [nv] acceleration without constraints, a0.
        start: [nv] acceleration to start from: the last step's.
        rows, cones: Constraints, or None.
        iterations: Largest number of evaluations.
    """
    in_lanes = None if cones is None else _in_lanes(cones.jacobian)

    def slip(a: jax.Array) -> jax.Array:
        assert cones is not None
        total = cones.jacobian[0] * a[0] - cones.reference
        for column, value in zip(cones.jacobian[1:], a[1:], strict=True):
            total = total + column * value
        return total

    def improve(carry: _Search) -> _Search:
        a = carry.a
        down, matrix = mass @ (free - a), mass  # the cost's slope downwards, and its curvature
        if cones is not None:
            at = jax.lax.optimization_barrier(slip(a))
            force, bend = jax.lax.optimization_barrier(
                cone(at, cones.weight, cones.friction, cones.ratio)
            )
            down = down + _pull(in_lanes, _in_lanes(force))
            matrix = matrix + _curvature(in_lanes, _in_lanes(bend))
        if rows is not None:
            r = rows.jacobian @ a - rows.reference
            down = down + rows.jacobian.T @ _row_force(rows, r)
            matrix = matrix + (rows.jacobian.T * _row_bend(rows, r)) @ rows.jacobian
        # Where contacts come or go, or begin to slide, Newton's step overshoots: behind the lowest
        # point of its line the slope is upwards. The cost is convex, so that the point lies between
        # the line's start and here.
        slope = -(down @ carry.move)
        beyond = slope > TOO_FAR * carry.steepness
        shorter = carry.length * carry.steepness / (carry.steepness + jnp.maximum(slope, 1e-30))
        move = solve_spd(matrix, down)
        energy = move @ down
        origin = jnp.where(beyond, carry.origin, a)
        move = jnp.where(beyond, carry.move, move)
        length = jnp.where(beyond, shorter, 1.0)
        return _Search(
            a=origin + length * move,
            origin=origin,
            move=move,
            steepness=jnp.where(beyond, carry.steepness, energy),
            length=length,
            energy=jnp.where(beyond, jnp.inf, energy),
            turns=carry.turns + 1,
        )

    def unsettled(carry: _Search) -> jax.Array:
        return (carry.energy > CONVERGED) & (carry.turns < iterations)

    acting = jnp.zeros((), bool)
    if cones is not None:
        acting = acting | jnp.any(cones.weight > 0)
    if rows is not None:
        acting = acting | jnp.any(rows.weight > 0)
    first = jnp.where(acting, start, free)
    begin = _Search(
        a=first,
        origin=first,
        move=jnp.zeros_like(free),
        steepness=jnp.zeros((), jnp.float32),
        length=jnp.ones((), jnp.float32),
        energy=jnp.where(acting, jnp.inf, 0.0),
        turns=jnp.zeros((), jnp.int32),
    )
    a = jax.lax.while_loop(unsettled, improve, begin).a
    own = None if rows is None else _row_force(rows, rows.jacobian @ a - rows.reference)
    pushed = None
    if cones is not None:
        pushed = cone_force(slip(a), cones.weight, cones.friction, cones.ratio)
    return Solution(a, own, pushed)
