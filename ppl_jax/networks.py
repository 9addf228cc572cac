"""The networks. Flax Linen stays inside this file.

All are MLPs with ReLU between layers whose input is the observation, centred and scaled by
constants of the environment (and, for a critic, the action).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import jax.scipy

from ppl_jax.types import EnvSpec

Params = Any
Layers = list[tuple[jax.Array, jax.Array]]
"""Weights [I, O] and biases [O] from input to output, row vectors: `x @ w + b`."""


NARROW = 2
"""Layers of so many outputs at most are a product of matrix and vector for each output."""


def _by_column(x: jax.Array, w: jax.Array, *_: Any, **__: Any) -> jax.Array:
    """`x @ w`, a column of `w` at a time.

    The gradient of a product with one or two columns is two products that XLA's CPU library does at
    2 GFLOP/s; with both columns of driving's actions they were a sixth of a training step.
    """
    return jnp.stack([x @ column for column in w.T], -1)


class _MLP(nn.Module):
    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.hidden:
            x = nn.relu(nn.Dense(width)(x))
        product = _by_column if self.outputs <= NARROW else None
        return nn.Dense(self.outputs, dot_general=product)(x)


class Network(NamedTuple):
    """A network as two pure functions.

    Attributes:
        init: `init(key) -> params`.
        apply: `apply(params, observation [..., O], ...) -> [..., outputs]`.
    """

    init: Callable[[jax.Array], Params]
    apply: Callable[..., jax.Array]


def make_policy(spec: EnvSpec, hidden: tuple[int, ...]) -> Network:
    """A deterministic policy: tanh at the end, actions [..., A] in [-1, 1]."""
    raw = make_raw(spec, hidden, spec.action_size)
    return Network(
        init=raw.init,
        apply=lambda params, observation: jnp.tanh(raw.apply(params, observation)),
    )


def make_raw(spec: EnvSpec, hidden: tuple[int, ...], outputs: int) -> Network:
    """A network of the observation without anything behind its last layer."""
    module = _MLP(tuple(hidden), outputs)
    mean, scale = (
        jnp.asarray(spec.observation_mean, jnp.float32),
        jnp.asarray(spec.observation_scale, jnp.float32),
    )

    def init(key: jax.Array) -> Params:
        return module.init(key, spec.zeros()[0])

    def apply(params: Params, observation: jax.Array) -> jax.Array:
        return module.apply(params, (observation - mean) / scale)  # pyright: ignore[reportReturnType]

    return Network(init=init, apply=apply)


def make_critic(spec: EnvSpec, hidden: tuple[int, ...], count: int) -> Network:
    """`count` independent networks of observation and action: `apply(params, s, a)`, [count, ...].

    Parameters carry a leading [count] axis.
    """
    module = _MLP(tuple(hidden), 1)
    mean, scale = (
        jnp.asarray(spec.observation_mean, jnp.float32),
        jnp.asarray(spec.observation_scale, jnp.float32),
    )

    def init(key: jax.Array) -> Params:
        inputs = jnp.concatenate(spec.zeros())
        return jax.vmap(module.init, in_axes=(0, None))(jax.random.split(key, count), inputs)

    def apply(params: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        inputs = jnp.concatenate([(observation - mean) / scale, action], -1)
        values: jax.Array = jax.vmap(module.apply, in_axes=(0, None))(params, inputs)  # pyright: ignore[reportAssignmentType]
        return values[..., 0]

    return Network(init=init, apply=apply)


class Ensemble(NamedTuple):
    """Independent policies whose parameters carry a leading [K] axis.

    Attributes:
        init: `init(key) -> params`, every member from a key of its own.
        members: `members(params, observation [..., O]) -> [K, ..., A]`.
        each: `each(params, observation [K, B, O]) -> [K, B, A]`, each member on inputs of its own.
        apply: `apply(params, observation) -> [..., A]`, tanh of the mean before the squashing, so
            that the ensemble is itself one network (`ensemble_layers`).
    """

    init: Callable[[jax.Array], Params]
    members: Callable[[Params, jax.Array], jax.Array]
    each: Callable[[Params, jax.Array], jax.Array]
    apply: Callable[[Params, jax.Array], jax.Array]


def make_ensemble(spec: EnvSpec, hidden: tuple[int, ...], count: int) -> Ensemble:
    """`count` deterministic policies."""
    raw = make_raw(spec, hidden, spec.action_size)
    shared = jax.vmap(raw.apply, in_axes=(0, None))
    return Ensemble(
        init=lambda key: jax.vmap(raw.init)(jax.random.split(key, count)),
        members=lambda params, observation: jnp.tanh(shared(params, observation)),
        each=lambda params, observation: jnp.tanh(jax.vmap(raw.apply)(params, observation)),
        apply=lambda params, observation: jnp.tanh(jnp.mean(shared(params, observation), 0)),
    )


def layers(params: Params) -> Layers:
    """The layers of a network."""
    dense = params["params"]
    return [(dense[f"Dense_{i}"]["kernel"], dense[f"Dense_{i}"]["bias"]) for i in range(len(dense))]


def ensemble_layers(params: Params) -> Layers:
    """The layers of an `Ensemble` as one network, members side by side."""
    stacked = layers(params)
    count = stacked[0][0].shape[0]
    merged = []
    for i, (w, b) in enumerate(stacked):
        if i == 0:
            w = jnp.concatenate(list(w), -1)
        elif i < len(stacked) - 1:
            w = jax.scipy.linalg.block_diag(*w)
        else:
            w, b = jnp.concatenate(list(w), 0) / count, jnp.mean(b, 0)
        merged.append((w, b.ravel()))
    return merged
