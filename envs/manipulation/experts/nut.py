"""A scripted expert for nut assembly: a pure function of the state.

Which part of the task it is in follows from where ring and gripper are, never from what it did
before, so that it can take over anywhere and a lookahead may ask it again. Conditions widen once a
part is under way (height and gripper tell), so that noise on the action does not send it back.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.scenes.model import GRIPPER, PEG
from envs.manipulation.tasks.base import lagged_frames
from envs.manipulation.tasks.nut import (
    BASE,
    PLACE_Z,
    NutParams,
    NutState,
    handle_of,
    lagged_ring,
    rotation_matrix,
)

GAIN = 12.0  # 1/m, action per distance
TURN = 2.0  # action per rad
HOVER = 0.08  # m above the handle, where gripper and handle are not in line
ALIGNED, LOST = 0.5, 1.0  # misalignment up to which to be down, from which to be up
ASIDE, ASKEW = 0.035, 0.50  # m and rad, of misalignment 1
LEVEL = (0.012, 0.025)  # m, of the gripper above the handle: where it closes, and stays closed
CARRY, LOWER = 0.99, 0.80  # m, height of the ring on its way to the peg and aimed at on it
LIFTED = (0.93, 0.97)  # m, between which the ring sets off to the side
OVER, OFF = 0.009, 0.016  # m from the peg's axis: up to which to be down, from which to be up
TIGHT = (0.6, 1.0)  # command, between which the ring is lifted
GENTLE = 0.3  # lift from the table
EMPTY = (0.36, 0.42)  # rad, of the knuckles: closed farther than a handle lets them


def _ramp(value: jax.Array, low: float, high: float) -> jax.Array:
    """0 below `low`, 1 above `high`, straight between them."""
    return jnp.clip((value - low) / (high - low), 0.0, 1.0)


def scripted_expert(
    key: jax.Array, state: NutState, observation: jax.Array, params: NutParams
) -> jax.Array:
    """Action [7]: hover over the handle, descend, grasp, lift, carry, lower onto the peg."""
    del key, observation, params
    at = lagged_frames(state, GRIPPER)
    eef = jnp.stack(at.position) + BASE
    axes = unrolled_linalg.array(at.rotation)  # rows
    position, quaternion = lagged_ring(state)
    ring = rotation_matrix(quaternion)
    handle = handle_of(position, quaternion)

    # the gripper closes along its x axis, which should lie along the handle's y axis, either way
    across = ring[:, 1] * jnp.where(jnp.sum(ring[:, 1] * axes[0]) < 0, -1.0, 1.0)
    flat = across * jnp.array([1.0, 1.0, 0.0], jnp.float32)
    flat = flat / jnp.sqrt(jnp.sum(flat**2) + 1e-9)
    yaw = jnp.arctan2(axes[0, 0] * flat[1] - axes[0, 1] * flat[0], axes[0, :2] @ flat[:2])
    down = jnp.array([0.0, 0.0, -1.0], jnp.float32)
    tilt = jnp.cross(axes[2], down)
    turn = jnp.clip(TURN * jnp.array([tilt[0], tilt[1], yaw], jnp.float32), -1.0, 1.0)

    # height over the handle is a funnel: the better in line, the lower
    off = handle - eef
    aside = jnp.sqrt(jnp.sum(off[:2] ** 2) + 1e-12)
    wrong = jnp.maximum(aside / ASIDE, jnp.abs(yaw) / ASKEW)
    empty = _ramp(jnp.mean(state.fingers[::3]), *EMPTY)
    reach = off.at[2].add(HOVER * jnp.maximum(_ramp(wrong, ALIGNED, LOST), empty))
    level = LEVEL[0] + (LEVEL[1] - LEVEL[0]) * _ramp(state.command, -1.0, 0.0)
    around = (wrong < LOST) & (jnp.abs(off[2]) < level)

    # and so is height over the peg
    peg = jnp.array(PEG[:2], jnp.float32) - position[:2]
    beside = jnp.sqrt(jnp.sum(peg**2) + 1e-12)
    height = LOWER + (CARRY - LOWER) * _ramp(beside, OVER, OFF)
    free = jnp.maximum(_ramp(position[2], *LIFTED), 1 - _ramp(beside, 2 * OFF, 3 * OFF))
    tight = _ramp(state.command, *TIGHT)
    carry = tight * jnp.append(free * peg, height - position[2])
    gentle = GENTLE + (1 - GENTLE) * _ramp(position[2], PLACE_Z - 0.06, LIFTED[0])

    touching = state.touching
    move = jnp.clip(GAIN * jnp.where(touching, carry, reach), -1.0, 1.0)
    limit = jnp.where(touching, gentle, 1.0)
    move = move.at[2].set(jnp.clip(move[2], -0.5, limit))
    turn = jnp.where(touching, 0.5 * turn.at[2].set(0.0), turn)
    grip = jnp.where(around | touching, 1.0, -1.0)
    return jnp.concatenate([move, turn, grip[None]])
