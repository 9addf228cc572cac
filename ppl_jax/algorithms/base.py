"""The record that a learning method fills in, and the update that gradient methods share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from ppl_jax.config import HParams, TrainConfig
from ppl_jax.losses import Metrics
from ppl_jax.networks import Layers
from ppl_jax.types import DecisionPoint, EnvSpec, Interaction

PyTree = Any


class Algorithm(NamedTuple):
    """A method as a record of pure functions; the loop knows nothing else of it.

    Attributes:
        name: As in results.
        init: `init(key) -> state`, a struct with buffers and a field `learned` that holds all
            that updates change.
        act: `act(state, key, observation [O]) -> action [A]`, the novice's while training. It is
            clipped to [-1, 1] before it is executed.
        decide: `decide(state, point, hparams) -> bool`, whether the expert takes over for the next
            block of steps; None leaves it to the gate that the configuration names.
        store: `store(state, interaction, hparams) -> state`.
        update: `update(state, key, hparams) -> (state, metrics)`.
        policy: `policy(state) -> Layers`: the deterministic policy that is evaluated, saved and
            exported (ReLU between layers, tanh at the end, input centred and scaled).
        predicted_steps: Steps of `interaction.predicted` that `store` reads; 0 where it reads none.
        labels_predictions: The expert is asked at these predicted states, too.
        needs_expert_rollout: Its own `decide` reads `point.experts`.
        update_every: Steps between updates: 1, or a multiple of `decision_interval`.
        fit: Update of the phase between demonstrations and the first step; `update` where None.
    """

    name: str
    init: Callable[[jax.Array], PyTree]
    act: Callable[[PyTree, jax.Array, jax.Array], jax.Array]
    store: Callable[[PyTree, Interaction, HParams], PyTree]
    update: Callable[[PyTree, jax.Array, HParams], tuple[PyTree, Metrics]]
    policy: Callable[[PyTree], Layers]
    decide: Callable[[PyTree, DecisionPoint, HParams], jax.Array] | None = None
    predicted_steps: int = 0
    labels_predictions: bool = False
    needs_expert_rollout: bool = False
    update_every: int = 1
    fit: Callable[[PyTree, jax.Array, HParams], tuple[PyTree, Metrics]] | None = None

    @property
    def supports_human(self) -> bool:
        """Whether an expert, a person too, decides when to take over."""
        return self.decide is None


MakeAlgorithm = Callable[[EnvSpec, TrainConfig], Algorithm]
"""`make(spec, config) -> Algorithm`."""
