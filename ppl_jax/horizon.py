"""What a preference horizon L buys and costs, measured: the theorem's two errors on real worlds.

The theorem (`ppl_jax.bounds`) balances delta_dist, how far the states with preferences are from
those that the novice visits, against delta_pref, how far the stored pairs are from the ones the
expert would give there. On continuous worlds both distances are 1 almost surely; what can be
measured at the i-th predicted state s~_i of an intervention at s is

    wrong_i = [ |h(s~_i) - a_h| >= |h(s~_i) - a_n| ]   asked there, it sides with the novice
    drift_i = |h(s~_i) - a_h|                          how far its answer has moved
    reach_i = |s~_i - s|, in the world's units         how far the prediction has come from s

`preference_horizon="auto"` keeps moving means of wrong and reach while it trains and takes the L
that minimises the sum of both errors, each as a share of its worst:

    gap(L) + error(L),  gap(L) = 1 - reach_L / reach_M,  error(L) = 2 mean_{i <= L} wrong_i

(labels that are wrong half the time teach nothing: error 1; M is the longest horizon allowed).
"""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

MEMORY = 500  # predicted trajectories that the moving means look back


class Measured(NamedTuple):
    """Of the predicted steps of one intervention, [..., M]; see the module's text.

    Attributes:
        wrong: 0 or 1.
        drift: In units of the action.
        reach: In units of the world's observation scale.
    """

    wrong: jax.Array
    drift: jax.Array
    reach: jax.Array


def measure(
    observation: jax.Array,
    predicted: jax.Array,
    advice: jax.Array,
    expert_action: jax.Array,
    novice_action: jax.Array,
    scale: jax.Array,
) -> Measured:
    """Measure one intervention's predicted states.

    Args:
        observation: [O] where the expert took over.
        predicted: [M, O] predicted observations.
        advice: [M, A] the expert's action at each.
        expert_action, novice_action: [A] a_h and a_n, both from `observation`.
        scale: [O] units of the observation.
    """
    drift = jnp.linalg.norm(advice - expert_action, axis=-1)
    other = jnp.linalg.norm(advice - novice_action, axis=-1)
    reach = jnp.linalg.norm((predicted - observation) / scale, axis=-1)
    return Measured((drift >= other).astype(jnp.float32), drift, reach)


def coverage(
    visited: jax.Array, predicted: jax.Array, valid: jax.Array, scale: jax.Array
) -> jax.Array:
    """Mean distance from visited states to the nearest state with a preference, for L = 1..M, [M].

    Args:
        visited: [N, O] of the novice's own episodes.
        predicted: [K, M, O] of K interventions.
        valid: [K, M] the prediction had not ended.
        scale: [O] units of the observation.
    """

    def nearest(state: jax.Array) -> jax.Array:
        away = jnp.linalg.norm((predicted - state) / scale, axis=-1)
        closest = jnp.min(jnp.where(valid, away, jnp.inf), 0)  # by step, [M]
        return jax.lax.cummin(closest)

    return jnp.mean(jax.lax.map(nearest, visited), 0)


@flax.struct.dataclass
class Horizon:
    """Moving means over interventions, [M].

    Attributes:
        count: Predicted steps seen, by step.
        wrong, reach: As in `Measured`.
    """

    count: jax.Array
    wrong: jax.Array
    reach: jax.Array


def init_horizon(steps: int) -> Horizon:
    """Nothing seen yet."""
    return Horizon(jnp.zeros(steps), jnp.zeros(steps), jnp.zeros(steps))


def add(horizon: Horizon, measured: Measured, valid: jax.Array) -> Horizon:
    """With one intervention's `valid` [M] steps as well.

    A prediction that has ended stays where it is and reaches no further.
    """
    count = horizon.count + valid
    rate = jnp.where(valid, 1.0 / jnp.clip(count, 1.0, MEMORY), 0.0)
    return Horizon(
        count,
        horizon.wrong + rate * (measured.wrong - horizon.wrong),
        horizon.reach + rate[0] * (measured.reach - horizon.reach),
    )


def errors(horizon: Horizon) -> tuple[jax.Array, jax.Array]:
    """gap(L) and error(L) for L = 1..M, [M] each; steps never seen reach as far as the last."""
    reach = jax.lax.cummax(horizon.reach)
    gap = 1.0 - reach / jnp.maximum(reach[-1], 1e-9)
    steps = jnp.arange(1, reach.shape[0] + 1)
    return gap, 2.0 * jnp.cumsum(horizon.wrong) / steps


def choose(horizon: Horizon, most: jax.Array | float) -> jax.Array:
    """The L from 1 to `most` with the least gap(L) + error(L); 1 before anything was seen."""
    gap, error = errors(horizon)
    allowed = jnp.arange(1, gap.shape[0] + 1) <= most
    return 1.0 + jnp.argmin(jnp.where(allowed, gap + error, jnp.inf))
