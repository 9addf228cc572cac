"""Takeover rules: would the predicted trajectory fail?

`rule(trajectory, experts, hparams) -> bool`; `experts` is what the expert itself is predicted to do
from here, for rules in `COMPARING`, and None for the others.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ppl_jax.config import HParams
from ppl_jax.types import Trajectory

Rule = Callable[[Trajectory, "Trajectory | None", HParams], jax.Array]


def unsafe_or_slow(
    trajectory: Trajectory, experts: Trajectory | None, hparams: HParams
) -> jax.Array:
    """The paper's driving rule: any predicted crash or leaving the road, or mean speed too low.

    A prediction that ends in success is not slow.
    """
    del experts
    steps = jnp.maximum(jnp.sum(trajectory.valid), 1)
    mean_speed = jnp.sum(trajectory.speed * trajectory.valid) / steps
    slow = (mean_speed < hparams.min_speed) & ~jnp.any(trajectory.success)
    return jnp.any(trajectory.unsafe) | slow


def low_return(trajectory: Trajectory, experts: Trajectory | None, hparams: HParams) -> jax.Array:
    """The released code's rule: the prediction ends with a negative reward, or returns too little.

    An arrival in the first predicted step (return 10) counts as a failure there, and here.
    """
    del experts
    failed = jnp.any(trajectory.terminated & (trajectory.reward < 0))
    return failed | (jnp.sum(trajectory.reward) <= hparams.min_return)


def falls_short(trajectory: Trajectory, experts: Trajectory | None, hparams: HParams) -> jax.Array:
    """The prediction fails, or returns less than a share of what the expert would from here.

    A threshold on the return alone also fires where nobody can earn it yet: on the expert's own
    way to the dirt or to the ring. A prediction that succeeds never falls short.
    """
    if experts is None:
        raise ValueError("gate 'falls_short' needs the expert's own prediction")
    failed = jnp.any(trajectory.unsafe)
    needed = hparams.min_share * jnp.sum(experts.reward)
    return failed | ((jnp.sum(trajectory.reward) < needed) & ~jnp.any(trajectory.success))


RULES: dict[str, Rule] = {
    "unsafe_or_slow": unsafe_or_slow,
    "low_return": low_return,
    "falls_short": falls_short,
}
COMPARING = ("falls_short",)
