import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax.gates import (
    DeviatesFromExpertHParams,
    LowReturnHParams,
    UnsafeOrSlowHParams,
    deviates_from_expert,
    low_return,
    unsafe_or_slow,
)
from ppl_jax.preference import preference_pairs
from ppl_jax.types import DecisionPoint, Interaction, Trajectory

M, O, A = 6, 4, 2
SCALE = np.array([1.0, 1.0, 2.0, 1.0], np.float32)


def point(novice, experts=None):
    """A decision where the rules look at predicted trajectories alone."""
    return DecisionPoint(
        observation=jnp.zeros(O),
        novice_action=jnp.zeros(A),
        expert_action=jnp.zeros(A),
        takeover=jnp.zeros((), bool),
        trajectory=novice,
        experts=experts,
        log_density=jnp.asarray(jnp.nan),
    )


def trajectory(valid=M, reward=1.0, speed=10.0, unsafe=(), success=(), ended=(), clearance=9.0):
    def at(steps):
        return jnp.isin(jnp.arange(M), jnp.array(list(steps), int))

    steps = jnp.arange(M) < valid
    return Trajectory(
        observation=jnp.arange(M * O, dtype=jnp.float32).reshape(M, O),
        reward=jnp.where(steps, reward, 0.0),
        speed=jnp.where(steps, speed, 0.0),
        unsafe=at(unsafe),
        success=at(success),
        terminated=at(ended),
        valid=steps,
        clearance=jnp.full(M, clearance),
    )


def interaction(takeover, predicted):
    flag = jnp.asarray(takeover)
    zero = jnp.zeros(())
    return Interaction(
        observation=jnp.full(O, -1.0),
        next_observation=jnp.zeros(O),
        novice_action=jnp.full(A, 0.25),
        expert_action=jnp.full(A, 0.75),
        executed_action=jnp.zeros(A),
        takeover=flag,
        takeover_start=flag,
        reward=zero,
        cost=zero,
        terminated=flag,
        truncated=flag,
        success=flag,
        predicted=predicted,
    )


@pytest.mark.parametrize("takeover", [False, True])
@pytest.mark.parametrize("horizon", [1, 4, M])
@pytest.mark.parametrize("valid", [1, 3, M])
@pytest.mark.parametrize("pair_states", ["predicted", "future", "shifted"])
def test_pairs_are_the_loop_of_algorithm_1(takeover, horizon, valid, pair_states):
    """For L = 1, 4 and H, where the prediction or the episode ends within it or does not."""
    step = interaction(takeover, trajectory(valid, ended=[valid - 1] if valid < M else []))
    pairs, mask = preference_pairs(step, jnp.float32(horizon), pair_states)
    states = [np.full(O, -1.0), *np.asarray(step.predicted.observation)]
    last = min(horizon, valid)
    expected = {
        "predicted": [(state, None) for state in states[: last + 1]],
        "future": [(state, None) for state in states[1 : last + 1]],
        "shifted": [(states[k], states[k + 1]) for k in range(last)],
    }[pair_states]
    expected = expected if takeover else []
    got = np.flatnonzero(np.asarray(mask))
    assert len(got) == len(expected)
    for row, (state, rejected) in zip(got, expected, strict=True):
        np.testing.assert_array_equal(pairs.observation[row], state)
        np.testing.assert_array_equal(pairs.preferred_action[row], np.full(A, 0.75))
        np.testing.assert_array_equal(pairs.rejected_action[row], np.full(A, 0.25))
        if rejected is not None:
            np.testing.assert_array_equal(pairs.rejected_observation[row], rejected)


def test_changing_the_horizon_compiles_nothing():
    step = interaction(True, trajectory())
    run = jax.jit(preference_pairs, static_argnums=2)
    for horizon in (1.0, 2.0, 5.0):
        assert int(run(step, jnp.float32(horizon), "predicted")[1].sum()) == 1 + horizon
    assert run._cache_size() == 1


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({}, False),
        ({"unsafe": [4]}, True),
        ({"speed": 4.0}, True),
        ({"speed": 4.0, "success": [2], "valid": 3}, False),
        ({"valid": 2, "speed": 6.0}, False),
        ({"clearance": 0.4}, True),
        ({"clearance": 0.6}, False),
        ({"speed": np.linspace(1.0, 4.0, M)}, False),
        ({"speed": np.linspace(1.0, 2.5, M)}, True),
        ({"speed": np.linspace(1.0, 4.0, M), "unsafe": [1]}, True),
    ],
)
def test_the_driving_gate(case, expected):
    hparams = UnsafeOrSlowHParams(min_speed=5.0, min_clearance=0.5, min_gain=2.0)
    assert bool(unsafe_or_slow(point(trajectory(**case)), hparams, SCALE)) is expected


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({"reward": 2.0}, False),
        ({"reward": 1.6}, True),
        ({"reward": 20.0, "valid": 1, "ended": [0]}, False),
        ({"reward": -1.0, "valid": 1, "ended": [0]}, True),
    ],
)
def test_the_released_gate(case, expected):
    assert (
        bool(low_return(point(trajectory(**case)), LowReturnHParams(min_return=10.0), SCALE))
        is expected
    )


@pytest.mark.parametrize(
    ("case", "shift", "expected"),
    [
        ({}, [0.9, 0.0, 1.9, 0.0], False),
        ({}, [0.0, 0.0, 2.1, 0.0], True),
        ({"success": [3]}, [0.0, 0.0, 2.1, 0.0], False),
        ({"unsafe": [4]}, [0.0, 0.0, 0.0, 0.0], True),
    ],
)
def test_the_gate_that_compares_with_the_expert(case, shift, expected):
    novice = trajectory(**case)
    experts = trajectory()
    experts = experts.replace(observation=experts.observation.at[-1].add(jnp.array(shift)))
    hparams = DeviatesFromExpertHParams(max_departure=1.0)
    assert bool(deviates_from_expert(point(novice, experts), hparams, SCALE)) is expected
    with pytest.raises(ValueError, match="expert's own prediction"):
        deviates_from_expert(point(novice), hparams, SCALE)


def test_unknown_states_and_shapes_that_do_not_fit_are_refused():
    step = interaction(True, trajectory())
    with pytest.raises(
        ValueError, match="one of predicted, future, shifted, got 'shift': did you mean"
    ):
        preference_pairs(step, 3, "shift")
    with pytest.raises(ValueError, match=rf"must not exceed the predicted states \({M}\), got 9"):
        preference_pairs(step, 9)
    for wrong in (
        {"observation": jnp.zeros(O + 1)},
        {"novice_action": jnp.zeros((1, A))},
        {"predicted": trajectory().replace(valid=jnp.ones(M + 1, bool))},
    ):
        with pytest.raises(AssertionError, match="shape"):
            preference_pairs(step.replace(**wrong), 3)
