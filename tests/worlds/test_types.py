"""Types of a world's numbers: single precision whatever `jax_enable_x64` says, none promoted."""

import contextlib

import jax
import jax.numpy as jnp
import pytest

import envs
from envs.manipulation.randomisation import Ranges
from ppl_jax import algorithms
from ppl_jax.config import as_arrays
from ppl_jax.evaluation import make_evaluate
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from ppl_jax.ppo.loop import make_ppo_lagrangian
from ppl_jax.types import in_single
from tests.helpers import Probe, functions, program

WORLDS = [
    ("driving", "auto"),
    ("table_wiping", "analytic"),
    ("table_wiping", "mjx"),
    ("table_wiping", "mujoco_c"),
    ("nut_assembly", "analytic"),
    pytest.param("nut_assembly", "mjx", marks=pytest.mark.slow),
    ("nut_assembly", "mujoco_c"),
    pytest.param("lift", "mjx", marks=pytest.mark.slow),
]


class Single(Probe):
    """The probe with its types said."""

    def __init__(self):
        super().__init__()
        self.default_params = self.held_out_params = in_single(self.default_params)

    def reset_to(self, index, key, params):
        return in_single(super().reset_to(index, key, params))

    def observe(self, state, params):
        return jnp.stack([state.sign, state.error, jnp.float32(1.0)])


@contextlib.contextmanager
def double_and_strict():
    """Under `jax_enable_x64`, and where no operation promotes one type to another."""
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        yield


def build(world, physics):
    if world == "driving":
        return envs.make(world, training=range(100, 102), held_out=range(1000, 1002))
    return envs.make(world, training=range(2), held_out=range(1000, 1002), physics=physics)


def traced(env, params):
    """Shapes and types of all that a world computes."""
    key = jax.random.key(0)
    action = jax.ShapeDtypeStruct((env.spec.action_size,), jnp.float32)
    observation, state = jax.eval_shape(env.reset, key, params)
    return {
        "reset": (observation, state),
        "numbers": jax.eval_shape(env.scenario_numbers, params),
        "predictors": {
            name: jax.eval_shape(predictor, key, state, action, params)
            for name, predictor in env.predictors.items()
        },
        "experts": {
            name: jax.eval_shape(expert, key, state, observation, params)
            for name, expert in env.experts.items()
        },
    }


def types(tree):
    return [
        (jax.tree_util.keystr(path), jnp.shape(leaf), str(leaf.dtype))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    ]


@pytest.mark.parametrize(("world", "physics"), WORLDS)
def test_a_world_has_the_same_types_under_x64_and_strict_promotion(world, physics):
    """State, observation, reward and outcome; MJX's own code is traced as it expects."""
    env = build(world, physics)
    usual = types((env.default_params, traced(env, env.default_params)))
    with double_and_strict():
        env = build(world, physics)
        params = env.default_params
        assert types((params, traced(env, params))) == usual
        if physics == "analytic":
            ranges = as_arrays(Ranges(friction_range=0.2, sensor_noise=0.1))
            varied = traced(env, env.with_ranges(params, ranges))
            assert types(varied) == types(traced(env, params))
    assert {dtype for _, _, dtype in usual} == {"float32", "int32", "bool"}


@pytest.mark.parametrize("method", algorithms.registered())
def test_training_has_no_double_precision(method):
    """Of every method, losses included; Optax, which promotes, is let do so."""
    with double_and_strict():
        made, hparams = functions(method, Single())
        trained = jax.eval_shape(made.train, jax.random.key(0), as_arrays(hparams))
    assert not doubles(trained)


def doubles(tree):
    return [path for path, _, dtype in types(tree) if "64" in dtype]


def test_evaluation_and_the_experts_trainer_have_no_double_precision():
    env = Single()
    config = PPOConfig(total_steps=2048, num_envs=4, rollout_steps=16, num_minibatches=4)
    made = make_ppo_lagrangian(env, config, expert=env.scripted_expert)
    key = jax.random.key(0)
    with double_and_strict():
        episodes = jax.eval_shape(make_evaluate(env, env.scripted_expert), env.held_out_params, key)
        learner = jax.eval_shape(made.init, key, PPOHParams())
        learner, metrics = jax.eval_shape(lambda learner: made.run(learner, 1), learner)
    assert not doubles((episodes, learner, metrics))


@pytest.mark.parametrize("world", ["probe", pytest.param("driving", marks=pytest.mark.slow)])
def test_a_run_trains_under_x64(world, tmp_path, monkeypatch):
    """The probe's own state is in double precision then, as a user's might be."""
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    out = tmp_path / "run"
    few = ["--total-steps", 40, "--batch-size", 16, "--hidden", 16]
    program(tmp_path, "train", world, *few, "--out", out)
    assert (out / "summary.json").is_file()
