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
from ppl_jax.interaction import (
    Learner,
    Problem,
    init,
    interact,
    learn,
    make_problem,
    params_of,
    query_expert,
    repeat,
    sample_novice_action,
    summarise,
    transition_of,
)
from ppl_jax.losses import Metrics
from ppl_jax.predictors import predict
from ppl_jax.types import DecisionPoint, Env, Expert

PyTree = Any
Phase = Literal["demonstrate", "fit", "interact"]


class TrainFunctions(NamedTuple):
    """Functions that `make_train` returns; all pure, jittable and vmappable.

    Attributes:
        init: `init(key, hparams) -> Learner`.
        run_chunk: `run_chunk(learner, blocks, phase="interact") -> (Learner, Metrics)` for a
            number of blocks of `decision_interval` steps (or updates, in phase "fit"), which may
            be traced: a run of any length, evaluated as often as one likes, is one program.
            Metrics are means over the chunk.
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
    algorithm = make_algorithm(env.spec, config)
    problem = make_problem(env, expert, algorithm, config, params=env_params)
    check_rounds(algorithm, config)
    takeovers = make_takeovers(problem)
    return TrainFunctions(
        init=functools.partial(init, problem),
        run_chunk=functools.partial(run_chunk, problem, takeovers),
        train=functools.partial(train, problem, takeovers),
        algorithm=algorithm,
    )


@dataclasses.dataclass(frozen=True)
class Takeovers:
    """How a run decides who acts next; static.

    Attributes:
        rule: `rule(algorithm state, DecisionPoint, hparams) -> bool`.
        needs_expert_rollout: The rule reads the expert's own predicted path.
        closed_loop: The novice acts anew at every predicted state, instead of holding its action.
        log_density: `log_density(observation, action)` of the expert; NaN of one that has none.
    """

    rule: Callable[[PyTree, DecisionPoint, HParams], jax.Array]
    needs_expert_rollout: bool
    closed_loop: bool
    log_density: Callable[[jax.Array, jax.Array], jax.Array | float]


def make_takeovers(problem: Problem) -> Takeovers:
    """The rule of the method, or else of the gate that the settings name.

    Raises:
        ValueError: If the gate needs a density that the expert lacks.
    """
    algorithm, config = problem.algorithm, problem.config
    shared = gate(config.gate) if algorithm.decide is None else None
    needs_expert_rollout = algorithm.needs_expert_rollout or (
        shared is not None and shared.needs_expert_rollout
    )
    density = getattr(problem.expert, "log_density", None)
    if density is None and shared is not None and shared.needs_density:
        raise ValueError(
            f"gate {config.gate!r} needs an expert with a density, such as a neural one: "
            "give one, or another gate"
        )
    return Takeovers(
        rule=algorithm.decide or shared_gate(config.gate, problem.env.spec.observation_scale),
        needs_expert_rollout=needs_expert_rollout,
        closed_loop=config.gate_rollout == "closed_loop" or needs_expert_rollout,
        log_density=density or (lambda observation, action: jnp.nan),
    )


def decide(problem: Problem, takeovers: Takeovers, learner: Learner, key: jax.Array) -> jax.Array:
    """Whether the expert takes the next block of K steps."""
    env, params = problem.env, params_of(problem, learner.hparams)
    key_propose, key_predict, key_expert, key_act = jax.random.split(key, 4)
    observation = env.observe(learner.env_state, params)
    action = sample_novice_action(problem, learner, key_propose, observation)
    roll = functools.partial(
        predict,
        env,
        transition_of(problem, learner.hparams.predictor),
        key_predict,
        learner.env_state,
        action=action,
        params=params,
        horizon=problem.config.prediction_horizon,
        observe=takeovers.needs_expert_rollout,
    )
    act = functools.partial(problem.algorithm.act, learner.algorithm, key_act)
    point = DecisionPoint(
        observation=observation,
        novice_action=action,
        expert_action=query_expert(problem, learner, key_expert, observation),
        takeover=learner.takeover,
        trajectory=roll(act=act if takeovers.closed_loop else None),
        experts=roll(expert=problem.expert) if takeovers.needs_expert_rollout else None,
        log_density=jnp.asarray(takeovers.log_density(observation, jnp.clip(action, -1.0, 1.0))),
    )
    return takeovers.rule(learner.algorithm, point, learner.hparams)


def block(problem: Problem, takeovers: Takeovers, learner: Learner) -> tuple[Learner, Metrics]:
    """One decision and the K steps that it holds for, each followed by an update.

    Methods that learn in rounds (`Algorithm.update_every`) make their updates in
    `round_of_blocks`.
    """
    algorithm, interval = problem.algorithm, problem.config.decision_interval
    key, key_decide = jax.random.split(learner.key)
    was_expert = learner.takeover
    takeover = decide(problem, takeovers, learner, key_decide)
    learner = dataclasses.replace(learner, takeover=takeover, key=key)

    def step(learner: Learner, started: jax.Array) -> tuple[Learner, Metrics]:
        learner, _ = interact(problem, learner, started)
        if algorithm.update_every > 1:
            return learner, {}
        return learn(learner, algorithm.update)

    first = jnp.arange(interval) == 0
    learner, metrics = jax.lax.scan(step, learner, first & ~was_expert)
    return learner, jax.tree.map(jnp.mean, metrics)


def round_of_blocks(
    problem: Problem, takeovers: Takeovers, learner: Learner
) -> tuple[Learner, Metrics]:
    """The `update_every` steps of a round, then its update."""

    def one(learner: Learner, _: None) -> tuple[Learner, Metrics]:
        return block(problem, takeovers, learner)

    blocks = problem.algorithm.update_every // problem.config.decision_interval
    learner, _ = jax.lax.scan(one, learner, None, length=blocks)
    return learn(learner, problem.algorithm.update)


def demonstrate(problem: Problem, learner: Learner) -> tuple[Learner, Metrics]:
    """One step of the expert, which nothing is learned from yet."""
    started = ~learner.takeover  # at the start of an episode
    learner = dataclasses.replace(learner, takeover=jnp.ones((), bool))
    return interact(problem, learner, started)[0], {}


def run_chunk(
    problem: Problem,
    takeovers: Takeovers,
    learner: Learner,
    blocks: int | jax.Array,
    phase: Phase = "interact",
) -> tuple[Learner, Metrics]:
    """So many blocks of K steps (or K updates each, in phase "fit"); metrics are means over them.

    `blocks` may be traced.
    """
    algorithm, interval = problem.algorithm, problem.config.decision_interval

    def one(learner: Learner) -> tuple[Learner, Metrics]:
        if phase == "demonstrate":
            return demonstrate(problem, learner)
        if phase == "fit":
            return learn(learner, algorithm.fit or algorithm.update)
        if algorithm.update_every > 1:
            return round_of_blocks(problem, takeovers, learner)
        return block(problem, takeovers, learner)

    steps_of_one = 1
    if phase == "interact":
        steps_of_one = max(algorithm.update_every, interval)
    before = learner.counters
    learner, metrics = repeat(one, learner, blocks * interval // steps_of_one)
    return learner, summarise(metrics, before, learner.counters)


def train(
    problem: Problem, takeovers: Takeovers, key: jax.Array, hparams: HParams
) -> tuple[Learner, Metrics]:
    """A whole run: its phases, the last one in (at most) ten parts with their metrics."""
    interval, every = problem.config.decision_interval, problem.algorithm.update_every
    learner = init(problem, key, hparams)
    *first, (last, length) = phases(problem.config)
    for phase, count in first:
        learner, _ = run_chunk(problem, takeovers, learner, count // interval, phase)
    unit = every if last == "interact" else 1
    units = length // max(unit, interval)
    parts = max(n for n in range(1, 11) if units % n == 0)

    def part(learner: Learner, _: None) -> tuple[Learner, Metrics]:
        return run_chunk(problem, takeovers, learner, length // parts // interval, last)

    return jax.lax.scan(part, learner, None, length=parts)


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
