"""The training loop of every method: Algorithm 1 of the paper as pure functions.

At steps 0, K, 2K, ... and at the start of every episode the novice proposes an action, the
predictor rolls it H steps ahead, and the decision whether the expert takes over holds until the
next. Each step is executed, stored and followed by one update. Everything is one scan over blocks
of K steps; the host acts between chunks of them.

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
    propose,
    query_expert,
    repeat,
    summarise,
    transition_of,
)
from ppl_jax.losses import Metrics
from ppl_jax.predictors import imperfect, predict
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


def decide(problem: Problem, takeovers: Takeovers, learner: Learner, due: jax.Array) -> Learner:
    """Let the rule say who takes the coming steps, where a decision is `due`."""
    key, key_decide = jax.random.split(learner.key)
    learner = dataclasses.replace(learner, key=key)
    params = params_of(problem, learner.hparams)
    ask = _if_due(functools.partial(takes_over, problem, takeovers))
    return dataclasses.replace(learner, takeover=ask(due, learner, key_decide, params))


def _if_due(ask: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """`ask(learner, key, params)` where a decision is due, else the last decision.

    Of runs that are stepped together all are asked where one has to be (a batched `cond` would ask
    all of them in every step).
    """

    @jax.custom_batching.custom_vmap
    def one(due: jax.Array, learner: Learner, key: jax.Array, params: PyTree) -> jax.Array:
        return jax.lax.cond(
            due, ask, lambda learner, key, params: learner.takeover, learner, key, params
        )

    @one.def_vmap
    def many(
        size: int, batched: Any, due: jax.Array, learner: Learner, key: jax.Array, params: PyTree
    ) -> tuple[jax.Array, bool]:
        asked, *axes = jax.tree.map(lambda mapped: 0 if mapped else None, tuple(batched))
        del asked
        last = jnp.broadcast_to(learner.takeover, (size,))
        every = jax.vmap(ask, in_axes=tuple(axes), axis_size=size)
        now = jax.lax.cond(jnp.any(due), every, lambda *_: last, learner, key, params)
        return jnp.where(due, now, last), True

    return one


def takes_over(
    problem: Problem, takeovers: Takeovers, learner: Learner, key: jax.Array, params: PyTree
) -> jax.Array:
    """The rule's answer, given what the novice proposes and where that leads."""
    env, config, hparams = problem.env, problem.config, learner.hparams
    key_predict, key_expert = jax.random.split(key)
    observation = env.observe(learner.env_state, params)
    action = propose(problem, learner, observation)
    transition = transition_of(problem, hparams.predictor)
    if config.noise_at != "pairs":
        transition = imperfect(transition, hparams.prediction_noise)
    roll = functools.partial(
        predict,
        env,
        transition,
        key_predict,
        learner.env_state,
        action=action,
        params=params,
        horizon=config.prediction_horizon,
        observe=takeovers.needs_expert_rollout,
    )
    act = functools.partial(problem.algorithm.act, learner.algorithm)
    point = DecisionPoint(
        observation=observation,
        novice_action=action,
        expert_action=query_expert(problem, learner, key_expert, observation),
        takeover=learner.takeover,
        trajectory=roll(act=act if takeovers.closed_loop else None),
        experts=roll(expert=problem.expert) if takeovers.needs_expert_rollout else None,
        log_density=jnp.asarray(takeovers.log_density(observation, jnp.clip(action, -1.0, 1.0))),
    )
    return takeovers.rule(learner.algorithm, point, hparams)


def block(problem: Problem, takeovers: Takeovers, learner: Learner) -> tuple[Learner, Metrics]:
    """K steps, each followed by an update, with a decision at the first of them.

    A takeover ends with its episode; the next one's first step has a decision of its own, which
    holds to the end of the block. Methods that learn in rounds (`Algorithm.update_every`) make
    their updates in `round_of_blocks`.
    """
    algorithm, interval = problem.algorithm, problem.config.decision_interval

    def step(
        carry: tuple[Learner, jax.Array], first: jax.Array
    ) -> tuple[tuple[Learner, jax.Array], Metrics]:
        learner, restarted = carry
        before = learner.takeover
        learner = decide(problem, takeovers, learner, first | restarted)
        learner, made = interact(problem, learner, ~before)
        carry = learner, made.terminated | made.truncated
        if algorithm.update_every > 1:
            return carry, {}
        learner, metrics = learn(learner, algorithm.update)
        return (learner, carry[1]), metrics

    start = learner, jnp.zeros((), bool)
    (learner, _), metrics = jax.lax.scan(step, start, jnp.arange(interval, dtype=jnp.int32) == 0)
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
