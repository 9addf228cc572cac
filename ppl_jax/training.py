"""The training loop of every interactive method: Algorithm 1 of the paper as pure functions.

At steps 0, K, 2K, ... the novice proposes an action, the predictor rolls it H steps ahead, and the
decision whether the expert takes over holds for K steps. Each step is executed, stored and followed
by one update. Everything is one scan over blocks of K steps; the host acts between chunks of them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.config import HParams, TrainConfig, as_arrays
from ppl_jax.losses import Metrics
from ppl_jax.predictor import add_noise, predict, selected_transition
from ppl_jax.types import Env, Expert, Interaction, Trajectory

PyTree = Any


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
        run_chunk: `run_chunk(learner, blocks) -> (Learner, Metrics)` for a static number of blocks
            of `decision_interval` steps; metrics are means over the chunk.
        train: `train(key, hparams) -> (Learner, Metrics)`: the whole run, metrics per tenth, [10].
        act: `act(policy_params, observation) -> action`.
        algorithm: The method.
    """

    init: Callable[[jax.Array, HParams], Learner]
    run_chunk: Callable[[Learner, int], tuple[Learner, Metrics]]
    train: Callable[[jax.Array, HParams], tuple[Learner, Metrics]]
    algorithm: Algorithm


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
        make_algorithm: One of `ppl_jax.algorithms.ALGORITHMS`, or one's own.
        config: Static settings; check them with `ppl_jax.config.validate` first.
        env_params: The world's parameters; its training ones where None.

    Raises:
        ValueError: If the world lacks the predictor that `config` names.
    """
    params = env.default_params if env_params is None else env_params
    algorithm = make_algorithm(env.spec, config)
    transition = selected_transition(env, config.predictor)
    interval = config.decision_interval

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
        action = algorithm.act(learner.algorithm, observation)
        if config.random_steps:
            guess = jax.random.uniform(key, action.shape, minval=-1.0, maxval=1.0)
            action = jnp.where(learner.counters.steps < config.random_steps, guess, action)
        return action

    def decide(learner: Learner, key: jax.Array) -> jax.Array:
        """Whether the expert takes the next block."""
        key_propose, key_predict = jax.random.split(key)
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
        act = functools.partial(algorithm.act, learner.algorithm)
        trajectory = roll(act=act if asked_again else None)
        experts = roll(expert=expert) if algorithm.compares else None
        return algorithm.decide(learner.algorithm, trajectory, experts, learner.hparams)

    def ahead(
        takeover: jax.Array, key: jax.Array, state: PyTree, action: jax.Array, params: PyTree
    ) -> Trajectory:
        def roll() -> Trajectory:
            horizon = config.max_preference_horizon
            return predict(env, transition, key, state, action, params, horizon, observe=True)

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

    def step(learner: Learner, started: jax.Array) -> tuple[Learner, Metrics]:
        """One environment step: act, store, update."""
        keys = jax.random.split(learner.key, 8)
        key, key_propose, key_expert, key_noise, key_ahead, key_env, key_reset, key_update = keys
        hparams, state = learner.hparams, learner.env_state
        observation = env.observe(state, params)
        novice_action = propose(learner, key_propose, observation)
        expert_action = expert(key_expert, state, observation, params)
        noise = hparams.expert_noise * jax.random.normal(key_noise, expert_action.shape)
        expert_action = jnp.clip(expert_action + noise, -1.0, 1.0)
        takeover = learner.takeover
        executed = jnp.where(takeover, expert_action, novice_action)
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
            predicted=predicted,
        )
        stored = algorithm.store(learner.algorithm, interaction, hparams)
        updated, metrics = algorithm.update(stored, key_update, hparams)
        finite = jnp.all(
            jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(metrics)])
        )
        diverged = learner.diverged | ~finite
        kept = jax.tree.map(
            lambda new, old: jnp.where(diverged, old, new),
            updated.learned,
            stored.learned,
        )
        updated = dataclasses.replace(updated, learned=kept)
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
            algorithm=updated,
            env_state=restarted,
            takeover=takeover & ~done,
            key=key,
            counters=counters,
            diverged=diverged,
        ), metrics

    def block(learner: Learner, _: None) -> tuple[Learner, Metrics]:
        key, key_decide = jax.random.split(learner.key)
        was_expert = learner.takeover
        takeover = decide(learner, key_decide)
        learner = dataclasses.replace(learner, takeover=takeover, key=key)
        first = jnp.arange(interval) == 0
        learner, metrics = jax.lax.scan(step, learner, first & ~was_expert)
        return learner, jax.tree.map(jnp.mean, metrics)

    def run_chunk(learner: Learner, blocks: int) -> tuple[Learner, Metrics]:
        before = learner.counters
        learner, metrics = jax.lax.scan(block, learner, None, length=blocks)
        return learner, summarise(metrics, before, learner.counters)

    def train(key: jax.Array, hparams: HParams) -> tuple[Learner, Metrics]:
        blocks = config.total_steps // interval
        parts = max(n for n in range(1, 11) if blocks % n == 0)

        def part(learner: Learner, _: None) -> tuple[Learner, Metrics]:
            return run_chunk(learner, blocks // parts)

        return jax.lax.scan(part, init(key, hparams), None, length=parts)

    return TrainFunctions(init, run_chunk, train, algorithm)


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
