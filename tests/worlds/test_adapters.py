"""Brax environments as ours and ours as theirs; brax's own code as an oracle for ours."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax.evaluation import make_evaluate
from ppl_jax.experts import act
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from ppl_jax.ppo.loop import make_ppo_lagrangian
from ppl_jax.ppo.losses import advantages, init_running_stats
from tests.helpers import Goal

pytest.importorskip("brax", reason="brax is not installed")
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import brax.envs as brax_envs
    from brax.envs.wrappers import training as brax_wrappers

from envs.adapters.brax import FromBrax, make_brax, to_brax

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


@pytest.fixture(scope="module")
def pendulum():
    return make_brax("inverted_pendulum", max_episode_steps=200, held_out=range(1000, 1008))


def test_steps_are_those_of_brax(pendulum):
    params, key = pendulum.default_params, jax.random.key(0)
    ours = jax.jit(pendulum.reset_to)(3, key, params)
    theirs = jax.jit(pendulum.inner.reset)(jax.random.key(params.number[3]))
    step, inner_step = jax.jit(pendulum.transition), jax.jit(pendulum.inner.step)
    for i in range(5):
        np.testing.assert_allclose(pendulum.observe(ours, params), theirs.obs, rtol=1e-5)
        action = jnp.array([0.3 * (-1) ** i])
        ours, outcome = step(key, ours, action, params)
        theirs = inner_step(theirs, action)
        assert float(outcome.reward) == float(theirs.reward)
        assert bool(outcome.terminated) == bool(theirs.done)


def test_the_second_episode_starts_anew(pendulum):
    params, push = pendulum.default_params, jnp.array([1.0])
    step = jax.jit(pendulum.step)
    observation, state = jax.jit(pendulum.reset)(jax.random.key(0), params)
    starts = [np.asarray(observation)]
    for i in range(60):
        observation, state, _, terminated, _, info = step(jax.random.key(i), state, push, params)
        if bool(terminated):
            assert not np.allclose(info.final_observation, observation)
            assert abs(float(info.final_observation[1])) > 0.2  # rad: it has fallen
            starts.append(np.asarray(observation))
    assert len(starts) >= 3
    assert len({tuple(start) for start in starts}) == len(starts)
    assert all(np.abs(start).max() <= 0.011 for start in starts)


def test_ppo_lagrangian_learns_a_stock_brax_environment(pendulum):
    """Kept upright for 200 steps from starts never seen; the untrained policy lets it fall."""
    config = PPOConfig(
        total_steps=60_000, num_envs=16, rollout_steps=64, num_minibatches=4, hidden=(32,)
    )
    made = make_ppo_lagrangian(pendulum, config)
    learner = jax.jit(made.init)(jax.random.key(0), PPOHParams(learning_rate=3e-3))
    batch = jax.jit(lambda learner: made.run(learner, 1)[0])

    @jax.jit
    def score(learner):
        policy = made.policy(learner)
        play = lambda key, state, observation, params: act(policy, observation)  # noqa: E731
        return make_evaluate(pendulum, play)(pendulum.held_out_params, jax.random.key(0))

    assert float(jnp.mean(score(learner).length)) < 100
    for _ in range(config.batches):
        learner = batch(learner)
    assert float(jnp.mean(score(learner).success)) == 1.0


def test_our_world_as_a_brax_environment():
    goal = Goal()
    env = to_brax(goal)
    assert (env.observation_size, env.action_size) == (2, 1)
    env = brax_wrappers.VmapWrapper(env, batch_size=3)
    state = env.reset(jax.random.key(0))
    step = jax.jit(env.step)
    for i in range(25):
        state = step(state, jnp.full((3, 1), 1.0))
        place = min(0.1 * (i % 10 + 1), 1.0)
        np.testing.assert_allclose(state.reward, 0.1, rtol=1e-5)
        np.testing.assert_allclose(state.info["final_observation"][:, 0], place, rtol=1e-4)
        arrived = i % 10 == 9
        assert np.all(np.asarray(state.done) == arrived)
        assert np.all(np.asarray(state.metrics["success"]) == arrived)
        np.testing.assert_allclose(state.obs[:, 0], 0.0 if arrived else place, atol=1e-5)
        assert not np.any(state.info["truncation"])


def test_under_braxs_own_wrappers_resets_are_theirs():
    goal = Goal()
    env = brax_wrappers.wrap(to_brax(goal, auto_reset=False), episode_length=7, action_repeat=1)
    # brax reads the number of worlds off untyped keys
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    step = jax.jit(env.step)
    for i in range(7):
        assert not np.any(state.done), i
        state = step(state, jnp.zeros((2, 1)))
    assert np.all(state.done)
    assert np.all(state.info["truncation"])


def test_a_missing_environment_is_named():
    with pytest.raises(ValueError, match="unknown brax environment 'tightrope': choose one of ant"):
        make_brax("tightrope")
    fast = brax_envs.get_environment("fast", obs_mode="dict_state")
    with pytest.raises(ValueError, match="fast: the observation must be one flat array"):
        FromBrax(fast, "fast")


def test_our_parts_against_braxs():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from brax.training.acme import running_statistics
        from brax.training.agents.ppo.losses import compute_gae

    rng = np.random.default_rng(3)
    steps, worlds = 12, 3
    reward, value = rng.normal(size=(2, steps, worlds)).astype(np.float32)
    terminated = rng.random((steps, worlds)) < 0.2
    following = np.concatenate([value[1:], rng.normal(size=(1, worlds)).astype(np.float32)])
    never = np.zeros((steps, worlds), np.float32)
    # brax's advantages are one more step of TD on its targets, so it is the targets that compare
    targets, _ = compute_gae(never, 1.0 * terminated, reward, value, following[-1], 0.9, 0.95)
    ours = advantages(
        reward, value, following, terminated, done=terminated, discount=0.95, gae_lambda=0.9
    )
    np.testing.assert_allclose(ours + value, targets, rtol=1e-4, atol=1e-5)

    state = running_statistics.init_state(jnp.zeros(4))
    running = init_running_stats((4,))
    for _ in range(3):
        batch = rng.normal(2.0, 3.0, (10, 4)).astype(np.float32)
        state, running = running_statistics.update(state, batch), running.add(batch)
    np.testing.assert_allclose(running.mean, state.mean, rtol=1e-4)
    np.testing.assert_allclose(jnp.sqrt(running.variance), state.std, rtol=1e-4)
