"""Arm, fingers and ring together: the contacts of nut assembly, solved as one convex problem.

Fourteen unknown accelerations: six joints, two knuckles, the ring (linear, angular; world axes).
Contacts are points: the pads on the handle, the ring's beads on the table and around the peg, the
handle's end and the finger tips on the table. As in MuJoCo with elliptic cones,

    min_a  1/2 (a - a0)' M (a - a0) + sum_i s(J_i a - aref_i).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.analytic import gripper, unrolled_linalg
from envs.manipulation.physics.analytic.arm import Motion
from envs.manipulation.physics.analytic.contact import Friction, cone, cone_cost, cone_force
from envs.manipulation.physics.may_close import DEEPEST
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import (
    HANDLE,
    HANDLE_HALF,
    NUT_BASE,
    NUT_TABLE,
    PEG,
    PEG_HALF,
    PEG_RADIUS,
    RING_BEAD,
    RING_CENTRE,
    RING_INERTIA,
    RING_MASS,
    RING_RADIUS,
)

ITERATIONS, CONVERGED = 8, 1e-4  # of Newton's method: at most, and the step's energy to stop at
_TRIES = np.array([0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0], np.float32)  # shares of a step
FRICTION = 1.0
# of every contact: MuJoCo's solref 0.02 1 at an impedance between ring's and others'
STIFF, DAMP, IMPEDANCE = 1 / (0.974 * 0.02) ** 2, 2 / (0.974 * 0.02), 0.96
_TABLE = NUT_TABLE[2] - NUT_BASE[2]
_PEG = np.array([PEG[0] - NUT_BASE[0], PEG[1] - NUT_BASE[1]], np.float32)
_PEG_TOP = PEG[2] + PEG_HALF - NUT_BASE[2]

RING_DAMPING = 0.0005

_ANGLES = np.pi / 4 * np.arange(8) + np.pi / 8
BEADS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), 0 * _ANGLES], -1) * RING_RADIUS
FEET = np.concatenate(
    [
        BEADS[::2] * [1.2, 1.2, 0] - [0, 0, 0.01],
        [[HANDLE[0] + HANDLE_HALF[0], side * HANDLE_HALF[1], -0.01] for side in (-1, 1)],
    ]
)
_ROWS = len(gripper.PAD_ROWS)
_PADS = 4 * _ROWS  # points on the pads: left then right finger, two per row
# those of the lower edges, which meet the table
_EDGE = np.array([0, _ROWS, 2 * _ROWS, 3 * _ROWS], np.int32)


class Ring(NamedTuple):
    """Pose and velocity of the ring's body, in axes of the world and the arm's base.

    Attributes:
        position: [3] m, from the base. rotation: [3, 3] columns are its axes.
        velocity, spin: [3] m/s of its origin, rad/s.
    """

    position: jax.Array
    rotation: jax.Array
    velocity: jax.Array
    spin: jax.Array


class Held(NamedTuple):
    """Result of a physics step.

    Attributes:
        acceleration: [14].
        squeeze: [2] normal force of left and right pad on the handle, N.
        touching: [2] whether the pad touches it.
    """

    acceleration: jax.Array
    squeeze: jax.Array
    touching: jax.Array


class _Points(NamedTuple):
    """Contact candidates: [C] gap, [C, 3] places and normals, and who carries them."""

    gap: jax.Array
    place: jax.Array
    normal: jax.Array
    tangent: jax.Array


def hand_axes(motion: Motion) -> tuple[jax.Array, jax.Array]:
    """Origin [3] and axes [3, 3] (rows x, y, z) of the hand."""
    position, columns = motion.at.links[6]
    return jnp.stack(position), unrolled_linalg.array(columns)


def pad_points(
    origin: jax.Array, axes: jax.Array, fingers: jax.Array, inner: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Points on both pads, [P, 3], and their velocity per knuckle speed, [P, 3].

    Args:
        origin, axes: Frame of the hand.
        fingers, inner: [2] knuckle and inner finger angles, left and right.
    """
    places, slopes = [], []
    for index, side in ((0, -1.0), (1, 1.0)):
        place, slope = gripper.pad_rows(fingers[index], inner[index])
        for x in (-gripper.PAD_HALF, gripper.PAD_HALF):
            out = place[:, :1] * (side * axes[1]) + place[:, 1:] * axes[2]
            places.append(origin + x * axes[0] + out)
            slopes.append(slope[:, :1] * (side * axes[1]) + slope[:, 1:] * axes[2])
    return jnp.concatenate(places), jnp.concatenate(slopes)


def on_handle(pads: jax.Array, ring: Ring) -> _Points:
    """Pads against the handle's long sides."""
    local = (pads - ring.position) @ ring.rotation - jnp.array(HANDLE, jnp.float32)
    side = jnp.where(local[:, 1] >= 0, 1.0, -1.0)
    gap = jnp.abs(local[:, 1]) - HANDLE_HALF[1]
    reach = (jnp.abs(local[:, 0]) < HANDLE_HALF[0]) & (jnp.abs(local[:, 2]) < HANDLE_HALF[2])
    gap = jnp.where(reach & (gap > -DEEPEST), gap, 1.0)
    normal = side[:, None] * ring.rotation[:, 1]
    return _Points(
        gap=gap,
        place=pads,
        normal=normal,
        tangent=jnp.broadcast_to(ring.rotation[:, 0], normal.shape),
    )


def _upward(place: jax.Array) -> _Points:
    up, east = jnp.array([0.0, 0.0, 1.0], jnp.float32), jnp.array([1.0, 0.0, 0.0], jnp.float32)
    shape = place.shape
    return _Points(
        gap=place[:, 2] - _TABLE,
        place=place,
        normal=jnp.broadcast_to(up, shape),
        tangent=jnp.broadcast_to(east, shape),
    )


def _around_peg(beads: jax.Array) -> _Points:
    """Spheres against the peg: its side, its top, or the edge between."""
    off = beads[:, :2] - _PEG
    away = jnp.sqrt(jnp.sum(off * off, -1) + 1e-12)
    out = off / away[:, None]
    beside = jnp.maximum(away - PEG_RADIUS, 0.0)
    above = jnp.maximum(beads[:, 2] - _PEG_TOP, 0.0)
    distance = jnp.sqrt(beside**2 + above**2 + 1e-12)
    outside = (beside > 0) | (above > 0)
    # inside the peg the nearest way out is its side
    gap = jnp.where(outside, distance, away - PEG_RADIUS) - RING_BEAD
    level = jnp.where(outside, beside / distance, 1.0)
    upward = jnp.where(outside, above / distance, 0.0)
    normal = jnp.concatenate([level[:, None] * out, upward[:, None]], -1)
    tangent = jnp.concatenate([-out[:, 1:], out[:, :1], jnp.zeros_like(upward)[:, None]], -1)
    return _Points(gap=gap, place=beads - RING_BEAD * normal, normal=normal, tangent=tangent)


def hold(
    motion: Motion,
    ring: Ring,
    *,
    fingers: jax.Array,
    finger_speeds: jax.Array,
    inner: jax.Array,
    command: jax.Array,
    start: jax.Array,
    factors: Factors = NOMINAL,
) -> Held:
    """One physics step's accelerations.

    Args:
        motion: The arm without contact.
        ring: Ring.
        fingers, finger_speeds, inner: [2] knuckles, their speeds, inner finger angles.
        command: Of the gripper, -1 open to 1 closed.
        start: [14] acceleration to start from: the last step's.
        factors: On friction and on the ring's mass.
    """
    origin, axes = hand_axes(motion)
    pads, slopes = pad_points(origin, axes, fingers, inner)
    tips, tip_slopes = pads[_EDGE], slopes[_EDGE]
    beads = ring.position + BEADS.astype(np.float32) @ ring.rotation.T
    feet = ring.position + FEET.astype(np.float32) @ ring.rotation.T
    groups = (on_handle(pads, ring), _upward(tips), _upward(feet), _around_peg(beads))
    gap, place, normal, tangent = (jnp.concatenate(parts) for parts in zip(*groups, strict=True))
    frame = jnp.stack([tangent, jnp.cross(normal, tangent), normal])  # [3, C, 3]

    carried = _PADS + len(
        _EDGE
    )  # by a finger; the rest belong to the ring, and so do the pads' partners
    site = jnp.stack(motion.at.position)
    linear = unrolled_linalg.array(part for part, _ in motion.columns)  # [6, 3]
    angular = unrolled_linalg.array(part for _, part in motion.columns)
    arm_place = place[:carried] - site
    swept = linear[:, None] + jnp.cross(angular[:, None], arm_place[None])  # [6, F, 3]
    by_arm = jnp.sum(frame[:, :carried, None] * jnp.swapaxes(swept, 0, 1)[None], -1)  # [3, F, 6]
    left = np.array([1] * 2 * _ROWS + [0] * 2 * _ROWS + [1, 1, 0, 0], np.float32)
    by_finger = jnp.sum(frame[:, :carried] * jnp.concatenate([slopes, tip_slopes]), -1)
    by_finger = jnp.stack([by_finger * left, by_finger * (1 - left)], -1)  # [3, F, 2]
    sides = np.array([-1, 0, 1], np.float32)
    sign = np.repeat(sides, [_PADS, len(_EDGE), len(FEET) + len(BEADS)])
    arms = place - ring.position
    by_ring = jnp.concatenate([frame, jnp.cross(arms[None], frame)], -1) * sign[None, :, None]
    none = np.zeros((3, len(FEET) + len(BEADS), 8), np.float32)
    mover = jnp.concatenate([jnp.concatenate([by_arm, by_finger], -1), none], 1)
    rows = jax.lax.optimization_barrier(jnp.concatenate([mover, by_ring], -1))  # [3, C, 14]

    mass, free = _inertia(
        motion, ring, fingers, finger_speeds, command=command, heavier=factors.mass
    )
    friction = FRICTION * factors.friction
    speed = jnp.concatenate([jnp.stack(motion.speeds), finger_speeds, ring.velocity, ring.spin])
    inverse = np.repeat([57.2, 5.7, 51.5], [_PADS, len(_EDGE), len(FEET) + len(BEADS)])
    stiff = (IMPEDANCE / ((1 - IMPEDANCE) * inverse)).astype(np.float32)
    weight = jnp.where(gap < 0, stiff, 0.0)
    depth = jnp.maximum(-gap, 0.0)
    rest = DAMP * (rows @ speed)
    rest = rest.at[2].add(-STIFF * IMPEDANCE * depth)

    def together() -> jax.Array:
        def curvature(bent: jax.Array) -> jax.Array:
            # the ring's own contacts do not touch the first eight columns
            near, bent_near = rows[:, :carried, :8].reshape(-1, 8), bent[:, :carried]
            by_mover = near.T @ bent_near.reshape(-1, 14)
            by_ring = rows[:, :, 8:].reshape(-1, 6).T @ bent[:, :, 8:].reshape(-1, 6)
            lower = jnp.concatenate([by_mover[:, 8:].T, by_ring], -1)
            return jnp.concatenate([by_mover, lower])

        return _newton(
            rows, rest, weight, mass, free=free, start=start, friction=friction, curvature=curvature
        )

    def apart() -> jax.Array:
        own = rows[:, carried:, 8:]
        alone = _newton(
            own,
            rest[:, carried:],
            weight[carried:],
            mass[8:, 8:],
            free=free[8:],
            start=start[8:],
            friction=friction,
            curvature=lambda bent: own.reshape(-1, 6).T @ bent.reshape(-1, 6),
        )
        return jnp.concatenate([free[:8], alone])

    # where no finger touches anything, the ring is alone with table and peg
    a = jax.lax.cond(jnp.any(gap[:carried] < 0), together, apart)
    force = cone_force(rows @ a + rest, weight, friction)
    squeeze = force[2, :_PADS].reshape(2, 2 * _ROWS)
    touching = jnp.any(gap[:_PADS].reshape(2, 2 * _ROWS) < 0, -1)
    return Held(acceleration=a, squeeze=jnp.sum(squeeze, -1), touching=touching)


def _newton(
    rows: jax.Array,
    rest: jax.Array,
    weight: jax.Array,
    mass: jax.Array,
    *,
    free: jax.Array,
    start: jax.Array,
    friction: Friction,
    curvature: Callable[[jax.Array], jax.Array],
) -> jax.Array:
    """Minimise 1/2 (a - free)' M (a - free) + cones(rows a + rest) from the better of two starts.

    Args:
        rows: [3, C, N] Jacobian. rest: [3, C] what the residual is without acceleration.
        weight: [C].
        mass: [N, N]. free, start: [N] acceleration without contact, and the last step's.
        friction: Coefficient.
        curvature: `curvature(bent [3, C, N]) -> rows' bent [N, N]`.
    """

    def cost(a: jax.Array) -> jax.Array:
        off = a - free
        return 0.5 * off @ mass @ off + cone_cost(rows @ a + rest, weight, friction)

    def improve(carry: tuple[jax.Array, jax.Array, jax.Array]) -> Any:
        a, _, count = carry
        at = rows @ a + rest
        force, h = cone(at, weight, friction)
        bent = jnp.stack(
            [
                h[0][:, None] * rows[0] + h[1][:, None] * rows[1] + h[3][:, None] * rows[2],
                h[1][:, None] * rows[0] + h[2][:, None] * rows[1] + h[4][:, None] * rows[2],
                h[3][:, None] * rows[0] + h[4][:, None] * rows[1] + h[5][:, None] * rows[2],
            ]
        )
        flat = rows.reshape(-1, rows.shape[-1])
        residual = flat.T @ force.reshape(-1) - mass @ (a - free)
        move = unrolled_linalg.solve_array(mass + curvature(bent), residual)
        energy = move @ residual
        # where contacts come or go, or begin to slide, Newton's step overshoots: the cost is
        # convex, so that its slope along the step has one zero, between two of the tries
        along = rows @ move
        there = at[:, None] + _TRIES[:, None] * along[:, None]  # [3, K, C]
        pulled = jnp.sum(cone_force(there, weight, friction) * along[:, None], (0, 2))
        bend = mass @ move
        slope = (a - free) @ bend + _TRIES * (move @ bend) - pulled
        ends = jnp.concatenate([-energy[None], slope])
        share = jnp.append(0.0, _TRIES)
        last = jnp.sum(slope < 0)  # the interval's lower end
        after = jnp.minimum(last + 1, len(_TRIES))
        low, high = ends[last], ends[after]
        step = share[last] + (share[after] - share[last]) * low / jnp.minimum(low - high, -1e-12)
        return a + step * move, energy, count + 1

    def unsettled(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return (carry[1] > CONVERGED) & (carry[2] < ITERATIONS)

    a = jnp.where(cost(start) < cost(free), start, free)
    begin = (a, jnp.full((), jnp.inf, jnp.float32), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unsettled, improve, begin)[0]


def _inertia(
    motion: Motion,
    ring: Ring,
    fingers: jax.Array,
    finger_speeds: jax.Array,
    *,
    command: jax.Array,
    heavier: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Mass matrix [14, 14] and the acceleration without contact [14]; `heavier` is the ring's."""
    finger_mass = gripper.SERVO_INERTIA
    finger_free = gripper.servo(command, fingers, finger_speeds) / finger_mass

    ring_mass = RING_MASS * heavier
    centre = RING_CENTRE * ring.rotation[:, 0]
    about = (ring.rotation * (RING_INERTIA.astype(np.float32) * heavier)) @ ring.rotation.T
    eye = jnp.eye(3, dtype=jnp.float32)
    about = about + ring_mass * (jnp.sum(centre * centre) * eye - jnp.outer(centre, centre))
    zero = jnp.zeros((), jnp.float32)
    skew = ring_mass * jnp.array(
        [
            [zero, -centre[2], centre[1]],
            [centre[2], zero, -centre[0]],
            [-centre[1], centre[0], zero],
        ],
        jnp.float32,
    )
    spin = ring.spin
    whirl = ring_mass * jnp.cross(spin, jnp.cross(spin, centre))
    weight = ring_mass * jnp.array([0.0, 0.0, -9.81], jnp.float32)
    force = weight - whirl - RING_DAMPING * ring.velocity
    torque = jnp.cross(centre, weight) - jnp.cross(spin, about @ spin) - RING_DAMPING * spin
    own = jnp.block([[ring_mass * eye, -skew], [skew, about]])
    ring_free = unrolled_linalg.solve_array(own, jnp.concatenate([force, torque]))

    mass = jnp.zeros((14, 14), jnp.float32)
    mass = mass.at[:6, :6].set(unrolled_linalg.array(motion.matrix)).at[8:, 8:].set(own)
    mass = mass.at[6, 6].set(finger_mass).at[7, 7].set(finger_mass)
    return mass, jnp.concatenate([jnp.stack(motion.acceleration), finger_free, ring_free])
