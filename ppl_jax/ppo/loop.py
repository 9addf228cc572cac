"""PPO-Lagrangian: trains a neural expert to earn reward within a limit on cost.

    max_pi J(pi)  subject to  J_C(pi) <= d          (d: mean cost per episode)

by PPO on the reward's and the cost's advantages with a multiplier that rises while the cost is
above its limit (Ray, Achiam and Amodei 2019, "Benchmarking Safe Exploration in Deep Reinforcement
Learning"):

    lambda = softplus(p),   p <- p + Adam(J_C - d)          once per batch, before the policy
    min over theta of [ L(A) + lambda L_c(A_C) ] / (1 + lambda)
    L(A)     = -E[ min(rho A,   clip(rho, 1 - e, 1 + e) A)   ]    A   standardised
    L_c(A_C) =  E[ max(rho A_C, clip(rho, 1 - e, 1 + e) A_C) ]    A_C centred only

As A is divided by its standard deviation s, the multiplier in units of the reward is lambda s
(`train/multiplier` times `train/advantage_std`). Beside the published recipe: the cost's ratio is
clipped too; the policy's updates of a batch stop at the first epoch whose divergence from the
policy that played exceeds `target_kl`; where no episode ended, the multiplier stays; a policy
that is `guided` also keeps to what an expert would do where it went,

    - w E[ log pi(expert's action) ],    w: `guidance_weight`, log pi: `PPOConfig.cloning`

as the demonstration-augmented gradient of Rajeswaran et al. (2018, "Learning Complex Dexterous
Manipulation") keeps to demonstrations.

The policy is a Gaussian around tanh of a network of the scaled observation, clipped to the action
box where it acts.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.distributions import gaussian_log_prob, log_likelihood
from ppl_jax.experts import SavedPolicy
from ppl_jax.learned import Learned, adam_step, all_finite, init_learned
from ppl_jax.losses import Metrics
from ppl_jax.networks import layers
from ppl_jax.ppo.cloning import clone
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from ppl_jax.ppo.losses import (
    advantages,
    clip_grads,
    clipped_loss,
    gaussian_divergence,
    init_multiplier,
    init_running_stats,
    mean_of_ended,
    update_multiplier,
)
from ppl_jax.ppo.rollout import (
    PPOLearned,
    PPOLearner,
    Problem,
    Rollout,
    centre_and_scale,
    make_problem,
    rollout,
    scaled,
    start_envs,
    value_unit,
    values,
)
from ppl_jax.types import Env, Expert, PyTree

LAST_LAYER = 0.01  # factor on the policy's last layer at the start: the first actions are near 0


@flax.struct.dataclass
class Batch:
    """A rollout as it is learnt from, [N] steps.

    Attributes:
        inputs: [N, O] scaled observations.
        action, expert_actions: [N, A].
        mean, log_std: [N, A], [A] of the policy that played.
        log_prob: [N] that it gave the action.
        gain, cost_gain: [N] A standardised, A_C centred.
        target: [N, 2] of the critics, in their unit.
    """

    inputs: jax.Array
    action: jax.Array
    expert_actions: jax.Array
    mean: jax.Array
    log_std: jax.Array
    log_prob: jax.Array
    gain: jax.Array
    cost_gain: jax.Array
    target: jax.Array

    def rows(self, at: jax.Array) -> Batch:
        """The steps of these numbers."""
        chosen = jax.tree.map(lambda x: x[at], dataclasses.replace(self, log_std=None))
        return dataclasses.replace(chosen, log_std=self.log_std)


class PPOFunctions(NamedTuple):
    """Functions that `make_ppo_lagrangian` returns; all pure, jittable and vmappable.

    Attributes:
        init: `init(key, hparams) -> PPOLearner`.
        clone: `clone(learner) -> (learner, Metrics)`: demonstrations, and the policy cloned from
            them, where the settings name any; metrics say how often who played succeeded in the
            first round and in the last.
        run: `run(learner, batches) -> (learner, Metrics)` for a static number of batches; metrics
            carry a leading [batches] axis.
        policy: `policy(learner) -> SavedPolicy` with its `log_std`.
        critics: `critics(learner, observation [..., O]) -> [..., 2]`: values of reward and cost.
    """

    init: Callable[[jax.Array, PPOHParams], PPOLearner]
    clone: Callable[[PPOLearner], tuple[PPOLearner, Metrics]]
    run: Callable[[PPOLearner, int], tuple[PPOLearner, Metrics]]
    policy: Callable[[PPOLearner], SavedPolicy]
    critics: Callable[[PPOLearner, jax.Array], jax.Array]


def init(problem: Problem, key: jax.Array, hparams: PPOHParams) -> PPOLearner:
    """The state of a run before its first batch."""
    key, key_policy, key_critics, key_env = jax.random.split(key, 4)
    hparams = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)
    network = problem.policy.init(key_policy)
    last = f"Dense_{len(problem.config.hidden)}"
    network["params"][last]["kernel"] = LAST_LAYER * network["params"][last]["kernel"]
    log_std = jnp.broadcast_to(jnp.log(hparams.initial_std), (problem.env.spec.action_size,))
    return PPOLearner(
        learned=PPOLearned(
            policy=init_learned({"mean": network, "log_std": log_std}),
            critics=init_learned(jax.vmap(problem.critic.init)(jax.random.split(key_critics, 2))),
            multiplier=init_multiplier(hparams.initial_multiplier),
            inputs=init_running_stats((problem.env.spec.observation_size,)),
            returns=init_running_stats((2,)),
        ),
        **start_envs(problem, key_env),
        key=key,
        hparams=hparams,
        batches=jnp.zeros((), jnp.int32),
        diverged=jnp.zeros((), bool),
    )


def prepare(
    problem: Problem, learned: PPOLearned, steps: Rollout, hparams: PPOHParams
) -> tuple[PPOLearned, Batch, Metrics]:
    """Advantages, targets and densities of a batch before it is learnt from."""
    inputs = scaled(problem, learned.inputs, steps.observation)
    before = values(problem, learned, inputs)
    after = values(problem, learned, scaled(problem, learned.inputs, steps.final_observation))
    signal = jnp.stack([steps.reward, steps.cost], -1)
    over = hparams.terminate_on_cost * steps.cost > 0
    ends = (steps.terminated | over)[..., None], (steps.done | over)[..., None]
    discount = jnp.stack([hparams.discount, hparams.cost_discount])
    terminated, done = ends
    gain = advantages(
        signal,
        before,
        after,
        terminated,
        done=done,
        discount=discount,
        gae_lambda=hparams.gae_lambda,
    )
    inputs, action, expert_actions, gain, target = (
        jnp.reshape(x, (problem.config.batch_steps, -1))
        for x in (inputs, steps.action, steps.expert_actions, gain, gain + before)
    )
    returns = learned.returns.add(target**2)
    gain, spread = gain - jnp.mean(gain, 0), jnp.std(gain, 0)
    mean = problem.policy.apply(learned.policy.params["mean"], inputs)
    log_std = learned.policy.params["log_std"]
    batch = Batch(
        inputs=inputs,
        action=action,
        expert_actions=expert_actions,
        mean=mean,
        log_std=log_std,
        log_prob=gaussian_log_prob(mean, log_std, action),
        gain=gain[:, 0] / (spread[0] + 1e-8),
        cost_gain=gain[:, 1],
        target=target / value_unit(returns),
    )
    metrics = {"advantage_std": spread[0], "cost_advantage_std": spread[1]}
    return dataclasses.replace(learned, returns=returns), batch, metrics


def policy_loss(
    network: Any,
    rows: Batch,
    *,
    problem: Problem,
    hparams: PPOHParams,
    multiplier: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The policy's objective on a minibatch, and its mean KL from the policy that played.

    Args:
        network: {"mean": network, "log_std": [A]}.
        rows: Steps [N].
        problem: Networks and static settings.
        hparams: Traced settings.
        multiplier: lambda.
    """
    mean, log_std = problem.policy.apply(network["mean"], rows.inputs), network["log_std"]
    chex.assert_equal_shape([mean, rows.mean, rows.action, rows.expert_actions])
    chex.assert_equal_shape([rows.log_prob, rows.gain, rows.cost_gain])
    new = gaussian_log_prob(mean, log_std, rows.action)
    loss = clipped_loss(new, rows.log_prob, rows.gain, hparams.clip)
    # max(rho A, clip(rho) A) = -min(rho (-A), clip(rho) (-A))
    cost = clipped_loss(new, rows.log_prob, -rows.cost_gain, hparams.clip)
    loss, entropy = loss + multiplier * cost, jnp.sum(log_std)
    away = gaussian_divergence(rows.mean, rows.log_std, mean, log_std)
    total = loss / (1 + multiplier) - hparams.entropy_coef * entropy
    if problem.config.guided:
        likely = log_likelihood(mean, rows.expert_actions, problem.config.cloning)
        total = total - hparams.guidance_weight * jnp.mean(likely)
    return total, jnp.mean(away)


def critic_loss(networks: Any, rows: Batch, *, problem: Problem) -> jax.Array:
    """Mean over steps of both critics' squared errors, in the unit of their targets."""
    raw = jax.vmap(problem.critic.apply, in_axes=(0, None), out_axes=-1)(networks, rows.inputs)
    chex.assert_equal_shape([raw[..., 0, :], rows.target])
    return jnp.mean(jnp.sum((raw[..., 0, :] - rows.target) ** 2, -1))


class Update(NamedTuple):
    """Fixed quantities of the updates on one batch.

    Attributes:
        problem: Networks and static settings.
        batch: Its steps.
        hparams: Traced settings.
        multiplier: lambda.
        rate: Adam's learning rate.
        most_log_std: Upper bound on the log standard deviation.
    """

    problem: Problem
    batch: Batch
    hparams: PPOHParams
    multiplier: jax.Array
    rate: jax.Array
    most_log_std: jax.Array


def minibatch(update: Update, carry: Any, at: jax.Array) -> Any:
    """One update of the critics and, until `stop`, of the policy; `at` numbers the steps."""
    actor, critics, stop = carry
    hparams, rows = update.hparams, update.batch.rows(at)
    objective = functools.partial(
        policy_loss, problem=update.problem, hparams=hparams, multiplier=update.multiplier
    )

    def move(actor: Learned) -> tuple[Learned, tuple[jax.Array, jax.Array]]:
        grads, away = jax.grad(objective, has_aux=True)(actor.params, rows)
        actor = adam_step(actor, clip_grads(grads, hparams.max_grad_norm), update.rate)
        log_std = jnp.minimum(actor.params["log_std"], update.most_log_std)
        log_std = jnp.maximum(log_std, jnp.log(hparams.min_std))
        moved = actor.params | {"log_std": log_std}
        return dataclasses.replace(actor, params=moved), (away, jnp.ones((), jnp.float32))

    def stay(actor: Learned) -> tuple[Learned, tuple[jax.Array, jax.Array]]:
        return actor, (jnp.zeros((), jnp.float32), jnp.zeros((), jnp.float32))

    actor, moved = jax.lax.cond(stop, stay, move, actor)
    errors = functools.partial(critic_loss, problem=update.problem)
    loss, grads = jax.value_and_grad(errors)(critics.params, rows)
    critics = adam_step(critics, clip_grads(grads, hparams.max_grad_norm), update.rate)
    return (actor, critics, stop), (*moved, loss)


def epoch(update: Update, carry: Any, key: jax.Array) -> Any:
    """One pass over the batch in random order; `stop` is set beyond `target_kl`."""
    config = update.problem.config
    order = jax.random.permutation(key, config.batch_steps)
    at = jnp.reshape(order, (config.num_minibatches, -1))
    (actor, critics, stop), (away, moved, loss) = jax.lax.scan(
        functools.partial(minibatch, update), carry, at
    )
    away = jnp.sum(away) / jnp.maximum(jnp.sum(moved), 1)
    stop = stop | (away > update.hparams.target_kl)
    return (actor, critics, stop), (away, jnp.mean(moved), jnp.mean(loss))


def improve(
    problem: Problem,
    learned: PPOLearned,
    batch: Batch,
    key: jax.Array,
    *,
    hparams: PPOHParams,
    number: jax.Array,
) -> tuple[PPOLearned, Metrics]:
    """The epochs over one batch.

    Args:
        problem: Networks and static settings.
        learned: Before.
        batch: Its steps.
        key: Random key.
        hparams: Traced settings.
        number: Batches before this one.
    """
    multiplier = learned.multiplier.value
    progress = number / problem.config.batches
    rate = hparams.learning_rate * jnp.clip(1.0 - progress, 0.0, 1.0)
    shrunk = jnp.log(hparams.final_std) - jnp.log(hparams.initial_std)
    update = Update(
        problem=problem,
        batch=batch,
        hparams=hparams,
        multiplier=multiplier,
        rate=rate,
        most_log_std=jnp.log(hparams.initial_std) + progress * shrunk,
    )
    keys = jax.random.split(key, problem.config.epochs)
    carry = (learned.policy, learned.critics, number < problem.config.critic_batches)
    (actor, critics, _), (away, epochs, loss) = jax.lax.scan(
        functools.partial(epoch, update), carry, keys
    )
    return dataclasses.replace(learned, policy=actor, critics=critics), {
        "loss_critics": jnp.mean(loss),
        "divergence": jnp.max(away),
        "epochs": jnp.sum(epochs),
        "action_std": jnp.mean(jnp.exp(actor.params["log_std"])),
    }


def iterate(problem: Problem, learner: PPOLearner, _: None) -> tuple[PPOLearner, Metrics]:
    """One batch: play, move the multiplier, learn."""
    learner, steps = rollout(problem, learner)
    key, key_improve = jax.random.split(learner.key)
    hparams, before = learner.hparams, learner.learned
    cost, known = mean_of_ended(steps.ended.cost, steps.done)
    learned = dataclasses.replace(
        before,
        multiplier=update_multiplier(
            before.multiplier, cost, hparams.cost_limit, hparams.lagrangian_lr, known=known
        ),
    )
    learned, batch, metrics = prepare(problem, learned, steps, hparams)
    learned, more = improve(
        problem, learned, batch, key_improve, hparams=hparams, number=learner.batches
    )
    seen = jnp.reshape(steps.observation, (problem.config.batch_steps, -1))
    learned = dataclasses.replace(learned, inputs=learned.inputs.add(seen))
    metrics |= more
    diverged = learner.diverged | ~all_finite((metrics, learned))
    kept = jax.tree.map(lambda new, old: jnp.where(diverged, old, new), learned, before)
    metrics |= {
        "episodes": jnp.sum(steps.done, dtype=jnp.int32),
        "episodic_return": mean_of_ended(steps.ended.reward, steps.done)[0],
        "episodic_cost": cost,
        "episode_length": mean_of_ended(steps.ended.length, steps.done)[0],
        "success_rate": mean_of_ended(steps.success, steps.done)[0],
        "multiplier": kept.multiplier.value,
    }
    learner = dataclasses.replace(
        learner, learned=kept, key=key, batches=learner.batches + 1, diverged=diverged
    )
    return learner, {f"train/{name}": value for name, value in metrics.items()}


def run(problem: Problem, learner: PPOLearner, batches: int) -> tuple[PPOLearner, Metrics]:
    """A static number of batches; metrics [batches]."""
    return jax.lax.scan(functools.partial(iterate, problem), learner, None, length=batches)


def saved(problem: Problem, learner: PPOLearner) -> SavedPolicy:
    """The averaged policy as plain arrays, with its `log_std`."""
    network = learner.learned.policy.average
    mean, scale = centre_and_scale(problem, learner.learned.inputs)
    return SavedPolicy(
        weights=layers(network["mean"]),
        activation="relu",
        output="tanh",
        obs_mean=mean,
        obs_scale=scale,
        log_std=network["log_std"],
    )


def critics(problem: Problem, learner: PPOLearner, observation: jax.Array) -> jax.Array:
    """Values of reward and cost, [..., O] -> [..., 2]."""
    return values(problem, learner.learned, scaled(problem, learner.learned.inputs, observation))


def make_ppo_lagrangian(
    env: Env, config: PPOConfig, env_params: PyTree | None = None, expert: Expert | None = None
) -> PPOFunctions:
    """The functions that train one expert.

    Args:
        env: Any environment; without costs this is PPO.
        config: Static settings; check them with `ppl_jax.ppo.config.validate` first.
        env_params: The environment's parameters; its training ones where None.
        expert: Demonstrates and guides, where `config` asks for it.

    Raises:
        ValueError: If demonstrations are asked for and there is no expert.
    """
    problem = make_problem(env, config, env_params, expert)
    return PPOFunctions(
        init=functools.partial(init, problem),
        clone=functools.partial(clone, problem),
        run=functools.partial(run, problem),
        policy=functools.partial(saved, problem),
        critics=functools.partial(critics, problem),
    )
