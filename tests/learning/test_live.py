from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax import algorithms
from ppl_jax.live import make_live
from tests.helpers import Probe, tiny_settings

SMALL = {
    "total_steps": 200,
    "batch_size": 16,
    "hidden": (16,),
    "prediction_horizon": 6,
    "decision_interval": 5,
    "max_preference_horizon": 6,
    "human_capacity": 200,
    "preference_capacity": 1000,
    "learning_rate": 3e-3,
}


def small(algorithm="ppl", **changes):
    return tiny_settings(algorithm, SMALL, **changes)


CONFIG, HP = small()
NO_KEY: Any = None  # acting without noise needs none


def live(algorithm="ppl", **changes):
    probe, (config, _) = Probe(), small(algorithm, **changes)
    make = algorithms.method(algorithm).make
    fns = make_live(probe, make, config, place=lambda state: state.error[None])
    return probe, fns


def session(probe, fns, steps, seed=0, hparams=HP):
    """Somebody who takes over where the prediction would fail, and knows what to do."""
    predict_path, play, learn = jax.jit(fns.predict_path), jax.jit(fns.play), jax.jit(fns.learn)
    learner, rows, takeover = jax.jit(fns.init)(jax.random.key(seed), hparams), [], False
    for t in range(steps):
        if t % 5 == 0:
            ahead = predict_path(learner, jnp.zeros(1), False)
            takeover = bool(np.any(ahead.unsafe))
        action = jnp.atleast_1d(probe.answer(learner.env_state.sign))
        learner, row = play(learner, jnp.array(takeover), action)
        takeover = takeover and not bool(row.terminated | row.truncated)
        learner, _ = learn(learner)
        rows.append(row)
    return learner, jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


def equal(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("algorithm", ["ppl", "pvp", "hg_dagger", "iwr", "eil", "haco"])
def test_a_session_teaches_and_its_recording_teaches_the_same(algorithm):
    probe, fns = live(algorithm)
    hparams = small(algorithm)[1]
    learner, rows = session(probe, fns, 200, hparams=hparams)
    counters = learner.counters
    assert int(counters.steps) == 200
    assert 0 < int(counters.human_data) < 200
    assert int(counters.human_data) == int(rows.takeover.sum())
    assert int(counters.takeovers) == int(rows.takeover_start.sum())
    again, _ = jax.jit(fns.ingest)(jax.jit(fns.init)(jax.random.key(0), hparams), rows)
    equal(again.counters, counters)
    # one program rounds otherwise than the other
    for a, b in zip(*map(jax.tree.leaves, (again.algorithm, learner.algorithm)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)
    if algorithm == "ppl":
        for sign in (1.0, -1.0):
            action = fns.algorithm.act(learner.algorithm, NO_KEY, jnp.array([sign, 0.0, 1.0]))
            assert float(action[0]) == pytest.approx(0.6 * sign, abs=probe.tolerance)


def test_whose_action_is_executed_and_stored():
    _, fns = live()
    learner = fns.init(jax.random.key(0), HP)
    mine, novices = (
        jnp.array([0.3]),
        fns.algorithm.act(learner.algorithm, NO_KEY, jnp.array([learner.env_state.sign, 0.0, 1.0])),
    )
    taken, row = fns.play(learner, jnp.array(True), 5 * mine)
    np.testing.assert_allclose(row.executed_action, [1.0])  # clipped
    taken, row = fns.play(learner, jnp.array(True), mine)
    np.testing.assert_allclose(row.executed_action, mine)
    np.testing.assert_allclose(row.novice_action, novices)
    assert bool(row.takeover_start)
    _, row = fns.play(taken, jnp.array(True), mine)
    assert not bool(row.takeover_start)  # still the same takeover
    left, row = fns.play(taken, jnp.array(False), mine)
    np.testing.assert_array_equal(row.executed_action, row.novice_action)
    _, row = fns.play(left, jnp.array(True), mine)
    assert bool(row.takeover_start)


def test_a_predicted_path_leaves_no_trace_and_is_what_then_happens():
    _, fns = live()
    learner = fns.init(jax.random.key(0), HP)
    for mine in (True, False):
        action = jnp.array([0.9])
        ahead = fns.predict_path(learner, action, jnp.array(mine))
        held = (
            action
            if mine
            else fns.algorithm.act(
                learner.algorithm, NO_KEY, jnp.array([learner.env_state.sign, 0.0, 1.0])
            )
        )
        state = learner
        for k in range(CONFIG.prediction_horizon):
            state, row = fns.play(state, jnp.array(True), held)
            if not bool(ahead.valid[k]):
                break
            assert ahead.position is not None
            assert bool(ahead.unsafe[k]) == bool(row.cost > 0)
            if not bool(row.terminated):
                assert float(ahead.position[k, 0]) == pytest.approx(
                    float(row.next_observation[1]), abs=1e-5
                )


def test_a_restart_keeps_what_was_learnt():
    probe, fns = live()
    learner, _ = session(probe, fns, 13)
    fresh = fns.restart(learner)
    assert int(fresh.env_state.time) == 0
    assert not bool(fresh.takeover)
    equal(fresh.algorithm, learner.algorithm)


def test_methods_that_ask_nobody_say_so():
    supports_human = {
        name: live(name)[1].algorithm.supports_human for name in algorithms.registered()
    }
    silent = {"bc", "gail", "ensemble_dagger", "thrifty_dagger"}
    assert {name for name, asked in supports_human.items() if not asked} == silent
