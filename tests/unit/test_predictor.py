import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax.config import NoHParams
from ppl_jax.predictors import add_noise, imperfect, predict
from ppl_jax.predictors import predictor as named

H = 8


@pytest.fixture(scope="module")
def start(world):
    """A state in motion."""
    params = world.default_params
    state = world.reset_to(jnp.int32(1), jax.random.key(0), params)

    def step(state, _):
        return world.transition(None, state, jnp.array([0.02, 0.8]), params)[0], None

    return jax.jit(lambda s: jax.lax.scan(step, s, None, length=40)[0])(state)


@pytest.mark.parametrize("predictor", ["simulator", "kinematic"])
def test_a_prediction_is_the_transition_in_a_loop_and_leaves_no_trace(world, start, predictor):
    params, action = world.default_params, jnp.array([0.3, 0.5])
    rolled = named(predictor).make(world)
    transition = lambda *args: rolled(*args, hparams=NoHParams())  # noqa: E731
    before = jax.tree.map(np.array, start)
    predicted = jax.jit(
        lambda s: predict(
            world,
            transition,
            jax.random.key(1),
            s,
            action=action,
            params=params,
            horizon=H,
            observe=True,
        )
    )(start)
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(start), strict=True):
        np.testing.assert_array_equal(old, new)

    step = jax.jit(lambda s: transition(None, s, action, params))
    observe = jax.jit(lambda s: world.observe(s, params))
    state, alive = start, True
    for i in range(H):
        assert bool(predicted.valid[i]) == alive
        if alive:
            state, outcome = step(state)
            alive = not bool(outcome.terminated | outcome.truncated)
            np.testing.assert_allclose(predicted.reward[i], outcome.reward, atol=2e-4)
            assert bool(predicted.unsafe[i]) == bool(outcome.unsafe)
        np.testing.assert_allclose(predicted.observation[i], observe(state), atol=2e-4)


def test_an_imperfect_step_is_off_by_a_share_of_what_changes(world, start):
    params, action = world.default_params, jnp.array([0.1, 0.2])

    @jax.jit
    def steps(state, epsilon):
        off = imperfect(world.transition, epsilon)(jax.random.key(3), state, action, params)
        return world.transition(None, state, action, params), off

    for epsilon in (0.0, 0.25):
        (exact, outcome), (off, same) = steps(start, epsilon)
        for a, b in zip(jax.tree.leaves(outcome), jax.tree.leaves(same), strict=True):
            np.testing.assert_array_equal(a, b)
        moved = 0
        parts = zip(*map(jax.tree.leaves, (start, exact, off)), strict=True)
        for before, after, wrong in parts:
            if not np.issubdtype(after.dtype, np.floating):
                np.testing.assert_array_equal(after, wrong)
                continue
            changed = np.linalg.norm(np.ravel(after - before))
            error = np.linalg.norm(np.ravel(wrong - after))
            assert error == pytest.approx(epsilon * changed, rel=1e-3, abs=1e-4)
            moved += changed > 1e-3
        assert moved >= 4


def test_the_real_step_is_the_same_with_and_without_a_prediction(world, start):
    params, action = world.default_params, jnp.array([0.1, 0.2])

    @jax.jit
    def with_lookahead(state):
        ahead = predict(
            world,
            world.transition,
            jax.random.key(0),
            state,
            action=-action,
            params=params,
            horizon=H,
            observe=True,
        )
        return world.transition(None, state, action, params)[0], ahead.reward.sum()

    plain = jax.jit(lambda s: world.transition(None, s, action, params)[0])(start)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(with_lookahead(start)[0]), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_the_kinematic_prediction_freezes_traffic(world, start):
    state, _ = world.transition_kinematic(None, start, jnp.array([0.0, 1.0]), world.default_params)
    np.testing.assert_array_equal(state.traffic.long, start.traffic.long)
    assert float(state.ego.pose[0]) != float(start.ego.pose[0])


def test_noise_has_the_stated_length():
    observation = jax.random.uniform(jax.random.key(0), (5, 259))
    for epsilon in (0.0, 0.25, 1.0):
        noise = add_noise(jax.random.key(1), observation, epsilon) - observation
        np.testing.assert_allclose(
            np.linalg.norm(noise, axis=-1),
            epsilon * np.linalg.norm(observation, axis=-1),
            rtol=1e-3,
            atol=1e-5,
        )


def test_an_unknown_predictor_is_named():
    from tests.helpers import Probe

    with pytest.raises(ValueError, match="'probe' has no predictor 'kinematic'"):
        named("kinematic").make(Probe())
