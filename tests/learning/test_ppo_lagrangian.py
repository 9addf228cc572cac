"""PPO-Lagrangian: its parts against NumPy, and what it learns where the answer is known."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax.evaluation import make_evaluate
from ppl_jax.experts import SavedPolicy, act, log_density
from ppl_jax.ppo import config as ppo_config
from ppl_jax.ppo import losses as parts
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from ppl_jax.ppo.loop import make_ppo_lagrangian
from ppl_jax.ppo.losses import advantages, clipped_loss, gaussian_divergence
from tests.helpers import Aim, Endless, Goal, Probe, Spend, Toll, TwoSteps

RNG = np.random.default_rng(2)
TINY = PPOConfig(
    total_steps=400 * 256, num_envs=16, rollout_steps=16, num_minibatches=4, hidden=(16,), epochs=4
)
QUICK = {"learning_rate": 3e-3, "target_kl": 0.05}


def uniform(*shape):
    return RNG.uniform(-1, 1, shape).astype(np.float32)


def coins(*shape):
    return RNG.random(shape) < 0.4


@functools.cache
def functions(world, config=TINY):
    made = make_ppo_lagrangian(world(), config, expert=getattr(world, "scripted_expert", None))
    batch = jax.jit(lambda learner: made.run(learner, 1))  # one program for any number of batches

    def run(learner, batches):
        rows = []
        for _ in range(batches):
            learner, metrics = batch(learner)
            rows.append(metrics)
        return learner, jax.tree.map(lambda *values: np.concatenate(values), *rows)

    return made, run, jax.jit(made.init)


def train(world, batches=200, seed=0, config=TINY, **changes):
    made, run, init = functions(world, config)
    hparams = PPOHParams(**(QUICK | changes))
    return made, *run(init(jax.random.key(seed), hparams), batches)


def score(world, made, learner):
    policy = made.policy(learner)
    env = world()

    def play(key, state, observation, params):
        return act(policy, observation)

    return jax.jit(make_evaluate(env, play))(env.held_out_params, jax.random.key(0))


# --- the parts ---


def test_advantages():
    t, w, discount, gae_lambda = 7, 2, 0.9, 0.8
    reward, value, following, ended = uniform(t, w), uniform(t, w), uniform(t, w), coins(t, w)
    done = ended | coins(t, w)
    expected = np.zeros((t, w))
    for world in range(w):
        advantage = 0.0
        for i in reversed(range(t)):
            after = 0.0 if ended[i, world] else discount * following[i, world]
            delta = reward[i, world] + after - value[i, world]
            carried = 0.0 if done[i, world] else discount * gae_lambda * advantage
            expected[i, world] = advantage = delta + carried
    found = advantages(
        reward, value, following, ended, done=done, discount=discount, gae_lambda=gae_lambda
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_the_clipped_objective():
    new, old, gain = uniform(9), uniform(9), uniform(9)
    expected = 0.0
    for b in range(9):
        ratio = np.exp(new[b] - old[b])
        expected -= min(ratio * gain[b], np.clip(ratio, 0.7, 1.3) * gain[b]) / 9
    assert float(clipped_loss(new, old, gain, 0.3)) == pytest.approx(expected, rel=1e-4)


def test_the_divergence_is_the_integral():
    x = np.linspace(-12, 12, 200_001)

    def density(mean, std):
        return np.exp(-0.5 * ((x - mean) / std) ** 2) / std / np.sqrt(2 * np.pi)

    total = 0.0
    old, new = ((0.3, 0.5), (-0.2, 0.9)), ((0.1, 0.8), (0.4, 0.6))
    for (m, s), (n, t) in zip(old, new, strict=True):
        p, q = density(m, s), density(n, t)
        total += np.sum(np.where(p > 1e-290, p * (np.log(p + 1e-300) - np.log(q + 1e-300)), 0))
    total *= x[1] - x[0]
    (m, s), (n, t) = (np.array(pairs).T for pairs in (old, new))
    assert float(gaussian_divergence(m, np.log(s), n, np.log(t))) == pytest.approx(total, rel=1e-4)


def test_the_multiplier_is_adam_on_softplus():
    limit, rate = 0.5, 0.05
    costs, known = [2.0, 0.1, 0.0, 3.0, 0.4], [True, True, False, True, True]
    multiplier = parts.init_multiplier(1.5)
    p, m, v, count = np.log(np.exp(1.5) - 1), 0.0, 0.0, 0
    assert float(multiplier.value) == pytest.approx(1.5, rel=1e-5)
    for cost, there in zip(costs, known, strict=True):
        multiplier = parts.update_multiplier(
            multiplier, jnp.float32(cost), limit, rate, known=jnp.asarray(there)
        )
        if there:
            count, slope = count + 1, -(cost - limit)
            m, v = 0.9 * m + 0.1 * slope, 0.999 * v + 0.001 * slope**2
            p -= rate * (m / (1 - 0.9**count)) / (np.sqrt(v / (1 - 0.999**count)) + 1e-8)
        assert float(multiplier.value) == pytest.approx(np.log1p(np.exp(p)), rel=1e-4)


def test_running_statistics_are_those_of_everything_seen():
    seen, running = [], parts.init_running_stats((3,))
    for size in (5, 1, 40):
        seen.append(5 + 3 * uniform(size, 3))
        running = running.add(seen[-1])
    everything = np.concatenate(seen)
    assert float(running.count) == len(everything)
    np.testing.assert_allclose(running.mean, everything.mean(0), rtol=1e-5)
    np.testing.assert_allclose(running.variance, everything.var(0), rtol=1e-4)


def test_means_are_over_the_episodes_that_ended():
    values, done = uniform(6, 2), coins(6, 2)
    mean, known = parts.mean_of_ended(values, done)
    assert float(mean) == pytest.approx(values[done].mean(), rel=1e-5)
    assert bool(known)
    mean, known = parts.mean_of_ended(values, np.zeros((6, 2), bool))
    assert float(mean) == 0
    assert not bool(known)


def test_log_density():
    w, b, log_std = uniform(3, 2), uniform(2), uniform(2)
    policy = SavedPolicy([(w, b)], "relu", "tanh", np.zeros(3), np.ones(3), log_std)
    observation, action = uniform(5, 3), uniform(5, 2)
    expected = np.zeros(5)
    for i in range(5):
        for j in range(2):
            mean, std = np.tanh(observation[i] @ w[:, j] + b[j]), np.exp(log_std[j])
            expected[i] += -0.5 * ((action[i, j] - mean) / std) ** 2 - np.log(
                std * np.sqrt(2 * np.pi)
            )
    np.testing.assert_allclose(log_density(policy, observation, action), expected, rtol=1e-4)
    with pytest.raises(ValueError, match="no log_std"):
        log_density(policy._replace(log_std=None), observation, action)


# --- known answers ---


def test_values_of_reward_and_cost():
    made, learner, _ = train(TwoSteps, discount=0.8, cost_discount=0.5)
    values = made.critics(learner, jnp.array([[0.0, 1.0], [1.0, 1.0]]))
    np.testing.assert_allclose(values[:, 0], [0.8, 1.0], atol=0.06)
    np.testing.assert_allclose(values[:, 1], [1.5, 3.0], atol=0.18)


@pytest.mark.parametrize(("ends", "value"), [(0.0, 0.8), (1.0, 0.0)])
def test_a_cost_may_end_what_is_worth_anything(ends, value):
    made, learner, _ = train(Toll, discount=0.8, terminate_on_cost=ends)
    values = made.critics(learner, jnp.array([[0.0, 1.0], [1.0, 1.0]]))
    np.testing.assert_allclose(values[:, 0], [value, 1.0], atol=0.06)


def test_a_time_limit_is_no_end():
    made, learner, _ = train(Endless, discount=0.8, gae_lambda=0.95)
    assert float(made.critics(learner, jnp.ones(2))[0]) == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize("world", [Aim, Goal])
def test_it_solves_the_probe(world):
    made, learner, metrics = train(world)
    assert float(jnp.mean(score(world, made, learner).success)) == 1.0
    assert not bool(learner.diverged)
    assert float(metrics["train/success_rate"][-1]) > 0.8  # with the noise of its actions


def test_the_multiplier_of_the_toy_problem():
    """The known optimum, in units of the reward; without the multiplier the limit is broken."""
    std = 0.2
    fixed = {"initial_std": std, "min_std": std, "cost_limit": 0.5, "lagrangian_lr": 0.1}
    made, learner, metrics = train(Spend, 400, **fixed)
    mean = np.sqrt(1 - std**2) - 1
    last = {name: float(jnp.mean(values[-40:])) for name, values in metrics.items()}
    assert last["train/episodic_cost"] == pytest.approx(0.5, abs=0.05)
    multiplier = last["train/multiplier"] * last["train/advantage_std"]
    assert multiplier == pytest.approx(2 / (1 + mean), rel=0.1)
    assert float(act(made.policy(learner), jnp.array([0.0, 1.0]))[0]) == pytest.approx(
        mean, abs=0.06
    )

    made, learner, metrics = train(
        Spend, **(fixed | {"initial_multiplier": 1e-3, "lagrangian_lr": 0.0})
    )
    assert float(act(made.policy(learner), jnp.array([0.0, 1.0]))[0]) > 0.9
    assert float(metrics["train/episodic_cost"][-1]) > 1.5


def test_cloning_demonstrations_comes_first():
    config = dataclasses.replace(TINY, demonstrations=400, cloning_updates=400, scaling="world")
    made, _, init = functions(Probe, config)
    learner = init(jax.random.key(0), PPOHParams(demonstration_noise=0.05))
    before = float(jnp.mean(score(Probe, made, learner).success))
    learner, metrics = jax.jit(made.clone)(learner)
    assert before == 0
    assert float(jnp.mean(score(Probe, made, learner).success)) == 1.0
    assert float(metrics["clone/success_rate"]) == 1.0
    assert int(learner.batches) == 0


def test_in_later_rounds_the_clone_plays():
    rounds = {"demonstration_rounds": 4, "demonstration_stride": 2}
    config = dataclasses.replace(TINY, demonstrations=2560, scaling="world", **rounds)
    for updates, success in ((0, 0.0), (400, 1.0)):
        made, _, init = functions(Probe, dataclasses.replace(config, cloning_updates=updates))
        learner, metrics = jax.jit(made.clone)(
            init(jax.random.key(0), PPOHParams(demonstration_noise=0.05))
        )
        assert float(metrics["clone/success_rate"]) == 1.0
        assert float(metrics["clone/last_success_rate"]) == success
        assert float(jnp.mean(score(Probe, made, learner).success)) == success


@pytest.mark.parametrize("step", [0, 1])
def test_of_a_stride_the_step_with_the_greatest_disagreement_is_kept(step):
    def expert(key, state, observation, params):
        return jnp.where(state.time == step, 0.9, 0.0)[None]

    config = dataclasses.replace(
        TINY, demonstrations=128, cloning_updates=10, demonstration_stride=2
    )
    made = make_ppo_lagrangian(TwoSteps(), config, expert=expert)
    learner = made.init(jax.random.key(0), PPOHParams(demonstration_noise=0.0))
    learner, _ = jax.jit(made.clone)(learner)
    assert float(learner.learned.inputs.count) == 64
    assert float(learner.learned.inputs.mean[0]) == step  # what is observed is the time


@pytest.mark.parametrize(("weight", "reached"), [(0.0, 1.0), (10.0, -0.5)])
def test_a_guided_policy_keeps_to_the_expert(weight, reached):
    config = dataclasses.replace(TINY, guided=True)
    made = make_ppo_lagrangian(Spend(), config, expert=lambda *_: jnp.array([-0.5]))
    hparams = PPOHParams(guidance_weight=weight, initial_multiplier=1e-3, lagrangian_lr=0.0)
    learner = jax.jit(made.init)(jax.random.key(0), hparams.replace(**QUICK))
    learner, _ = jax.jit(made.run, static_argnums=1)(learner, 200)
    mean = act(made.policy(learner), jnp.array([0.0, 1.0]))[0]
    assert float(mean) == pytest.approx(reached, abs=0.1)


# --- properties ---


def test_updates_stop_at_the_divergence():
    _, _, metrics = train(Goal, 3, target_kl=0.0)
    assert set(np.asarray(metrics["train/epochs"])) == {1.0}
    _, _, metrics = train(Goal, 3, target_kl=1e9)
    assert set(np.asarray(metrics["train/epochs"])) == {float(TINY.epochs)}


def test_at_first_the_critics_alone_learn():
    config = dataclasses.replace(TINY, critic_batches=2)
    _, run, init = functions(Goal, config)
    start = init(jax.random.key(0), PPOHParams())
    learner, _ = run(start, 2)
    same = jax.tree.map(
        lambda a, b: bool(jnp.all(a == b)), start.learned.policy, learner.learned.policy
    )
    assert all(jax.tree.leaves(same))
    moved = start.learned.critics.params, learner.learned.critics.params
    assert not np.allclose(*(jax.tree.leaves(params)[0] for params in moved))
    learner, _ = run(learner, 2)
    assert int(learner.learned.policy.updates) > 0


def test_stopping_and_going_on_is_never_having_stopped():
    made, run, init = functions(Goal)
    start = init(jax.random.key(3), PPOHParams())
    whole, _ = jax.jit(made.run, static_argnums=1)(start, 2)
    halves, _ = run(start, 2)
    for a, b in zip(jax.tree.leaves(whole.learned), jax.tree.leaves(halves.learned), strict=True):
        np.testing.assert_array_equal(a, b)


def test_vmapped_seeds_are_the_single_ones():
    made, run, init = functions(Goal)
    keys = jnp.stack([jax.random.key(seed) for seed in (0, 1)])
    rates = jnp.array([1e-3, 3e-4])

    def both(key, rate):
        return made.run(made.init(key, PPOHParams(learning_rate=rate)), 2)[0].learned

    together = jax.jit(jax.vmap(both))(keys, rates)
    for i in (0, 1):
        alone, _ = run(init(keys[i], PPOHParams(learning_rate=float(rates[i]))), 2)
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone.learned), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=2e-3, atol=2e-4)


def test_a_diverged_run_keeps_what_it_had():
    _, run, init = functions(Goal)
    start = init(jax.random.key(0), PPOHParams())
    hparams = start.hparams.replace(learning_rate=jnp.float32(jnp.inf))
    learner, _ = run(dataclasses.replace(start, hparams=hparams), 1)
    assert bool(learner.diverged)
    for a, b in zip(jax.tree.leaves(start.learned), jax.tree.leaves(learner.learned), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        (
            {"num_minibatches": 7},
            "num_minibatches must divide num_envs x rollout_steps \\(256\\), got 7",
        ),
        ({"critic_batches": -1}, "critic_batches must not be negative, got -1"),
        ({"hidden": ()}, "hidden must name at least one width"),
        ({"learning_rate": float("nan")}, "learning_rate must be a number of 0 or more, got nan"),
        ({"initial_multiplier": 0.0}, "initial_multiplier must be positive, got 0.0"),
        ({"discount": 1.5}, "discount must lie between 0 and 1, got 1.5"),
    ],
)
def test_wrong_settings_are_named(changes, line):
    config, hparams = TINY, PPOHParams()
    for name, value in changes.items():
        if hasattr(config, name):
            config = dataclasses.replace(config, **{name: value})
        else:
            hparams = hparams.replace(**{name: value})
    with pytest.raises(ValueError, match=line):
        ppo_config.validate(config, hparams)
