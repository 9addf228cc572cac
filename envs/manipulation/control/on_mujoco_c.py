"""Operational-space control of the arm in C MuJoCo, in NumPy: the same law, MuJoCo's quantities."""

from __future__ import annotations

from typing import Any

import numpy as np

from envs.manipulation.control.operational_space import (
    DAMPING_RATE,
    POSITION_STEP,
    ROTATION_STEP,
    STIFFNESS,
)
from envs.manipulation.physics.mujoco_c import MujocoArm
from envs.manipulation.scenes.model import FRICTION_LOSS, TORQUE_LIMIT


def _turn(vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def begin(
    arm: MujocoArm, action: Any, held: Any
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The clipped action, and the controller's goal for it: position, rotation (columns).

    `held` is the last goal's rotation, its axes as rows. MuJoCo's data is in the state.
    """
    action = np.clip(np.asarray(action, float), -1, 1)
    arm.mujoco.mj_forward(arm.model, arm.data)
    place = arm.data.site_xpos[arm.site] + POSITION_STEP * action[:3]
    if not np.any(action[3:6]):
        return action, (place, np.asarray(held, float).T)
    now = arm.data.site_xmat[arm.site].reshape(3, 3)
    return action, (place, _turn(ROTATION_STEP * action[3:6]) @ now)


def torque(arm: MujocoArm, goal: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Joint torques of `operational_space.free_motion` less friction in the joints, [6] N m."""
    data = arm.data
    jac, mass, speed = arm.jacobian(), arm.mass_matrix(), data.qvel[:6]
    twist = jac @ speed
    now = data.site_xmat[arm.site].reshape(3, 3)
    off = goal[0] - data.site_xpos[arm.site]
    turned = 0.5 * np.cross(now.T, goal[1].T).sum(0)
    inverse = np.linalg.inv(mass)
    total = np.zeros(6)
    for part, error in ((slice(0, 3), off), (slice(3, 6), turned)):
        wanted = STIFFNESS * error - DAMPING_RATE * twist[part]
        inertia = np.linalg.inv(jac[part] @ inverse @ jac[part].T)
        total += jac[part].T @ inertia @ wanted
    bias = data.qfrc_bias[:6]
    applied = np.clip(total + bias, -TORQUE_LIMIT, TORQUE_LIMIT)
    return applied - FRICTION_LOSS * np.tanh(speed / 1e-3)
