"""Fixed-capacity ring buffers, written in place under `jit` and `scan`."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

PyTree = Any


@flax.struct.dataclass
class RingBuffer:
    """A ring buffer.

    Attributes:
        data: Pytree of [C, ...] arrays.
        next: Row the next item goes to.
        added: Number of items ever added.
    """

    data: PyTree
    next: jax.Array
    added: jax.Array


def init_buffer(item: PyTree, capacity: int) -> RingBuffer:
    """An empty buffer for items like `item` (arrays or shapes)."""
    data = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), item)
    return RingBuffer(data, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def capacity(buffer: RingBuffer) -> int:
    """Number of rows."""
    return jax.tree.leaves(buffer.data)[0].shape[0]


def size(buffer: RingBuffer) -> jax.Array:
    """Number of items held."""
    return jnp.minimum(buffer.added, capacity(buffer))


def add(buffer: RingBuffer, items: PyTree, mask: jax.Array) -> RingBuffer:
    """Append those of `items` that `mask` selects, in order.

    Args:
        buffer: Before.
        items: Pytree of [N, ...].
        mask: [N] bool.
    """
    rows = capacity(buffer)
    rank = jnp.cumsum(mask) - 1
    data = buffer.data
    # one row after the other: XLA's scatter of the same rows takes a hundred times longer on a CPU
    for i in range(mask.shape[0]):
        row = (buffer.next + rank[i]) % rows

        def write(old: jax.Array, new: jax.Array, i: int = i, row: jax.Array = row) -> jax.Array:
            before = jax.lax.dynamic_index_in_dim(old, row, 0, keepdims=True)
            chosen = jnp.where(mask[i], new[i : i + 1], before)
            return jax.lax.dynamic_update_slice_in_dim(old, chosen, row, 0)

        data = jax.tree.map(write, data, items)
    count = jnp.sum(mask, dtype=jnp.int32)
    return RingBuffer(data, (buffer.next + count) % rows, buffer.added + count)


def sample(buffer: RingBuffer, key: jax.Array, count: int) -> PyTree:
    """`count` items drawn with replacement; zeros from an empty buffer.

    Whoever uses them must weigh a loss on an empty buffer with zero.
    """
    index = jax.random.randint(key, (count,), 0, jnp.maximum(size(buffer), 1))
    return jax.tree.map(lambda leaf: leaf[index], buffer.data)
