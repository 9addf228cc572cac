"""The two-finger gripper: how its six joints follow the command, and where its pads are.

robosuite's Robotiq 85 holds its links together by soft tendons and contacts between its own
meshes. What the recordings show of it is kept: where the outer knuckle comes to rest for each
command, how fast it follows, how hard it squeezes, and what the other two joints of a finger do
with it. The knuckles are dynamic; the other four joints follow.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.scenes.model import PAD_SPHERE, TIMESTEP

Scalar = Any  # a float, or a traced scalar

RAMP = 0.01  # change of the command per physics step towards the sign of the action
COMMANDS = np.linspace(0.0, 0.8, 9)
# joints at rest for these commands, nothing held, rad (measured in robosuite 1.4.1)
KNUCKLE_REST = np.array([-0.0276, 0.0269, 0.0904, 0.1532, 0.2156, 0.2858, 0.3560, 0.4262, 0.5005])
INNER_FINGER_REST = np.array(
    [-0.276, -0.276, -0.272, -0.266, -0.263, -0.264, -0.260, -0.257, -0.238]
)
INNER_KNUCKLE_REST = np.array(
    [-0.2018, -0.1560, -0.1048, -0.0545, -0.003, 0.062, 0.127, 0.193, 0.2594]
)
INITIAL = np.array([-0.026, -0.267, -0.2] * 2)  # rad, after a reset

STIFFNESS = 28.0  # N m/rad, knuckle towards its rest
LAG = 0.037  # s, of the knuckle behind it
INERTIA = 3e-4  # kg m^2 about a knuckle
YIELD, RISE = -0.093, 0.040  # rad, inner finger and inner knuckle give way at full squeeze
FULL_SQUEEZE = 10.0  # N
FOLLOW = 0.05  # s, of the four following joints

# a finger in the hand's frame: knuckle, inner finger, tip; m
_KNUCKLE = (0.0306011, 0.054904)
FINGER = (0.0376, 0.043)
TIP = 0.03242
FACE = -0.0253  # of the pad, towards the other finger
PAD_HALF = 0.011  # along the hand's x
PAD_ROWS = np.array([0.01875, 0.006, -0.007])  # along the pad, from its centre to the tip

# the knuckles' servo and its damping are taken implicitly: they are stiff against 2 ms
SERVO_DAMPING = STIFFNESS * LAG  # N m s/rad
SERVO_INERTIA = INERTIA + TIMESTEP * SERVO_DAMPING + TIMESTEP**2 * STIFFNESS  # kg m^2


def command_to_control(command: Scalar) -> Scalar:
    """Position target of the knuckles' servos, rad."""
    return 0.4 + 0.4 * command


def _look_up(values: np.ndarray, control: jax.Array) -> jax.Array:
    return jnp.interp(control, jnp.asarray(COMMANDS, jnp.float32), jnp.asarray(values, jnp.float32))


def knuckle_rest(control: jax.Array) -> jax.Array:
    """Where a knuckle rests, rad."""
    return _look_up(KNUCKLE_REST, control)


def following_rest(knuckle: jax.Array, squeeze: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rest of inner finger and inner knuckle for a knuckle angle and a squeeze, N."""
    control = jnp.interp(
        knuckle, jnp.asarray(KNUCKLE_REST, jnp.float32), jnp.asarray(COMMANDS, jnp.float32)
    )
    share = jnp.clip(squeeze / FULL_SQUEEZE, 0.0, 1.0)
    return (
        _look_up(INNER_FINGER_REST, control) + YIELD * share,
        _look_up(INNER_KNUCKLE_REST, control) + RISE * share,
    )


def pad_rows(knuckle: jax.Array, inner: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rows of points on a pad's face: [3, 2] positions and [3, 2] d/d(knuckle).

    In the hand's frame for the right finger: y (towards the right) and z (forward), m; the left
    finger mirrors y.
    """
    turn = knuckle + inner
    along = (TIP + PAD_ROWS).astype(np.float32)
    sine, cosine = jnp.sin(knuckle), jnp.cos(knuckle)
    tilt, level = jnp.sin(turn), jnp.cos(turn)
    out_y = FINGER[0] * cosine - FINGER[1] * sine + FACE * level - along * tilt
    out_z = FINGER[0] * sine + FINGER[1] * cosine + FACE * tilt + along * level
    place = jnp.stack([_KNUCKLE[0] + out_y, _KNUCKLE[1] + out_z], -1)
    return place, jnp.stack([-out_z, out_y], -1)


def servo(command: Scalar, knuckles: jax.Array, speeds: jax.Array) -> jax.Array:
    """Torque of the servos on both knuckles, [2] N m, for an inertia of `SERVO_INERTIA`.

    Args:
        command: Of the gripper, -1 open to 1 closed.
        knuckles, speeds: [2] rad, rad/s.
    """
    pull = knuckle_rest(command_to_control(command)) - knuckles - TIMESTEP * speeds
    return STIFFNESS * pull - SERVO_DAMPING * speeds


def follow(
    knuckles: jax.Array, inner: jax.Array, outer: jax.Array, squeeze: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Speeds of inner fingers and inner knuckles, [2] rad/s each, for a physics step.

    Args:
        knuckles: [2] at the step's end, rad.
        inner, outer: [2] inner fingers and inner knuckles at its start, rad.
        squeeze: [2] N.
    """
    inner_rest, outer_rest = following_rest(knuckles, squeeze)
    return (inner_rest - inner) / FOLLOW, (outer_rest - outer) / FOLLOW


SIDES = ("left", "right")
# a finger's spheres in MJCF, in the order of `pad_spheres`
PADS = {side: tuple(f"{side}_{i}" for i in range(2 * len(PAD_ROWS))) for side in SIDES}
TIPS = {side: tuple(f"{side}_tip_{i}" for i in range(2)) for side in SIDES}


def pad_spheres(knuckles: Any, inner: Any) -> jax.Array:
    """Centres of both fingers' spheres in the frames of their knuckles, [2, 8, 3] m.

    The pad's have their surface in the pad's face. The tips' have their lowest point, seen along
    the hand, in the pad's lower edge, which is what meets a table below.

    Args:
        knuckles, inner: [2] rad.
    """
    along = (TIP + PAD_ROWS).astype(np.float32)
    sine, cosine = jnp.sin(inner)[:, None], jnp.cos(inner)[:, None]
    y = FINGER[0] + FACE * cosine - along * sine
    z = FINGER[1] + FACE * sine + along * cosine
    x = np.repeat(np.array([-PAD_HALF, PAD_HALF], np.float32), len(along))
    face = jnp.stack(
        [jnp.broadcast_to(x, (2, len(x))), jnp.tile(y + PAD_SPHERE, (1, 2)), jnp.tile(z, (1, 2))],
        -1,
    )
    edge_y = y[:, 0] - PAD_SPHERE * jnp.sin(knuckles)
    edge_z = z[:, 0] - PAD_SPHERE * jnp.cos(knuckles)
    tips = [
        jnp.stack([jnp.full(2, sign * PAD_HALF, jnp.float32), edge_y, edge_z], -1)
        for sign in (-1.0, 1.0)
    ]
    return jnp.concatenate([face, jnp.stack(tips, 1)], 1)
