"""Parameters with their optimiser and their average: what every gradient method updates."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax

PyTree = Any

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


def all_finite(tree: PyTree) -> jax.Array:
    """Whether every number of a tree is finite: parameters and Adam's moments as well as losses."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


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
        with jax.numpy_dtype_promotion("standard"):  # Optax adds whole and real numbers
            updates, opt_state = _ADAM.update(grads, learned.opt_state, learned.params)
        params = jax.tree.map(lambda p, u: p - learning_rate * u, learned.params, updates)
        if polyak_tau is None:
            count = learned.updates.astype(jnp.float32) + 1.0
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
