"""The training loop of every method: Algorithm 1 of the paper as pure functions.

At steps 0, K, 2K, ... the novice proposes an action, the predictor rolls it H steps ahead, and the
decision whether the expert takes over holds for K steps. Each step is executed, stored and followed
by one update. Everything is one scan over blocks of K steps; the host acts between chunks of them.

A run has up to three phases: in `demonstrate` the expert makes every step and nothing is updated,
in `fit` there are updates and no steps, `interact` is the above. Most methods have only the last.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.gates import gate, shared_gate
from ppl_jax.interaction import Learner, make_steps, summarise
from ppl_jax.losses import Metrics
from ppl_jax.predictors import predict, predictor
from ppl_jax.types import DecisionPoint, Env, Expert

PyTree = Any
Phase = Literal["demonstrate", "fit", "interact"]


class TrainFunctions(NamedTuple):
    """Functions that `make_train` returns; all pure, jittable and vmappable.

    Attributes:
        init: `init(key, hparams) -> Learner`.
        run_chunk: `run_chunk(learner, blocks, phase="interact") -> (Learner, Metrics)` for a static
            number of blocks of `decision_interval` steps (or updates, in phase "fit"); metrics
            are means over the chunk.
        train: `train(key, hparams) -> (Learner, Metrics)`: the whole run, metrics per tenth of its
            last phase, [10].
        algorithm: The method.
    """

    init: Callable[[jax.Array, HParams], Learner]
    run_chunk: Callable[..., tuple[Learner, Metrics]]
    train: Callable[[jax.Array, HParams], tuple[Learner, Metrics]]
    algorithm: Algorithm


def phases(config: TrainConfig) -> list[tuple[Phase, int]]:
    """The phases of a run and how many steps (updates, in "fit") each has; none are empty."""
    all_phases: list[tuple[Phase, int]] = [
        ("demonstrate", config.demonstrations),
        ("fit", config.offline_updates),
        ("interact", config.total_steps - config.demonstrations),
    ]
    return [(phase, length) for phase, length in all_phases if length]


def make_train(
    env: Env,
    expert: Expert,
    make_algorithm: MakeAlgorithm,
    config: TrainConfig,
    *,
    env_params: PyTree | None = None,
) -> TrainFunctions:
    """Build the functions that train one policy.

    `jax.vmap(train)(keys, hparams)` trains a batch: over seeds, L, beta, noise, in one program.

    Args:
        env: The environment.
        expert: Acts during takeovers.
        make_algorithm: `ppl_jax.algorithms.method(name).make`, or one's own.
        config: Static settings; check them with `ppl_jax.config.validate` first.
        env_params: The environment's parameters; its training ones where None.

    Raises:
        ValueError: If the environment lacks the predictor that `config` names, the expert the
            density that its gate needs, or the run's length does not fit the method's rounds.
    """
    params = env.default_params if env_params is None else env_params
    algorithm = make_algorithm(env.spec, config)
    predicted_transition = predictor(config.predictor).make(env)
    decide_takeover = algorithm.decide or shared_gate(config.gate, env.spec.observation_scale)
    compares = algorithm.needs_expert_rollout or (
        algorithm.decide is None and gate(config.gate).needs_expert_rollout
    )
    init, sample_novice_action, query_expert, interact, _, learn = make_steps(
        env, expert, algorithm, config, params=params
    )
    interval = config.decision_interval
    check_rounds(algorithm, config)
    density = getattr(expert, "log_density", None)
    if density is None:
        if algorithm.decide is None and gate(config.gate).needs_density:
            raise ValueError(
                f"gate {config.gate!r} needs an expert with a density, such as a neural one: "
                "give one, or another gate"
            )
        density = lambda observation, action: jnp.nan  # noqa: E731

    def decide(learner: Learner, key: jax.Array) -> jax.Array:
        """Whether the expert takes the next block."""
        key_propose, key_predict, key_expert, key_act = jax.random.split(key, 4)
        observation = env.observe(learner.env_state, params)
        action = sample_novice_action(learner, key_propose, observation)

        def transition(*args: Any) -> Any:
            return predicted_transition(*args, learner.hparams.predictor)

        roll = functools.partial(
            predict,
            env,
            transition,
            key_predict,
            learner.env_state,
            action=action,
            params=params,
            horizon=config.prediction_horizon,
            observe=compares,
        )
        asked_again = config.gate_rollout == "closed_loop" or compares
        act = functools.partial(algorithm.act, learner.algorithm, key_act)
        point = DecisionPoint(
            observation=observation,
            novice_action=action,
            expert_action=query_expert(learner, key_expert, observation),
            takeover=learner.takeover,
            trajectory=roll(act=act if asked_again else None),
            experts=roll(expert=expert) if compares else None,
            log_density=jnp.asarray(density(observation, jnp.clip(action, -1.0, 1.0))),
        )
        return decide_takeover(learner.algorithm, point, learner.hparams)

    def step(learner: Learner, started: jax.Array) -> tuple[Learner, Metrics]:
        learner, _ = interact(learner, started)
        if algorithm.update_every > 1:
            return learner, {}
        return learn(learner, algorithm.update)

    def block(learner: Learner, _: None) -> tuple[Learner, Metrics]:
        key, key_decide = jax.random.split(learner.key)
        was_expert = learner.takeover
        takeover = decide(learner, key_decide)
        learner = dataclasses.replace(learner, takeover=takeover, key=key)
        first = jnp.arange(interval) == 0
        learner, metrics = jax.lax.scan(step, learner, first & ~was_expert)
        return learner, jax.tree.map(jnp.mean, metrics)

    def round_of_blocks(learner: Learner, _: None) -> tuple[Learner, Metrics]:
        learner = jax.lax.scan(block, learner, None, length=algorithm.update_every // interval)[0]
        return learn(learner, algorithm.update)

    def demonstrated_step(learner: Learner, _: None) -> tuple[Learner, None]:
        started = ~learner.takeover  # at the start of an episode
        learner = dataclasses.replace(learner, takeover=jnp.ones((), bool))
        return interact(learner, started)[0], None

    def fitted(learner: Learner, _: None) -> tuple[Learner, Metrics]:
        return learn(learner, algorithm.fit or algorithm.update)

    def run_chunk(
        learner: Learner, blocks: int, phase: Phase = "interact"
    ) -> tuple[Learner, Metrics]:
        metrics: Metrics
        before, length = learner.counters, blocks * interval
        if phase == "demonstrate":
            learner, _ = jax.lax.scan(demonstrated_step, learner, None, length=length)
            metrics = {}
        elif phase == "fit":
            learner, metrics = jax.lax.scan(fitted, learner, None, length=length)
        elif algorithm.update_every > 1:
            rounds = length // algorithm.update_every
            learner, metrics = jax.lax.scan(round_of_blocks, learner, None, length=rounds)
        else:
            learner, metrics = jax.lax.scan(block, learner, None, length=blocks)
        return learner, summarise(metrics, before, learner.counters)

    def train(key: jax.Array, hparams: HParams) -> tuple[Learner, Metrics]:
        learner = init(key, hparams)
        *first, (last, length) = phases(config)
        for phase, count in first:
            learner, _ = run_chunk(learner, count // interval, phase)
        unit = algorithm.update_every if last == "interact" else 1
        units = length // max(unit, interval)
        parts = max(n for n in range(1, 11) if units % n == 0)

        def part(learner: Learner, _: None) -> tuple[Learner, Metrics]:
            return run_chunk(learner, length // parts // interval, last)

        return jax.lax.scan(part, learner, None, length=parts)

    return TrainFunctions(init, run_chunk, train, algorithm)


def check_rounds(algorithm: Algorithm, config: TrainConfig) -> None:
    """Check that a method's rounds fit the decision grid and the run.

    Raises:
        ValueError: One line naming field, value and what is allowed.
    """
    every, interval = algorithm.update_every, config.decision_interval
    if every == 1:
        return
    if every % interval:
        raise ValueError(
            f"rollout_steps must be a multiple of decision_interval ({interval}), got {every}"
        )
    rest = config.total_steps - config.demonstrations
    if rest % every:
        raise ValueError(
            f"total_steps less demonstrations must be a multiple of rollout_steps ({every}) for "
            f"{algorithm.name}, got {rest}"
        )
