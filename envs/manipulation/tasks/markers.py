"""The dirt on the table, a random walk (robosuite 1.4.1, `models/arenas/wipe_arena.py`)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

COUNT = 100
SPACING = 0.005  # m
TURN_CHANCE, TURN = 0.3, 0.5  # of a new heading per marker; its standard deviation, rad
COVERAGE, LINE_WIDTH = 0.6, 0.04


def draw_markers(key: jax.Array, half: tuple[float, float]) -> jax.Array:
    """One dirty line, [COUNT, 2], relative to the table's centre, m.

    The heading changes by N(0, 0.5) with probability 0.3 per marker, and again and again where the
    next marker would lie outside the central 60% of the table less half a line's width.

    Args:
        key: Random key.
        half: Half sizes of the table, m.
    """
    limit = jnp.array([COVERAGE * size - LINE_WIDTH / 2 for size in half], jnp.float32)
    key_place, key_heading, key_walk = jax.random.split(key, 3)
    place = jax.random.uniform(key_place, (2,), jnp.float32, minval=-limit, maxval=limit)
    heading = jax.random.uniform(key_heading, minval=-jnp.pi, maxval=jnp.pi, dtype=jnp.float32)

    def ahead(place: jax.Array, heading: jax.Array) -> jax.Array:
        return place + SPACING * jnp.stack([jnp.sin(heading), jnp.cos(heading)])

    def step(carry, key):
        place, heading = carry
        key_chance, key_turn, key_border = jax.random.split(key, 3)
        turned = heading + TURN * jax.random.normal(key_turn, dtype=jnp.float32)
        heading = jnp.where(
            jax.random.uniform(key_chance, dtype=jnp.float32) < TURN_CHANCE, turned, heading
        )

        def outside(carry) -> jax.Array:
            return ~jnp.all(jnp.abs(ahead(place, carry[0])) < limit)

        def turn(carry):
            heading, key = carry
            key, key_now = jax.random.split(key)
            return heading + TURN * jax.random.normal(key_now, dtype=jnp.float32), key

        heading, _ = jax.lax.while_loop(outside, turn, (heading, key_border))
        return (ahead(place, heading), heading), place

    return jax.lax.scan(step, (place, heading), jax.random.split(key_walk, COUNT))[1]
