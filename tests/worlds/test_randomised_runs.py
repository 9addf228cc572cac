"""Runs in randomised worlds: ranges of 0 change nothing, others do, and all share a program."""

import functools

import jax
import numpy as np

from envs.manipulation.make import make_table_wiping
from ppl_jax import algorithms
from ppl_jax.training import make_train

STEPS = 10


@functools.cache
def program(randomise):
    """The first steps of a run, those of the expert, as one function of its traced settings."""
    env = make_table_wiping(training=range(2), held_out=range(1000, 1002), physics="analytic")
    config, _ = settings(randomise)
    functions = make_train(env, env.scripted_expert, algorithms.method("bc").make, config)

    def run(hparams):
        learner = functions.init(jax.random.key(0), hparams)
        learner = functions.run_chunk(learner, STEPS // config.decision_interval, "demonstrate")[0]
        return learner.algorithm.human_buffer, learner.env_state, learner.counters

    return jax.jit(run)


def settings(randomise, **ranges):
    steps = {"total_steps": 20, "demonstrations": STEPS, "human_capacity": STEPS}
    return algorithms.settings("bc", "table_wiping", randomise=randomise, **steps, **ranges)


def test_ranges_of_zero_are_the_world_as_it_is_and_others_are_not():
    plain = program(False)(settings(False)[1])
    same = program(True)(settings(True)[1])
    for mine, own in zip(jax.tree.leaves(same), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(mine, own, rtol=1e-4, atol=1e-4)
    for name in ("mass_range", "damping_range", "gain_range", "start_noise", "sensor_noise"):
        found = program(True)(settings(True, **{name: 0.5})[1])
        apart = [
            np.abs(np.asarray(mine, float) - np.asarray(own, float)).max()
            for mine, own in zip(jax.tree.leaves(found), jax.tree.leaves(same), strict=True)
        ]
        assert max(apart) > 1e-4, name
    assert program(True)._cache_size() == 1
