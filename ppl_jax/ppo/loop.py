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
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.algorithms.base import Learned, adam_step, init_learned
from ppl_jax.distributions import gaussian_log_prob, log_likelihood
from ppl_jax.experts import SavedPolicy
from ppl_jax.losses import Metrics
from ppl_jax.networks import layers, make_policy, make_raw
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from ppl_jax.ppo.losses import (
    Multiplier,
    RunningStats,
    advantages,
    clip_grads,
    clipped_loss,
    gaussian_divergence,
    init_multiplier,
    init_running_stats,
    mean_of_ended,
    update_multiplier,
)
from ppl_jax.types import Env, Expert, PyTree

LAST_LAYER = 0.01  # the policy's last layer starts so much smaller: the first actions are near 0
LEAST_SCALE = 0.1  # of an input, in the world's own scale: what hardly varies is not blown up
CLONING_RATE = 1e-3  # Adam, falling to 0
CLONING_BATCH = 1024


@flax.struct.dataclass
class PPOLearned:
    """What updates change.

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
    """Sums over the running episode of each world, [W]."""

    reward: jax.Array
    cost: jax.Array
    length: jax.Array


@flax.struct.dataclass
class PPOLearner:
    """All of a run's state, one pytree.

    Attributes:
        learned: `PPOLearned`.
        env_state: [W] worlds.
        observation: [W, O] of them.
        played: `Played`.
        key: Random key.
        hparams: `PPOHParams`.
        batches: Batches so far.
        diverged: A loss was not finite: what was learned stays as it was before.
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
    advice: jax.Array  # what the expert would have done; the action itself where nobody is asked
    ended: Played  # of the episode, up to and with this step


@flax.struct.dataclass
class Batch:
    """A rollout as it is learnt from, [N] steps.

    Attributes:
        inputs: [N, O] scaled observations.
        action, advice: [N, A].
        mean, log_std: [N, A], [A] of the policy that played.
        log_prob: [N] that it gave the action.
        gain, cost_gain: [N] A standardised, A_C centred.
        target: [N, 2] of the critics, in their unit.
    """

    inputs: jax.Array
    action: jax.Array
    advice: jax.Array
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
    """What `make_ppo_lagrangian` returns; all pure, jittable and vmappable.

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


def make_ppo_lagrangian(
    env: Env, config: PPOConfig, env_params: PyTree | None = None, expert: Expert | None = None
) -> PPOFunctions:
    """Build the functions that train one expert.

    Args:
        env: Any world; without costs this is PPO.
        config: Static settings; check them with `ppl_jax.ppo.config.validate` first.
        env_params: The world's parameters; its training ones where None.
        expert: Demonstrates, where `config.demonstrations` asks for it.

    Raises:
        ValueError: If demonstrations are asked for and there is no expert.
    """
    for field in ("demonstrations", "guided"):
        if getattr(config, field) and expert is None:
            raise ValueError(f"{field}: {env.name} has no expert to learn from")
    params = env.default_params if env_params is None else env_params
    spec = env.spec
    size = spec.observation_size
    plain = spec._replace(
        observation_mean=np.zeros(size, np.float32), observation_scale=np.ones(size, np.float32)
    )
    policy, critic = make_policy(plain, config.hidden), make_raw(plain, config.hidden, 1)

    def init(key: jax.Array, hparams: PPOHParams) -> PPOLearner:
        key, key_policy, key_critics, key_env = jax.random.split(key, 4)
        hparams = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)
        network = policy.init(key_policy)
        last = f"Dense_{len(config.hidden)}"
        network["params"][last]["kernel"] = LAST_LAYER * network["params"][last]["kernel"]
        log_std = jnp.broadcast_to(jnp.log(hparams.initial_std), (spec.action_size,))
        return PPOLearner(
            learned=PPOLearned(
                policy=init_learned({"mean": network, "log_std": log_std}),
                critics=init_learned(jax.vmap(critic.init)(jax.random.split(key_critics, 2))),
                multiplier=init_multiplier(hparams.initial_multiplier),
                inputs=init_running_stats((size,)),
                returns=init_running_stats((2,)),
            ),
            **start_worlds(key_env),
            key=key,
            hparams=hparams,
            batches=jnp.zeros((), jnp.int32),
            diverged=jnp.zeros((), bool),
        )

    def start_worlds(key: jax.Array) -> dict[str, Any]:
        keys, zero = jax.random.split(key, config.num_envs), jnp.zeros(config.num_envs)
        observation, env_state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
        played = Played(zero, zero, zero)
        return {"observation": observation, "env_state": env_state, "played": played}

    def centre_and_scale(inputs: RunningStats) -> tuple[jax.Array, jax.Array]:
        mean, scale = jnp.asarray(spec.observation_mean), jnp.asarray(spec.observation_scale)
        if config.scaling == "world":
            return mean, scale
        seen = inputs.count > 0
        spread = jnp.maximum(jnp.sqrt(inputs.variance), LEAST_SCALE * scale)
        return jnp.where(seen, inputs.mean, mean), jnp.where(seen, spread, scale)

    def scaled(inputs: RunningStats, observation: jax.Array) -> jax.Array:
        mean, scale = centre_and_scale(inputs)
        return (observation - mean) / scale

    def values(learned: PPOLearned, inputs: jax.Array) -> jax.Array:
        """Both critics in the units of reward and cost, [..., O] -> [..., 2]."""
        raw = jax.vmap(critic.apply, in_axes=(0, None), out_axes=-1)(learned.critics.params, inputs)
        return raw[..., 0, :] * unit(learned.returns)

    def unit(returns: RunningStats) -> jax.Array:
        return jnp.where(returns.count > 0, jnp.sqrt(returns.mean) + 1e-3, 1.0)

    def step_worlds(key: jax.Array, learner: PPOLearner, action: jax.Array) -> Any:
        """One step of every world with clipped actions; (learner, rollout row less observation)."""
        observation, env_state, reward, terminated, truncated, info = jax.vmap(
            env.step, in_axes=(0, 0, 0, None)
        )(
            jax.random.split(key, config.num_envs),
            learner.env_state,
            jnp.clip(action, -1.0, 1.0),
            params,
        )
        played = Played(
            learner.played.reward + reward,
            learner.played.cost + info.cost,
            learner.played.length + 1,
        )
        done = terminated | truncated
        learner = dataclasses.replace(
            learner,
            env_state=env_state,
            observation=observation,
            played=jax.tree.map(lambda total: jnp.where(done, 0.0, total), played),
        )
        return learner, (reward, terminated, done, info, played)

    def query_expert(key: jax.Array, env_state: PyTree, observation: jax.Array) -> jax.Array:
        """The expert's action in every world, [W, A]."""
        assert expert is not None  # see `make_ppo_lagrangian`
        keys = jax.random.split(key, config.num_envs)
        return jax.vmap(expert, in_axes=(0, 0, 0, None))(keys, env_state, observation, params)

    def rollout(learner: PPOLearner) -> tuple[PPOLearner, Rollout]:
        network, inputs = learner.learned.policy.params, learner.learned.inputs

        def step(learner: PPOLearner, _: None) -> tuple[PPOLearner, Rollout]:
            key, key_act, key_step = jax.random.split(learner.key, 3)
            observation, before = learner.observation, learner.env_state
            mean = policy.apply(network["mean"], scaled(inputs, observation))
            noise = jax.random.normal(key_act, mean.shape)
            action = mean + jnp.exp(network["log_std"]) * noise
            learner, row = step_worlds(key_step, dataclasses.replace(learner, key=key), action)
            reward, terminated, done, info, played = row
            return learner, Rollout(
                observation,
                action,
                info.final_observation,
                reward + learner.hparams.success_bonus * info.success,
                info.cost,
                terminated,
                done,
                info.success,
                query_expert(key_act, before, observation) if config.guided else action,
                played,
            )

        return jax.lax.scan(step, learner, None, length=config.rollout_steps)

    def prepare(
        learned: PPOLearned, steps: Rollout, hparams: PPOHParams
    ) -> tuple[PPOLearned, Batch, Metrics]:
        """Advantages, targets and densities of a batch before it is learnt from."""
        inputs = scaled(learned.inputs, steps.observation)
        before = values(learned, inputs)
        after = values(learned, scaled(learned.inputs, steps.final_observation))
        signal = jnp.stack([steps.reward, steps.cost], -1)
        over = hparams.terminate_on_cost * steps.cost > 0
        ends = (steps.terminated | over)[..., None], (steps.done | over)[..., None]
        discount = jnp.stack([hparams.discount, hparams.cost_discount])
        gain = advantages(signal, before, after, *ends, discount, hparams.gae_lambda)
        inputs, action, advice, gain, target = (
            jnp.reshape(x, (config.batch_steps, -1))
            for x in (inputs, steps.action, steps.advice, gain, gain + before)
        )
        returns = learned.returns.add(target**2)
        gain, spread = gain - jnp.mean(gain, 0), jnp.std(gain, 0)
        mean = policy.apply(learned.policy.params["mean"], inputs)
        log_std = learned.policy.params["log_std"]
        batch = Batch(
            inputs=inputs,
            action=action,
            advice=advice,
            mean=mean,
            log_std=log_std,
            log_prob=gaussian_log_prob(mean, log_std, action),
            gain=gain[:, 0] / (spread[0] + 1e-8),
            cost_gain=gain[:, 1],
            target=target / unit(returns),
        )
        metrics = {"advantage_std": spread[0], "cost_advantage_std": spread[1]}
        return dataclasses.replace(learned, returns=returns), batch, metrics

    def improve(
        learned: PPOLearned, made: Batch, key: jax.Array, hparams: PPOHParams, batch: jax.Array
    ) -> tuple[PPOLearned, Metrics]:
        """The epochs over one batch."""
        multiplier = learned.multiplier.value
        progress = batch / config.batches
        rate = hparams.learning_rate * jnp.clip(1.0 - progress, 0.0, 1.0)
        shrunk = jnp.log(hparams.final_std) - jnp.log(hparams.initial_std)
        most_log_std = jnp.log(hparams.initial_std) + progress * shrunk
        critics_only = batch < config.critic_batches

        def policy_loss(network: Any, rows: Batch) -> tuple[jax.Array, jax.Array]:
            mean, log_std = policy.apply(network["mean"], rows.inputs), network["log_std"]
            new = gaussian_log_prob(mean, log_std, rows.action)
            loss = clipped_loss(new, rows.log_prob, rows.gain, hparams.clip)
            # max(rho A, clip(rho) A) = -min(rho (-A), clip(rho) (-A))
            cost = clipped_loss(new, rows.log_prob, -rows.cost_gain, hparams.clip)
            loss, entropy = loss + multiplier * cost, jnp.sum(log_std)
            away = gaussian_divergence(rows.mean, rows.log_std, mean, log_std)
            total = loss / (1 + multiplier) - hparams.entropy_coef * entropy
            if config.guided:
                likely = log_likelihood(mean, rows.advice, config.cloning)
                total = total - hparams.guidance_weight * jnp.mean(likely)
            return total, jnp.mean(away)

        def critic_loss(networks: Any, rows: Batch) -> jax.Array:
            raw = jax.vmap(critic.apply, in_axes=(0, None), out_axes=-1)(networks, rows.inputs)
            return jnp.mean(jnp.sum((raw[..., 0, :] - rows.target) ** 2, -1))

        def minibatch(carry: Any, at: jax.Array) -> Any:
            actor, critics, stop = carry
            rows = made.rows(at)

            def move(actor: Learned) -> tuple[Learned, tuple[jax.Array, jax.Array]]:
                grads, away = jax.grad(policy_loss, has_aux=True)(actor.params, rows)
                actor = adam_step(actor, clip_grads(grads, hparams.max_grad_norm), rate)
                log_std = jnp.minimum(actor.params["log_std"], most_log_std)
                log_std = jnp.maximum(log_std, jnp.log(hparams.min_std))
                moved = actor.params | {"log_std": log_std}
                return dataclasses.replace(actor, params=moved), (away, jnp.ones(()))

            def stay(actor: Learned) -> tuple[Learned, tuple[jax.Array, jax.Array]]:
                return actor, (jnp.zeros(()), jnp.zeros(()))

            actor, moved = jax.lax.cond(stop, stay, move, actor)
            loss, grads = jax.value_and_grad(critic_loss)(critics.params, rows)
            critics = adam_step(critics, clip_grads(grads, hparams.max_grad_norm), rate)
            return (actor, critics, stop), (*moved, loss)

        def epoch(carry: Any, key: jax.Array) -> Any:
            order = jax.random.permutation(key, config.batch_steps)
            at = jnp.reshape(order, (config.num_minibatches, -1))
            (actor, critics, stop), (away, moved, loss) = jax.lax.scan(minibatch, carry, at)
            away = jnp.sum(away) / jnp.maximum(jnp.sum(moved), 1)
            stop = stop | (away > hparams.target_kl)
            return (actor, critics, stop), (away, jnp.mean(moved), jnp.mean(loss))

        keys = jax.random.split(key, config.epochs)
        carry = (learned.policy, learned.critics, critics_only)
        (actor, critics, _), (away, epochs, loss) = jax.lax.scan(epoch, carry, keys)
        return dataclasses.replace(learned, policy=actor, critics=critics), {
            "loss_critics": jnp.mean(loss),
            "divergence": jnp.max(away),
            "epochs": jnp.sum(epochs),
            "action_std": jnp.mean(jnp.exp(actor.params["log_std"])),
        }

    def iterate(learner: PPOLearner, _: None) -> tuple[PPOLearner, Metrics]:
        learner, steps = rollout(learner)
        key, key_improve = jax.random.split(learner.key)
        hparams, before = learner.hparams, learner.learned
        cost, known = mean_of_ended(steps.ended.cost, steps.done)
        learned = dataclasses.replace(
            before,
            multiplier=update_multiplier(
                before.multiplier, cost, hparams.cost_limit, hparams.lagrangian_lr, known
            ),
        )
        learned, batch, metrics = prepare(learned, steps, hparams)
        learned, more = improve(learned, batch, key_improve, hparams, learner.batches)
        seen = jnp.reshape(steps.observation, (config.batch_steps, size))
        learned = dataclasses.replace(learned, inputs=learned.inputs.add(seen))
        metrics |= more
        finite = jnp.all(jnp.isfinite(jnp.stack(list(metrics.values()))))
        diverged = learner.diverged | ~finite
        kept = jax.tree.map(lambda new, old: jnp.where(diverged, old, new), learned, before)
        metrics |= {
            "episodes": jnp.sum(steps.done),
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

    def run(learner: PPOLearner, batches: int) -> tuple[PPOLearner, Metrics]:
        return jax.lax.scan(iterate, learner, None, length=batches)

    def clone(learner: PPOLearner) -> tuple[PPOLearner, Metrics]:
        """The expert shows under noise what to do, as in DART (Laskey et al. 2017), and is cloned.

        What is cloned is its action without the noise, which shows it how to get back. In every
        round after the first the clone plays, under the same noise, and the expert says what it
        would have done; the clone learns from all rounds so far (DAgger; Ross et al. 2011).
        """
        rounds = config.demonstration_rounds
        stride = config.demonstration_stride
        length = -(-config.demonstrations // (config.num_envs * rounds * stride))
        updates = config.cloning_updates // rounds

        def one_round(carry: Any, number: jax.Array) -> Any:
            learner, cloned, inputs, kept = carry

            def show(learner: PPOLearner, _: None) -> Any:
                key, key_expert, key_noise, key_step = jax.random.split(learner.key, 4)
                observation = learner.observation
                shown = query_expert(key_expert, learner.env_state, observation)
                own = policy.apply(cloned.average["mean"], scaled(inputs, observation))
                action = jnp.where(number == 0, shown, own)
                noise = learner.hparams.demonstration_noise * jax.random.normal(
                    key_noise, action.shape
                )
                learner = dataclasses.replace(learner, key=key)
                learner, row = step_worlds(key_step, learner, action + noise)
                apart = jnp.sum(jnp.abs(jnp.clip(own, -1.0, 1.0) - shown), -1)
                return learner, (apart, observation, shown, row[3].success, row[2])

            def show_some(learner: PPOLearner, _: None) -> Any:
                learner, (apart, *pairs, success, done) = jax.lax.scan(
                    show, learner, None, length=stride
                )
                most = jnp.argmax(apart, 0)[None, :, None]
                pairs = (jnp.take_along_axis(x, most, 0)[0] for x in pairs)
                return learner, (*pairs, success, done)

            learner, (*pairs, success, done) = jax.lax.scan(show_some, learner, None, length=length)
            inputs = inputs.add(jnp.reshape(pairs[0], (-1, size)))
            kept = [
                jax.lax.dynamic_update_slice(to, jnp.reshape(x, (-1, x.shape[-1])), (at, 0))
                for to, x, at in zip(
                    kept, pairs, 2 * [number * length * config.num_envs], strict=True
                )
            ]
            count = (number + 1) * length * config.num_envs

            def update(learned: Learned, at: Any) -> tuple[Learned, jax.Array]:
                key, progress = at
                chosen = jax.random.randint(key, (CLONING_BATCH,), 0, count)
                seen, action = scaled(inputs, kept[0][chosen]), kept[1][chosen]

                def loss(network: Any) -> jax.Array:
                    mean = policy.apply(network["mean"], seen)
                    return -jnp.mean(log_likelihood(mean, action, config.cloning))

                value, grads = jax.value_and_grad(loss)(learned.params)
                return adam_step(learned, grads, CLONING_RATE * (1.0 - progress)), value

            key, key_updates = jax.random.split(learner.key)
            learner = dataclasses.replace(learner, key=key)
            progress = (number + jnp.arange(updates) / max(updates, 1)) / rounds
            each = (jax.random.split(key_updates, updates), progress)
            cloned, losses = jax.lax.scan(update, cloned, each)
            return (learner, cloned, inputs, kept), {
                "loss": jnp.sum(losses) / max(updates, 1),
                "success_rate": mean_of_ended(success, done)[0],
            }

        total = rounds * length * config.num_envs
        kept = [jnp.zeros((total, width)) for width in (size, spec.action_size)]
        carry = (learner, learner.learned.policy, learner.learned.inputs, kept)
        carry, metrics = jax.lax.scan(one_round, carry, jnp.arange(rounds))
        learner, cloned, inputs, _ = carry
        start = init_learned(cloned.average)  # PPO's Adam starts anew
        learned = dataclasses.replace(learner.learned, policy=start, inputs=inputs)
        learner = dataclasses.replace(learner, learned=learned, **start_worlds(learner.key))
        return learner, {
            "clone/loss": metrics["loss"][-1],
            "clone/success_rate": metrics["success_rate"][0],
            "clone/last_success_rate": metrics["success_rate"][-1],
        }

    def saved(learner: PPOLearner) -> SavedPolicy:
        network = learner.learned.policy.average
        mean, scale = centre_and_scale(learner.learned.inputs)
        return SavedPolicy(
            layers(network["mean"]), "relu", "tanh", mean, scale, log_std=network["log_std"]
        )

    def critics(learner: PPOLearner, observation: jax.Array) -> jax.Array:
        return values(learner.learned, scaled(learner.learned.inputs, observation))

    return PPOFunctions(init, clone, run, saved, critics)
