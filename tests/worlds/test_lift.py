"""Lift: observation, reward, ends, and what its expert does; one batched program for all tests."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.check import check_env
from envs.manipulation.make import make_lift
from envs.manipulation.physics.mujoco_c import import_mujoco
from envs.manipulation.randomisation import Factors, Ranges
from envs.manipulation.scenes.lift import CUBE_MASS
from envs.manipulation.tasks.lift import shaped_reward

KEY = jax.random.key(0)
STARTS = 3


@functools.cache
def env():
    return make_lift(training=range(STARTS), held_out=range(1000, 1002))


@functools.cache
def _start():
    return jax.jit(jax.vmap(lambda i: env().reset_to(i, KEY, env().default_params)))


def starts():
    return _start()(jnp.arange(STARTS))


@functools.cache
def _step():
    """One control step of each state of a batch: states, outcomes and observations."""

    def one(state, action):
        params = env().default_params
        state, outcome = env().transition(KEY, state, action, params)
        return state, outcome, env().observe(state, params)

    return jax.jit(jax.vmap(one))


def step(states, actions):
    return _step()(states, jnp.broadcast_to(jnp.asarray(actions, jnp.float32), (STARTS, 7)))


@functools.cache
def expert():
    act = env().scripted_expert
    return jax.jit(jax.vmap(lambda state: act(KEY, state, env().see(state), env().default_params)))


def test_it_keeps_the_contract_and_its_card():
    check_env(env(), "lift")
    card = envs.card("lift")
    assert env().card is card
    assert tuple(env().experts) == card.experts
    assert len(card.actions) == env().spec.action_size == 7
    assert env().physics == "mjx"
    with pytest.raises(ValueError, match="physics must be auto or one of mjx for 'lift'"):
        envs.make("lift", physics="analytic")


def test_the_observation_is_robosuites():
    """Against C MuJoCo's own frames at a start."""
    mujoco = import_mujoco()
    states = starts()
    seen = np.asarray(jax.vmap(env().see)(states))
    assert seen.shape == (STARTS, 47)
    model = env().scene.full
    for row, one in zip(seen, range(STARTS), strict=True):
        data = mujoco.MjData(model)
        data.qpos[:] = states.bodies.qpos[one]
        mujoco.mj_forward(model, data)
        cube, hand, eef = data.body("cube"), data.body("hand"), data.site("grip")
        joints = data.qpos[env().arm.qpos]
        wanted = [cube.xpos, np.roll(cube.xquat, -1), eef.xpos - cube.xpos, np.cos(joints),
                  np.sin(joints), np.zeros(6), eef.xpos, np.roll(hand.xquat, -1)]  # fmt: skip
        np.testing.assert_allclose(row[:35], np.concatenate(wanted), atol=2e-5)
        np.testing.assert_allclose(row[35:41], [-0.026, -0.267, -0.2] * 2, atol=1e-6)
        np.testing.assert_array_equal(row[41:], 0.0)


def test_reward_has_known_values():
    cube, low = jnp.array([0.0, 0.0, 0.82]), 1 - np.tanh(1.0)
    away = cube + jnp.array([0.0, 0.1, 0.0])
    np.testing.assert_allclose(shaped_reward(away, cube, jnp.bool_(False)), low / 2.25, rtol=1e-5)
    np.testing.assert_allclose(
        shaped_reward(cube, cube, jnp.bool_(True)), (1.0 + 0.25) / 2.25, rtol=1e-6
    )
    high = cube.at[2].set(0.841)
    assert float(shaped_reward(away, high, jnp.bool_(False))) == 1.0
    assert float(shaped_reward(away, high.at[2].set(0.839), jnp.bool_(False))) < 1.0


@pytest.mark.parametrize(
    ("height", "success", "unsafe"),
    [(0.82, False, False), (0.841, True, False), (0.76, False, False), (0.74, False, True)],
)
def test_ends(height, success, unsafe):
    state = jax.tree.map(lambda leaf: leaf[0], starts())
    cube = state.sensed.replace(position=jnp.array([0.0, 0.0, height]))
    verdict = env().judge(state, state.replace(sensed=cube))
    assert (bool(verdict.success), bool(verdict.unsafe)) == (success, unsafe)


def test_its_expert_lifts_the_cube():
    states = starts()
    done, rewards = np.zeros(STARTS, bool), []
    for _ in range(70):
        states, outcome, _ = step(states, expert()(states))
        assert not np.any(outcome.unsafe | outcome.physics_diverged)
        np.testing.assert_array_equal(outcome.terminated, outcome.success)
        done |= np.asarray(outcome.success)
        rewards.append(np.asarray(outcome.reward))
        if done.all():
            break
    assert done.all()
    assert np.max(rewards) == 1.0
    assert np.max(rewards[0]) < 0.1


def test_the_neighbours_in_a_batch_do_not_matter():
    states, action = starts(), np.linspace(-1.0, 1.0, 7)
    together, _, seen = step(states, action)
    alike = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[1], leaf.shape), states)
    alone, _, seen_alone = step(alike, action)
    np.testing.assert_array_equal(seen[1], seen_alone[0])
    np.testing.assert_array_equal(together.bodies.qpos[1], alone.bodies.qpos[2])


def test_a_cube_beyond_the_edge_falls():
    states = starts()
    at = env().cube_at.start
    off = states.bodies.replace(qpos=states.bodies.qpos.at[:, at].set(0.5))
    states = states.replace(bodies=off)
    for _ in range(4):
        states, outcome, _ = step(states, np.zeros(7))
        assert not bool(jnp.any(outcome.success))
    assert bool(jnp.all(states.sensed.position[:, 2] < 0.80))


def test_divergence_is_flagged_and_the_state_kept():
    states = starts()
    wild = states.bodies.replace(qvel=states.bodies.qvel.at[1].set(1e20))
    moved, outcome, _ = step(states.replace(bodies=wild), np.zeros(7))
    np.testing.assert_array_equal(outcome.physics_diverged, [False, True, False])
    np.testing.assert_array_equal(outcome.terminated, [False, True, False])
    np.testing.assert_array_equal(moved.bodies.qpos[1], states.bodies.qpos[1])
    assert float(outcome.reward[1]) == 0.0
    np.testing.assert_array_equal(moved.time, 1)


def test_a_scenario_has_its_own_mass_and_start():
    scene = env().scene
    put = scene.varied(Factors(friction=0.5, mass=2.0), [env().cube])
    np.testing.assert_allclose(put.body_mass[env().cube], 2 * CUBE_MASS, rtol=1e-6)
    np.testing.assert_allclose(put.pair_friction, 0.5 * scene.put.pair_friction, rtol=1e-6)
    params = env().with_ranges(env().default_params, Ranges(start_noise=0.1))
    joints = jnp.zeros(6)
    moved = [env().first_joints(joints, jnp.int32(i), params) for i in range(STARTS)]
    assert np.std(moved) > 0.03
    np.testing.assert_array_equal(
        env().first_joints(joints, jnp.int32(0), env().default_params), joints
    )


def test_it_is_drawn_as_it_is():
    from envs.manipulation.drawn import DrawnTask

    state = jax.tree.map(lambda leaf: leaf[2], starts())
    twin = DrawnTask(env())
    twin.place(state)
    arm = twin.arm
    arm.mujoco.mj_forward(arm.model, arm.data)
    np.testing.assert_allclose(arm.data.site_xpos[arm.site], env().grip_position(state), atol=1e-5)
    np.testing.assert_allclose(arm.data.body("cube").xpos, state.sensed.position, atol=1e-6)
    half = float(state.fingers.inner[0]) / 2
    np.testing.assert_allclose(
        arm.model.body("left_finger").quat, [np.cos(half), np.sin(half), 0, 0], atol=1e-6
    )
