"""What a learning method fills in, and what every gradient method shares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
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
        init: `init(key) -> state`, a struct with buffers and a field `learned` that holds all
            that updates change.
        act: `act(state, observation [O]) -> action [A]`, deterministic.
        decide: `decide(state, trajectory, experts, hparams) -> bool`, whether the expert takes
            over for the next block of steps; `experts` is the expert's own predicted trajectory
            where `compares` asks for it, else None.
        store: `store(state, interaction, hparams) -> state`.
        update: `update(state, key, hparams) -> (state, metrics)`, one per environment step.
        policy_params: `policy_params(state)`, what evaluation, saving and export use.
        uses_predictions: Whether `store` reads `interaction.predicted`.
        compares: Whether `decide` reads the expert's own prediction.
    """

    name: str
    init: Callable[[jax.Array], PyTree]
    act: Callable[[PyTree, jax.Array], jax.Array]
    decide: Callable[[PyTree, Trajectory, Trajectory | None, HParams], jax.Array]
    store: Callable[[PyTree, Interaction, HParams], PyTree]
    update: Callable[[PyTree, jax.Array, HParams], tuple[PyTree, Metrics]]
    policy_params: Callable[[PyTree], PyTree]
    uses_predictions: bool
    compares: bool = False


MakeAlgorithm = Callable[[WorldSpec, TrainConfig], Algorithm]
"""`make(spec, config) -> Algorithm`."""

_ADAM = optax.scale_by_adam()
AVERAGING = 0.999  # decay of the average of the parameters, per update


@flax.struct.dataclass
class Learned:
    """Parameters with their optimiser.

    Attributes:
        params: What acts while training.
        opt_state: Of Adam.
        updates: Number of updates so far.
        average: Moving average of `params` over the last thousand or so updates: what is
            evaluated, saved and exported. One update per step on changing data leaves the last
            parameters noisy.
    """

    params: PyTree
    opt_state: PyTree
    updates: jax.Array
    average: PyTree


def init_learned(params: PyTree) -> Learned:
    """Before the first update."""
    return Learned(params, _ADAM.init(params), jnp.zeros((), jnp.int32), params)


def adam_step(
    learned: Learned, grads: PyTree, learning_rate: jax.Array | float, do: jax.Array
) -> Learned:
    """One step of Adam with a traced learning rate where `do`, else nothing."""

    def step(learned: Learned) -> Learned:
        updates, opt_state = _ADAM.update(grads, learned.opt_state, learned.params)
        params = jax.tree.map(lambda p, u: p - learning_rate * u, learned.params, updates)
        count = learned.updates + 1.0
        decay = jnp.minimum(AVERAGING, count / (count + 9.0))  # young averages forget faster
        average = jax.tree.map(
            lambda old, new: decay * old + (1 - decay) * new, learned.average, params
        )
        return Learned(params, opt_state, learned.updates + 1, average)

    return jax.lax.cond(do, step, lambda learned: learned, learned)
