"""A scripted expert for table wiping: a pure function of the state, and easy to learn from.

robosuite's observation tells where the centroid of the remaining dirt is and how far the farthest
marker lies from it, not where the markers are. An expert that goes to the nearest marker uses what
a policy cannot see, and its clones stall at the centroid between two remains. This one circles the
centroid at that distance, which wipes the farthest dirt and so shrinks the circle: all of it is in
the observation. Only when patience runs out does it look at the markers themselves.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.manipulation.physics.analytic.arm import cross
from envs.manipulation.scenes.model import WIPER
from envs.manipulation.tasks.base import lagged_frames
from envs.manipulation.tasks.wiping import (
    BASE,
    WipingParams,
    WipingState,
    gap_below,
    remaining,
)

GAIN = 15.0  # 1/m, action per distance
INSIDE = 0.03  # m: the circle is that much smaller than the dirt's radius, half the wiper
BEND = 0.05  # m off the circle at which it only closes in
SMALL = 0.03  # m, radius below which it stops circling
FAR, FLY, LOW = 0.08, 0.04, 0.008  # m outside the dirt, and the height there; where pressing begins
PRESS, PRESS_GAIN, PRESS_DEPTH = 0.35, 150.0, 0.0007  # action, 1/m, m below the table
PATIENCE = 200  # steps
NEAR, CLUSTER = 0.05, 0.02  # m


def _circle(away: jax.Array, radius: jax.Array) -> jax.Array:
    """Velocity command, [2], at `away` [2] from the centroid of dirt of that radius."""
    distance = jnp.sqrt(jnp.sum(away**2) + 1e-8)
    out = away + jnp.array([0.0, 0.01], jnp.float32)  # at the centre, some way out
    out = out / jnp.sqrt(jnp.sum(out**2) + 1e-8)
    along = jnp.stack([-out[1], out[0]])
    wanted = jnp.maximum(radius - INSIDE, 0.0)
    closing = jnp.clip(GAIN * (wanted - distance), -1.0, 1.0)
    turning = jnp.clip(wanted / SMALL, 0.0, 1.0) * jnp.clip(1 - (distance - wanted) / BEND, 0, 1)
    command = closing * out + turning * along
    return command / jnp.maximum(jnp.sqrt(jnp.sum(command**2) + 1e-9), 1.0)


def scripted_expert(
    key: jax.Array, state: WipingState, observation: jax.Array, params: WipingParams
) -> jax.Array:
    """Action [6]: keep the wiper level and pressed, and circle what is left of the dirt."""
    del key, observation, params
    at = lagged_frames(state, WIPER)
    place = jnp.stack(at.position)[:2] + BASE[:2]
    _, radius, centroid = remaining(state.markers, state.wiped)
    away = place - centroid[:2]
    command = _circle(away, radius)

    left = ~state.wiped
    distance = jnp.sqrt(jnp.sum((state.markers - place) ** 2, -1))
    closest = jnp.argmin(jnp.where(left, distance, jnp.inf))
    near = jnp.sum((state.markers - state.markers[closest]) ** 2, -1) < CLUSTER**2
    around = left & near
    target = jnp.sum(jnp.where(around[:, None], state.markers, 0.0), 0)
    error = target / jnp.maximum(jnp.sum(around, dtype=jnp.float32), 1.0) - place
    looking = (state.time >= PATIENCE) & (distance[closest] < NEAR)
    command = jnp.where(looking, jnp.clip(GAIN * error, -1.0, 1.0), command)

    height = gap_below(at)
    press = -jnp.clip(PRESS + PRESS_GAIN * (height + PRESS_DEPTH), 0.15, 0.7)
    down = jnp.where(height > LOW, -jnp.clip(12 * height, 0.1, 0.5), press)
    far = jnp.sqrt(jnp.sum(away**2)) > radius + FAR
    vertical = jnp.where(far & (height > LOW), jnp.clip(15 * (FLY - height), -0.5, 0.5), down)
    tilt = jnp.stack(cross(at.rotation[2], (0.0, 0.0, -1.0)))
    return jnp.concatenate([command, vertical[None], jnp.clip(tilt, -1.0, 1.0)])
