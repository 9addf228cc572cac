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

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.config import HParams, TrainConfig, as_arrays
from ppl_jax.losses import Metrics
from ppl_jax.predictor import add_noise, predict, selected_transition
from ppl_jax.types import DecisionPoint, Env, Expert, Interaction, Trajectory

PyTree = Any
Phase = Literal["demonstrate", "fit", "interact"]


@flax.struct.dataclass
class Counters:
    """Sums over a run (or, as differences, over a chunk).

    Attributes:
        steps: Environment steps.
        human_data: Steps under the expert's control.
        takeovers: Times the expert took control.
        episodes, successes: Training episodes that ended, and with success.
        cost: Sum of step costs while training.
        broken: Episodes that ended because the physics broke down.
    """

    steps: jax.Array
    human_data: jax.Array
    takeovers: jax.Array
    episodes: jax.Array
    successes: jax.Array
    cost: jax.Array
    broken: jax.Array


@flax.struct.dataclass
class Learner:
    """All of a run's state, one pytree: saving it whole makes resuming exact.

    Attributes:
        algorithm: The method's own state (parameters, optimiser, buffers).
        env_state: The world.
        takeover: The expert is in control.
        key: Random key.
        hparams: The run's hyper-parameters.
        counters: `Counters`.
        diverged: A loss was not finite: what was learned stays as it was before.
    """

    algorithm: PyTree
    env_state: PyTree
    takeover: jax.Array
    key: jax.Array
    hparams: HParams
    counters: Counters
    diverged: jax.Array


class TrainFunctions(NamedTuple):
    """What `make_train` returns; all pure, jittable and vmappable.

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
    env_params: PyTree | None = None,
) -> TrainFunctions:
    """Build the functions that train one policy.

    `jax.vmap(train)(keys, hparams)` trains a batch: over seeds, L, beta, noise, in one program.

    Args:
        env: The world.
        expert: Acts during takeovers.
        make_algorithm: `ppl_jax.algorithms.method(name).make`, or one's own.
        config: Static settings; check them with `ppl_jax.config.validate` first.
        env_params: The world's parameters; its training ones where None.

    Raises:
        ValueError: If the world lacks the predictor that `config` names, the expert the density
            that its gate needs, or the run's length does not fit the method's rounds.
    """
    params = env.default_params if env_params is None else env_params
    algorithm = make_algorithm(env.spec, config)
    transition = selected_transition(env, config.predictor)
    interval = config.decision_interval
    check_rounds(algorithm, config)
    density = getattr(expert, "log_density", None)
    if density is None:
        if config.gate == "unlikely":
            raise ValueError(
                "gate 'unlikely' needs an expert with a density, such as a neural one: give one, "
                "or another gate"
            )
        density = lambda observation, action: jnp.nan  # noqa: E731

    def init(key: jax.Array, hparams: HParams) -> Learner:
        key, key_algorithm, key_env = jax.random.split(key, 3)
        _, env_state = env.reset(key_env, params)
        zero = jnp.zeros((), jnp.int32)
        return Learner(
            algorithm=algorithm.init(key_algorithm),
            env_state=env_state,
            takeover=jnp.zeros((), bool),
            key=key,
            hparams=as_arrays(hparams),
            counters=Counters(zero, zero, zero, zero, zero, jnp.zeros(()), zero),
            diverged=jnp.zeros((), bool),
        )

    def propose(learner: Learner, key: jax.Array, observation: jax.Array) -> jax.Array:
        key_act, key_guess = jax.random.split(key)
        action = algorithm.act(learner.algorithm, key_act, observation)
        if config.random_steps:
            guess = jax.random.uniform(key_guess, action.shape, minval=-1.0, maxval=1.0)
            action = jnp.where(learner.counters.steps < config.random_steps, guess, action)
        return action

    def advise(learner: Learner, key: jax.Array, observation: jax.Array) -> jax.Array:
        """The expert's action, with its noise."""
        key_expert, key_noise = jax.random.split(key)
        action = expert(key_expert, learner.env_state, observation, params)
        noise = learner.hparams.expert_noise * jax.random.normal(key_noise, action.shape)
        return jnp.clip(action + noise, -1.0, 1.0)

    def decide(learner: Learner, key: jax.Array) -> jax.Array:
        """Whether the expert takes the next block."""
        key_propose, key_predict, key_expert, key_act = jax.random.split(key, 4)
        observation = env.observe(learner.env_state, params)
        action = propose(learner, key_propose, observation)
        roll = functools.partial(
            predict,
            env,
            transition,
            key_predict,
            learner.env_state,
            action,
            params,
            config.prediction_horizon,
            observe=algorithm.compares,
        )
        asked_again = config.gate_rollout == "closed_loop" or algorithm.compares
        act = functools.partial(algorithm.act, learner.algorithm, key_act)
        point = DecisionPoint(
            observation=observation,
            novice_action=action,
            expert_action=advise(learner, key_expert, observation),
            takeover=learner.takeover,
            trajectory=roll(act=act if asked_again else None),
            experts=roll(expert=expert) if algorithm.compares else None,
            log_density=jnp.asarray(density(observation, jnp.clip(action, -1.0, 1.0))),
        )
        return algorithm.decide(learner.algorithm, point, learner.hparams)

    def ahead(
        takeover: jax.Array, key: jax.Array, state: PyTree, action: jax.Array, params: PyTree
    ) -> Trajectory:
        def roll() -> Trajectory:
            horizon = config.max_preference_horizon
            return predict(
                env,
                transition,
                key,
                state,
                action,
                params,
                horizon,
                observe=True,
                advisor=expert if config.adaptive_horizon else None,
            )

        def nothing() -> Trajectory:
            return jax.tree.map(
                lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(roll)
            )

        return jax.lax.cond(takeover, roll, nothing)

    if jax.default_backend() == "cpu":
        # a batched cond makes every lane pay for the lookahead; one lane after another, only those
        # whose expert is in control do (a core is as fast with one lane as with many)
        ahead = jax.custom_batching.sequential_vmap(ahead)

    def look_ahead(learner: Learner, key: jax.Array, action: jax.Array) -> Trajectory:
        """The first predicted states, for the pairs; skipped while the novice is in control."""
        key_predict, key_noise = jax.random.split(key)
        trajectory = ahead(learner.takeover, key_predict, learner.env_state, action, params)
        noisy = add_noise(key_noise, trajectory.observation, learner.hparams.prediction_noise)
        return dataclasses.replace(trajectory, observation=noisy)

    def interact(learner: Learner, started: jax.Array) -> Learner:
        """One environment step: act and store."""
        keys = jax.random.split(learner.key, 6)
        key, key_propose, key_expert, key_ahead, key_env, key_reset = keys
        hparams, state = learner.hparams, learner.env_state
        observation = env.observe(state, params)
        novice_action = propose(learner, key_propose, observation)
        expert_action = advise(learner, key_expert, observation)
        takeover = learner.takeover
        executed = jnp.where(takeover, expert_action, jnp.clip(novice_action, -1.0, 1.0))
        if algorithm.uses_predictions:
            predicted = look_ahead(learner, key_ahead, novice_action)
        else:
            empty = jnp.zeros((0,))
            predicted = Trajectory(empty[:, None], empty, empty, *([empty.astype(bool)] * 4))
        after, outcome = env.transition(key_env, state, executed, params)
        interaction = Interaction(
            observation=observation,
            next_observation=env.observe(after, params),
            novice_action=novice_action,
            expert_action=expert_action,
            executed_action=executed,
            takeover=takeover,
            takeover_start=takeover & started,
            reward=outcome.reward,
            cost=outcome.cost,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            success=outcome.success,
            predicted=predicted,
        )
        done = outcome.terminated | outcome.truncated
        restarted = jax.lax.cond(
            done, lambda k: env.reset(k, params)[1], lambda _: after, key_reset
        )
        counters = learner.counters
        counters = Counters(
            steps=counters.steps + 1,
            human_data=counters.human_data + takeover,
            takeovers=counters.takeovers + (takeover & started),
            episodes=counters.episodes + done,
            successes=counters.successes + outcome.success,
            cost=counters.cost + outcome.cost,
            broken=counters.broken + outcome.broken,
        )
        # a takeover ends with its episode; the next decision waits for the grid
        return dataclasses.replace(
            learner,
            algorithm=algorithm.store(learner.algorithm, interaction, hparams),
            env_state=restarted,
            takeover=takeover & ~done,
            key=key,
            counters=counters,
        )

    def learn(learner: Learner, update: Callable) -> tuple[Learner, Metrics]:
        """One update; where a loss is not finite, what was learned stays as it was."""
        key, key_update = jax.random.split(learner.key)
        before = learner.algorithm
        updated, metrics = update(before, key_update, learner.hparams)
        finite = jnp.all(
            jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(metrics)])
        )
        diverged = learner.diverged | ~finite
        kept = jax.tree.map(
            lambda new, old: jnp.where(diverged, old, new), updated.learned, before.learned
        )
        updated = dataclasses.replace(updated, learned=kept)
        return dataclasses.replace(learner, algorithm=updated, key=key, diverged=diverged), metrics

    def step(learner: Learner, started: jax.Array) -> tuple[Learner, Metrics]:
        learner = interact(learner, started)
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
        return interact(learner, started), None

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


def summarise(losses: Metrics, before: Counters, after: Counters) -> Metrics:
    """Metrics of a chunk: mean losses, and what the counters say."""
    spent = jax.tree.map(lambda new, old: new - old, after, before)
    steps = jnp.maximum(spent.steps, 1)
    metrics = {f"train/{name}": jnp.mean(value) for name, value in losses.items()}
    return metrics | {
        "train/human_data_usage": after.human_data,
        "train/intervention_rate": spent.human_data / steps,
        "train/takeovers": spent.takeovers,
        "train/episodes": spent.episodes,
        "train/success_rate": spent.successes / jnp.maximum(spent.episodes, 1),
        "train/cost_per_step": spent.cost / steps,
        "train/broken_episodes": spent.broken,
    }
