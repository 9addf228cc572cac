"""The ego vehicle: a bicycle with the engine, brakes and tyres of MetaDrive's default car.

Two axles on a rigid body. Each 0.02 s every wheel takes away a fifth of its sideways slip by an
impulse (that is the yaw lag: at small angles the yaw rate reaches the kinematic bicycle's
`v tan(delta) / wheelbase` after 0.2-0.3 s), engine or brake add an impulse along the wheel, and
the friction circle of the wheel bounds both (that is the lateral limit of 8-9 m/s^2):

    j_side = -0.2 v_side M          M: mass the wheel feels, kg
    j_long = F_engine t 0.02        throttle t > 0 below 80 km/h
           = -min(|j_stop|, F_brake |t|)   t < 0: a brake force is an impulse per 0.02 s
           = -min(|j_stop|, 2)      no throttle: the coasting drag
    scale both by mu N 0.02 / |(0.5 j_long, j_side)| where that is below 1

These are the rules of the ray-cast vehicle in MetaDrive's physics engine, in the plane. The four
constants that the plane leaves open (felt masses, height of the centre of mass, yaw inertia) were
fitted to recorded drives: position error after 1 s 0.024 m median, 0.14 m at the 95th percentile.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from envs.derivatives import length
from ppl_jax.types import Array

CONTROL_STEP, SUBSTEP, SUBSTEPS = 0.1, 0.02, 5  # s
MASS = 1100.0  # kg
FRONT, REAR = 1.05234, 1.4166  # m, axles before and behind the centre of mass
WHEELBASE = FRONT + REAR
MAX_STEERING = jnp.pi * 40.0 / 180.0  # rad at |steer| = 1
MAX_SPEED = 80.0 / 3.6  # m/s: the engine is off above
HALF_SIZE = (4.515 / 2, 1.852 / 2)  # m
COASTING_IMPULSE = 2.0  # N s per wheel and substep
FELT_MASS = (538.5, 408.2)  # kg, front and rear wheel
MASS_HEIGHT = 0.468  # m
YAW_INERTIA = 2397.0  # kg m^2
SLIP_TAKEN = 0.2  # share of the sideways slip a wheel removes per substep
GRAVITY = 9.81
REPORT_AFTER = 3  # substeps: the simulator reports the pose two substeps late, velocities are new


@flax.struct.dataclass
class Ego:
    """The ego vehicle.

    Attributes:
        pose: [3] reported x, y, heading: m, rad, heading anticlockwise.
        body: [3] pose of the body itself, two substeps ahead of `pose`.
        velocity: [2] world frame, m/s.
        yaw_rate: rad/s.
        last_pose: [3] `pose` one control step ago.
        action: [2] steer (positive left) and throttle/brake just executed, in [-1, 1].
    """

    pose: jax.Array
    body: jax.Array
    velocity: jax.Array
    yaw_rate: jax.Array
    last_pose: jax.Array
    action: jax.Array


def place(pose: jax.Array, velocity: jax.Array, yaw_rate: jax.Array, action: jax.Array) -> Ego:
    """An ego vehicle at a reported pose, [3], [2], scalar, [2]."""
    late = (SUBSTEPS - REPORT_AFTER) * SUBSTEP
    body = pose + late * jnp.append(velocity, yaw_rate)
    return Ego(
        pose=pose,
        body=body,
        velocity=velocity,
        yaw_rate=yaw_rate,
        last_pose=pose,
        action=action,
    )


class _Moving(NamedTuple):
    """What a substep changes: the `Ego`'s body, velocity and yaw rate, and m/s^2 forward."""

    body: jax.Array
    velocity: jax.Array
    yaw_rate: jax.Array
    acceleration: jax.Array


def _wheel_impulses(
    forward: jax.Array,
    sideways: jax.Array,
    *,
    engine: jax.Array,
    brake: jax.Array,
    felt_mass: float,
    load: jax.Array,
    friction: Array | float,
) -> tuple[jax.Array, jax.Array]:
    """Impulse along and across one wheel over a substep, N s, from its contact velocity."""
    stop = forward * (MASS / 4)
    along = jnp.where(engine > 0, engine, -jnp.clip(stop, -brake, brake))
    across = -SLIP_TAKEN * sideways * felt_mass
    limit = friction * jnp.maximum(load, 0.0) * SUBSTEP
    size = jnp.sqrt((0.5 * along) ** 2 + across**2 + 1e-12)
    scale = jnp.minimum(1.0, limit / size)
    return along * scale, across * scale


def drive(
    ego: Ego,
    action: jax.Array,
    *,
    engine_force: Array | float,
    brake_force: Array | float,
    friction: Array | float,
) -> Ego:
    """One control step of 0.1 s.

    Args:
        ego: Before.
        action: [2] steer, throttle/brake; clipped to [-1, 1].
        engine_force: N per wheel at full throttle.
        brake_force: N s per wheel and substep at full brake.
        friction: Tyre friction coefficient.
    """
    action = jnp.clip(action, -1.0, 1.0)
    steer, throttle = action[0] * MAX_STEERING, action[1]
    cd, sd = jnp.cos(steer), jnp.sin(steer)
    too_fast = jnp.sum(ego.velocity**2) > MAX_SPEED**2
    engine = jnp.where((throttle > 0) & ~too_fast, engine_force * throttle * SUBSTEP, 0.0)
    brake = jnp.where(throttle < 0, -throttle * brake_force, COASTING_IMPULSE)

    def substep(_: jax.Array, car: _Moving) -> _Moving:
        body, velocity, yaw_rate, acceleration = car
        c, s = jnp.cos(body[2]), jnp.sin(body[2])
        u = c * velocity[0] + s * velocity[1]
        w = -s * velocity[0] + c * velocity[1]
        front_side = w + FRONT * yaw_rate
        front_along, front_across = _wheel_impulses(
            cd * u + sd * front_side,
            -sd * u + cd * front_side,
            engine=engine,
            brake=brake,
            felt_mass=FELT_MASS[0],
            load=MASS * (GRAVITY * REAR - acceleration * MASS_HEIGHT) / WHEELBASE / 2,
            friction=friction,
        )
        rear_along, rear_across = _wheel_impulses(
            u,
            w - REAR * yaw_rate,
            engine=engine,
            brake=brake,
            felt_mass=FELT_MASS[1],
            load=MASS * (GRAVITY * FRONT + acceleration * MASS_HEIGHT) / WHEELBASE / 2,
            friction=friction,
        )
        front_left = front_along * sd + front_across * cd
        du = 2 * (front_along * cd - front_across * sd + rear_along) / MASS
        dw = 2 * (front_left + rear_across) / MASS
        yaw_rate = yaw_rate + 2 * (FRONT * front_left - REAR * rear_across) / YAW_INERTIA
        velocity = velocity + jnp.stack([c * du - s * dw, s * du + c * dw])
        body = body + SUBSTEP * jnp.append(velocity, yaw_rate)
        return _Moving(body, velocity, yaw_rate, acceleration=du / SUBSTEP)

    start = _Moving(ego.body, ego.velocity, ego.yaw_rate, acceleration=jnp.zeros((), jnp.float32))
    # a loop is half the compile time of the substeps written out; an accelerator has them so
    loop = functools.partial(jax.lax.fori_loop, unroll=jax.default_backend() != "cpu")
    late = loop(0, REPORT_AFTER, substep, start)
    now = loop(REPORT_AFTER, SUBSTEPS, substep, late)
    return Ego(
        pose=late.body,
        body=now.body,
        velocity=now.velocity,
        yaw_rate=now.yaw_rate,
        last_pose=ego.pose,
        action=action,
    )


def drive_kinematic(
    ego: Ego, action: jax.Array, engine_force: Array | float, brake_force: Array | float
) -> Ego:
    """One step of the plain kinematic bicycle, the paper's rule-based predictor.

        v' = clip(v + a dt, 0, v_max)    a = 4 F_engine t / m, or -4 F_brake |t| / (m 0.02)
        heading' = heading + v' / wheelbase tan(delta) dt

    Brakes are in the units of the simulator; the released predictor lacks the division by 0.02
    and so brakes fifty times too weakly.
    """
    action = jnp.clip(action, -1.0, 1.0)
    throttle = action[1]
    speed = length(ego.velocity)
    acceleration = jnp.where(
        throttle >= 0,
        4 * engine_force * throttle / MASS,
        4 * brake_force * throttle / (MASS * SUBSTEP),
    )
    speed = jnp.clip(speed + acceleration * CONTROL_STEP, 0.0, MAX_SPEED)
    yaw_rate = speed / WHEELBASE * jnp.tan(action[0] * MAX_STEERING)
    heading = ego.pose[2] + yaw_rate * CONTROL_STEP
    velocity = speed * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    pose = jnp.append(ego.pose[:2] + velocity * CONTROL_STEP, heading)
    placed = place(pose, velocity, yaw_rate, action)
    return dataclasses.replace(placed, last_pose=ego.pose)
