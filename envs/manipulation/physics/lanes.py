"""How a batch of arms goes through one control step on a CPU: one world after another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from envs.manipulation.randomisation import NOMINAL, Factors


def one_after_another(
    advance: Callable[[Any, jax.Array, Factors], Any],
    state: Any,
    action: jax.Array,
    factors: Factors,
) -> Any:
    """`advance(state, action, factors)`, whose batch goes one world after another on a CPU.

    There the control step of one world is one function that keeps all it needs in the nearest
    cache, and the contact solver stops in each world as soon as it has converged: a batch side by
    side is slower and takes three times as long to compile (`ppl bench --parts physics`). On every
    other backend a batch stays one program over all of its worlds.
    """
    if jax.default_backend() != "cpu":
        return advance(state, action, factors)
    # of plain numbers, which change no program
    given = (state, action) if factors is NOMINAL else (state, action, factors)

    def one(state: Any, action: jax.Array, factors: Factors = NOMINAL) -> Any:
        return advance(state, action, factors)

    lanes = jax.custom_jvp(jax.custom_batching.sequential_vmap(one))
    # a function with a batching rule of its own has no derivative in reverse
    lanes.defjvp(lambda primals, tangents: jax.jvp(one, primals, tangents))
    return lanes(*given)
