"""One step of the loop: act, look ahead, store; one update. What decides who acts is elsewhere.

`ppl_jax.training` scans these steps with a gate that decides; `ppl_jax.live` makes them one by one
as a person decides.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.algorithms.base import Algorithm
from ppl_jax.config import HParams, TrainConfig, as_arrays
from ppl_jax.losses import Metrics
from ppl_jax.predictors import add_noise, predict, predictor
from ppl_jax.types import Env, Expert, Interaction, Trajectory

PyTree = Any
KEYS = 6  # of a step


@flax.struct.dataclass
class Counters:
    """Sums over a run (or, as differences, over a chunk).

    Attributes:
        steps: Environment steps.
        human_data: Steps under the expert's control.
        takeovers: Times the expert took control.
        episodes, successes: Training episodes that ended, and with success.
        cost: Sum of step costs while training.
        physics_diverged: Episodes that ended because the physics broke down.
    """

    steps: jax.Array
    human_data: jax.Array
    takeovers: jax.Array
    episodes: jax.Array
    successes: jax.Array
    cost: jax.Array
    physics_diverged: jax.Array


@flax.struct.dataclass
class Learner:
    """All of a run's state, one pytree: saving it whole makes resuming exact.

    Attributes:
        algorithm: The method's own state (parameters, optimiser, buffers).
        env_state: The environment.
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


class Steps(NamedTuple):
    """Functions that `make_steps` returns; all pure.

    Attributes:
        init: `init(key, hparams) -> Learner`.
        sample_novice_action: `sample_novice_action(learner, key, observation) -> action [A]` of the
            novice, not yet clipped.
        query_expert: `query_expert(learner, key, observation) -> action [A]` of the expert, with
            its noise.
        interact: `interact(learner, started, action=None) -> (Learner, Interaction)`: one step
            of expert or novice (see `learner.takeover`); `action` is the expert's where given.
            `started`: an expert in control was not in the step before.
        ingest: `ingest(learner, interaction) -> Learner`: store a recorded step as if made now.
        learn: `learn(learner, update) -> (Learner, Metrics)`: one update; where a loss is not
            finite, what was learned stays as it was before.
    """

    init: Callable[[jax.Array, HParams], Learner]
    sample_novice_action: Callable[[Learner, jax.Array, jax.Array], jax.Array]
    query_expert: Callable[[Learner, jax.Array, jax.Array], jax.Array]
    interact: Callable[..., tuple[Learner, Interaction]]
    ingest: Callable[[Learner, Interaction], Learner]
    learn: Callable[..., tuple[Learner, Metrics]]


def make_steps(
    env: Env, expert: Expert | None, algorithm: Algorithm, config: TrainConfig, *, params: PyTree
) -> Steps:
    """Build them.

    Args:
        env: The environment.
        expert: Acts during takeovers; None where somebody outside does.
        algorithm: The method.
        config: Static settings.
        params: The environment's parameters.

    Raises:
        ValueError: If the environment lacks the predictor that `config` names.
    """
    predicted_transition = predictor(config.predictor).make(env)

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

    def sample_novice_action(learner: Learner, key: jax.Array, observation: jax.Array) -> jax.Array:
        key_act, key_guess = jax.random.split(key)
        action = algorithm.act(learner.algorithm, key_act, observation)
        if config.random_steps:
            guess = jax.random.uniform(key_guess, action.shape, minval=-1.0, maxval=1.0)
            action = jnp.where(learner.counters.steps < config.random_steps, guess, action)
        return action

    def query_expert(learner: Learner, key: jax.Array, observation: jax.Array) -> jax.Array:
        """The expert's action, with its noise."""
        assert expert is not None  # else the caller of `interact` says what it does
        key_expert, key_noise = jax.random.split(key)
        action = expert(key_expert, learner.env_state, observation, params)
        noise = learner.hparams.expert_noise * jax.random.normal(key_noise, action.shape)
        return jnp.clip(action + noise, -1.0, 1.0)

    def ahead(
        takeover: jax.Array,
        key: jax.Array,
        state: PyTree,
        action: jax.Array,
        params: PyTree,
        hparams: PyTree,
    ) -> Trajectory:
        def transition(*args: Any) -> Any:
            return predicted_transition(*args, hparams)

        def roll() -> Trajectory:
            return predict(
                env,
                transition,
                key,
                state,
                action=action,
                params=params,
                horizon=algorithm.predicted_steps,
                observe=True,
                labelling_expert=expert if algorithm.labels_predictions else None,
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
        trajectory = ahead(
            learner.takeover,
            key_predict,
            learner.env_state,
            action,
            params,
            learner.hparams.predictor,
        )
        noisy = add_noise(key_noise, trajectory.observation, learner.hparams.prediction_noise)
        return dataclasses.replace(trajectory, observation=noisy)

    def store(
        learner: Learner, step: Interaction, physics_diverged: jax.Array | bool = False
    ) -> Learner:
        counters, done = learner.counters, step.terminated | step.truncated
        return dataclasses.replace(
            learner,
            algorithm=algorithm.store(learner.algorithm, step, learner.hparams),
            counters=Counters(
                steps=counters.steps + 1,
                human_data=counters.human_data + step.takeover,
                takeovers=counters.takeovers + step.takeover_start,
                episodes=counters.episodes + done,
                successes=counters.successes + step.success,
                cost=counters.cost + step.cost,
                physics_diverged=counters.physics_diverged + physics_diverged,
            ),
        )

    def ingest(learner: Learner, step: Interaction) -> Learner:
        key = jax.random.split(learner.key, KEYS)[0]  # as `interact` would leave it
        return store(dataclasses.replace(learner, key=key), step)

    def interact(
        learner: Learner, started: jax.Array, action: jax.Array | None = None
    ) -> tuple[Learner, Interaction]:
        """One environment step: act and store."""
        keys = jax.random.split(learner.key, KEYS)
        key, key_propose, key_expert, key_ahead, key_env, key_reset = keys
        state = learner.env_state
        observation = env.observe(state, params)
        novice_action = sample_novice_action(learner, key_propose, observation)
        expert_action = query_expert(learner, key_expert, observation) if action is None else action
        takeover = learner.takeover
        executed = jnp.where(takeover, expert_action, jnp.clip(novice_action, -1.0, 1.0))
        if algorithm.predicted_steps:
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
        learner = store(
            dataclasses.replace(learner, key=key), interaction, outcome.physics_diverged
        )
        # a takeover ends with its episode; the gate next runs at a multiple of K
        learner = dataclasses.replace(learner, env_state=restarted, takeover=takeover & ~done)
        return learner, interaction

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

    return Steps(init, sample_novice_action, query_expert, interact, ingest, learn)


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
        "train/physics_diverged_episodes": spent.physics_diverged,
    }
