"""Records of PPO-Lagrangian and the stepping of its environments."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.learned import Learned
from ppl_jax.networks import Network, make_policy, make_raw
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from ppl_jax.ppo.losses import Multiplier, RunningStats
from ppl_jax.types import Env, Expert, PyTree, in_single

LEAST_SCALE = 0.1  # of an input, in the environment's own scale: hardly varying ones stay small


@dataclasses.dataclass(frozen=True)
class Problem:
    """Everything static that the functions of PPO-Lagrangian share.

    Attributes:
        env: The environment.
        config: Static settings.
        params: The environment's parameters.
        expert: Demonstrates and guides, or None.
        policy: Network of the action's mean, [..., O] -> [..., A].
        critic: Network of one value, [..., O] -> [..., 1].
    """

    env: Env
    config: PPOConfig
    params: PyTree
    expert: Expert | None
    policy: Network
    critic: Network


def make_problem(
    env: Env, config: PPOConfig, env_params: PyTree | None = None, expert: Expert | None = None
) -> Problem:
    """Networks and environment of a run.

    Args:
        env: Any environment.
        config: Static settings.
        env_params: The environment's parameters; its training ones where None.
        expert: Demonstrates and guides, where `config` asks for it.

    Raises:
        ValueError: If demonstrations are asked for and there is no expert.
    """
    for field in ("demonstrations", "guided"):
        if getattr(config, field) and expert is None:
            raise ValueError(f"{field}: {env.name} has no expert to learn from")
    size = env.spec.observation_size
    plain = env.spec._replace(
        observation_mean=np.zeros(size, np.float32), observation_scale=np.ones(size, np.float32)
    )
    return Problem(
        env=env,
        config=config,
        params=env.default_params if env_params is None else env_params,
        expert=expert,
        policy=make_policy(plain, config.hidden),
        critic=make_raw(plain, config.hidden, 1),
    )


@flax.struct.dataclass
class PPOLearned:
    """State that updates change.

    Attributes:
        policy: `Learned` of {"mean": network, "log_std": [A]}.
        critics: `Learned` of two networks [2]: of the reward's and of the cost's value.
        multiplier: `Multiplier`.
        inputs: `RunningStats` of the observations, [O].
        returns: `RunningStats` of the squared targets of both critics, [2]: they learn in units of
            their root.
    """

    policy: Learned
    critics: Learned
    multiplier: Multiplier
    inputs: RunningStats
    returns: RunningStats


@flax.struct.dataclass
class Played:
    """Sums over the running episode of each environment, [W]."""

    reward: jax.Array
    cost: jax.Array
    length: jax.Array


@flax.struct.dataclass
class PPOLearner:
    """All of a run's state, one pytree.

    Attributes:
        learned: `PPOLearned`.
        env_state: [W] environments.
        observation: [W, O] of them.
        played: `Played`.
        key: Random key.
        hparams: `PPOHParams`.
        batches: Batches so far.
        diverged: A loss, a parameter or a moment of the optimiser was not finite: what was learned
            stays as it was before.
    """

    learned: PPOLearned
    env_state: PyTree
    observation: jax.Array
    played: Played
    key: jax.Array
    hparams: PPOHParams
    batches: jax.Array
    diverged: jax.Array


@flax.struct.dataclass
class Rollout:
    """A batch of steps, [T, W] (observations [T, W, O], actions [T, W, A])."""

    observation: jax.Array
    action: jax.Array
    final_observation: jax.Array
    reward: jax.Array
    cost: jax.Array
    terminated: jax.Array
    done: jax.Array
    success: jax.Array
    expert_actions: jax.Array  # the action itself where no expert guides
    ended: Played  # of the episode, up to and with this step


def start_envs(problem: Problem, key: jax.Array) -> dict[str, Any]:
    """Fresh environments with their observations and empty episode sums."""
    count = problem.config.num_envs
    keys, zero = jax.random.split(key, count), jnp.zeros(count, jnp.float32)
    observation, env_state = jax.vmap(problem.env.reset, in_axes=(0, None))(keys, problem.params)
    played = Played(reward=zero, cost=zero, length=zero)
    return {"observation": in_single(observation), "env_state": env_state, "played": played}


def centre_and_scale(problem: Problem, inputs: RunningStats) -> tuple[jax.Array, jax.Array]:
    """Mean and scale of the inputs of policy and critics, [O] each."""
    mean, scale = (
        jnp.asarray(problem.env.spec.observation_mean, jnp.float32),
        jnp.asarray(problem.env.spec.observation_scale, jnp.float32),
    )
    if problem.config.scaling == "world":
        return mean, scale
    seen = inputs.count > 0
    spread = jnp.maximum(jnp.sqrt(inputs.variance), LEAST_SCALE * scale)
    return jnp.where(seen, inputs.mean, mean), jnp.where(seen, spread, scale)


def scaled(problem: Problem, inputs: RunningStats, observation: jax.Array) -> jax.Array:
    """Observations as the networks see them, [..., O]."""
    mean, scale = centre_and_scale(problem, inputs)
    return (observation - mean) / scale


def step_envs(problem: Problem, key: jax.Array, learner: PPOLearner, action: jax.Array) -> Any:
    """One step of every environment, clipped actions; (learner, rollout row less observation)."""
    observation, env_state, reward, terminated, truncated, info = jax.vmap(
        problem.env.step, in_axes=(0, 0, 0, None)
    )(
        jax.random.split(key, problem.config.num_envs),
        learner.env_state,
        jnp.clip(action, -1.0, 1.0),
        problem.params,
    )
    observation, reward, info = in_single((observation, reward, info))
    played = Played(
        reward=learner.played.reward + reward,
        cost=learner.played.cost + info.cost,
        length=learner.played.length + 1,
    )
    done = terminated | truncated
    learner = dataclasses.replace(
        learner,
        env_state=env_state,
        observation=observation,
        played=jax.tree.map(lambda total: jnp.where(done, 0.0, total), played),
    )
    return learner, (reward, terminated, done, info, played)


def query_expert(
    problem: Problem, key: jax.Array, env_state: PyTree, observation: jax.Array
) -> jax.Array:
    """The expert's action in every environment, [W, A]."""
    assert problem.expert is not None  # see `make_ppo_lagrangian`
    keys = jax.random.split(key, problem.config.num_envs)
    ask = jax.vmap(problem.expert, in_axes=(0, 0, 0, None))
    return in_single(ask(keys, env_state, observation, problem.params))


def rollout(problem: Problem, learner: PPOLearner) -> tuple[PPOLearner, Rollout]:
    """`rollout_steps` steps of every environment with the noisy policy, [T, W]."""
    network, inputs = learner.learned.policy.params, learner.learned.inputs

    def step(learner: PPOLearner, _: None) -> tuple[PPOLearner, Rollout]:
        key, key_act, key_step = jax.random.split(learner.key, 3)
        observation, before = learner.observation, learner.env_state
        mean = problem.policy.apply(network["mean"], scaled(problem, inputs, observation))
        noise = jax.random.normal(key_act, mean.shape, jnp.float32)
        action = mean + jnp.exp(network["log_std"]) * noise
        learner, row = step_envs(problem, key_step, dataclasses.replace(learner, key=key), action)
        reward, terminated, done, info, played = row
        guided = problem.config.guided
        return learner, Rollout(
            observation=observation,
            action=action,
            final_observation=info.final_observation,
            reward=reward + jnp.where(info.success, learner.hparams.success_bonus, 0.0),
            cost=info.cost,
            terminated=terminated,
            done=done,
            success=info.success,
            expert_actions=query_expert(problem, key_act, before, observation)
            if guided
            else action,
            ended=played,
        )

    return jax.lax.scan(step, learner, None, length=problem.config.rollout_steps)


def values(problem: Problem, learned: PPOLearned, inputs: jax.Array) -> jax.Array:
    """Both critics in the units of reward and cost, [..., O] -> [..., 2]."""
    raw = jax.vmap(problem.critic.apply, in_axes=(0, None), out_axes=-1)(
        learned.critics.params, inputs
    )
    return raw[..., 0, :] * value_unit(learned.returns)


def value_unit(returns: RunningStats) -> jax.Array:
    """Root of the mean squared target of each critic, [2]; 1 before anything was seen."""
    return jnp.where(returns.count > 0, jnp.sqrt(returns.mean) + 1e-3, 1.0)
