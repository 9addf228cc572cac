"""Linear algebra on lists of scalars, unrolled: fourteen by fourteen at most.

LAPACK calls inside a vectorised program are slow and, with few threads, have been seen to
deadlock; unrolled, every entry is one vector over worlds.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

Scalar = Any
Rows = list[list[Scalar]]


def materialize(tree: Any) -> Any:
    """The same scalars, computed and stored once.

    XLA fuses across everything it can and computes shared terms anew for each user: without these
    stops a batch of 64 arms takes six times as long. A bare barrier is not enough; the stack is
    what makes it a store.
    """
    leaves, treedef = jax.tree.flatten(tree)
    traced = [index for index, leaf in enumerate(leaves) if not isinstance(leaf, float)]
    stored = jax.lax.optimization_barrier(jnp.stack([leaves[index] for index in traced]))
    for row, index in enumerate(traced):
        leaves[index] = stored[row]
    return jax.tree.unflatten(treedef, leaves)


def cholesky(matrix: Rows) -> Rows:
    """Lower factor L of a symmetric positive definite matrix; 1 / L[i][i] on the diagonal."""
    size = len(matrix)
    factor: Rows = [[0.0] * size for _ in range(size)]
    for j in range(size):
        rest = matrix[j][j]
        for k in range(j):
            rest = rest - factor[j][k] * factor[j][k]
        factor[j][j] = 1.0 / jnp.sqrt(rest)
        for i in range(j + 1, size):
            value = matrix[i][j]
            for k in range(j):
                value = value - factor[i][k] * factor[j][k]
            factor[i][j] = value * factor[j][j]
    return factor


def forward(factor: Rows, right: list[Scalar]) -> list[Scalar]:
    """L^-1 right."""
    result: list[Scalar] = []
    for i, value in enumerate(right):
        for k in range(i):
            value = value - factor[i][k] * result[k]
        result.append(value * factor[i][i])
    return result


def backward(factor: Rows, right: list[Scalar]) -> list[Scalar]:
    """L'^-1 right."""
    size = len(right)
    result: list[Scalar] = [0.0] * size
    for i in reversed(range(size)):
        value = right[i]
        for k in range(i + 1, size):
            value = value - factor[k][i] * result[k]
        result[i] = value * factor[i][i]
    return result


def solve(factor: Rows, right: list[Scalar]) -> list[Scalar]:
    """(L L')^-1 right."""
    return backward(factor, forward(factor, right))


def array(rows: Any) -> jax.Array:
    """Nested scalars as an array: a matrix of its rows, or (columns given) its transpose."""
    return jnp.stack([jnp.stack(list(row)) for row in rows])


def solve_array(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """matrix^-1 right for a symmetric positive definite matrix [n, n] and right [n]."""
    size = len(right)
    factor = cholesky([[matrix[i, j] for j in range(size)] for i in range(size)])
    return jnp.stack(solve(materialize(factor), [right[i] for i in range(size)]))


def inner(a: list[Scalar], b: list[Scalar]) -> Scalar:
    """The inner product a . b."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def apply_inverse3(matrix: Rows, right: list[Scalar]) -> list[Scalar]:
    """Symmetric 3 x 3 matrix^-1 right, by cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * aa + b * ab + c * ac)
    x, y, z = right
    return [
        scale * (aa * x + ab * y + ac * z),
        scale * (ab * x + bb * y + bc * z),
        scale * (ac * x + bc * y + cc * z),
    ]
