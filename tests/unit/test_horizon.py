"""What L buys and costs: measurements against loops, and the choice where the answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax import horizon
from ppl_jax.training import make_train
from tests.helpers import Probe, probe_settings

RNG = np.random.default_rng(4)


def test_measurements_against_a_loop():
    here, ahead, scale = RNG.normal(size=3), RNG.normal(size=(5, 3)), np.array([1.0, 2.0, 0.5])
    expert_actions, preferred, rejected = (
        RNG.normal(size=(5, 2)),
        RNG.normal(size=2),
        RNG.normal(size=2),
    )
    found = horizon.measure(
        here,
        ahead,
        expert_actions,
        expert_action=preferred,
        novice_action=rejected,
        scale=scale,
    )
    for i in range(5):
        drift = np.sqrt(((expert_actions[i] - preferred) ** 2).sum())
        other = np.sqrt(((expert_actions[i] - rejected) ** 2).sum())
        np.testing.assert_allclose(found.drift[i], drift, rtol=1e-5)
        assert float(found.wrong[i]) == float(drift >= other)
        reach = np.sqrt((((ahead[i] - here) / scale) ** 2).sum())
        np.testing.assert_allclose(found.reach[i], reach, rtol=1e-5)


def test_coverage_against_a_loop():
    visited, predicted = RNG.normal(size=(7, 3)), RNG.normal(size=(4, 5, 3))
    valid = RNG.random((4, 5)) < 0.7
    valid[0, 0] = True
    found = horizon.coverage(*map(jnp.asarray, (visited, predicted, valid)), jnp.ones(3))
    for most in range(1, 6):
        total = 0.0
        for state in visited:
            total += min(
                np.linalg.norm(predicted[k, i] - state)
                for k in range(4)
                for i in range(most)
                if valid[k, i]
            )
        np.testing.assert_allclose(found[most - 1], total / 7, rtol=1e-5)
    assert np.all(np.diff(found) <= 1e-6)


def test_moving_means_are_means_of_what_was_seen():
    state = horizon.init_horizon(3)
    drift, valid = RNG.random((20, 3)), RNG.random((20, 3)) < 0.6
    valid[:, 0] = True
    for row, seen in zip(drift, valid, strict=True):
        measured = horizon.Measured(
            wrong=jnp.zeros(3), drift=jnp.asarray(row), reach=jnp.ones(3), apart=jnp.float32(0.5)
        )
        state = horizon.add(state, measured, jnp.asarray(seen))
    for i in range(3):
        np.testing.assert_allclose(state.drift[i], drift[valid[:, i], i].mean(), rtol=1e-5)
    np.testing.assert_allclose(state.reach, 1.0)  # also of what had ended: it stays there
    np.testing.assert_allclose(state.apart, 0.5)


def test_the_choice_balances_both_errors():
    steps = jnp.arange(1.0, 11.0)

    def chosen(drift, most=10):
        seen = horizon.Horizon(count=steps, drift=drift, reach=steps, apart=jnp.float32(1.0))
        return int(horizon.choose(seen, most))

    assert chosen(0.0 * steps) == 10  # the expert says the same everywhere
    assert chosen(0.0 * steps, 6) == 6  # never above the bound
    assert chosen(0.1 * steps) == 5  # gap 0.5 and error 0.5
    assert chosen(0.25 * steps) == 3  # gap 0.7, error 0.75; at 2: 0.8 and 0.5
    assert chosen(1.0 + 0.0 * steps) == 1  # no label is worth anything
    assert int(horizon.choose(horizon.init_horizon(10), 10)) == 1


def test_it_is_chosen_while_training():
    """Here the expert says the same everywhere: every label is right, so L is the most."""
    config, hparams = probe_settings(
        "ppl",
        adaptive_horizon=True,
        max_preference_horizon=6,
        preference_horizon=6,
        total_steps=400,
    )
    functions = make_train(Probe(), Probe.scripted_expert, make(), config)
    run = jax.jit(functions.run_chunk)
    learner = functions.init(jax.random.key(0), hparams)
    learner, metrics = run(learner, 40)
    assert int(learner.counters.human_data) > 0
    assert float(jnp.max(learner.algorithm.horizon.drift)) < 1e-6
    assert int(horizon.choose(learner.algorithm.horizon, 6)) == 6
    assert 1 <= float(metrics["train/preference_horizon"]) <= 6


def make():
    from ppl_jax import algorithms

    return algorithms.method("ppl").make


def test_a_profile_of_a_world_that_is_known():
    """The expert says the same at every predicted state of an episode: nothing drifts."""
    config, hparams = probe_settings("ppl", max_preference_horizon=6)
    profile = horizon.make_profile(
        Probe(), Probe.scripted_expert, config, num_envs=4, steps=60, visited=50, kept=20
    )
    found = jax.jit(lambda key: profile(key, lambda observation: jnp.zeros(1), hparams))(
        jax.random.key(0)
    )
    assert int(found.interventions) > 0
    np.testing.assert_allclose(found.drift, 0, atol=1e-6)
    np.testing.assert_allclose(found.wrong, 0)
    np.testing.assert_allclose(found.apart, 0.6, atol=1e-6)  # of 0 and +-0.6
    assert np.all(np.diff(found.reach) >= -1e-6)
    assert np.all(np.diff(found.coverage) <= 1e-6)


def test_shapes_that_do_not_fit_are_refused():
    here, ahead, actions = np.ones(3), np.zeros((5, 3)), np.zeros((5, 2))
    one = {"expert_action": actions[0], "novice_action": actions[0], "scale": here}
    seen = horizon.measure(here, ahead, actions, **one)
    for call in (
        lambda: horizon.measure(here, ahead[:, :2], actions, **one),
        lambda: horizon.measure(here, ahead, actions[:4], **one),
        lambda: horizon.measure(here, ahead, actions, **{**one, "novice_action": actions}),
        lambda: horizon.measure(here, ahead, actions, **{**one, "scale": ahead}),
        lambda: horizon.coverage(ahead, ahead, np.ones((5, 3), bool), here),
        lambda: horizon.coverage(ahead, ahead[None], np.ones((1, 4), bool), here),
        lambda: horizon.add(horizon.init_horizon(4), seen, np.ones(4, bool)),
        lambda: horizon.errors(np.zeros(3), np.zeros(4), 1.0),
    ):
        with pytest.raises(AssertionError, match=r"shape|rank"):
            call()
