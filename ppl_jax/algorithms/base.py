"""The record that a learning method fills in, and the update that gradient methods share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

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

_ADAM = optax.scale_by_adam()
AVERAGING = 0.999  # decay of the average of the parameters, per update


@flax.struct.dataclass
class Learned:
    """Parameters with their optimiser.

    Attributes:
        params: They act while training.
        opt_state: State of Adam.
        updates: Number of updates so far.
        average: Moving average of `params`. A policy's, over the last thousand or so updates, is
            evaluated, saved and exported (one update per step on changing data leaves the last
            parameters noisy). A critic's is its target network.
    """

    params: PyTree
    opt_state: PyTree
    updates: jax.Array
    average: PyTree


def init_learned(params: PyTree) -> Learned:
    """Before the first update."""
    return Learned(
        params=params,
        opt_state=_ADAM.init(params),
        updates=jnp.zeros((), jnp.int32),
        average=params,
    )


def adam_step(
    learned: Learned,
    grads: PyTree,
    learning_rate: jax.Array | float,
    do: jax.Array | bool = True,
    *,
    polyak_tau: jax.Array | float | None = None,
) -> Learned:
    """One step of Adam with a traced learning rate where `do`, else nothing.

    Args:
        learned: Before.
        grads: Like `learned.params`.
        learning_rate: Step size.
        do: Scalar.
        polyak_tau: tau of a target network: average <- (1 - tau) average + tau params. Where None
            the average is a policy's, with `AVERAGING` for decay.
    """

    def step(learned: Learned) -> Learned:
        updates, opt_state = _ADAM.update(grads, learned.opt_state, learned.params)
        params = jax.tree.map(lambda p, u: p - learning_rate * u, learned.params, updates)
        if polyak_tau is None:
            count = learned.updates + 1.0
            decay = jnp.minimum(AVERAGING, count / (count + 9.0))  # young averages forget faster
        else:
            decay = 1.0 - polyak_tau
        average = jax.tree.map(
            lambda old, new: decay * old + (1 - decay) * new, learned.average, params
        )
        return Learned(
            params=params, opt_state=opt_state, updates=learned.updates + 1, average=average
        )

    return jax.lax.cond(do, step, lambda learned: learned, learned)


@flax.struct.dataclass
class ActorCritic:
    """The parameters of a method with critics.

    Attributes:
        actor: `Learned` of the policy.
        critic: `Learned` of twin action values, with their target networks.
    """

    actor: Learned
    critic: Learned
