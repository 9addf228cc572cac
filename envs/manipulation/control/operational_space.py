"""Operational-space control (robosuite's OSC_POSE, fixed impedance) and the arm's free motion."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import (
    Matrix,
    Motion,
    Vector,
    add,
    combine,
    cross,
    dot,
    drag,
    frames,
    jacobian,
    joint_torque,
    mass_matrix,
    scale,
    twist_of,
)
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import (
    DAMPING,
    FRICTION_LOSS,
    TORQUE_LIMIT,
    Tool,
)

Scalar = Any

STIFFNESS = 150.0  # 1/s^2, of position and orientation
DAMPING_RATE = 2.0 * STIFFNESS**0.5  # 1/s: critical
POSITION_STEP, ROTATION_STEP = 0.05, 0.5  # m and rad, what an action of 1 asks for
POSTURE = 10.0  # 1/s^2, of an arm of more than six joints towards its rest pose
_SETTLING = 1e-3  # rad/s, within which friction in the joints builds up


def rotation_from(vector: Vector) -> Matrix:
    """Rotation by |vector| about vector (Rodrigues), finite at zero."""
    square = dot(vector, vector)
    angle = jnp.sqrt(square + 1e-20)
    sine = jnp.sin(angle) / angle
    # 0 where the floor cuts in, whose square is a number, for the derivative
    fall = (1.0 - jnp.cos(angle)) / jnp.maximum(angle * angle, 1e-18)
    x, y, z = vector
    return (
        (1.0 - fall * (y * y + z * z), fall * x * y + sine * z, fall * x * z - sine * y),
        (fall * x * y - sine * z, 1.0 - fall * (x * x + z * z), fall * y * z + sine * x),
        (fall * x * z + sine * y, fall * y * z - sine * x, 1.0 - fall * (x * x + y * y)),
    )


def new_goal(
    action: list[Scalar], position: Vector, rotation: Matrix, held: Matrix
) -> tuple[Vector, Matrix]:
    """Goal of a control step: where the grip site is now, moved and turned by the action.

        x_goal = x + 0.05 a[:3],  R_goal = exp(0.5 a[3:]) R,  or the last R_goal where a[3:] = 0

    Source: robosuite 1.4.1, `controllers/osc.py`, `set_goal`.
    """
    goal = add(position, scale(POSITION_STEP, tuple(action[:3])))
    turn = rotation_from(scale(ROTATION_STEP, tuple(action[3:6])))
    turned = any_nonzero(action[3:6])
    columns = []
    for now, before in zip(rotation, held, strict=True):
        new = combine(turn, now)
        columns.append(tuple(jnp.where(turned, a, b) for a, b in zip(new, before, strict=True)))
    return goal, tuple(columns)


def any_nonzero(values: list[Scalar]) -> Scalar:
    """Whether any of them is not zero."""
    found = values[0] != 0
    for value in values[1:]:
        found = found | (value != 0)
    return found


def task_torque(
    columns: list[tuple[Vector, Vector]],
    factor: list[list[Scalar]],
    *,
    site: tuple[Vector, Matrix],
    twist: tuple[Vector, Vector],
    goal: tuple[Vector, Matrix],
    gain: Scalar = 1.0,
) -> list[Scalar]:
    """Joint torques that pull the grip site to its goal, gravity and limits left out.

        tau = J' [L_p (k e_p - d v); L_o (k e_o - d w)],  d = 2 sqrt(k)
        L_p = (J_p M^-1 J_p')^-1,  L_o = (J_o M^-1 J_o')^-1,  e_o = sum_i R_i x G_i / 2

    Source: robosuite 1.4.1, `controllers/osc.py`, `run_controller` (position and orientation
    uncoupled).

    Args:
        columns: Jacobian of the site, per joint (linear, angular).
        factor: `unrolled_linalg.cholesky` of the joint-space inertia M.
        site: Position and rotation (columns) of the site.
        twist: Its velocity, m/s and rad/s.
        goal: Position and rotation that it is to have.
        gain: Factor on the stiffness k; the damping stays critical.
    """
    halves = unrolled_linalg.materialize(
        [
            unrolled_linalg.forward(factor, [column[part][axis] for column in columns])
            for part in (0, 1)
            for axis in range(3)
        ]
    )
    stiffness, damping = STIFFNESS, DAMPING_RATE
    if not isinstance(gain, float):
        stiffness, damping = gain * STIFFNESS, jnp.sqrt(gain) * DAMPING_RATE
    error = add(goal[0], scale(-1.0, site[0]))
    twisted: Vector = (0.0, 0.0, 0.0)
    for now, wanted in zip(site[1], goal[1], strict=True):
        twisted = add(twisted, scale(0.5, cross(now, wanted)))
    linear, angular = twist
    wanted_force = [stiffness * e - damping * v for e, v in zip(error, linear, strict=True)]
    wanted_torque = [stiffness * e - damping * v for e, v in zip(twisted, angular, strict=True)]
    inverse = [[unrolled_linalg.inner(a, b) for b in halves] for a in halves[:3]]
    force = unrolled_linalg.apply_inverse3([row[:3] for row in inverse], wanted_force)
    inverse = [[unrolled_linalg.inner(a, b) for b in halves[3:]] for a in halves[3:]]
    torque = unrolled_linalg.apply_inverse3(inverse, wanted_torque)
    return joint_torque(columns, tuple(force), tuple(torque))


def nullspace_torque(
    columns: list[tuple[Vector, Vector]],
    factor: list[list[Scalar]],
    *,
    mass: list[list[Scalar]],
    offset: list[Scalar],
    speeds: list[Scalar],
) -> list[Scalar]:
    """Torques that pull an arm of more than six joints to a rest pose without moving its site.

        tau = (I - J' L J M^-1) M (k (q_0 - q) - 2 sqrt(k) dq),  L = (J M^-1 J')^-1,  k = 10

    Source: robosuite 1.4.1, `controllers/osc.py` and `utils/control_utils.py`,
    `nullspace_torques`. Zero for six joints, where the site's pose fixes them all.

    Args:
        columns, factor: As for `task_torque`.
        mass: The inertia itself.
        offset: q_0 - q, rad. speeds: dq, rad/s.
    """
    pull = [
        POSTURE * away - 2.0 * POSTURE**0.5 * speed
        for away, speed in zip(offset, speeds, strict=True)
    ]
    torque = [unrolled_linalg.inner(row, pull) for row in mass]
    rows = [[column[part][axis] for column in columns] for part in (0, 1) for axis in range(3)]
    halves = [unrolled_linalg.forward(factor, row) for row in rows]
    inverse = unrolled_linalg.materialize(
        [[unrolled_linalg.inner(a, b) for b in halves] for a in halves]
    )
    moved = [unrolled_linalg.inner(row, pull) for row in rows]  # J M^-1 (M pull)
    held = unrolled_linalg.solve(unrolled_linalg.cholesky(inverse), moved)
    return [
        own - unrolled_linalg.inner([row[j] for row in rows], held) for j, own in enumerate(torque)
    ]


def vector_of(values: jax.Array) -> Vector:
    """[3] as scalars."""
    x, y, z = values
    return x, y, z


def axes_of(rotation: jax.Array) -> Matrix:
    """Columns of a rotation [3, 3] as scalars."""
    x, y, z = rotation.T
    return vector_of(x), vector_of(y), vector_of(z)


def arm_torque(
    jacobian: jax.Array,
    mass: jax.Array,
    *,
    position: jax.Array,
    rotation: jax.Array,
    speeds: jax.Array,
    goal: tuple[jax.Array, jax.Array],
    posture: jax.Array,
    gain: Scalar = 1.0,
) -> jax.Array:
    """`task_torque` and (beyond six joints) `nullspace_torque` of an arm given as arrays, [J] N m.

    Args:
        jacobian: [J, 6] of the site: m and rad per rad, world axes.
        mass: [J, J] joint-space inertia.
        position, rotation: [3] m and [3, 3] (columns) of the site.
        speeds: [J] rad/s.
        goal: Position [3] and rotation [3, 3] that it is to have.
        posture: [J] rad from the joints to their rest pose.
        gain: Factor on the stiffness.
    """
    count = speeds.shape[0]
    matrix = unrolled_linalg.materialize([[mass[i, j] for j in range(count)] for i in range(count)])
    factor = unrolled_linalg.materialize(unrolled_linalg.cholesky(matrix))
    columns = [(tuple(row[:3]), tuple(row[3:])) for row in jacobian]
    twist = speeds @ jacobian
    torque = task_torque(
        columns,
        factor,
        site=(vector_of(position), axes_of(rotation)),
        twist=(vector_of(twist[:3]), vector_of(twist[3:])),
        goal=(vector_of(goal[0]), axes_of(goal[1])),
        gain=gain,
    )
    if count > 6:
        own = nullspace_torque(
            columns, factor, mass=matrix, offset=list(posture), speeds=list(speeds)
        )
        torque = [a + b for a, b in zip(torque, own, strict=True)]
    return jnp.stack(torque)


def applied_torque(
    task: jax.Array,
    bias: jax.Array,
    *,
    limit: Any,
    speeds: jax.Array,
    damping: float,
    friction: float,
    factor: Scalar = 1.0,
) -> jax.Array:
    """What a motor applies, [J] N m: the task and the bias forces within its limit, less its brake.

    Args:
        task: [J] of `arm_torque`. bias: [J] gravity and what the speeds do.
        limit: [J] N m.
        speeds: [J] rad/s.
        damping, friction: Of `joint_brake`, where the MJCF does not say them.
        factor: On the brake.
    """
    total = jnp.clip(task + bias, -limit, limit)
    if damping or friction:
        total = total - factor * joint_brake(speeds, damping, friction)
    return total


def shifted(
    position: jax.Array, rotation: jax.Array, action: jax.Array, held: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """`new_goal` on arrays: position [3] m and rotation [3, 3] (columns)."""
    place, turn = new_goal(list(action), vector_of(position), axes_of(rotation), axes_of(held))
    return jnp.stack(place), unrolled_linalg.array(turn).T


def free_motion(
    joints: list[Scalar],
    speeds: list[Scalar],
    *,
    goal: tuple[Vector, Matrix],
    tool: Tool,
    weight: list[Scalar],
    factors: Factors = NOMINAL,
) -> Motion:
    """Acceleration that the controller gives the arm where nothing touches it.

    Args:
        joints, speeds: rad, rad/s.
        goal: Position (in the base's frame) and rotation of the grip site.
        tool: In the hand.
        weight: `bias_torque` at the start of the control step. It is added and compensated, so
            that it matters only where a torque limit cuts in.
        factors: On the gains and on the joints' damping and friction.
    """
    at = unrolled_linalg.materialize(frames(joints, tool))
    columns = jacobian(at)
    linear, angular = twist_of(columns, speeds)
    matrix = unrolled_linalg.materialize(mass_matrix(at, tool))
    factor = unrolled_linalg.materialize(unrolled_linalg.cholesky(matrix))
    task = task_torque(
        columns,
        factor,
        site=(at.position, at.rotation),
        twist=(linear, angular),
        goal=goal,
        gain=factors.gain,
    )
    air = joint_torque(columns, *drag(tool, at.rotation, (linear, angular)))
    net = []
    for index in range(6):
        limit = float(TORQUE_LIMIT[index])
        applied = jnp.clip(task[index] + weight[index], -limit, limit) - weight[index]
        brake = joint_brake(speeds[index], DAMPING, FRICTION_LOSS)
        net.append(applied + air[index] - factors.damping * brake)
    return Motion(
        at=at,
        columns=columns,
        twist=(linear, angular),
        matrix=matrix,
        acceleration=unrolled_linalg.solve(factor, net),
        speeds=speeds,
    )


def joint_brake(speed: Scalar, damping: float, friction: float) -> Scalar:
    """Torque of damping and dry friction in a joint, N m, against its speed in rad/s.

    Dry friction builds up within 1e-3 rad/s (tanh): MuJoCo's own costs a solver row per joint.
    """
    return damping * speed + friction * jnp.tanh(speed / _SETTLING)
