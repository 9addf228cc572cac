"""The UR5e worlds: against C MuJoCo, MJX and recorded robosuite, and as properties."""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.manipulation.control import operational_space
from envs.manipulation.make import make_nut_assembly, make_table_wiping
from envs.manipulation.physics.analytic import arm, grasp_contact, wipe_contact
from envs.manipulation.scenes.model import GRIPPER, INITIAL_JOINTS, TIMESTEP, WIPER
from envs.manipulation.tasks import nut, wiping
from envs.manipulation.tasks.markers import COUNT, SPACING, draw_markers
from ppl_jax import algorithms
from ppl_jax.config import values
from ppl_jax.evaluation import make_evaluate
from ppl_jax.predictors import predict

KEY = jax.random.key(0)
WORLDS = ("table_wiping", "nut_assembly")


@functools.cache
def world(name):
    make = {"table_wiping": make_table_wiping, "nut_assembly": make_nut_assembly}[name]
    return make(range(8), range(1000, 1008))


@functools.cache
def transition(name):
    env = world(name)
    return jax.jit(lambda state, action: env.transition(KEY, state, action, env.default_params))


@functools.cache
def four_together(name):
    env = world(name)
    return jax.jit(
        jax.vmap(lambda state, action: env.transition(KEY, state, action, env.default_params))
    )


@functools.cache
def expert_action(name):
    env = world(name)
    return jax.jit(lambda state: env.scripted_expert(KEY, state, None, env.default_params))


def start(name, index=0):
    env = world(name)
    return env.reset_to(jnp.int32(index), KEY, env.default_params)


def close(a, b, tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), atol=tolerance, rtol=tolerance)


# ---- the arm


@pytest.fixture(scope="module")
def mujoco():
    return pytest.importorskip("mujoco")


def arm_values(q, v, tool):
    at = arm.frames([jnp.float32(x) for x in q], tool)
    columns = np.array([np.concatenate(c) for c in arm.jacobian(at)]).T
    mass = np.array(arm.mass_matrix(at, tool))
    bias = np.array(arm.bias_torque(at, tool, [jnp.float32(x) for x in v]))
    return np.array(at.position), np.array(at.rotation).T, columns, mass, bias


@pytest.mark.parametrize("name", WORLDS)
def test_arm_is_c_mujocos(mujoco, name):
    from envs.manipulation.drawn import arm_of
    from envs.manipulation.physics.mujoco_c import nut_xml, wiping_xml

    twin = arm_of(wiping_xml() if name == "table_wiping" else nut_xml())
    tool, model, data = (WIPER if name == "table_wiping" else GRIPPER), twin.model, twin.data
    base = model.body("mount").pos
    random = np.random.default_rng(0)
    for _ in range(3):
        q = INITIAL_JOINTS + random.normal(0, 0.5, 6)
        v = random.normal(0, 1, 6)
        data.qpos[:6], data.qvel[:] = q, 0
        data.qvel[:6] = v
        mujoco.mj_forward(model, data)
        position, rotation, columns, mass, bias = arm_values(q, v, tool)
        jac = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, jac[:3], jac[3:], twin.site)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(position + base, data.site_xpos[twin.site], atol=1e-6)
        np.testing.assert_allclose(rotation, data.site_xmat[twin.site].reshape(3, 3), atol=2e-6)
        np.testing.assert_allclose(columns, jac[:, :6], atol=2e-6)
        # the fingers of the twin weigh a few micrograms of their own
        np.testing.assert_allclose(mass, full[:6, :6], atol=2e-5)
        np.testing.assert_allclose(bias, data.qfrc_bias[:6], atol=2e-4)


def test_arm_and_pressed_wiper_are_mjxs(mujoco):
    """MJX defines the physics: mass, bias and the acceleration under contact agree with it."""
    mjx = pytest.importorskip("mujoco.mjx")
    from envs.manipulation.physics.mujoco_c import wiping_xml

    model = mujoco.MjModel.from_xml_string(wiping_xml(markers=0))
    record = pressed_state()
    data = mujoco.MjData(model)
    torque = np.array([1.0, -20.0, 12.0, 3.0, -2.0, 0.5])
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = record[0], record[1], torque
    put = mjx.put_model(model)
    seen = jax.jit(mjx.forward)(put, mjx.put_data(model, data))
    _, _, _columns, mass, bias = arm_values(record[0], record[1], WIPER)
    np.testing.assert_allclose(mass, np.asarray(mjx.full_m(put, seen)), atol=1e-4)
    np.testing.assert_allclose(bias, np.asarray(seen.qfrc_bias), atol=1e-3)
    passive = np.asarray(seen.qfrc_passive)
    free = np.linalg.solve(mass, torque + passive - bias)
    at = arm.frames([jnp.float32(x) for x in record[0]], WIPER)
    joints = [jnp.float32(x) for x in record[1]]
    motion = operational_space.Motion(
        at,
        arm.jacobian(at),
        operational_space.twist_of(arm.jacobian(at), joints),
        [[jnp.float32(x) for x in row] for row in mass],
        [jnp.float32(x) for x in free],
        joints,
    )
    touch = wipe_contact.press(motion, jnp.asarray(free, jnp.float32))
    assert float(touch.force[2]) > 5.0
    np.testing.assert_allclose(touch.acceleration, seen.qacc, atol=0.02, rtol=0.02)


def pressed_state():
    """Joints and speeds of a wiper that slides, pressed a millimetre into the table."""
    state = start("table_wiping")
    act, step = expert_action("table_wiping"), transition("table_wiping")
    for _ in range(400):
        state, _ = step(state, act(state))
        if float(jnp.linalg.norm(state.force)) > 10:
            return np.asarray(state.joints, float), np.asarray(state.speeds, float)
    raise AssertionError("the wiper never pressed")


# ---- properties


@pytest.mark.parametrize("name", WORLDS)
def test_vmap_equals_loop(name):
    env = world(name)
    states = [start(name, index) for index in range(4)]
    actions = jax.random.uniform(KEY, (4, env.spec.action_size), minval=-1.0)
    together = four_together(name)(jax.tree.map(lambda *x: jnp.stack(x), *states), actions)
    for index, (state, action) in enumerate(zip(states, actions, strict=True)):
        alone = transition(name)(state, action)
        close(jax.tree.map(lambda x, i=index: x[i], together), alone, 2e-3)


@pytest.mark.parametrize("name", WORLDS)
def test_lookahead_is_the_world_and_leaves_no_trace(name):
    env = world(name)
    state = start(name)
    for _ in range(3):
        state, _ = transition(name)(state, expert_action(name)(state))
    before = jax.tree.map(np.array, state)
    action = expert_action(name)(state)
    ahead = jax.jit(
        lambda s, a: predict(
            env,
            env.transition,
            KEY,
            s,
            action=a,
            params=env.default_params,
            horizon=5,
            observe=True,
        )
    )(state, action)
    close(state, before, 0)
    for k in range(5):
        state, outcome = transition(name)(state, action)
        np.testing.assert_allclose(ahead.reward[k], outcome.reward, atol=1e-4)
        np.testing.assert_allclose(
            ahead.observation[k], env.observe(state, env.default_params), atol=2e-3
        )


@pytest.mark.parametrize("name", WORLDS)
def test_broken_physics_ends_one_world_and_spreads_nowhere(name):
    env = world(name)
    states = jax.tree.map(lambda *x: jnp.stack(x), *(start(name, index) for index in range(4)))
    states = states.replace(speeds=states.speeds.at[0, 0].set(jnp.nan))
    actions = jnp.zeros((4, env.spec.action_size))
    after, outcome = four_together(name)(states, actions)
    assert list(np.asarray(outcome.physics_diverged)) == [True, False, False, False]
    assert list(np.asarray(outcome.terminated)) == [True, False, False, False]
    assert not bool(outcome.success[0])
    assert np.isfinite(np.asarray(outcome.reward)).all()
    alone, _ = transition(name)(start(name, 1), actions[1])
    close(jax.tree.map(lambda x: x[1], after), alone, 1e-4)


@pytest.mark.parametrize("name", WORLDS)
def test_experts_solve_held_out_starts(name):
    env = world(name)
    act = env.scripted_expert
    episodes = jax.jit(make_evaluate(env, act))(env.held_out_params, KEY)
    assert float(jnp.mean(episodes.success)) >= 7 / 8
    assert float(jnp.sum(episodes.episodic_cost)) <= 1


def test_batched_arms_do_not_recompute():
    """Fused naively, a joint's frame is computed again for all that follow: sixty times slower."""
    joints = jnp.asarray(INITIAL_JOINTS, jnp.float32)
    goal = tuple(tuple(row) for row in np.eye(3, dtype=np.float32))

    def run(joints):
        def step(carry, _):
            q, v = carry
            motion = operational_space.free_motion(
                list(q),
                list(v),
                goal=((0.3, 0.0, 0.2), goal),
                tool=WIPER,
                weight=[jnp.zeros(())] * 6,
            )
            v = v + TIMESTEP * jnp.stack(motion.acceleration)
            return (q + TIMESTEP * v, v), None

        return jax.lax.scan(step, (joints, jnp.zeros(6)), None, length=200)[0]

    def seconds(function, argument):
        jax.block_until_ready(function(argument))
        times = []
        for _ in range(5):
            began = time.perf_counter()
            jax.block_until_ready(function(argument))
            times.append(time.perf_counter() - began)
        return min(times)

    one = seconds(jax.jit(run), joints)
    many = seconds(jax.jit(jax.vmap(run)), jnp.stack([joints] * 64))
    assert many / 64 < 6 * one  # two or three on a quiet machine


def test_a_large_batch_of_grasps_runs_through():
    """LAPACK inside a vectorised program deadlocks two threads at 256 worlds: there is none."""
    env = world("nut_assembly")
    states = jax.vmap(lambda i: env.reset_to(i % 8, KEY, env.default_params))(jnp.arange(256))
    step = jax.jit(jax.vmap(lambda s, a: env.transition(KEY, s, a, env.default_params)))
    program = step.lower(states, jnp.zeros((256, 7))).compile()
    assert "lapack" not in program.as_text()
    after, outcome = program(states, jnp.zeros((256, 7)))
    assert not bool(jnp.any(outcome.physics_diverged))
    np.testing.assert_allclose(after.joints[8:16], after.joints[:8], atol=1e-6)


def test_contact_does_not_vanish():
    """A wiper under the table's top is pushed up, the more the deeper, from any solver start."""
    q, last = np.asarray(pressed_state()[0]), 0.0
    for depth in (0.0005, 0.002, 0.008):
        at = arm.frames([jnp.float32(x) for x in q], WIPER)
        x, y, _ = at.position
        at = at._replace(position=(x, y, jnp.float32(wipe_contact.TABLE_TOP - depth)))
        columns = arm.jacobian(at)
        mass = arm.mass_matrix(at, WIPER)
        zero = [jnp.zeros(())] * 6
        motion = operational_space.Motion(
            at, columns, operational_space.twist_of(columns, zero), mass, zero, zero
        )
        forces = []
        for begin in (jnp.zeros(6), jnp.full(6, 50.0)):
            for _ in range(4):  # each physics step starts where the last one ended
                touch = wipe_contact.press(motion, begin)
                begin = touch.acceleration
            forces.append(float(touch.force[2]))
        assert forces[0] > last + 0.5
        np.testing.assert_allclose(forces[0], forces[1], rtol=1e-2)
        last = forces[0]


def test_markers_walk_inside_the_table():
    half = (0.25, 0.4)
    walks = jax.vmap(lambda key: draw_markers(key, half))(jax.random.split(KEY, 50))
    assert walks.shape == (50, COUNT, 2)
    steps = jnp.linalg.norm(jnp.diff(walks, axis=1), axis=-1)
    np.testing.assert_allclose(steps, SPACING, rtol=1e-3)
    assert bool(jnp.all(jnp.abs(walks) <= jnp.array([0.13, 0.22])))


def test_wiping_needs_pressure_and_the_face():
    """A marker is wiped under the face, with the plane of its corners below it, not above."""
    state = start("table_wiping")
    at = arm.frames([jnp.float32(x) for x in np.asarray(state.joints)], WIPER)
    site = np.array([float(x) for x in at.position])
    for lift, expected in ((0.001, False), (-0.001, True), (-0.03, False)):
        moved = at._replace(position=(site[0], site[1], wipe_contact.TABLE_TOP + lift))
        level = moved._replace(rotation=((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
        spots = jnp.array([[site[0], site[1]], [site[0] + 0.03, site[1]]])
        assert list(np.asarray(wiping.under_face(level, spots))) == [expected, False]


def test_stages_of_the_nut():
    far, on_table = jnp.array([0.0, 0.0, 1.0]), jnp.array([-0.11, -0.15, 0.83])
    staged, on = nut.stages(far, on_table, on_table, touching=jnp.array(False), time=jnp.int32(60))
    assert not bool(on)
    assert float(staged[1]) == 0
    staged, _ = nut.stages(
        on_table, on_table, on_table, touching=jnp.array(True), time=jnp.int32(60)
    )
    assert float(staged[0]) == pytest.approx(0.1)
    assert float(staged[1]) == pytest.approx(0.35)
    lifted = jnp.array([0.23, -0.10, 0.995])
    staged, on = nut.stages(lifted, lifted, lifted, touching=jnp.array(True), time=jnp.int32(60))
    assert float(staged[3]) == pytest.approx(0.7)
    assert not bool(on)
    assert bool(
        nut.stages(
            lifted, lifted.at[2].set(0.86), lifted, touching=jnp.array(True), time=jnp.int32(1)
        )[1]
    )


def test_contact_rows_of_the_grasp_are_velocities():
    """Points of the pads move with knuckles as their geometry says (central differences)."""
    origin, axes = jnp.zeros(3), jnp.eye(3)
    fingers, inner = jnp.array([0.2, 0.4]), jnp.array([-0.3, -0.25])
    _, slopes = grasp_contact.pad_points(origin, axes, fingers, inner)
    ahead, _ = grasp_contact.pad_points(origin, axes, fingers + 1e-3, inner)
    behind, _ = grasp_contact.pad_points(origin, axes, fingers - 1e-3, inner)
    np.testing.assert_allclose((ahead - behind) / 2e-3, slopes, atol=2e-4)


# ---- settings


def test_presets_of_the_tasks():
    found = values(*algorithms.settings("ppl", "table_wiping", "paper"))
    assert (found["total_steps"], found["gate"]) == (4000, "low_return")
    assert (found["preference_horizon"], found["min_return"]) == (4, 1.0)
    found = values(*algorithms.settings("ppl", "nut_assembly"))
    names = ("total_steps", "preference_horizon", "min_return")
    assert [found[name] for name in names] == [200_000, 6, 2.0]
    with pytest.raises(ValueError, match="is not for table_wiping: choose default or paper"):
        algorithms.settings("ppl", "table_wiping", "reference")


# ---- against robosuite


def test_recorded_robosuite(robosuite_recordings):
    from envs.manipulation.fidelity import fidelity

    figures = fidelity(robosuite_recordings)
    assert figures["free_motion_error_1s_max"] < 2e-3
    assert figures["step_response_error"] < 0.03
    assert figures["press_force_error"] < 0.2
    assert figures["obs_max_abs_error"] < 1e-5
    assert figures["wipe_reward_agreement"] >= 0.95
    assert figures["nut_reward_agreement"] >= 0.90
    assert figures["nut_position_error_median"] < 5e-3
    assert figures["lookahead_return_error"] < 0.15


def test_fidelity_names_a_missing_folder(tmp_path):
    from envs.manipulation.fidelity import fidelity

    with pytest.raises(ValueError, match="no folder of recordings"):
        fidelity(tmp_path / "none")
    with pytest.raises(ValueError, match="no recording"):
        fidelity(tmp_path)
