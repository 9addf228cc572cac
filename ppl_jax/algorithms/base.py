"""What a learning method fills in, and what every gradient method shares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from ppl_jax.config import HParams, TrainConfig
from ppl_jax.losses import Metrics
from ppl_jax.types import Interaction, Trajectory, WorldSpec

PyTree = Any


class Algorithm(NamedTuple):
    """A method as a record of pure functions; the loop knows nothing else of it.

    Attributes:
        name: As in results.
        init: `init(key) -> state`, a pytree of parameters, optimiser and buffers.
        act: `act(state, observation [O]) -> action [A]`, deterministic.
        decide: `decide(state, trajectory, hparams) -> bool`, whether the expert takes over for
            the next block of steps.
        store: `store(state, interaction, hparams) -> state`.
        update: `update(state, key, hparams) -> (state, metrics)`, one per environment step.
        policy_params: `policy_params(state)`, what evaluation, saving and export use.
        uses_predictions: Whether `store` reads `interaction.predicted`.
    """

    name: str
    init: Callable[[jax.Array], PyTree]
    act: Callable[[PyTree, jax.Array], jax.Array]
    decide: Callable[[PyTree, Trajectory, HParams], jax.Array]
    store: Callable[[PyTree, Interaction, HParams], PyTree]
    update: Callable[[PyTree, jax.Array, HParams], tuple[PyTree, Metrics]]
    policy_params: Callable[[PyTree], PyTree]
    uses_predictions: bool


MakeAlgorithm = Callable[[WorldSpec, TrainConfig], Algorithm]
"""`make(spec, config) -> Algorithm`."""

_ADAM = optax.scale_by_adam()


def init_adam(params: PyTree) -> PyTree:
    """State of Adam."""
    return _ADAM.init(params)


def adam_step(
    params: PyTree, opt_state: PyTree, grads: PyTree, learning_rate: jax.Array | float,
    do: jax.Array,
) -> tuple[PyTree, PyTree]:
    """One step of Adam with a traced learning rate where `do`, else nothing."""
    updates, new_state = _ADAM.update(grads, opt_state, params)

    def select(new: PyTree, old: PyTree) -> PyTree:
        return jax.tree.map(lambda n, o: jnp.where(do, n, o), new, old)

    stepped = jax.tree.map(lambda p, u: p - learning_rate * u, params, updates)
    return select(stepped, params), select(new_state, opt_state)
