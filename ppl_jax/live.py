"""The training loop step by step, driven by an external controller: a person or a recording.

Each step is the one that `ppl_jax.training` scans, with the same buffers and updates; only the
takeover is decided outside instead of by a gate.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.interaction import Learner, Steps, make_steps, summarise
from ppl_jax.losses import Metrics
from ppl_jax.predictors import predict, predictor
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
        fit: `fit(learner, updates) -> (Learner, Metrics)`: a static number of the updates that a
            method makes on demonstrations before its first step.
        restart: `restart(learner) -> Learner` at a new start, the episode left unfinished.
        ingest: `ingest(learner, interactions [T], learning=True) -> (Learner, Metrics)`: use
            recorded steps as if they were made now, with an update after each where `learning`.
            With the settings and key of the recorded session, its policy results again.
        algorithm: The method.
    """

    init: Callable[[jax.Array, HParams], Learner]
    predict_path: Callable[[Learner, jax.Array, jax.Array], Trajectory]
    play: Callable[[Learner, jax.Array, jax.Array], tuple[Learner, Interaction]]
    learn: Callable[[Learner], tuple[Learner, Metrics]]
    fit: Callable[[Learner, int], tuple[Learner, Metrics]]
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
    params = env.default_params if env_params is None else env_params
    algorithm = make_algorithm(env.spec, config)
    predicted_transition = predictor(config.predictor).make(env)
    steps = make_steps(env, None, algorithm, config, params=params)

    def predict_path(learner: Learner, action: jax.Array, mine: jax.Array) -> Trajectory:
        key_propose, key_predict = jax.random.split(learner.key)
        observation = env.observe(learner.env_state, params)

        def transition(*args: Any) -> Any:
            return predicted_transition(*args, learner.hparams.predictor)

        proposed = jnp.clip(
            steps.sample_novice_action(learner, key_propose, observation), -1.0, 1.0
        )
        return predict(
            env,
            transition,
            key_predict,
            learner.env_state,
            action=jnp.where(mine, action, proposed),
            params=params,
            horizon=config.prediction_horizon,
            place=place,
        )

    def play(
        learner: Learner, takeover: jax.Array, action: jax.Array
    ) -> tuple[Learner, Interaction]:
        started = takeover & ~learner.takeover
        learner = dataclasses.replace(learner, takeover=takeover)
        return steps.interact(learner, started, jnp.clip(action, -1.0, 1.0))

    functions = _learning(env, steps, algorithm, params)
    return LiveFunctions(
        init=steps.init, predict_path=predict_path, play=play, algorithm=algorithm, **functions
    )


def _learning(
    env: Env, steps: Steps, algorithm: Algorithm, params: PyTree
) -> dict[str, Callable[..., Any]]:
    """The `LiveFunctions` that do not choose an action: learn, fit, restart and ingest."""

    def learn(learner: Learner) -> tuple[Learner, Metrics]:
        return steps.learn(learner, algorithm.update)

    def fit(learner: Learner, updates: int) -> tuple[Learner, Metrics]:
        def step(learner: Learner, _: None) -> tuple[Learner, Metrics]:
            return steps.learn(learner, algorithm.fit or algorithm.update)

        learner, metrics = jax.lax.scan(step, learner, None, length=updates)
        return learner, jax.tree.map(jnp.mean, metrics)

    def restart(learner: Learner) -> Learner:
        key, key_reset = jax.random.split(learner.key)
        _, state = env.reset(key_reset, params)
        return dataclasses.replace(learner, env_state=state, key=key, takeover=jnp.zeros((), bool))

    def ingest(
        learner: Learner, interactions: Interaction, learning: bool = True
    ) -> tuple[Learner, Metrics]:
        before = learner.counters

        def step(learner: Learner, row: Interaction) -> tuple[Learner, Metrics]:
            learner = steps.ingest(learner, row)
            return learn(learner) if learning else (learner, {})

        learner, metrics = jax.lax.scan(step, learner, interactions)
        return learner, summarise(metrics, before, learner.counters)

    return {"learn": learn, "fit": fit, "restart": restart, "ingest": ingest}
