from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppl_jax import buffers


@settings(max_examples=30, deadline=None)
@given(st.lists(st.lists(st.booleans(), min_size=4, max_size=4), max_size=12))
def test_masked_insert_is_a_deque(masks):
    rows = 7
    buffer = buffers.init_buffer((jnp.zeros(2), jnp.zeros(())), rows)
    model, count = deque(maxlen=rows), 0
    for step, mask in enumerate(masks):
        values = np.arange(4, dtype=np.float32) + 10 * step
        items = (np.stack([values, -values], 1), values)
        buffer = ADD(buffer, items, np.array(mask))
        for value, keep in zip(values, mask, strict=True):
            if keep:
                model.append(float(value))
                count += 1
    assert int(buffer.added) == count
    assert int(buffers.size(buffer)) == len(model)
    held = np.asarray(buffer.data[1])
    order = [(int(buffer.next) - len(model) + i) % rows for i in range(len(model))]
    assert [float(held[i]) for i in order] == list(model)
    np.testing.assert_array_equal(np.asarray(buffer.data[0])[:, 1], -held)


ADD = jax.jit(buffers.add)


def test_samples_come_from_what_is_held_and_evenly():
    buffer = buffers.init_buffer(jnp.zeros(()), 50)
    buffer = buffers.add(buffer, jnp.arange(1.0, 6.0), jnp.ones(5, bool))
    drawn = np.asarray(buffers.sample(buffer, jax.random.key(0), 5000))
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert counts.min() > 850


@pytest.mark.parametrize("count", [3, 5, 8])
@pytest.mark.parametrize("recency", [0.0, 1.0, 3.0])
def test_recent_items_are_drawn_more_often(count, recency):
    """Also once the buffer of 5 rows has gone round."""
    buffer = buffers.init_buffer(jnp.zeros(()), 5)
    for value in range(count):
        buffer = ADD(buffer, jnp.full(4, float(value)), jnp.arange(4) == 0)
    drawn = np.asarray(buffers.sample(buffer, jax.random.key(0), 20_000, recency))
    held = min(count, 5)
    share = (np.arange(held + 1) / held) ** (1 + recency)
    found = [np.mean(drawn == value) for value in range(count - held, count)]
    np.testing.assert_allclose(found, np.diff(share), atol=0.015)


def test_an_empty_buffer_gives_zeros():
    buffer = buffers.init_buffer(jnp.zeros(3), 5)
    for recency in (0.0, 2.0):
        assert not np.asarray(buffers.sample(buffer, jax.random.key(0), 4, recency)).any()


def test_written_in_place_inside_a_scan():
    rows = 4099  # a number that no other array has
    buffer = buffers.init_buffer(jnp.zeros(16), rows)

    def body(buffer, value):
        items = jnp.full((5, 16), value)
        return buffers.add(buffer, items, jnp.arange(5) < value % 5), None

    run = jax.jit(lambda b, xs: jax.lax.scan(body, b, xs)[0], donate_argnums=0)
    text = run.lower(buffer, jnp.arange(10.0)).compile().as_text()
    copies = [line for line in text.splitlines() if f"[{rows},16]" in line and " copy(" in line]
    assert not copies, copies


def test_a_mask_of_another_length_is_refused():
    buffer = buffers.init_buffer((jnp.zeros(2), jnp.zeros(())), 7)
    for items, mask in (
        ((np.zeros((4, 2)), np.zeros(4)), np.ones(3, bool)),
        ((np.zeros((4, 2)), np.zeros(3)), np.ones(4, bool)),
        ((np.zeros((4, 2)), np.zeros(4)), np.ones((4, 1), bool)),
    ):
        with pytest.raises(AssertionError, match=r"shape|rank"):
            buffers.add(buffer, items, mask)
