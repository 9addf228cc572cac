"""The wiper pressed on the table: soft contact with friction, as MuJoCo's elliptic cones.

robosuite's wiper is a grid of small boxes whose 56 lower corners touch the table. Here they are 56
points of one rigid rectangle, each with the same soft contact, solved together by Newton's method
on MuJoCo's own convex cost in the six joint accelerations a:

    min_a  1/2 (a - a0)' M (a - a0) + sum_i s(J_i a - aref_i)

with s the elliptic cone's cost (MuJoCo documentation, "Computation", constraint model).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import Motion, cross
from envs.manipulation.physics.analytic.contact import Friction, cone, cone_force, impedance
from envs.manipulation.scenes.model import WIPING_BASE, WIPING_TABLE

# Contact of one point. MuJoCo 2.3.7 reports half of the true depth for a box that lies flat on
# another, so that robosuite's wiper is twice as soft as its table of parameters says; the
# recordings show it, and the half is kept.
DEPTH_SCALE = 0.5
TIME_CONSTANT = 0.05  # s; damping ratio 1
IMPEDANCE = (0.2, 0.9, 0.01)  # at no depth, at full width, width (m)
FRICTION = 0.03
INVERSE_WEIGHT = 0.0843  # 1/kg, of the wiper in the arm's reference pose (MuJoCo's invweight0)
ITERATIONS = 2

_X = np.array([-60, -50, -45, -35, -25, -15, -5, 5, 15, 25, 35, 45, 50, 60]) * 1e-3
_Y = np.array([-30, -10, 10, 30]) * 1e-3
POINTS = np.stack(np.meshgrid(_X, _Y, indexing="ij"), -1).reshape(-1, 2).astype(np.float32)
# in the frame of the arm's base: centre [2] and half size [2] of the table's top, and its height
TABLE_CENTRE = np.array(WIPING_TABLE[0], np.float32) - np.array(WIPING_BASE[:2], np.float32)
TABLE_HALF = np.array(WIPING_TABLE[1], np.float32)
TABLE_TOP = float(WIPING_TABLE[2] - WIPING_BASE[2])
_PX, _PY = POINTS[:, 0], POINTS[:, 1]
_BASIS = np.stack([np.ones_like(_PX), _PX, _PY, _PX**2, _PX * _PY, _PY**2])  # [6, P]

_STIFFNESS = 1.0 / (IMPEDANCE[1] * TIME_CONSTANT) ** 2
_DAMPING = 2.0 / (IMPEDANCE[1] * TIME_CONSTANT)


class Touch(NamedTuple):
    """The effect of the table on the wiper.

    Attributes:
        acceleration: [6] of the joints, rad/s^2, contact included.
        force: [3] on the wiper, N, world axes.
    """

    acceleration: jax.Array
    force: jax.Array


def over_table(place: jax.Array) -> jax.Array:
    """Which places [..., 2], m in the frame of the arm's base, lie over the table."""
    return jnp.all(jnp.abs(place - TABLE_CENTRE) < TABLE_HALF, -1)


def press(motion: Motion, start: jax.Array, friction: Friction = FRICTION) -> Touch:
    """Contact of the wiper's face with the table; a point beyond its edge touches nothing.

    Args:
        motion: Motion of the arm without contact.
        start: Acceleration to start from, rad/s^2: the last step's.
        friction: Coefficient.
    """
    at = motion.at
    x, y = at.rotation[0], at.rotation[1]
    place = jnp.stack([at.position[k] + _PX * x[k] + _PY * y[k] for k in range(2)], -1)
    height = at.position[2] - TABLE_TOP + _PX * x[2] + _PY * y[2]
    height = jnp.where(over_table(place), height, 1.0)
    reported = DEPTH_SCALE * jnp.maximum(-height, 0.0)
    d = impedance(reported, *IMPEDANCE)
    weight = jnp.where(height < 0, d / ((1 - d) * INVERSE_WEIGHT), 0.0)  # 1/R, kg
    spring = _STIFFNESS * d * reported
    # per joint, the acceleration field c + u px + w py of the face: [9, 6]
    fields = jax.lax.optimization_barrier(_fields(motion))
    mass = unrolled_linalg.array(motion.matrix)
    free = jnp.stack(motion.acceleration)
    speed = jnp.stack(motion.speeds)

    def rows(joint: jax.Array) -> jax.Array:
        field = fields @ joint
        return field[:3, None] + field[3:6, None] * _PX + field[6:, None] * _PY

    # residual of a row: J a + b v, and - k d depth on the normal
    rest = _DAMPING * rows(speed) - jnp.stack([jnp.zeros_like(spring)] * 2 + [spring])

    def improve(a: jax.Array) -> jax.Array:
        force, hessian = cone(rows(a) + rest, weight, friction)
        moments = (force @ _BASIS[:3].T).T.reshape(9)
        matrix = mass + fields.T @ _spread(hessian @ _BASIS.T) @ fields
        residual = fields.T @ moments - mass @ (a - free)
        return a + unrolled_linalg.solve_array(matrix, residual)

    a = jnp.where(jnp.any(height < 0), start, free)
    for _ in range(ITERATIONS):
        a = jax.lax.optimization_barrier(improve(a))
    return Touch(a, jnp.sum(cone_force(rows(a) + rest, weight, friction), -1))


def _fields(motion: Motion) -> jax.Array:
    x_axis, y_axis, _ = motion.at.rotation
    entries = [
        [*linear, *cross(angular, x_axis), *cross(angular, y_axis)]
        for linear, angular in motion.columns
    ]
    return unrolled_linalg.array(zip(*entries, strict=True))


# where entry (axis a of moment i, axis b of moment j) of the 9 x 9 form lies in the [6, 6] sums
_ENTRY = np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])
_MOMENT = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_PLACE = (_ENTRY[None, :, None, :] * 6 + _MOMENT[:, None, :, None]).reshape(81).astype(np.int32)


def _spread(sums: jax.Array) -> jax.Array:
    return sums.reshape(36)[_PLACE].reshape(9, 9)
