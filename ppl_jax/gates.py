"""Takeover rules: would the predicted trajectory fail?

`rule(trajectory, experts, hparams, scale) -> bool`; `experts` is what the expert itself is
predicted to do from here, for rules in `COMPARING`, and None for the others; `scale` is the world's
`observation_scale`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.config import HParams
from ppl_jax.types import DecisionPoint, Trajectory

Scale = np.ndarray | jax.Array
Rule = Callable[[Trajectory, Trajectory | None, HParams, Scale], jax.Array]


def unsafe_or_slow(
    trajectory: Trajectory, experts: Trajectory | None, hparams: HParams, scale: Scale
) -> jax.Array:
    """The paper's driving rule: any predicted crash or leaving the road, or mean speed too low.

    A prediction that ends in success is not slow.
    """
    del experts, scale
    steps = jnp.maximum(jnp.sum(trajectory.valid), 1)
    mean_speed = jnp.sum(trajectory.speed * trajectory.valid) / steps
    slow = (mean_speed < hparams.min_speed) & ~jnp.any(trajectory.success)
    return jnp.any(trajectory.unsafe) | slow


def low_return(
    trajectory: Trajectory, experts: Trajectory | None, hparams: HParams, scale: Scale
) -> jax.Array:
    """The released code's rule: the prediction ends with a negative reward, or returns too little.

    An arrival in the first predicted step (return 10) counts as a failure there, and here.
    """
    del experts, scale
    failed = jnp.any(trajectory.terminated & (trajectory.reward < 0))
    return failed | (jnp.sum(trajectory.reward) <= hparams.min_return)


def deviates_from_expert(
    trajectory: Trajectory, experts: Trajectory | None, hparams: HParams, scale: Scale
) -> jax.Array:
    """The prediction fails, or ends elsewhere than the expert would from here.

        max_i |s_i - s*_i| / scale_i > max_departure

    with s, s* the two last predicted observations. A threshold on the return also fires where
    nobody can earn it yet (on the expert's own way to the ring), and does not fire where standing
    still earns enough (holding it). A prediction that succeeds does not depart.
    """
    if experts is None:
        raise ValueError("gate 'deviates_from_expert' needs the expert's own prediction")
    apart = jnp.max(jnp.abs(trajectory.observation[-1] - experts.observation[-1]) / scale)
    elsewhere = (apart > hparams.max_departure) & ~jnp.any(trajectory.success)
    return jnp.any(trajectory.unsafe) | elsewhere


Gate = Callable[[Any, DecisionPoint, HParams], jax.Array]
"""`decide` of a method (see `ppl_jax.algorithms.base.Algorithm`)."""


def make_gate(name: str, scale: Scale) -> Gate:
    """The gate that a `TrainConfig.gate` names, as the methods that share it use it.

    "action_probability" looks at no prediction: the expert takes over where it gives the novice's action a
    log-density below `min_log_density` (EGPO, Peng et al. 2021; PVP's "free level" 0.95 is a
    density of 0.05).
    """
    if name == "action_probability":
        return action_probability
    rule = RULES[name]

    def decide(state: Any, point: DecisionPoint, hparams: HParams) -> jax.Array:
        del state
        return rule(point.trajectory, point.experts, hparams, scale)

    return decide


def action_probability(state: Any, point: DecisionPoint, hparams: HParams) -> jax.Array:
    """The expert would hardly have done that."""
    del state
    return point.log_density < hparams.min_log_density


def never(state: Any, point: DecisionPoint, hparams: HParams) -> jax.Array:
    """The gate of a method that nobody watches."""
    del state, point, hparams
    return jnp.zeros((), bool)


RULES: dict[str, Rule] = {
    "unsafe_or_slow": unsafe_or_slow,
    "low_return": low_return,
    "deviates_from_expert": deviates_from_expert,
}
COMPARING = ("deviates_from_expert",)
