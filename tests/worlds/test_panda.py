"""The seven-joint arm: its kinematics, and what the operational-space controller does with it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.manipulation.control.on_mjx import OperationalSpace
from envs.manipulation.physics.mjx.scene import Scene
from envs.manipulation.physics.mujoco_c import import_mujoco
from envs.manipulation.scenes.panda import FLANGE, JOINTS, LIMITS, REST, TORQUE_LIMIT, panda_arm

GRIP = 0.1
# Franka Control Interface documentation: a, d, alpha (modified) of each joint
DENAVIT_HARTENBERG = [
    (0, 0.333, 0), (0, 0, -np.pi / 2), (0, 0.316, np.pi / 2), (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2), (0, 0, np.pi / 2), (0.088, 0, np.pi / 2), (0, FLANGE, 0),
]  # fmt: skip


@functools.cache
def scene():
    tool = '<geom type="capsule" fromto="0 0 0 0 0 .1" size=".01" mass=".2" contype="0"/>'
    return Scene(
        f'<mujoco><compiler angle="radian"/><option timestep=".002" cone="elliptic"/>'
        f"<worldbody>{panda_arm(tool, grip=GRIP)}</worldbody></mujoco>"
    )


@functools.cache
def arm():
    return OperationalSpace(
        scene(), joints=JOINTS, site="grip", torque_limit=TORQUE_LIMIT, rest=REST
    )


@functools.cache
def _place():
    def place(bodies):
        data = scene().placed(bodies)
        site = arm().site
        return data.site_xpos[site], data.site_xmat[site], arm().jacobian(data)

    return jax.jit(place)


@functools.cache
def _step():
    def step(bodies, held, place, action):
        data = scene().placed(bodies)
        goal = arm().goal(data, action, held)
        # a place to go to is given straight, so that the goal does not move with the arm
        goal = goal._replace(position=jnp.where(jnp.isnan(place), goal.position, place))
        bodies, torque = scene().advance(
            bodies,
            lambda data: data.replace(qfrc_applied=arm().torque(data, goal)),
            lambda data: data.qfrc_applied,
        )
        return bodies, goal.rotation, torque

    return jax.jit(step)


def settled(joints, place=(np.nan,) * 3, steps=40):
    """The arm's state, site and last torques after `steps` control steps without an action."""
    bodies = scene().start(joints)
    held, torque = _place()(bodies)[1], jnp.zeros(7)
    for _ in range(steps):
        bodies, held, torque = _step()(bodies, held, jnp.asarray(place), jnp.zeros(6))
    return bodies, _place()(bodies), torque


def test_kinematics_are_the_published_ones():
    mujoco = import_mujoco()
    joints = np.random.default_rng(0).uniform(LIMITS[:, 0], LIMITS[:, 1])
    data = mujoco.MjData(scene().full)
    data.qpos[:] = joints
    mujoco.mj_kinematics(scene().full, data)
    frame = np.eye(4)
    angles = np.append(joints, 0.0)
    for (a, d, alpha), angle in zip(DENAVIT_HARTENBERG, angles, strict=True):
        c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
        frame = frame @ [
            [c, -s, 0, a],
            [s * ca, c * ca, -sa, -d * sa],
            [s * sa, c * sa, ca, d * ca],
            [0, 0, 0, 1],
        ]
    np.testing.assert_allclose(data.body("hand").xpos, frame[:3, 3], atol=1e-12)
    np.testing.assert_allclose(
        data.site("grip").xpos, frame[:3, 3] + GRIP * frame[:3, 2], atol=1e-12
    )


def test_at_rest_the_hand_points_down_and_its_x_axis_ahead():
    place, axes, _ = _place()(scene().start(REST))
    np.testing.assert_allclose(axes[:, 2], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(axes[:, 0], [1, 0, 0], atol=1e-6)
    assert 0.3 < place[0] < 0.6


def test_it_holds_its_pose():
    bodies, (place, axes, _), torque = settled(REST)
    first, first_axes, _ = _place()(scene().start(REST))
    np.testing.assert_allclose(place, first, atol=5e-4)
    np.testing.assert_allclose(axes, first_axes, atol=5e-3)
    np.testing.assert_allclose(bodies.qpos, REST, atol=5e-3)
    assert np.all(np.abs(torque) < TORQUE_LIMIT)


@pytest.mark.parametrize("shift", [(0.08, 0.0, 0.0), (0.0, -0.1, 0.05)])
def test_it_goes_where_it_is_sent(shift):
    first, first_axes, _ = _place()(scene().start(REST))
    _, (place, axes, _), _ = settled(REST, first + jnp.asarray(shift))
    np.testing.assert_allclose(place, first + jnp.asarray(shift), atol=3e-3)
    np.testing.assert_allclose(axes, first_axes, atol=2e-2)


def test_the_seventh_joint_is_drawn_to_the_rest_pose_while_the_site_stays():
    jacobian = _place()(scene().start(REST))[2]
    free = np.linalg.svd(np.asarray(jacobian).T)[2][-1]  # moves the arm and not its site
    start = REST + 0.25 * free
    site = _place()(scene().start(start))[0]
    bodies, (place, _, _), _ = settled(start, site, steps=80)
    left = np.abs(free @ (np.asarray(bodies.qpos) - REST))
    assert left < 0.06
    np.testing.assert_allclose(place, site, atol=3e-3)
