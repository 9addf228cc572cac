"""The training loop step by step, driven by an external controller: a person or a recording.

Each step is the one that `ppl_jax.training` scans, with the same buffers and updates; only the
takeover is decided outside instead of by a gate.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.interaction import (
    Learner,
    Problem,
    ahead_key,
    ingest,
    init,
    interact,
    learn,
    make_problem,
    params_of,
    propose,
    repeat,
    summarise,
    transition_of,
)
from ppl_jax.losses import Metrics
from ppl_jax.predictors import predict
from ppl_jax.types import Env, Interaction, Trajectory

PyTree = Any


class LiveFunctions(NamedTuple):
    """The functions that `make_live` builds; all pure and jittable.

    Attributes:
        init: `init(key, hparams) -> Learner`.
        predict_path: `predict_path(learner, action, mine) -> Trajectory` [H], with positions if
            `place` was given: `action` [A] held where `mine`, else the novice's action held.
        play: `play(learner, takeover, action) -> (Learner, Interaction)`: one step, with `action`
            [A] where `takeover`, else with the novice's.
        learn: `learn(learner) -> (Learner, Metrics)`: one update.
        fit: `fit(learner, updates) -> (Learner, Metrics)`: so many of the updates that a method
            makes on demonstrations before its first step.
        restart: `restart(learner) -> Learner` at a new start, the episode left unfinished.
        ingest: `ingest(learner, interactions [T], learning=True, first=0, count=None) -> (Learner,
            Metrics)`: use recorded steps, all from the first or `count` of them, as if they were
            made now, with an update after each where `learning`. With the settings and key of the
            recorded session, its policy results again. With `ask_novice` the novice's actions in
            steps of the expert are those of the learner; with `states` [T] the predictions are made
            from these.
        algorithm: The method.
    """

    init: Callable[[jax.Array, HParams], Learner]
    predict_path: Callable[[Learner, jax.Array, jax.Array], Trajectory]
    play: Callable[[Learner, jax.Array, jax.Array], tuple[Learner, Interaction]]
    learn: Callable[[Learner], tuple[Learner, Metrics]]
    fit: Callable[[Learner, int | jax.Array], tuple[Learner, Metrics]]
    restart: Callable[[Learner], Learner]
    ingest: Callable[..., tuple[Learner, Metrics]]
    algorithm: Algorithm


def make_live(
    env: Env,
    make_algorithm: MakeAlgorithm,
    config: TrainConfig,
    *,
    place: Callable[[PyTree], jax.Array] | None = None,
    env_params: PyTree | None = None,
) -> LiveFunctions:
    """Build the functions that train one policy with an external controller.

    Args:
        env: The environment.
        make_algorithm: `ppl_jax.algorithms.method(name).make`, or one of your own.
        config: Static settings; check them with `ppl_jax.config.validate` first.
        place: `place(state) -> position [P]`, for predicted paths.
        env_params: The environment's parameters; its training ones where None.

    Raises:
        ValueError: If the environment lacks the predictor that `config` names.
    """
    algorithm = make_algorithm(env.spec, config)
    problem = make_problem(env, None, algorithm, config, params=env_params)
    return LiveFunctions(
        init=functools.partial(init, problem),
        predict_path=functools.partial(predict_path, problem, place),
        play=functools.partial(play, problem),
        learn=lambda learner: learn(learner, algorithm.update),
        fit=functools.partial(fit, problem),
        restart=functools.partial(restart, problem),
        ingest=functools.partial(ingest_all, problem),
        algorithm=algorithm,
    )


def predict_path(
    problem: Problem,
    place: Callable[[PyTree], jax.Array] | None,
    learner: Learner,
    action: jax.Array,
    mine: jax.Array,
) -> Trajectory:
    """See `LiveFunctions`."""
    params = params_of(problem, learner.hparams)
    observation = problem.env.observe(learner.env_state, params)
    novice_action = propose(problem, learner, observation)
    return predict(
        problem.env,
        transition_of(problem, learner.hparams.predictor),
        ahead_key(learner),
        learner.env_state,
        action=jnp.where(mine, action, jnp.clip(novice_action, -1.0, 1.0)),
        params=params,
        horizon=problem.config.prediction_horizon,
        place=place,
    )


def play(
    problem: Problem, learner: Learner, takeover: jax.Array, action: jax.Array
) -> tuple[Learner, Interaction]:
    """See `LiveFunctions`."""
    started = takeover & ~learner.takeover
    learner = dataclasses.replace(learner, takeover=takeover)
    return interact(problem, learner, started, jnp.clip(action, -1.0, 1.0))


def fit(problem: Problem, learner: Learner, updates: int | jax.Array) -> tuple[Learner, Metrics]:
    """See `LiveFunctions`."""
    update = problem.algorithm.fit or problem.algorithm.update
    return repeat(lambda learner: learn(learner, update), learner, updates)


def restart(problem: Problem, learner: Learner) -> Learner:
    """See `LiveFunctions`."""
    key, key_reset = jax.random.split(learner.key)
    _, state = problem.env.reset(key_reset, params_of(problem, learner.hparams))
    return dataclasses.replace(
        learner,
        env_state=state,
        key=key,
        takeover=jnp.zeros((), bool),
        costly=jnp.zeros_like(learner.costly),
    )


def ingest_all(
    problem: Problem,
    learner: Learner,
    interactions: Interaction,
    learning: bool = True,
    *,
    first: int | jax.Array = 0,
    count: int | jax.Array | None = None,
    ask_novice: bool = False,
    states: PyTree | None = None,
) -> tuple[Learner, Metrics]:
    """See `LiveFunctions.ingest`."""
    before = learner.counters

    def step(learner: Learner) -> tuple[Learner, Metrics]:
        at = first + learner.counters.steps - before.steps
        row, state = jax.tree.map(lambda column: column[at], (interactions, states))
        learner = ingest(problem, learner, row, ask_novice=ask_novice, state=state)
        return learn(learner, problem.algorithm.update) if learning else (learner, {})

    if count is None:
        count = interactions.reward.shape[0] - first
    learner, metrics = repeat(step, learner, count)
    return learner, summarise(metrics, before, learner.counters)
