"""Derivatives of a step by its action: finite, and those of finite differences where smooth."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.derivatives import length

SCRIPTED = (0, 1, 20)  # steps of the expert before the step that is differentiated
NAMES = ["driving", "table_wiping", pytest.param("nut_assembly", marks=pytest.mark.slow)]


@functools.cache
def world(name):
    """(environment, states, `along(state, action, direction) -> values and their derivative`)."""
    options = {} if name == "driving" else {"physics": "analytic"}
    env = envs.make(name, training=range(100, 101), held_out=range(1000, 1001), **options)
    params, key = env.default_params, jax.random.key(0)

    def made(state, action):
        new, outcome = env.transition(key, state, action, params)
        return new, outcome, env.observe(new, params)

    @jax.jit
    def along(state, action, direction):
        return jax.jvp(functools.partial(made, state), (action,), (direction,))

    state, states = env.reset_to(jnp.int32(0), key, params), []
    act = jax.jit(lambda state: env.scripted_expert(key, state, env.observe(state, params), params))
    for step in range(max(SCRIPTED) + 1):
        states += [state] if step in SCRIPTED else []
        state = along(state, act(state), jnp.zeros(env.spec.action_size, jnp.float32))[0][0]
    return env, states, along


def near(env, seed=0):
    """An action within the box, away from its middle, and a direction."""
    action, direction = np.random.default_rng(seed).uniform(0.1, 0.5, (2, env.spec.action_size))
    return jnp.asarray(action, jnp.float32), jnp.asarray(direction, jnp.float32)


@pytest.mark.parametrize("name", NAMES)
def test_the_derivative_by_the_action_is_finite(name):
    """Of state, reward, the outcome's other numbers and the observation; also where all rests."""
    env, states, along = world(name)
    action, direction = near(env)
    for state in states:
        for at in (jnp.zeros_like(action), action, -action):
            for leaf in jax.tree.leaves(along(state, at, direction)[1]):
                assert leaf.dtype == jax.dtypes.float0 or np.all(np.isfinite(leaf))


@pytest.mark.parametrize("name", NAMES)
def test_the_derivative_is_that_of_finite_differences(name):
    """Where a step is smooth: the car's and the arm's motion, after the expert has set it going."""
    env, states, along = world(name)
    action, direction = near(env)

    def motion(new):
        if name == "driving":
            return np.concatenate([new.ego.velocity, new.ego.yaw_rate[None], new.ego.body])
        return np.concatenate([new.joints, new.speeds])

    slope = motion(along(states[-1], action, direction)[1][0])
    ends = [
        motion(along(states[-1], action + side * 0.02 * direction, direction)[0][0])
        for side in (-1, 1)
    ]
    assert np.max(np.abs(slope)) > 1e-3
    np.testing.assert_allclose(
        (ends[1] - ends[0]) / 0.04, slope, rtol=0.02, atol=0.02 * np.max(np.abs(slope))
    )


@pytest.mark.parametrize("name", ["driving", pytest.param("table_wiping", marks=pytest.mark.slow)])
def test_the_derivative_in_reverse_is_the_same(name):
    """Nut assembly's contact solver is a loop without a fixed end, which has none in reverse."""
    env, states, along = world(name)
    params, key = env.default_params, jax.random.key(0)

    @jax.jit
    @jax.grad
    def gradient(action, state):
        new, outcome = env.transition(key, state, action, params)
        return jnp.sum(env.observe(new, params)) + outcome.reward

    action, direction = near(env)
    for state in states:
        _, outcome, seen = along(state, action, direction)[1]
        forward = float(jnp.sum(seen) + outcome.reward)
        reverse = float(gradient(action, state) @ direction)
        np.testing.assert_allclose(reverse, forward, rtol=1e-3, atol=1e-3)


def test_a_length_has_a_derivative_everywhere():
    vectors = jnp.array([[0.0, 0.0], [3.0, 4.0], [jnp.nan, 0.0]], jnp.float32)
    np.testing.assert_array_equal(length(vectors), [0.0, 5.0, np.nan])
    np.testing.assert_allclose(jax.grad(length)(vectors[0]), [0.0, 0.0])
    np.testing.assert_allclose(jax.grad(length)(vectors[1]), [0.6, 0.8])
