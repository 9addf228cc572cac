"""Kinematics and dynamics of a UR5e with a rigid tool, written out for its six joints.

The same quantities as MuJoCo's (`tests/worlds/test_manipulation.py` compares them with C MuJoCo and
MJX), but in scalars: under `vmap` each scalar becomes one vector over environments, so that nothing
is left in small trailing axes, which XLA does not vectorise on a CPU.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from envs.manipulation.scenes.model import (
    AIR_DENSITY,
    AIR_VISCOSITY,
    ARMATURE,
    HAND,
    LINKS,
    Tool,
)

Scalar = Any  # a float, or a traced scalar
Vector = tuple[Scalar, Scalar, Scalar]
Matrix = tuple[Vector, Vector, Vector]  # columns


class Frames(NamedTuple):
    """Where everything is, in the frame of the arm's base.

    Attributes:
        axes, anchors: For each of the six joints: direction, and a point on the axis, m.
        links: Position and rotation of each of the seven bodies (six links, the tool).
        position, rotation: Pose of the grip site.
    """

    axes: list[Vector]
    anchors: list[Vector]
    links: list[tuple[Vector, Matrix]]
    position: Vector
    rotation: Matrix


class Motion(NamedTuple):
    """The arm at the start of a physics step.

    Attributes:
        at: Kinematics.
        columns: Jacobian of the grip site, per joint (linear, angular).
        twist: Velocity of the grip site, m/s and rad/s.
        matrix: Mass matrix.
        acceleration: Acceleration of the joints, without contact, rad/s^2.
        speeds: Speeds of the joints, rad/s.
    """

    at: Frames
    columns: list[tuple[Vector, Vector]]
    twist: tuple[Vector, Vector]
    matrix: list[list[Scalar]]
    acceleration: list[Scalar]
    speeds: list[Scalar]


def add(a: Vector, b: Vector) -> Vector:
    """The sum a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def scale(k: Scalar, a: Vector) -> Vector:
    """The multiple k a."""
    return (k * a[0], k * a[1], k * a[2])


def dot(a: Vector, b: Vector) -> Scalar:
    """The inner product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """The cross product a x b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def combine(m: Matrix, v: Vector) -> Vector:
    """The product m v; components of `v` that are plain zeros cost nothing."""
    total: Vector | None = None
    for column, k in zip(m, v, strict=True):
        if isinstance(k, float) and k == 0.0:
            continue
        term = scale(k, column)
        total = term if total is None else add(total, term)
    return total if total is not None else (0.0, 0.0, 0.0)


def _about_y(m: Matrix, sine: Scalar, cosine: Scalar) -> Matrix:
    x, y, z = m
    return (
        add(scale(cosine, x), scale(-sine, z)),
        y,
        add(scale(sine, x), scale(cosine, z)),
    )


def _about_z(m: Matrix, sine: Scalar, cosine: Scalar) -> Matrix:
    x, y, z = m
    return (
        add(scale(cosine, x), scale(sine, y)),
        add(scale(-sine, x), scale(cosine, y)),
        z,
    )


_IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def frames(joints: list[Scalar], tool: Tool) -> Frames:
    """Forward kinematics.

    Args:
        joints: Six angles, rad.
        tool: For the grip site and the tool's body.
    """
    position: Vector = (0.0, 0.0, 0.0)
    rotation = _IDENTITY
    axes, anchors, links = [], [], []
    for angle, link in zip(joints, LINKS, strict=True):
        position = add(position, combine(rotation, link.position))
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        if link.turned:  # by 90 degrees about the joint's own axis, y
            sine, cosine = cosine, -sine
        turn = _about_y if link.axis == "y" else _about_z
        axes.append(rotation[1 if link.axis == "y" else 2])
        anchors.append(position)
        rotation = turn(rotation, sine, cosine)
        links.append((position, rotation))
    position = add(position, combine(rotation, HAND))
    x, y, z = rotation
    hand: Matrix = (x, scale(-1.0, z), y)
    links.append((position, hand))
    site: Matrix = (scale(-1.0, hand[1]), hand[0], hand[2])
    return Frames(
        axes=axes,
        anchors=anchors,
        links=links,
        position=add(position, scale(tool.grip, hand[2])),
        rotation=site,
    )


def jacobian(at: Frames) -> list[tuple[Vector, Vector]]:
    """Per joint: what unit speed does to the grip site, (m, rad)."""
    return [
        (cross(axis, add(at.position, scale(-1.0, anchor))), axis)
        for axis, anchor in zip(at.axes, at.anchors, strict=True)
    ]


def _bodies(at: Frames, tool: Tool):
    """Per body: mass, centre of mass, and inertia as (i, k, axis): i 1 + k axis axis'."""
    for link, (position, rotation) in zip(LINKS, at.links[:6], strict=True):
        a, b, c = link.inertia
        axis, k = (rotation[2], c - a) if a == b else (rotation[1], b - a)
        yield link.mass, add(position, combine(rotation, link.centre)), (a, k, axis)
    position, hand = at.links[6]
    a, b, c = tool.inertia
    if a is not b and a != b:
        raise ValueError(f"a tool's inertia must be the same about x and y, got {tool.inertia}")
    yield tool.mass, add(position, scale(tool.centre, hand[2])), (a, c - a, hand[2])


def mass_matrix(at: Frames, tool: Tool) -> list[list[Scalar]]:
    """Joint-space inertia, armature included; composite rigid bodies about the base's origin."""
    mass: Scalar = 0.0
    moment: Vector = (0.0, 0.0, 0.0)
    diagonal: Vector = (0.0, 0.0, 0.0)
    off: Vector = (0.0, 0.0, 0.0)  # yz, xz, xy
    bodies = list(_bodies(at, tool))
    matrix: list[list[Scalar]] = [[0.0] * 6 for _ in range(6)]
    motions = [
        (cross(anchor, axis), axis) for axis, anchor in zip(at.axes, at.anchors, strict=True)
    ]
    for j in reversed(range(6)):
        for m, c, (i, k, n) in bodies[5:] if j == 5 else bodies[j : j + 1]:
            square = dot(c, c)
            mass = mass + m
            moment = add(moment, scale(m, c))
            diagonal = add(
                diagonal, tuple(i + k * n[a] * n[a] + m * (square - c[a] * c[a]) for a in range(3))
            )
            off = add(
                off,
                tuple(k * n[a] * n[b] - m * c[a] * c[b] for a, b in ((1, 2), (0, 2), (0, 1))),
            )
        linear, angular = motions[j]
        push = add(scale(mass, linear), cross(angular, moment))
        spin = (
            diagonal[0] * angular[0] + off[2] * angular[1] + off[1] * angular[2],
            off[2] * angular[0] + diagonal[1] * angular[1] + off[0] * angular[2],
            off[1] * angular[0] + off[0] * angular[1] + diagonal[2] * angular[2],
        )
        spin = add(spin, cross(moment, linear))
        for i in range(j + 1):
            value = dot(motions[i][0], push) + dot(motions[i][1], spin)
            matrix[i][j] = matrix[j][i] = value + ARMATURE[j] if i == j else value
    return matrix


def bias_torque(at: Frames, tool: Tool, speeds: list[Scalar]) -> list[Scalar]:
    """Torques of gravity and of the Coriolis and centrifugal forces (MuJoCo's qfrc_bias)."""
    spin: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)  # angular acceleration at zero joint acceleration
    acceleration: Vector = (0.0, 0.0, 9.81)
    last: Vector = (0.0, 0.0, 0.0)
    wrenches = []
    bodies = list(_bodies(at, tool))
    for j in range(6):
        arm = add(at.anchors[j], scale(-1.0, last))
        swept = cross(spin, arm)
        acceleration = add(acceleration, add(cross(turn, arm), cross(spin, swept)))
        last = at.anchors[j]
        own = scale(speeds[j], at.axes[j])
        turn = add(turn, cross(spin, own))
        spin = add(spin, own)
        force: Vector = (0.0, 0.0, 0.0)
        torque: Vector = (0.0, 0.0, 0.0)
        for m, c, (i, k, n) in bodies[5:] if j == 5 else bodies[j : j + 1]:
            out = add(c, scale(-1.0, last))
            there = add(acceleration, add(cross(turn, out), cross(spin, cross(spin, out))))
            push = scale(m, there)
            held = add(scale(i, spin), scale(k * dot(n, spin), n))
            twist = add(add(scale(i, turn), scale(k * dot(n, turn), n)), cross(spin, held))
            force = add(force, push)
            torque = add(torque, add(twist, cross(c, push)))
        wrenches.append((force, torque))
    force, torque = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    result: list[Scalar] = [0.0] * 6
    for j in reversed(range(6)):
        force, torque = add(force, wrenches[j][0]), add(torque, wrenches[j][1])
        result[j] = dot(at.axes[j], torque) + dot(cross(at.anchors[j], at.axes[j]), force)
    return result


def twist_of(columns: list[tuple[Vector, Vector]], rates: list[Scalar]) -> tuple[Vector, Vector]:
    """The product J rates."""
    linear = angular = (0.0, 0.0, 0.0)
    for (a, b), rate in zip(columns, rates, strict=True):
        linear, angular = add(linear, scale(rate, a)), add(angular, scale(rate, b))
    return linear, angular


def joint_torque(columns: list[tuple[Vector, Vector]], force: Vector, torque: Vector):
    """The product J' [force, torque]."""
    return [dot(a, force) + dot(b, torque) for a, b in columns]


def drag(tool: Tool, rotation: Matrix, twist: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
    """Force and torque of the air on the tool (MuJoCo's inertia-box model).

    The wiper's nominal inertia makes it a box of 1.4 m: at 1 rad/s the air brakes it by 0.2 N m.
    """
    side = tool.box
    result = []
    for vector, quadratic, viscous in (
        (twist[0], 0.5 * AIR_DENSITY * side**2, 3 * jnp.pi * side * AIR_VISCOSITY),
        (twist[1], AIR_DENSITY * side**5 / 32, jnp.pi * side**3 * AIR_VISCOSITY),
    ):
        local = tuple(dot(axis, vector) for axis in rotation)
        local = tuple(-(quadratic * jnp.abs(v) + viscous) * v for v in local)
        result.append(combine(rotation, local))
    return result[0], result[1]
