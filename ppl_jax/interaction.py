"""One step of the loop: act, look ahead, store; one update. What decides who acts is elsewhere.

`ppl_jax.training` scans these steps with a gate that decides; `ppl_jax.live` makes them one by one
as a person decides. Every function takes the `Problem`, which is static, and the `Learner`, which
is all that changes.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax.core import Tracer

from ppl_jax.algorithms.base import Algorithm
from ppl_jax.config import HParams, TrainConfig, as_arrays, env_params, validate
from ppl_jax.learned import all_finite
from ppl_jax.losses import Metrics
from ppl_jax.predictors import add_noise, predict, predictor
from ppl_jax.types import Env, Expert, Interaction, Outcome, Trajectory, in_single

PyTree = Any
KEYS = 6  # of a step
_PROPOSE, _AHEAD = 1, 3  # the novice's and the predictor's among them


@flax.struct.dataclass
class Counters:
    """Sums over a run (or, as differences, over a chunk).

    Attributes:
        steps: Environment steps.
        human_data: Steps under the expert's control.
        human_cost_steps: Those of them that had a cost.
        takeovers: Times the expert took control.
        episodes, successes: Training episodes that ended, and with success.
        cost: Sum of step costs while training.
        physics_diverged: Episodes that ended because the physics broke down.
    """

    steps: jax.Array
    human_data: jax.Array
    human_cost_steps: jax.Array
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
        costly: Steps with cost in a row that it has made until now.
        key: Random key.
        hparams: The run's hyper-parameters.
        counters: `Counters`.
        diverged: A loss, a parameter or a moment of the optimiser was not finite: what was learned
            stays as it was before.
    """

    algorithm: PyTree
    env_state: PyTree
    takeover: jax.Array
    costly: jax.Array
    key: jax.Array
    hparams: HParams
    counters: Counters
    diverged: jax.Array


@dataclasses.dataclass(frozen=True)
class Problem:
    """Who learns what, where and from whom; static. `make_problem` builds it.

    Attributes:
        env: The environment.
        expert: Acts during takeovers; None where somebody outside does.
        algorithm: The method.
        config: Static settings.
        params: The environment's parameters; a run has them as `params_of` says.
        transition: `transition(key, state, action, params, hparams=...)` of the predictor.
    """

    env: Env
    expert: Expert | None
    algorithm: Algorithm
    config: TrainConfig
    params: PyTree
    transition: Callable[..., tuple[PyTree, Outcome]]


def make_problem(
    env: Env,
    expert: Expert | None,
    algorithm: Algorithm,
    config: TrainConfig,
    *,
    params: PyTree | None = None,
) -> Problem:
    """Put a problem together.

    Args:
        env: The environment.
        expert: Acts during takeovers; None where somebody outside does.
        algorithm: The method.
        config: Static settings.
        params: The environment's parameters; its training ones where None.

    Raises:
        ValueError: If the environment lacks the predictor that `config` names.
    """
    return Problem(
        env=env,
        expert=expert,
        algorithm=algorithm,
        config=config,
        params=env.default_params if params is None else params,
        transition=predictor(config.predictor).make(env),
    )


def params_of(problem: Problem, hparams: HParams) -> PyTree:
    """The environment's parameters in a run with these settings."""
    return env_params(problem.env, problem.params, hparams)


def init(problem: Problem, key: jax.Array, hparams: HParams) -> Learner:
    """A learner before its first step.

    Raises:
        ValueError: If a setting is out of its range; traced ones cannot be checked.
    """
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(hparams)):
        validate(problem.config, hparams)
    key, key_algorithm, key_env = jax.random.split(key, 3)
    _, env_state = problem.env.reset(key_env, params_of(problem, hparams))
    zero = jnp.zeros((), jnp.int32)
    return Learner(
        algorithm=problem.algorithm.init(key_algorithm),
        env_state=env_state,
        takeover=jnp.zeros((), bool),
        costly=zero,
        key=key,
        hparams=as_arrays(hparams),
        counters=Counters(
            steps=zero,
            human_data=zero,
            human_cost_steps=zero,
            takeovers=zero,
            episodes=zero,
            successes=zero,
            cost=jnp.zeros((), jnp.float32),
            physics_diverged=zero,
        ),
        diverged=jnp.zeros((), bool),
    )


def propose(problem: Problem, learner: Learner, observation: jax.Array) -> jax.Array:
    """The novice's action [A] in the coming step, not yet clipped.

    A random one in the first `random_steps`. It is drawn with the step's own key: asked before the
    step, by the gate or to show its path, the novice says what it then does.
    """
    key = jax.random.split(learner.key, KEYS)[_PROPOSE]
    key_act, key_guess = jax.random.split(key)
    action = problem.algorithm.act(learner.algorithm, key_act, observation)
    random_steps = problem.config.random_steps
    if random_steps:
        guess = jax.random.uniform(key_guess, action.shape, jnp.float32, minval=-1.0, maxval=1.0)
        action = jnp.where(learner.counters.steps < random_steps, guess, action)
    return action


def query_expert(
    problem: Problem, learner: Learner, key: jax.Array, observation: jax.Array
) -> jax.Array:
    """The expert's action [A], with its noise."""
    assert problem.expert is not None  # else the caller of `interact` says what it does
    key_expert, key_noise = jax.random.split(key)
    params = params_of(problem, learner.hparams)
    action = in_single(problem.expert(key_expert, learner.env_state, observation, params))
    noise = learner.hparams.expert_noise * jax.random.normal(key_noise, action.shape, jnp.float32)
    return jnp.clip(action + noise, -1.0, 1.0)


def ahead_key(learner: Learner) -> jax.Array:
    """The predictor's key in the coming step."""
    return jax.random.split(learner.key, KEYS)[_AHEAD]


def transition_of(problem: Problem, hparams: PyTree) -> Callable[..., tuple[PyTree, Outcome]]:
    """The predictor's `transition(key, state, action, params)` under its traced settings."""
    return functools.partial(problem.transition, hparams=hparams)


def look_ahead(problem: Problem, learner: Learner, key: jax.Array, action: jax.Array) -> Trajectory:
    """The first predicted states, for the pairs; skipped while the novice is in control.

    Where `noise_at` says so they are disturbed as in the paper's study of imperfect predictors.
    """
    key_predict, key_noise = jax.random.split(key)

    def ahead(learner: Learner, key: jax.Array, action: jax.Array, params: PyTree) -> Trajectory:
        return _if_expert(problem, learner, key, action=action, params=params)

    if jax.default_backend() == "cpu":
        # a batched cond makes every run pay for the lookahead; one run after another, only those
        # whose expert is in control do (a core is as fast with one run as with many)
        ahead = jax.custom_batching.sequential_vmap(ahead)
    only = dataclasses.replace(learner, algorithm=None, counters=None)  # what it reads
    trajectory = ahead(only, key_predict, action, params_of(problem, learner.hparams))
    trajectory = dataclasses.replace(trajectory, clearance=None)  # for gates alone
    if problem.config.noise_at == "gate":
        return trajectory
    noisy = add_noise(key_noise, trajectory.observation, learner.hparams.prediction_noise)
    return dataclasses.replace(trajectory, observation=noisy)


def _if_expert(
    problem: Problem, learner: Learner, key: jax.Array, *, action: jax.Array, params: PyTree
) -> Trajectory:
    """The prediction where the expert is in control, else zeros."""
    algorithm = problem.algorithm

    def roll() -> Trajectory:
        return predict(
            problem.env,
            transition_of(problem, learner.hparams.predictor),
            key,
            learner.env_state,
            action=action,
            params=params,
            horizon=algorithm.predicted_steps,
            observe=True,
            labelling_expert=problem.expert if algorithm.labels_predictions else None,
        )

    def nothing() -> Trajectory:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(roll))

    return jax.lax.cond(learner.takeover, roll, nothing)


def no_prediction() -> Trajectory:
    """A trajectory of no steps, of methods that make no pairs."""
    empty = jnp.zeros((0,), jnp.float32)
    no = empty.astype(bool)
    return Trajectory(
        observation=empty[:, None],
        reward=empty,
        speed=empty,
        unsafe=no,
        success=no,
        terminated=no,
        valid=no,
    )


def interact(
    problem: Problem, learner: Learner, started: jax.Array, action: jax.Array | None = None
) -> tuple[Learner, Interaction]:
    """One environment step of expert or novice (see `learner.takeover`): act and store.

    Args:
        problem: See `Problem`.
        learner: Before the step.
        started: An expert in control was not in the step before.
        action: The expert's [A], where somebody outside says it.
    """
    env, state = problem.env, learner.env_state
    params = params_of(problem, learner.hparams)
    keys = jax.random.split(learner.key, KEYS)
    key, _, key_expert, key_ahead, key_env, key_reset = keys  # the novice's is `propose`'s
    observation = env.observe(state, params)
    novice_action = propose(problem, learner, observation)
    if action is None:
        action = query_expert(problem, learner, key_expert, observation)
    takeover = learner.takeover
    executed = jnp.where(takeover, action, jnp.clip(novice_action, -1.0, 1.0))
    if problem.algorithm.predicted_steps:
        predicted = look_ahead(problem, learner, key_ahead, novice_action)
    else:
        predicted = no_prediction()
    after, outcome = env.transition(key_env, state, executed, params)
    costly = jnp.where(takeover & (outcome.cost > 0), learner.costly + 1, 0)
    patience = learner.hparams.give_up_after
    hopeless = (patience > 0) & (costly.astype(jnp.float32) >= patience) & ~outcome.terminated
    interaction = Interaction(
        observation=observation,
        next_observation=env.observe(after, params),
        novice_action=novice_action,
        expert_action=action,
        executed_action=executed,
        takeover=takeover,
        takeover_start=takeover & started,
        reward=outcome.reward,
        cost=outcome.cost,
        terminated=outcome.terminated,
        truncated=outcome.truncated | hopeless,
        success=outcome.success,
        predicted=predicted,
    )
    done = interaction.terminated | interaction.truncated
    restarted = jax.lax.cond(done, lambda k: env.reset(k, params)[1], lambda _: after, key_reset)
    learner = dataclasses.replace(learner, key=key)
    learner = store(problem, learner, interaction, outcome.physics_diverged)
    # a takeover ends with its episode
    learner = dataclasses.replace(
        learner,
        env_state=restarted,
        takeover=takeover & ~done,
        costly=jnp.where(done, 0, costly),
    )
    return learner, interaction


def store(
    problem: Problem,
    learner: Learner,
    step: Interaction,
    physics_diverged: jax.Array | bool = False,
) -> Learner:
    """Give a step to the method, and count it."""
    step = in_single(step)
    counters, done = learner.counters, step.terminated | step.truncated

    def counted(count: jax.Array, happened: jax.Array | bool) -> jax.Array:
        return count + jnp.asarray(happened, jnp.int32)

    return dataclasses.replace(
        learner,
        algorithm=problem.algorithm.store(learner.algorithm, step, learner.hparams),
        counters=Counters(
            steps=counters.steps + 1,
            human_data=counted(counters.human_data, step.takeover),
            human_cost_steps=counted(counters.human_cost_steps, step.takeover & (step.cost > 0)),
            takeovers=counted(counters.takeovers, step.takeover_start),
            episodes=counted(counters.episodes, done),
            successes=counted(counters.successes, step.success),
            cost=counters.cost + step.cost,
            physics_diverged=counted(counters.physics_diverged, physics_diverged),
        ),
    )


def ingest(
    problem: Problem,
    learner: Learner,
    step: Interaction,
    *,
    ask_novice: bool = False,
    state: PyTree | None = None,
) -> Learner:
    """Store a recorded step as if it were made now.

    Args:
        problem: See `Problem`.
        learner: Before the step.
        step: The step.
        ask_novice: What the novice proposes while the expert acts was not recorded: the present
            one is asked, as in `interact`.
        state: The environment's before the step, where predictions were not recorded: they are
            made from it.
    """
    novice_action = step.novice_action
    if ask_novice:
        proposed = propose(problem, learner, step.observation)
        novice_action = jnp.where(step.takeover, proposed, novice_action)
        step = dataclasses.replace(step, novice_action=novice_action)
    if state is not None:
        then = dataclasses.replace(learner, env_state=state, takeover=step.takeover)
        predicted = look_ahead(problem, then, ahead_key(learner), novice_action)
        step = dataclasses.replace(step, predicted=predicted)
    key = jax.random.split(learner.key, KEYS)[0]  # as `interact` would leave it
    return store(problem, dataclasses.replace(learner, key=key), step)


def learn(learner: Learner, update: Callable) -> tuple[Learner, Metrics]:
    """One update; where a loss or what it leads to is not finite, what was learned stays as it was.

    Args:
        learner: Before the update.
        update: `Algorithm.update` or `Algorithm.fit`.
    """
    key, key_update = jax.random.split(learner.key)
    before = learner.algorithm
    updated, metrics = update(before, key_update, learner.hparams)
    diverged = learner.diverged | ~all_finite((metrics, updated.learned))
    kept = jax.tree.map(
        lambda new, old: jnp.where(diverged, old, new), updated.learned, before.learned
    )
    updated = dataclasses.replace(updated, learned=kept)
    return dataclasses.replace(learner, algorithm=updated, key=key, diverged=diverged), metrics


def repeat(
    step: Callable[[Learner], tuple[Learner, Metrics]], learner: Learner, times: int | jax.Array
) -> tuple[Learner, Metrics]:
    """Make `step` so many times; metrics are means over them.

    Args:
        step: `step(learner) -> (learner, metrics)`.
        learner: Before the first.
        times: May be traced: one program then serves any number.
    """
    step = jax.jit(step)  # traced once, for the shapes of its metrics and for the loop
    sums = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, jnp.float32), jax.eval_shape(step, learner)[1]
    )

    def add(_: jax.Array, carry: tuple[Learner, Metrics]) -> tuple[Learner, Metrics]:
        learner, metrics = step(carry[0])
        return learner, jax.tree.map(jnp.add, carry[1], metrics)

    learner, sums = jax.lax.fori_loop(0, times, add, (learner, sums))
    return learner, jax.tree.map(lambda total: total / jnp.maximum(times, 1), sums)


def summarise(losses: Metrics, before: Counters, after: Counters) -> Metrics:
    """Metrics of a chunk: mean losses, and what the counters say."""
    spent = jax.tree.map(lambda new, old: new - old, after, before)
    steps = jnp.maximum(spent.steps, 1)
    metrics = {f"train/{name}": value for name, value in losses.items()}
    return metrics | {
        "train/human_data_usage": after.human_data,
        "train/human_cost_steps": after.human_cost_steps,
        "train/intervention_rate": spent.human_data / steps,
        "train/takeovers": spent.takeovers,
        "train/episodes": spent.episodes,
        "train/success_rate": spent.successes / jnp.maximum(spent.episodes, 1),
        "train/cost_per_step": spent.cost / steps.astype(jnp.float32),
        "train/physics_diverged_episodes": spent.physics_diverged,
    }
