"""The gain and the cost of a preference horizon L: the theorem's two errors, measured.

The theorem (`ppl_jax.bounds`) balances delta_dist, how far the states with preferences are from
those that the novice visits, against delta_pref, how far the stored pairs are from the ones the
expert would give there. In continuous environments both distances are 1 almost surely. These can be
measured, at the i-th predicted state s~_i of an intervention at s:

    wrong_i = [ |h(s~_i) - a_h| >= |h(s~_i) - a_n| ]   asked there, it sides with the novice
    drift_i = |h(s~_i) - a_h|                          how far its answer has moved
    reach_i = |s~_i - s|, in the env's units           how far the prediction has come from s

`preference_horizon="auto"` keeps moving means of drift, reach and |a_h - a_n| while it trains and
takes the L that balances both errors, each as a share of its worst:

    min over L of max(gap(L), error(L)),   gap(L)   = 1 - reach_L / reach_M
                                           error(L) = drift_L / |a_h - a_n|

M is the longest horizon allowed. An error of 1 is a pair whose preferred action is as far from the
expert's action there as the novice's action was from the expert's to begin with.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.config import HParams, TrainConfig, env_params
from ppl_jax.gates import gate
from ppl_jax.predictors import predict, predictor
from ppl_jax.types import Array, DecisionPoint, Env, Expert

Policy = Callable[[jax.Array], jax.Array]
"""`policy(observation [O]) -> action [A]`."""

MEMORY = 500  # predicted trajectories that the moving means look back


class Measured(NamedTuple):
    """Measurements at the predicted steps of one intervention, [..., M]; see the top of this file.

    Attributes:
        wrong: 0 or 1.
        drift: In units of the action.
        reach: In units of the environment's observation scale.
        apart: |a_h - a_n|, [...].
    """

    wrong: jax.Array
    drift: jax.Array
    reach: jax.Array
    apart: jax.Array


def measure(
    observation: Array,
    predicted: Array,
    expert_actions: Array,
    *,
    expert_action: Array,
    novice_action: Array,
    scale: Array,
) -> Measured:
    """Measure one intervention's predicted states.

    Args:
        observation: [O] where the expert took over.
        predicted: [M, O] predicted observations.
        expert_actions: [M, A] the expert's action at each.
        expert_action, novice_action: [A] a_h and a_n, both from `observation`.
        scale: [O] units of the observation.

    Raises:
        AssertionError: If shapes do not fit.
    """
    steps = predicted.shape[0]
    chex.assert_shape(predicted, (steps, *observation.shape))
    chex.assert_equal_shape([expert_action, novice_action])
    chex.assert_shape(expert_actions, (steps, *expert_action.shape))
    chex.assert_shape(scale, observation.shape)
    drift = jnp.linalg.norm(expert_actions - expert_action, axis=-1)
    other = jnp.linalg.norm(expert_actions - novice_action, axis=-1)
    reach = jnp.linalg.norm((predicted - observation) / scale, axis=-1)
    apart = jnp.linalg.norm(expert_action - novice_action)
    return Measured(
        wrong=(drift >= other).astype(jnp.float32), drift=drift, reach=reach, apart=apart
    )


def coverage(visited: Array, predicted: Array, valid: Array, scale: Array) -> jax.Array:
    """Mean distance from visited states to the nearest state with a preference, for L = 1..M, [M].

    Args:
        visited: [N, O] of the novice's own episodes.
        predicted: [K, M, O] of K interventions.
        valid: [K, M] the prediction had not ended.
        scale: [O] units of the observation.

    Raises:
        AssertionError: If shapes do not fit.
    """
    chex.assert_shape(predicted, (*valid.shape, visited.shape[-1]))
    chex.assert_rank([visited, valid], 2)
    chex.assert_shape(scale, visited.shape[1:])

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
    return Horizon(
        count=jnp.zeros(steps, jnp.float32),
        drift=jnp.zeros(steps, jnp.float32),
        reach=jnp.zeros(steps, jnp.float32),
        apart=jnp.zeros((), jnp.float32),
    )


def add(horizon: Horizon, measured: Measured, valid: jax.Array) -> Horizon:
    """Take in one intervention's `valid` [M] steps.

    A prediction that has ended stays where it is and reaches no further.
    """
    chex.assert_equal_shape([horizon.count, measured.drift, measured.reach, valid])
    count = horizon.count + valid.astype(jnp.float32)
    rate = jnp.where(valid, 1.0 / jnp.clip(count, 1.0, MEMORY), 0.0)
    return Horizon(
        count=count,
        drift=horizon.drift + rate * (measured.drift - horizon.drift),
        reach=horizon.reach + rate[0] * (measured.reach - horizon.reach),
        apart=horizon.apart + rate[0] * (measured.apart - horizon.apart),
    )


def errors(
    drift: jax.Array, reach: jax.Array, apart: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """gap(L) and error(L) for L = 1..M, [M] each."""
    chex.assert_equal_shape([drift, reach], custom_message="drift and reach")
    reach = jax.lax.cummax(reach)
    gap = 1.0 - reach / jnp.maximum(reach[-1], 1e-9)
    return gap, drift / jnp.maximum(apart, 1e-9)


def choose(horizon: Horizon, most: jax.Array | float) -> jax.Array:
    """The L from 1 to `most` whose larger error is least; 1 before anything was seen."""
    worse = jnp.maximum(*errors(horizon.drift, horizon.reach, horizon.apart))
    allowed = jnp.arange(1, worse.shape[0] + 1, dtype=jnp.float32) <= most
    return 1.0 + jnp.argmin(jnp.where(allowed, worse, jnp.inf)).astype(jnp.float32)


class Profile(NamedTuple):
    """Measurements of `make_profile`: means over interventions; [M] unless said otherwise.

    Attributes:
        wrong, drift, reach: As in `Measured`.
        apart: The same, scalar.
        coverage: See `coverage`.
        interventions: Their number, scalar.
    """

    wrong: jax.Array
    drift: jax.Array
    reach: jax.Array
    apart: jax.Array
    coverage: jax.Array
    interventions: jax.Array


class Watched(NamedTuple):
    """One step of a watched novice; leading axes in front.

    Attributes:
        observation: [O].
        predicted: [M, O] observations predicted for its action held.
        measured: At these predicted states.
        valid: [M] the gate would have handed over here, and the prediction had not ended.
    """

    observation: jax.Array
    predicted: jax.Array
    measured: Measured
    valid: jax.Array


def watch(
    env: Env,
    expert: Expert,
    config: TrainConfig,
    *,
    key: jax.Array,
    act: Policy,
    hparams: HParams,
    steps: int,
) -> Watched:
    """Let the novice alone play one environment for `steps` steps, [steps, ...].

    At every step its action is predicted `config.method.max_preference_horizon` steps ahead and the
    expert asked at every predicted state.

    Args:
        env: The environment; its training scenarios are played.
        expert: Asked; it never acts.
        config: Gate, predictor and horizons.
        key: Random key.
        act: The novice.
        hparams: Settings of gate and predictor.
        steps: Static.
    """
    predicted_transition = predictor(config.predictor).make(env)
    decide = gate(config.gate).decide
    params = env_params(env, env.default_params, hparams)
    scale = jnp.asarray(env.spec.observation_scale, jnp.float32)
    most = config.method.max_preference_horizon

    def transition(*args: Any) -> Any:
        return predicted_transition(*args, hparams=hparams.predictor)

    def step(carry: Any, _: None) -> tuple[Any, Watched]:
        key, observation, state = carry
        key, key_expert, key_ahead, key_step = jax.random.split(key, 4)
        novice, wanted = act(observation), expert(key_expert, state, observation, params)
        held = jnp.clip(novice, -1.0, 1.0)
        found = predict(
            env,
            transition,
            key_ahead,
            state,
            action=held,
            params=params,
            horizon=max(config.prediction_horizon, most),
            observe=True,
            labelling_expert=expert,
        )
        point = DecisionPoint(
            observation=observation,
            novice_action=held,
            expert_action=wanted,
            takeover=jnp.zeros((), bool),
            trajectory=jax.tree.map(lambda leaf: leaf[: config.prediction_horizon], found),
            experts=None,
            log_density=jnp.asarray(jnp.nan),
        )
        takeover = decide(point, hparams.gate, scale)
        assert found.expert_actions is not None  # a labelling expert was there
        measured = measure(
            observation,
            found.observation[:most],
            found.expert_actions[:most],
            expert_action=wanted,
            novice_action=novice,
            scale=scale,
        )
        seen = Watched(
            observation=observation,
            predicted=found.observation[:most],
            measured=measured,
            valid=takeover & found.valid[:most],
        )
        after = env.step(key_step, state, held, params)
        return (key, *after[:2]), seen

    key, key_reset = jax.random.split(key)
    start = (key, *env.reset(key_reset, params))
    return jax.lax.scan(step, start, None, length=steps)[1]


def summarise(
    seen: Watched,
    keys: tuple[jax.Array, jax.Array],
    scale: jax.Array,
    *,
    visited: int,
    kept: int,
) -> Profile:
    """Means over the interventions among N steps.

    Args:
        seen: [N, ...].
        keys: They draw the states and the interventions of `coverage`.
        scale: [O] units of the observation.
        visited, kept: How many of them.
    """
    key_visited, key_kept = keys
    measured, valid = seen.measured, seen.valid
    begun = valid[:, :1]

    def mean(values: jax.Array, of: jax.Array) -> jax.Array:
        count = jnp.sum(of, 0, dtype=jnp.float32)
        return jnp.sum(jnp.where(of, values, 0.0), 0) / jnp.maximum(count, 1.0)

    # a fixed number of interventions, drawn among those that there are
    share = begun[:, 0].astype(jnp.float32)
    total = jnp.sum(share)
    some = jnp.where(total > 0, share / jnp.maximum(total, 1.0), 1.0 / share.shape[0])
    chosen = jax.random.choice(key_kept, share.shape[0], (kept,), p=some)
    at = jax.random.randint(key_visited, (visited,), 0, share.shape[0], jnp.int32)
    return Profile(
        wrong=mean(measured.wrong, valid),
        drift=mean(measured.drift, valid),
        reach=mean(measured.reach, begun),
        apart=mean(measured.apart, begun[:, 0]),
        coverage=coverage(seen.observation[at], seen.predicted[chosen], valid[chosen], scale),
        interventions=jnp.maximum(jnp.sum(valid, 0, dtype=jnp.int32), 1)[0],
    )


def make_profile(
    env: Env,
    expert: Expert,
    config: TrainConfig,
    *,
    num_envs: int = 8,
    steps: int = 500,
    visited: int = 500,
    kept: int = 500,
) -> Callable[[jax.Array, Policy, HParams], Profile]:
    """`profile(key, act, hparams)`: the worth of preferences at predicted states now.

    The novice alone plays training scenarios. Where the gate would hand over, its action is
    predicted `config.method.max_preference_horizon` steps ahead and the expert asked at every one.

    Args:
        env: The environment.
        expert: Asked; it never acts.
        config: Gate, predictor and horizons.
        num_envs, steps: Played side by side, and for how long.
        visited, kept: States and interventions that `coverage` is computed from.

    Raises:
        ValueError: If the gate is one that compares with the expert's own prediction.
    """
    rule = gate(config.gate)
    if rule.needs_expert_rollout or rule.needs_density:
        raise ValueError(f"gate must judge a prediction by itself, got {config.gate!r}")
    predictor(config.predictor).make(env)  # refused now rather than where `profile` is called
    scale = jnp.asarray(env.spec.observation_scale, jnp.float32)

    def profile(key: jax.Array, act: Policy, hparams: HParams) -> Profile:
        key, key_visited, key_kept = jax.random.split(key, 3)
        lane = functools.partial(watch, env, expert, config, act=act, hparams=hparams, steps=steps)
        rows = jax.vmap(lambda key: lane(key=key))(jax.random.split(key, num_envs))
        seen = jax.tree.map(lambda leaf: leaf.reshape(num_envs * steps, *leaf.shape[2:]), rows)
        return summarise(seen, (key_visited, key_kept), scale, visited=visited, kept=kept)

    return profile
