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
    # rows past the end are dropped: that is where unselected items go
    row = jnp.where(mask, (buffer.next + rank) % rows, rows)
    data = jax.tree.map(lambda old, new: old.at[row].set(new, mode="drop"), buffer.data, items)
    count = jnp.sum(mask, dtype=jnp.int32)
    return RingBuffer(data, (buffer.next + count) % rows, buffer.added + count)


def sample(buffer: RingBuffer, key: jax.Array, count: int) -> PyTree:
    """`count` items drawn with replacement; zeros from an empty buffer.

    Whoever uses them must weigh a loss on an empty buffer with zero.
    """
    index = jax.random.randint(key, (count,), 0, jnp.maximum(size(buffer), 1))
    return jax.tree.map(lambda leaf: leaf[index], buffer.data)
