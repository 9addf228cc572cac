"""Experts as pure functions: a saved policy as an expert. Scripted ones live with their envs."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from ppl_jax.checks import check_name
from ppl_jax.distributions import gaussian_log_prob
from ppl_jax.types import Expert

ACTIVATIONS, OUTPUTS = ("relu", "tanh"), ("tanh", "clip")


class SavedPolicy(NamedTuple):
    """A policy as plain arrays, as in an exported file.

    Attributes:
        weights: (w [I, O], b [O]) per layer: `x @ w + b`.
        activation: Between layers: "relu" or "tanh".
        output: "tanh" squashes the last layer, "clip" clips it to [-1, 1].
        obs_mean, obs_scale: `(obs - mean) / scale` comes first.
        log_std: [A] of the Gaussian around the action, where the policy has one, else None.
    """

    weights: Sequence[tuple[Any, Any]]
    activation: str
    output: str
    obs_mean: Any
    obs_scale: Any
    log_std: Any = None

    def __call__(self, observation: Any) -> jax.Array:
        """The deterministic action, [..., O] -> [..., A]; see `act`."""
        return act(self, jnp.asarray(observation))


def act(policy: SavedPolicy, observation: jax.Array) -> jax.Array:
    """The deterministic action, [..., O] -> [..., A].

    Raises:
        ValueError: If the policy's activation or output is unknown.
        AssertionError: If the observation is not of the policy's size.
    """
    check_name("activation", policy.activation, ACTIVATIONS)
    check_name("output", policy.output, OUTPUTS)
    chex.assert_axis_dimension(observation, -1, policy.weights[0][0].shape[0])
    x = (observation - policy.obs_mean) / policy.obs_scale
    between = jnp.tanh if policy.activation == "tanh" else jax.nn.relu
    for w, b in policy.weights[:-1]:
        x = between(x @ w + b)
    w, b = policy.weights[-1]
    x = x @ w + b
    return jnp.tanh(x) if policy.output == "tanh" else jnp.clip(x, -1.0, 1.0)


def log_density(policy: SavedPolicy, observation: jax.Array, action: jax.Array) -> jax.Array:
    """Log of the density that a policy's Gaussian gives to an action, [..., O], [..., A] -> [...].

    Its mean is the deterministic action. It is the density before clipping to the action box, and
    so may exceed 1. A gate by action probability (EGPO; Peng et al. 2021) has the expert take over
    where it falls below a threshold.

    Raises:
        ValueError: If the policy has no standard deviation.
    """
    if policy.log_std is None:
        raise ValueError("this policy is deterministic: it has no log_std, so no density")
    return gaussian_log_prob(act(policy, observation), jnp.asarray(policy.log_std), action)


def neural_expert(policy: SavedPolicy) -> Expert:
    """An expert that acts as a saved policy does.

    Where the policy has a standard deviation, the expert has an attribute `log_density`, a function
    of observation and action.
    """
    arrays = jax.tree.map(jnp.asarray, (list(policy.weights), policy.obs_mean, policy.obs_scale))
    weights, mean, scale = arrays
    policy = policy._replace(weights=weights, obs_mean=mean, obs_scale=scale)

    def expert(key: jax.Array, state: Any, observation: jax.Array, params: Any) -> jax.Array:
        del key, state, params
        return act(policy, observation)

    if policy.log_std is not None:
        expert.log_density = functools.partial(log_density, policy)  # pyright: ignore[reportFunctionMemberAccess]
    return expert
