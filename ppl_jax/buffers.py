"""Fixed-capacity ring buffers, written in place under `jit` and `scan`."""

from __future__ import annotations

from typing import Any

import chex
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
    return RingBuffer(data=data, next=jnp.zeros((), jnp.int32), added=jnp.zeros((), jnp.int32))


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

    Raises:
        AssertionError: If shapes do not fit.
    """
    chex.assert_rank(mask, 1)
    chex.assert_tree_shape_prefix(items, mask.shape)
    rows = capacity(buffer)
    rank = jnp.cumsum(mask, dtype=jnp.int32) - 1
    # rows past the end are dropped: that is where unselected items go
    row = jnp.where(mask, (buffer.next + rank) % rows, rows)
    data = jax.tree.map(lambda old, new: old.at[row].set(new, mode="drop"), buffer.data, items)
    count = jnp.sum(mask, dtype=jnp.int32)
    return RingBuffer(data=data, next=(buffer.next + count) % rows, added=buffer.added + count)


def draw(
    buffer: RingBuffer, key: jax.Array, shape: tuple[int, ...], recency: jax.Array | float = 0.0
) -> jax.Array:
    """Rows drawn with replacement, all alike or recent ones more often.

        P(k-th oldest of n) = (k / n)^(1 + r) - ((k - 1) / n)^(1 + r)

    Args:
        buffer: To draw from; row 0 where it is empty.
        key: Random key.
        shape: Of the result.
        recency: r; 0 draws all alike.
    """
    held = size(buffer)
    share = jax.random.uniform(key, shape, jnp.float32) ** (1.0 / (1.0 + recency))
    rank = held.astype(jnp.float32) * share
    rank = jnp.clip(rank.astype(jnp.int32), 0, jnp.maximum(held - 1, 0))
    return (buffer.next - held + rank) % capacity(buffer)


def sample(
    buffer: RingBuffer, key: jax.Array, count: int, recency: jax.Array | float = 0.0
) -> PyTree:
    """`count` items; see `draw`. An empty buffer returns zeros; mask the loss."""
    rows = draw(buffer, key, (count,), recency)
    return jax.tree.map(lambda leaf: leaf[rows], buffer.data)


@flax.struct.dataclass
class SplitBuffer:
    """Steps of either party in control, for methods that learn from both.

    Attributes:
        human: Steps under the expert's control.
        robot: Steps under the novice's.
    """

    human: RingBuffer
    robot: RingBuffer


def init_split(item: PyTree, human_capacity: int, robot_capacity: int) -> SplitBuffer:
    """Two empty buffers for items like `item`."""
    return SplitBuffer(
        human=init_buffer(item, human_capacity), robot=init_buffer(item, robot_capacity)
    )


def add_split(split: SplitBuffer, item: PyTree, takeover: jax.Array) -> SplitBuffer:
    """Append one item to the one buffer or the other."""
    row = jax.tree.map(lambda leaf: leaf[None], item)
    return SplitBuffer(
        human=add(split.human, row, takeover[None]),
        robot=add(split.robot, row, ~takeover[None]),
    )


def sample_split(
    split: SplitBuffer, key: jax.Array, count: int, recency: jax.Array | float = 0.0
) -> tuple[PyTree, jax.Array]:
    """`count` items, one half from either buffer (human first), and their weights.

    Args:
        split: To draw from.
        key: Random key.
        count: Number of items.
        recency: See `draw`.

    Returns:
        Items and [count] weights of mean 1: all 1 where both buffers hold something; where one is
        empty its half weighs 0 and the other 2; all 0 where both are.
    """
    key_human, key_robot = jax.random.split(key)
    half = count // 2
    ours = sample(split.human, key_human, half, recency)
    theirs = sample(split.robot, key_robot, count - half, recency)
    items = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), ours, theirs)
    ours = jnp.arange(count, dtype=jnp.int32) < half
    held = jnp.where(ours, size(split.human), size(split.robot)) > 0
    held = held.astype(jnp.float32)
    return items, held / jnp.maximum(jnp.mean(held), 1e-9)


def sample_both(split: SplitBuffer, key: jax.Array, count: int) -> tuple[PyTree, jax.Array]:
    """`count` items, the expert's and the novice's steps alike; weights like `sample_split`'s."""
    human, robot = size(split.human), size(split.robot)
    row = jax.random.randint(key, (count,), 0, jnp.maximum(human + robot, 1), jnp.int32)
    ours = row < human

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        theirs = jnp.clip(row - human, 0, b.shape[0] - 1)
        mask = ours.reshape(-1, *[1] * (a.ndim - 1))
        return jnp.where(mask, a[jnp.clip(row, 0, a.shape[0] - 1)], b[theirs])

    items = jax.tree.map(pick, split.human.data, split.robot.data)
    return items, jnp.where(human + robot > 0, jnp.ones(count, jnp.float32), 0.0)
