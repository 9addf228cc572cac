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
    along = TIP + PAD_ROWS
    sine, cosine = jnp.sin(knuckle), jnp.cos(knuckle)
    tilt, level = jnp.sin(turn), jnp.cos(turn)
    out_y = FINGER[0] * cosine - FINGER[1] * sine + FACE * level - along * tilt
    out_z = FINGER[0] * sine + FINGER[1] * cosine + FACE * tilt + along * level
    place = jnp.stack([_KNUCKLE[0] + out_y, _KNUCKLE[1] + out_z], -1)
    return place, jnp.stack([-out_z, out_y], -1)
