"""What a preference horizon L buys and costs, measured: the theorem's two errors on real worlds.

The theorem (`ppl_jax.bounds`) balances delta_dist, how far the states with preferences are from
those that the novice visits, against delta_pref, how far the stored pairs are from the ones the
expert would give there. On continuous worlds both distances are 1 almost surely; what can be
measured at the i-th predicted state s~_i of an intervention at s is

    wrong_i = [ |h(s~_i) - a_h| >= |h(s~_i) - a_n| ]   asked there, it sides with the novice
    drift_i = |h(s~_i) - a_h|                          how far its answer has moved
    reach_i = |s~_i - s|, in the world's units         how far the prediction has come from s

`preference_horizon="auto"` keeps moving means of drift, reach and |a_h - a_n| while it trains and
takes the L that balances both errors, each as a share of its worst:

    min over L of max(gap(L), error(L)),   gap(L)   = 1 - reach_L / reach_M
                                           error(L) = drift_L / |a_h - a_n|

M is the longest horizon allowed. An error of 1 is a pair whose preferred action is as far from what
the expert would do there as the novice's action was from the expert's to begin with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.config import HParams, TrainConfig
from ppl_jax.gates import gate
from ppl_jax.predictors import Act, predict, predictor
from ppl_jax.types import DecisionPoint, Env, Expert

MEMORY = 500  # predicted trajectories that the moving means look back


class Measured(NamedTuple):
    """Of the predicted steps of one intervention, [..., M]; see the module's text.

    Attributes:
        wrong: 0 or 1.
        drift: In units of the action.
        reach: In units of the world's observation scale.
        apart: |a_h - a_n|, [...].
    """

    wrong: jax.Array
    drift: jax.Array
    reach: jax.Array
    apart: jax.Array


def measure(
    observation: jax.Array,
    predicted: jax.Array,
    expert_actions: jax.Array,
    expert_action: jax.Array,
    novice_action: jax.Array,
    scale: jax.Array,
) -> Measured:
    """Measure one intervention's predicted states.

    Args:
        observation: [O] where the expert took over.
        predicted: [M, O] predicted observations.
        expert_actions: [M, A] the expert's action at each.
        expert_action, novice_action: [A] a_h and a_n, both from `observation`.
        scale: [O] units of the observation.
    """
    drift = jnp.linalg.norm(expert_actions - expert_action, axis=-1)
    other = jnp.linalg.norm(expert_actions - novice_action, axis=-1)
    reach = jnp.linalg.norm((predicted - observation) / scale, axis=-1)
    apart = jnp.linalg.norm(expert_action - novice_action)
    return Measured((drift >= other).astype(jnp.float32), drift, reach, apart)


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
        drift, reach: As in `Measured`.
        apart: The same, scalar.
    """

    count: jax.Array
    drift: jax.Array
    reach: jax.Array
    apart: jax.Array


def init_horizon(steps: int) -> Horizon:
    """Nothing seen yet."""
    return Horizon(jnp.zeros(steps), jnp.zeros(steps), jnp.zeros(steps), jnp.zeros(()))


def add(horizon: Horizon, measured: Measured, valid: jax.Array) -> Horizon:
    """With one intervention's `valid` [M] steps as well.

    A prediction that has ended stays where it is and reaches no further.
    """
    count = horizon.count + valid
    rate = jnp.where(valid, 1.0 / jnp.clip(count, 1.0, MEMORY), 0.0)
    return Horizon(
        count,
        horizon.drift + rate * (measured.drift - horizon.drift),
        horizon.reach + rate[0] * (measured.reach - horizon.reach),
        horizon.apart + rate[0] * (measured.apart - horizon.apart),
    )


def errors(
    drift: jax.Array, reach: jax.Array, apart: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """gap(L) and error(L) for L = 1..M, [M] each."""
    reach = jax.lax.cummax(reach)
    gap = 1.0 - reach / jnp.maximum(reach[-1], 1e-9)
    return gap, drift / jnp.maximum(apart, 1e-9)


def choose(horizon: Horizon, most: jax.Array | float) -> jax.Array:
    """The L from 1 to `most` whose larger error is least; 1 before anything was seen."""
    worse = jnp.maximum(*errors(horizon.drift, horizon.reach, horizon.apart))
    allowed = jnp.arange(1, worse.shape[0] + 1) <= most
    return 1.0 + jnp.argmin(jnp.where(allowed, worse, jnp.inf))


class Profile(NamedTuple):
    """What `make_profile` measures, means over interventions; [M] unless said otherwise.

    Attributes:
        wrong, drift, reach: As in `Measured`.
        apart: The same, scalar.
        coverage: See `coverage`.
        interventions: How many there were, scalar.
    """

    wrong: jax.Array
    drift: jax.Array
    reach: jax.Array
    apart: jax.Array
    coverage: jax.Array
    interventions: jax.Array


def make_profile(
    env: Env,
    expert: Expert,
    config: TrainConfig,
    worlds: int = 8,
    steps: int = 500,
    visited: int = 500,
    kept: int = 500,
) -> Callable[[jax.Array, Act, HParams], Profile]:
    """`profile(key, act, hparams)`: what preferences at predicted states would be worth now.

    The novice alone plays training scenarios. Where the gate would hand over, its action is
    predicted `config.method.max_preference_horizon` steps ahead and the expert asked at every one.

    Args:
        env: The world.
        expert: Asked; it never acts.
        config: Gate, predictor and horizons.
        worlds, steps: Played side by side, and for how long.
        visited, kept: States and interventions that `coverage` is computed from.

    Raises:
        ValueError: If the gate is one that compares with the expert's own prediction.
    """
    rule = gate(config.gate)
    if rule.needs_expert_rollout or rule.needs_density:
        raise ValueError(f"gate must judge a prediction by itself, got {config.gate!r}")
    predicted_transition = predictor(config.predictor).make(env)
    params, scale = env.default_params, jnp.asarray(env.spec.observation_scale)
    ahead = max(config.prediction_horizon, config.method.max_preference_horizon)
    most = config.method.max_preference_horizon

    def profile(key: jax.Array, act: Act, hparams: HParams) -> Profile:
        def transition(*args: Any) -> Any:
            return predicted_transition(*args, hparams.predictor)

        def step(carry: Any, _: None) -> Any:
            key, observation, state = carry
            key, key_expert, key_ahead, key_step = jax.random.split(key, 4)
            novice, wanted = act(observation), expert(key_expert, state, observation, params)
            held = jnp.clip(novice, -1.0, 1.0)
            found = predict(
                env,
                transition,
                key_ahead,
                state,
                held,
                params,
                ahead,
                observe=True,
                labelling_expert=expert,
            )
            judged = jax.tree.map(lambda leaf: leaf[: config.prediction_horizon], found)
            point = DecisionPoint(
                observation=observation,
                novice_action=held,
                expert_action=wanted,
                takeover=jnp.zeros((), bool),
                trajectory=judged,
                experts=None,
                log_density=jnp.asarray(jnp.nan),
            )
            takeover = rule.decide(point, hparams.gate, scale)
            assert found.expert_actions is not None  # an labelling_expert was there
            states, expert_actions, valid = (
                leaf[:most] for leaf in (found.observation, found.expert_actions, found.valid)
            )
            measured = measure(observation, states, expert_actions, wanted, novice, scale)
            after = env.step(key_step, state, held, params)
            row = (observation, states, measured, takeover & valid)
            return (key, *after[:2]), row

        def lane(key: jax.Array) -> Any:
            key, key_reset = jax.random.split(key)
            start = (key, *env.reset(key_reset, params))
            return jax.lax.scan(step, start, None, length=steps)[1]

        key, key_visited, key_kept = jax.random.split(key, 3)
        rows = jax.vmap(lane)(jax.random.split(key, worlds))
        seen, states, measured, valid = jax.tree.map(
            lambda leaf: jnp.reshape(leaf, (worlds * steps, *leaf.shape[2:])), rows
        )
        count = jnp.maximum(jnp.sum(valid, 0), 1)
        begun = valid[:, :1]

        def mean(values: jax.Array, of: jax.Array) -> jax.Array:
            return jnp.sum(jnp.where(of, values, 0.0), 0) / jnp.maximum(jnp.sum(of, 0), 1)

        # a fixed number of interventions, drawn among those that there are
        share = begun[:, 0] / jnp.maximum(jnp.sum(begun), 1)
        some = jnp.where(jnp.sum(begun) > 0, share, 1.0 / share.shape[0])
        chosen = jax.random.choice(key_kept, share.shape[0], (kept,), p=some)
        at = jax.random.randint(key_visited, (visited,), 0, seen.shape[0])
        return Profile(
            wrong=mean(measured.wrong, valid),
            drift=mean(measured.drift, valid),
            reach=mean(measured.reach, begun),
            apart=mean(measured.apart, begun[:, 0]),
            coverage=coverage(seen[at], states[chosen], valid[chosen], scale),
            interventions=count[0],
        )

    return profile
