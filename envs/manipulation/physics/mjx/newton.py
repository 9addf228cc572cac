"""Constraint forces of a physics step by Newton's method on MuJoCo's own convex cost.

    min_a  1/2 (a - a0)' M (a - a0) + sum_i s_i(J_i a - aref_i)

(MuJoCo documentation, "Computation", constraint model). MJX's own solver does the same; its
elliptic cones scatter every contact into one dense matrix, its line search is a loop within the
loop and its factors are LAPACK's: three quarters of a step on a CPU. Here a cone is three rows of a
product, the line search one product over a few shares of the step, and the factor is unrolled.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.contact import cone, cone_force

CONVERGED = 1e-4  # energy of a step to stop at, J/s^2
_SHARES = np.array([0.05, 0.15, 0.35, 0.6, 1.0], np.float32)  # of a step, where its slope is known
_UNROLLED = 16  # degrees of freedom up to which a factor is unrolled

TWO_SIDED, ONE_SIDED, DRY = 0, 1, 2  # kinds of a row: equality; limit or pyramid's edge; friction


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
        jacobian: [3, C, nv] of x, y, z. reference: [3, C] aref. weight: [C] 1/R of the normal, 0
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
    rows: jax.Array | None
    cones: jax.Array | None


def solve_spd(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """matrix^-1 right, [n], for a symmetric positive definite matrix [n, n], without LAPACK."""
    size = right.shape[0]
    if size <= _UNROLLED:
        return unrolled_linalg.solve_array(matrix, right)

    def eliminate(k: Any, augmented: jax.Array) -> jax.Array:
        row = augmented[k] / augmented[k, k]
        rest = augmented - augmented[:, k, None] * row
        return rest.at[k].set(row)

    augmented = jnp.concatenate([matrix, right[:, None]], 1)
    return jax.lax.fori_loop(0, size, eliminate, augmented)[:, -1]


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
        iterations: At most so many steps of Newton's method.
    """
    if cones is not None:
        jacobian = jax.lax.optimization_barrier(cones.jacobian)
        flat = jacobian.reshape(-1, jacobian.shape[-1])

    def improve(carry: tuple[jax.Array, jax.Array, jax.Array]) -> Any:
        a, _, count = carry
        residual, matrix = mass @ (free - a), mass
        slopes = []  # of the constraints' force along a step, [K] for shares [K]
        if cones is not None:
            at = jacobian @ a - cones.reference
            force, h = cone(at, cones.weight, cones.friction, cones.ratio)
            x, y, z = jacobian
            bent = jnp.stack(
                [
                    h[0][:, None] * x + h[1][:, None] * y + h[3][:, None] * z,
                    h[1][:, None] * x + h[2][:, None] * y + h[4][:, None] * z,
                    h[3][:, None] * x + h[4][:, None] * y + h[5][:, None] * z,
                ]
            )
            residual = residual + flat.T @ force.reshape(-1)
            matrix = matrix + flat.T @ bent.reshape(flat.shape)
        if rows is not None:
            r = rows.jacobian @ a - rows.reference
            residual = residual + rows.jacobian.T @ _row_force(rows, r)
            matrix = matrix + (rows.jacobian.T * _row_bend(rows, r)) @ rows.jacobian
        move = solve_spd(matrix, residual)
        energy = move @ residual
        if cones is not None:
            along = jacobian @ move
            there = at[:, None] + _SHARES[:, None] * along[:, None]  # [3, K, C]
            pull = cone_force(there, cones.weight, cones.friction, cones.ratio)
            slopes.append(jnp.sum(pull * along[:, None], (0, 2)))
        if rows is not None:
            way = rows.jacobian @ move
            slopes.append(_row_force(rows, r + _SHARES[:, None] * way) @ way)
        # where constraints come or go, or begin to slide, Newton's step overshoots: the cost is
        # convex, so that its slope along the step has one zero, between two of the shares
        bend = mass @ move
        slope = (a - free) @ bend + _SHARES * (move @ bend) - sum(slopes)
        ends = jnp.concatenate([-energy[None], slope])
        share = jnp.append(0.0, _SHARES)
        last = jnp.sum(slope < 0)  # the interval's lower end
        after = jnp.minimum(last + 1, len(_SHARES))
        low, high = ends[last], ends[after]
        length = share[last] + (share[after] - share[last]) * low / jnp.minimum(low - high, -1e-12)
        return a + length * move, energy, count + 1

    def unsettled(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (carry[1] > CONVERGED) & (carry[2] < iterations)

    acting = jnp.zeros((), bool)
    if cones is not None:
        acting = acting | jnp.any(cones.weight > 0)
    if rows is not None:
        acting = acting | jnp.any(rows.weight > 0)
    first = (
        jnp.where(acting, start, free),
        jnp.where(acting, jnp.inf, 0.0),
        jnp.zeros((), jnp.int32),
    )
    a = jax.lax.while_loop(unsettled, improve, first)[0]
    own = None if rows is None else _row_force(rows, rows.jacobian @ a - rows.reference)
    pushed = None
    if cones is not None:
        at = jacobian @ a - cones.reference
        pushed = cone_force(at, cones.weight, cones.friction, cones.ratio)
    return Solution(a, own, pushed)
