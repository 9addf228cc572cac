"""The arm tasks' back ends against each other, and domain randomisation on them."""

import dataclasses
import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.manipulation.make import make_nut_assembly, make_table_wiping
from envs.manipulation.randomisation import Ranges
from envs.manipulation.scenes.model import WIPING_BASE, WIPING_TABLE

KEY = jax.random.key(0)
MAKE = {"table_wiping": make_table_wiping, "nut_assembly": make_nut_assembly}
ENGINES = ("analytic", "mjx", "mujoco_c")
EPISODE, WINDOWS = 220, 16


@functools.cache
def world(name, physics):
    return MAKE[name](range(4), range(1000, 1002), physics=physics)


@functools.cache
def stepper(name, physics):
    env = world(name, physics)
    return jax.jit(lambda state, action: env.transition(KEY, state, action, env.default_params))


@functools.cache
def expert(name):
    env = world(name, "analytic")
    return jax.jit(lambda state: env.scripted_expert(KEY, state, None, env.default_params))


@functools.cache
def played(name, physics):
    """States, actions and outcomes of an episode from the first start, the same on all engines.

    The expert plays on the hand-written engine: on each engine it would change its mind about the
    next marker a step sooner or later.
    """
    env, seen = world(name, physics), []
    state = env.reset_to(jnp.int32(0), KEY, env.default_params)
    for step in range(EPISODE):
        if physics == "analytic":
            action = expert(name)(state)
        else:
            action = played(name, "analytic")[1][step]
        after, outcome = stepper(name, physics)(state, action)
        seen.append(jax.device_get((state, action, outcome)))
        state = after
    return jax.tree.map(lambda *steps: np.stack(steps), *seen)


@pytest.mark.parametrize("physics", ["mjx", "mujoco_c"])
def test_whole_wiping_episodes_are_alike(physics):
    ours, theirs = played("table_wiping", "analytic"), played("table_wiping", physics)
    ends = np.flatnonzero(ours[2].terminated)
    last = int(ends[0]) if len(ends) else EPISODE
    assert last > 100
    np.testing.assert_allclose(ours[0].joints[:last], theirs[0].joints[:last], atol=1e-3)
    np.testing.assert_array_equal(ours[0].wiped[:last].sum(-1), theirs[0].wiped[:last].sum(-1))
    force = np.linalg.norm(ours[0].force[:last] - theirs[0].force[:last], axis=-1)
    assert np.median(force) < 0.05
    assert np.mean(force > 1.0) < 0.03  # N, at the instant of an impact


def test_nut_assembly_is_alike_in_single_steps():
    """One control step from states along an episode; where contact is chaotic, most of them."""
    states, actions, _ = played("nut_assembly", "analytic")
    off = {physics: [] for physics in ("mjx", "mujoco_c")}
    steps = np.linspace(5, 100, WINDOWS).astype(int)
    for step in steps:
        state = jax.tree.map(lambda leaf, step=step: leaf[step], states)
        ours, _ = stepper("nut_assembly", "analytic")(state, actions[step])
        for physics, found in off.items():
            theirs, _ = stepper("nut_assembly", physics)(state, actions[step])
            found.append(
                (
                    np.abs(ours.joints - theirs.joints).max(),
                    np.abs(ours.fingers - theirs.fingers).max(),
                    np.linalg.norm(ours.position - theirs.position),
                )
            )
    for found in off.values():
        joints, fingers, ring = np.array(found).T
        assert np.median(joints) < 1e-5  # rad
        assert np.max(joints) < 1e-3
        assert np.median(fingers) < 2e-3
        assert np.median(ring) < 2e-4  # m
        assert np.max(ring) < 2e-3
    assert any(states.touching[steps])
    assert not all(states.touching[steps])


def test_fingers_meet_the_table_alike():
    """The step in which an engine's fingers used to part from the others' by 0.05 rad."""
    env = world("nut_assembly", "analytic")
    state = env.reset_to(jnp.int32(0), KEY, env.default_params)
    down = jnp.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0])
    above = dataclasses.replace(state, position=state.position.at[1].add(0.3))
    for _ in range(14):
        above, _ = stepper("nut_assembly", "analytic")(above, down)
    after = {p: stepper("nut_assembly", p)(above, down)[0] for p in ENGINES}
    assert float(jnp.abs(after["analytic"].speeds).max()) > 0
    for physics in ("mjx", "mujoco_c"):
        np.testing.assert_allclose(after["analytic"].fingers, after[physics].fingers, atol=2e-3)
        np.testing.assert_allclose(after["analytic"].joints, after[physics].joints, atol=2e-4)


def test_the_table_ends_alike():
    """A wiper with half its face beyond the edge is pushed by the other half alone."""
    states, _, _ = played("table_wiping", "analytic")
    step = int(np.argmax(np.linalg.norm(states.force, axis=-1) > 10))
    state = jax.tree.map(lambda leaf: jnp.asarray(leaf[step]), states)
    env = world("table_wiping", "analytic")
    (centre, _), (half, _), _ = WIPING_TABLE
    push = jnp.zeros(6).at[2].set(-0.05)
    out = jnp.zeros(6).at[0].set(1.0).at[2].set(-0.05)
    edge = centre + half - WIPING_BASE[0]
    for _ in range(200):
        state, _ = stepper("table_wiping", "analytic")(state, out)
        if float(env.grip_position(state)[0]) - WIPING_BASE[0] > edge:
            break
    after = {p: stepper("table_wiping", p)(state, push)[0] for p in ENGINES}
    for physics in ("mjx", "mujoco_c"):
        np.testing.assert_allclose(after["analytic"].joints, after[physics].joints, atol=1e-3)
        np.testing.assert_allclose(after["analytic"].force, after[physics].force, atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["table_wiping", "nut_assembly"])
def test_worlds_side_by_side_are_worlds_alone(name):
    states, actions, _ = played(name, "analytic")
    some = jax.tree.map(lambda leaf: jnp.asarray(leaf[20:60:10]), (states, actions))
    env = world(name, "mjx")
    many = jax.jit(
        jax.vmap(lambda state, action: env.transition(KEY, state, action, env.default_params)[0])
    )(*some)
    for index in range(4):
        one, _ = stepper(name, "mjx")(*jax.tree.map(lambda leaf, i=index: leaf[i], some))
        np.testing.assert_allclose(many.joints[index], one.joints, atol=2e-5)
        np.testing.assert_allclose(many.speeds[index], one.speeds, atol=2e-3)


@pytest.mark.slow
def test_256_nut_worlds_finish():
    """A large batch never waits for itself: LAPACK under `vmap` did, with few threads."""
    code = """
import jax, jax.numpy as jnp
from envs.compiler import set_xla_flags
set_xla_flags()
from envs.manipulation.make import make_nut_assembly
env = make_nut_assembly(range(4), range(1000, 1001), physics="mjx")
params, key = env.default_params, jax.random.key(0)
start = jax.vmap(lambda i: env.reset_to(i % 4, key, params))(jnp.arange(256))
act = jnp.zeros(7).at[6].set(1.0)
step = jax.jit(jax.vmap(lambda s: env.transition(key, s, act, params)[0]))
state = step(step(start))
assert bool(jnp.all(jnp.isfinite(state.joints)))
print("done")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=400, check=False
    )
    assert done.stdout.strip().endswith("done"), done.stderr[-2000:]


@pytest.mark.parametrize("physics", ["analytic", pytest.param("mjx", marks=pytest.mark.slow)])
def test_randomisation_is_traced_and_nominal_at_zero(physics):
    env = world("table_wiping", physics)
    states, actions, _ = played("table_wiping", "analytic")
    step = int(np.argmax(np.linalg.norm(states.force, axis=-1) > 10))
    state, action = jax.tree.map(lambda leaf: jnp.asarray(leaf[step]), (states, actions))
    traces = []

    @jax.jit
    def run(ranges):
        traces.append(None)
        params = env.with_ranges(env.default_params, ranges)
        return env.transition(KEY, state, action, params)[0]

    plain, _ = stepper("table_wiping", physics)(state, action)
    zero = run(Ranges())
    np.testing.assert_allclose(plain.joints, zero.joints, atol=1e-6)
    for name in ("friction_range", "mass_range", "damping_range", "gain_range"):
        moved = run(Ranges(**{name: 2.0}))
        assert not np.array_equal(moved.joints, zero.joints), name
        np.testing.assert_allclose(moved.joints, zero.joints, atol=0.05)
    assert len(traces) == 1  # one program for every width
