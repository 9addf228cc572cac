"""The contract of an environment: what does not fit is told in one line, when it is made."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.check import check_env
from envs.registry import unknown
from ppl_jax.predictors import predictor
from ppl_jax.types import EnvSpec
from tests.helpers import ROOT, Aim, Balance, Endless, Goal, Probe, Spend, Toll, TwoSteps

ONES, ZEROS = np.ones(3, np.float32), np.zeros(3, np.float32)


class Named(Probe):
    def observe(self, state, params):
        return {"sign": state.sign}


class Longer(Probe):
    def observe(self, state, params):
        return jnp.zeros(4)


class Counted(Probe):
    def observe(self, state, params):
        return jnp.zeros(3, jnp.int32)


class Failing(Probe):
    def observe(self, state, params):
        return state.missing


class Unnumbered(Probe):
    scenario_numbers = None  # pyright: ignore[reportAssignmentType]


class Misnumbered(Probe):
    def scenario_numbers(self, params):
        return jnp.zeros(3, jnp.int32)


class Endlessly(Probe):
    max_episode_steps = 0


class Growing(Probe):
    def transition(self, key, state, action, params):
        state, outcome = super().transition(key, state, action, params)
        return dataclasses.replace(state, time=1.0 * state.time), outcome


class Wide(Probe):
    def transition(self, key, state, action, params):
        state, outcome = super().transition(key, state, action, params)
        return state, dataclasses.replace(outcome, reward=jnp.zeros(2))


class Bare(Probe):
    def transition(self, key, state, action, params):  # pyright: ignore[reportIncompatibleMethodOverride]
        return super().transition(key, state, action, params)[0]


class Clumsy(Probe):
    @staticmethod
    def scripted_expert(key, state, observation, params):
        return jnp.zeros(2)


def with_spec(spec):
    probe = Probe()
    probe.spec = spec
    return probe


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (Named, r"observe must return one flat float array of shape \(3,\) .* got dict"),
        (Longer, r"observe must return .* \(spec.observation_size\), got float32\[4\]"),
        (Counted, r"observe must return .* got int32\[3\]"),
        (Failing, r"observe failed: AttributeError: .*'missing'"),
        (Unnumbered, "it has no method scenario_numbers"),
        (Misnumbered, r"scenario_numbers\(default_params\) must be 2 integers, got int32\[3\]"),
        (Endlessly, "max_episode_steps must be an int of 1 or more, got 0"),
        (Growing, r"transition must keep .* state.time was int32\[\], became float32\[\]"),
        (Wide, r"transition: Outcome.reward must be a scalar, got float32\[2\]"),
        (Bare, r"transition must return \(state, ppl_jax.types.Outcome\), got ProbeState"),
        (Clumsy, r"experts\['scripted'\] must return a float array of shape \(1,\)"),
        (
            lambda: with_spec(EnvSpec(3, 1, ZEROS, np.array([1, 0, 1], np.float32))),
            "spec.observation_scale must be positive, got 0 at index 1",
        ),
        (
            lambda: with_spec(EnvSpec(3, 1, ZEROS, ONES * np.nan)),
            "spec.observation_scale must be finite",
        ),
        (
            lambda: with_spec(EnvSpec(3, 1, ZEROS[:2], ONES)),
            r"spec.observation_mean must have shape \(3,\), got \(2,\)",
        ),
        (lambda: with_spec(EnvSpec(3, 0, ZEROS, ONES)), "spec.action_size must be an int of 1"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(make, what):
    with pytest.raises(ValueError, match="^environment 'own' .* does not fit: " + what) as told:
        check_env(make(), "own")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("make", [Probe, Aim, Goal, Balance, Spend, TwoSteps, Toll, Endless])
def test_the_probes_fit(make):
    check_env(make(), "probe")


@pytest.mark.parametrize("name", ["table_wiping", "nut_assembly"])
def test_the_shipped_arms_fit(name):
    env = envs.make(name, training=range(2), held_out=range(2))
    check_env(env, name)
    assert tuple(env.experts) == env.card.experts
    assert tuple(env.predictors) == env.card.predictors


def test_driving_fits(world):
    check_env(world, "driving")
    assert tuple(world.experts) == world.card.experts
    assert tuple(world.predictors) == world.card.predictors
    assert world.card.expert.teacher in world.experts


def test_make_checks_the_first_of_a_name():
    made = []

    class Once(Probe):
        def observe(self, state, params):
            made.append(1)
            return super().observe(state, params)

    envs.register("checked_once", Once)
    envs.make("checked_once")
    traced = len(made)
    assert traced > 0
    envs.make("checked_once")
    assert len(made) == traced


def test_a_world_without_expert_says_so():
    class Alone(Probe):
        scripted_expert = None  # pyright: ignore[reportAssignmentType]

    assert Alone().experts == {}
    check_env(Alone(), "alone")


def test_defaults_of_the_base_class():
    probe = Probe()
    np.testing.assert_array_equal(probe.scenario_numbers(probe.default_params), [0, 1])
    assert list(probe.experts) == ["scripted"]
    assert probe.card == envs.EnvCard()
    key = jax.random.key(0)
    assert probe.readings(probe.reset_to(jnp.int32(0), key, probe.default_params)) == []
    with pytest.raises(ValueError, match="no predictor 'kinematic': choose one of simulator"):
        predictor("kinematic").make(probe)


def test_names():
    assert "did you mean 'driving'?" in unknown("drivin")
    assert "choose one of" in unknown("flying")
    with pytest.raises(ValueError, match="registered already"):
        envs.register("driving", Probe)
    with pytest.raises(ValueError, match="must be one word"):
        envs.register("two words", Probe)
    with pytest.raises(ValueError, match="must be callable"):
        envs.register("nothing", None)  # pyright: ignore[reportArgumentType]


def test_cards_are_read_without_jax():
    code = (
        "import sys, envs; c = envs.card('driving'); assert c.control_rate == 10.0, c; "
        "assert envs.card('table_wiping').changes('default')['min_return'] == 1.64; "
        "assert envs.card('nobody') == envs.EnvCard(); assert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, timeout=60)
    with pytest.raises(ValueError, match="'reference' is not for this environment"):
        envs.card("nut_assembly").changes("reference")
