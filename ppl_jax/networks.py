"""The policy network. Flax Linen stays inside this file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from ppl_jax.types import WorldSpec

Params = Any


class _MLP(nn.Module):
    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.hidden:
            x = nn.relu(nn.Dense(width)(x))
        return nn.tanh(nn.Dense(self.outputs)(x))


class PolicyNetwork(NamedTuple):
    """A deterministic policy.

    Attributes:
        init: `init(key) -> params`.
        apply: `apply(params, observation [..., O]) -> action [..., A]` in [-1, 1].
    """

    init: Callable[[jax.Array], Params]
    apply: Callable[[Params, jax.Array], jax.Array]


def make_policy(spec: WorldSpec, hidden: tuple[int, ...]) -> PolicyNetwork:
    """An MLP with ReLU between layers and tanh at the end; its input is centred and scaled."""
    module = _MLP(tuple(hidden), spec.action_size)
    mean, scale = jnp.asarray(spec.observation_mean), jnp.asarray(spec.observation_scale)

    def init(key: jax.Array) -> Params:
        return module.init(key, jnp.zeros(spec.observation_size))

    def apply(params: Params, observation: jax.Array) -> jax.Array:
        return module.apply(params, (observation - mean) / scale)  # pyright: ignore[reportReturnType]

    return PolicyNetwork(init, apply)


def layers(params: Params) -> list[tuple[jax.Array, jax.Array]]:
    """Weights [I, O] and biases [O] from input to output, row vectors: `x @ w + b`."""
    dense = params["params"]
    return [(dense[f"Dense_{i}"]["kernel"], dense[f"Dense_{i}"]["bias"]) for i in range(len(dense))]


def from_layers(weights: list[tuple[jax.Array, jax.Array]]) -> Params:
    """The inverse of `layers`."""
    return {
        "params": {
            f"Dense_{i}": {"kernel": kernel, "bias": bias}
            for i, (kernel, bias) in enumerate(weights)
        }
    }
