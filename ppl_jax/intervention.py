"""Takeover rules: would the predicted trajectory fail? `rule(trajectory, hparams) -> bool`."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ppl_jax.config import HParams
from ppl_jax.types import Trajectory

Rule = Callable[[Trajectory, HParams], jax.Array]


def unsafe_or_slow(trajectory: Trajectory, hparams: HParams) -> jax.Array:
    """The paper's driving rule: any predicted crash or leaving the road, or mean speed too low.

    A prediction that ends in success is not slow.
    """
    steps = jnp.maximum(jnp.sum(trajectory.valid), 1)
    mean_speed = jnp.sum(trajectory.speed * trajectory.valid) / steps
    slow = (mean_speed < hparams.min_speed) & ~jnp.any(trajectory.success)
    return jnp.any(trajectory.unsafe) | slow


def low_return(trajectory: Trajectory, hparams: HParams) -> jax.Array:
    """The released code's rule: the prediction ends with a negative reward, or returns too little.

    An arrival in the first predicted step (return 10) counts as a failure there, and here.
    """
    failed = jnp.any(trajectory.terminated & (trajectory.reward < 0))
    return failed | (jnp.sum(trajectory.reward) <= hparams.min_return)


RULES: dict[str, Rule] = {"unsafe_or_slow": unsafe_or_slow, "low_return": low_return}
