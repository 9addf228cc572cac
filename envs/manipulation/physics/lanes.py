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
    if factors is NOMINAL:  # of plain numbers, which change no program
        return jax.custom_batching.sequential_vmap(lambda s, a: advance(s, a, NOMINAL))(
            state, action
        )
    return jax.custom_batching.sequential_vmap(advance)(state, action, factors)
