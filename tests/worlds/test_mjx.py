"""MJX as this package uses it: its repairs, its contact rows, and the solver beside its own."""

import functools
import time
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.manipulation.physics.lanes import one_after_another
from envs.manipulation.physics.mjx import closed_forms, newton, rows
from envs.manipulation.physics.mjx.repairs import mjx, private
from envs.manipulation.physics.mjx.scene import Scene
from envs.manipulation.randomisation import NOMINAL

BOX = """
<mujoco><option timestep="0.002" cone="{cone}" impratio="{ratio}"/>
<worldbody><geom name="floor" type="plane" size="1 1 .1" friction="{friction} .005 .0001"/>
<body name="arm" pos="0 0 .5"><joint name="swing" axis="0 1 0" range="-1 .1" limited="true"
  frictionloss=".02" damping=".05"/>
<geom name="arm" type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
</body>
<body name="box" pos="0 0 .049"><freejoint name="box"/>
<geom name="box" type="box" size=".05 .05 .05" friction="{friction} .005 .0001"/></body>
</worldbody></mujoco>"""


@functools.cache
def boxes(cone, solver):
    return Scene(BOX.format(cone=cone, ratio=5, friction=0.6), solver=solver)


def moving(scene):
    velocity = np.array([0.4, 0.8, -0.3, 0.1, 0.5, -0.2, 0.3], np.float32)
    start = scene.start()
    return start.replace(qpos=start.qpos.at[0].set(0.12), qvel=jnp.asarray(velocity))


def chain(links):
    """MJCF of a chain of hinges."""
    text = ""
    for index in reversed(range(links)):
        axis = "0 1 0" if index % 2 else "0 0 1"
        text = f"""<body pos="0 0 .1"><joint axis="{axis}"/>
<geom type="capsule" fromto="0 0 0 0 0 .1" size=".01" contype="0" conaffinity="0"/>{text}</body>"""
    return f"<mujoco><option timestep='0.002'/><worldbody>{text}</worldbody></mujoco>"


def kinematics_of(scene, count):
    """Frames of `count` chains, compiled with the repair and without."""
    random = np.random.default_rng(0)
    given = jnp.asarray(random.normal(size=(count, scene.model.nq)), jnp.float32)

    def frames(qpos):
        def one(qpos):
            data = scene.data(scene.start().replace(qpos=qpos))
            return mjx().kinematics(scene.put, data).xpos

        return jax.vmap(one)(qpos)

    math = private("math")
    repaired = jax.jit(frames).lower(given).compile()
    barred = math.quat_mul
    math.quat_mul = barred.__wrapped__
    try:
        plain = jax.jit(lambda qpos: frames(qpos)).lower(given).compile()
    finally:
        math.quat_mul = barred
    return given, repaired, plain


def test_the_repair_changes_no_number():
    given, repaired, plain = kinematics_of(Scene(chain(6)), 1)
    np.testing.assert_allclose(repaired(given), plain(given), atol=1e-6)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the repair acts on a CPU alone")
def test_the_repair_is_still_needed():
    """Says so when XLA or MJX no longer computes every ancestor anew for each joint."""
    given, repaired, plain = kinematics_of(Scene(chain(9)), 16)

    def seconds(program):
        jax.block_until_ready(program(given))
        times = []
        for _ in range(5):
            began = time.process_time()
            jax.block_until_ready(program(given))
            times.append(time.process_time() - began)
        return min(times)

    ratio = seconds(plain) / seconds(repaired)
    assert ratio > 3, (
        f"MJX without the barrier behind quat_mul takes {ratio:.1f} times as long: the repair in "
        "envs/manipulation/physics/mjx/repairs.py is no longer needed, remove it"
    )


FINGERS = """
<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
<body><joint name="a" axis="0 0 1" range="-1 .1" limited="true"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0" range="-.2 .5" limited="true" margin=".01"/>
<geom type="sphere" size=".03"/></body>
<body pos=".3 .1 0"><joint name="c" type="slide" axis="1 0 0" range="-.01 .02" limited="true"/>
<geom type="sphere" size=".03"/></body></body></worldbody>
<actuator><motor joint="a" gear="3"/><position joint="c" kp="40"/></actuator></mujoco>"""


@functools.cache
def fingers():
    return Scene(FINGERS)


def bent(scene):
    """Two joints beyond their limits, one within."""
    start = scene.start(qpos=[0.15, 0.0, -0.013], ctrl=[0.5, 0.01])
    return start.replace(qvel=jnp.array([0.3, -0.2, 0.1]))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the repair acts on a CPU alone")
@pytest.mark.parametrize(
    ("scene", "start"), [(lambda: boxes("elliptic", "newton"), moving), (fingers, bent)]
)
def test_a_step_scatters_nothing(scene, start):
    """One scatter keeps a step from being one function (`repairs.py`): three times the time."""
    scene = scene()
    step = jax.jit(lambda bodies: scene.step(scene.data(bodies), lambda data: data).qpos)
    assert " scatter(" not in step.lower(start(scene)).compile().as_text()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the repair acts on a CPU alone")
def test_limits_and_motors_are_mjxs():
    scene, constraint = fingers(), private("constraint")
    data = scene.placed(bent(scene))
    for repaired in (constraint._efc_limit_slide_hinge, mjx().transmission):
        original = repaired.__wrapped__
        ours, theirs = jax.tree.leaves(repaired(scene.put, data)), original(scene.put, data)
        for own, other in zip(ours, jax.tree.leaves(theirs), strict=True):
            np.testing.assert_array_equal(own, other)
        assert "scatter" in jax.jit(original).lower(scene.put, data).as_text(), (
            "MJX scatters no longer here: the repair in "
            "envs/manipulation/physics/mjx/repairs.py is no longer needed, remove it"
        )


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the repair acts on a CPU alone")
def test_the_repairs_against_scatters_are_still_needed():
    """Says so when MJX no longer scatters where it is repaired, and that they change no number."""
    math, scan = private("math"), private("scan")
    axis, angle = jnp.array([0.6, 0.0, -0.8]), jnp.float32(0.7)
    plain = math.axis_angle_to_quat.__wrapped__
    values, segments = jnp.arange(8.0).reshape(4, 2), np.array([2, 0, 2, 2])
    pairs = [
        (plain, math.axis_angle_to_quat, (axis, angle)),
        (
            lambda x: jax.ops.segment_sum(x, segments, 4),
            lambda x: scan.jax.ops.segment_sum(x, segments, 4),
            (values,),
        ),
    ]
    for original, repaired, given in pairs:
        np.testing.assert_array_equal(jax.jit(original)(*given), jax.jit(repaired)(*given))
        assert "scatter" in jax.jit(original).lower(*given).as_text(), (
            "MJX scatters no longer here: the repair in "
            "envs/manipulation/physics/mjx/repairs.py is no longer needed, remove it"
        )
        assert "scatter" not in jax.jit(repaired).lower(*given).as_text()


@pytest.mark.parametrize("shape", ["cylinder", "box"])
def test_closed_forms_are_c_mujocos(shape):
    """Random places, inside and outside; the same contact as C MuJoCo wherever it has one."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
<body pos="0 0 1"><freejoint/><geom type="{shape}" size=".05 .04 .06" margin=".05"/></body>
<body><freejoint/><geom type="sphere" size=".02" margin=".05"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    form = jax.jit(functools.partial(contact_of, shape))
    random = np.random.default_rng(0)
    found = 0
    for _ in range(300):
        turn = random.normal(size=4)
        data.qpos[3:7] = turn / np.linalg.norm(turn)
        data.qpos[7:10] = data.qpos[:3] + random.uniform(-0.15, 0.15, 3)
        mujoco.mj_forward(model, data)
        where = [data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3), model.geom_size]
        distance, point, normal = form(*(x.astype(np.float32)[[1, 0]] for x in where))
        if data.ncon:
            contact, found = data.contact[0], found + 1
            sign = 1 if contact.geom1 == 1 else -1  # from the sphere
            assert distance == pytest.approx(contact.dist, abs=2e-6)
            np.testing.assert_allclose(point, contact.pos, atol=3e-6)
            np.testing.assert_allclose(normal, sign * contact.frame[:3], atol=2e-4)
        else:
            assert distance > 0.05
    assert 150 < found < 290


def contact_of(shape, position, rotation, size):
    form = closed_forms.sphere_cylinder if shape == "cylinder" else closed_forms.sphere_box
    one, other = (
        types.SimpleNamespace(pos=p, mat=r, size=s)
        for p, r, s in zip(position, rotation, size, strict=True)
    )
    return form(one, other)


def test_a_step_calls_no_lapack():
    scene = boxes("elliptic", "newton")
    step = jax.jit(lambda bodies: scene.step(scene.data(bodies), lambda data: data).qpos)
    text = step.lower(moving(scene)).as_text()
    assert "lapack" not in text
    assert "cholesky" not in text, "MJX factors a matrix by LAPACK in a step again"


def test_contact_rows_are_mjxs():
    scene = boxes("elliptic", "newton")

    @jax.jit
    def both(bodies):
        seen = {}

        def control(data):
            seen["data"] = data
            return data

        scene.step(scene.data(bodies), control)
        data = seen["data"]
        made = mjx().make_constraint(scene.put, data)._impl
        return rows.cones(scene, scene.put, data), rows.rows(scene, scene.put, data), made

    ours, others, theirs = jax.device_get(both(moving(scene)))
    count, size = len(others.weight), scene.model.nv
    contact = theirs.efc_J[count:].reshape(-1, 3, size)
    closed = np.any(contact != 0, (1, 2))
    assert closed.sum() == 4
    jacobian = np.transpose(ours.jacobian, (2, 1, 0))[:, [2, 0, 1]]
    np.testing.assert_allclose(jacobian[closed], contact[closed], atol=1e-6)
    reference = ours.reference.T[:, [2, 0, 1]]
    np.testing.assert_allclose(
        reference[closed], theirs.efc_aref[count:].reshape(-1, 3)[closed], rtol=2e-4, atol=1e-3
    )
    np.testing.assert_allclose(
        ours.weight[closed], theirs.efc_D[count:].reshape(-1, 3)[closed, 0], rtol=1e-4
    )
    assert np.all(ours.weight[~closed] == 0)
    np.testing.assert_allclose(others.jacobian, theirs.efc_J[:count])


def test_pyramids_are_left_to_mjx():
    scene = Scene(BOX.format(cone="pyramidal", ratio=1, friction=0.6))
    assert scene.solver == "mjx"
    with pytest.raises(ValueError, match="cannot solve pyramidal cones"):
        boxes("pyramidal", "newton")


def test_newton_solves_what_mjx_solves():
    found = {}
    for solver in ("newton", "mjx"):
        scene = boxes("elliptic", solver)
        found[solver] = jax.jit(
            lambda bodies, scene=scene: scene.advance(
                bodies, lambda data: data, lambda data: data.qacc
            )
        )(moving(scene))
    ours, theirs = found["newton"][0], found["mjx"][0]
    np.testing.assert_allclose(ours.qpos, theirs.qpos, atol=2e-4)
    np.testing.assert_allclose(ours.qvel, theirs.qvel, atol=2e-2)


@pytest.mark.parametrize("size", [3, 8, 9, 14, 21])
def test_solving_without_lapack(size):
    random = np.random.default_rng(size)
    half = random.normal(size=(size, size)).astype(np.float32)
    matrix, right = half @ half.T + size * np.eye(size, dtype=np.float32), half[0]
    np.testing.assert_allclose(
        jax.jit(newton.solve_spd)(matrix, right),
        np.linalg.solve(matrix.astype(float), right),
        rtol=1e-4,
        atol=1e-5,
    )


def primitives(jaxpr, found):
    """Names of all primitives, and of scans with their lengths."""
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        found.add(f"scan {equation.params['length']}" if name == "scan" else name)
        for value in jax.tree.leaves(equation.params, is_leaf=lambda v: hasattr(v, "eqns")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                primitives(inner, found)
    return found


def test_on_an_accelerator_a_batch_is_one_program(monkeypatch):
    """On a CPU seven worlds go one after another; elsewhere none does, and nothing calls back."""
    scene = fingers()

    def advance(bodies, action, factors):
        put = scene.varied(factors)
        control = lambda data: data.replace(qfrc_applied=action)  # noqa: E731
        return scene.advance(bodies, control, lambda data: data.qacc, put)[0]

    def used():
        def step(action):
            return one_after_another(advance, bent(scene), action, NOMINAL)

        return primitives(jax.make_jaxpr(jax.vmap(step))(jnp.zeros((7, 3))).jaxpr, set())

    assert {"scan 7", "scan 25"} <= used()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    elsewhere = used()
    assert "scan 25" in elsewhere
    assert "scan 7" not in elsewhere
    assert not [name for name in elsewhere if "callback" in name]


def test_warp_is_mjx():
    """MuJoCo Warp on its CPU device, where warp-lang is installed: one control step, two worlds."""
    pytest.importorskip("warp", reason="MuJoCo Warp (the extra `warp`) is not installed")
    ends = []
    for impl in ("jax", "warp"):
        scene = Scene(FINGERS, impl=impl)

        def advance(torque, scene=scene):
            bodies, mass = scene.advance(
                bent(scene), lambda data: data.replace(qfrc_applied=torque), scene.mass_matrix
            )
            return bodies.qpos, bodies.qvel, mass

        ends.append(jax.jit(jax.vmap(advance))(jnp.array([[0.0, 0.1, 0.0], [0.2, 0.0, -0.1]])))
    for ours, theirs in zip(*ends, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-4)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"impl": "cuda"}, "impl must be one of jax, warp, got 'cuda'"),
        ({"impl": "warp", "solver": "newton"}, "impl 'warp' has its own solver"),
    ],
)
def test_an_impl_that_cannot_be_is_one_line(options, error):
    with pytest.raises(ValueError, match=error):
        Scene(FINGERS, **options)


def test_warp_that_is_not_installed_is_one_line(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ImportError, match="impl 'warp' needs MuJoCo Warp: pip install"):
        Scene(FINGERS, impl="warp")
