"""A scripted expert for nut assembly: a pure function of the state.

Which part of the task it is in follows from where ring and gripper are, never from what it did
before, so that it can take over anywhere and a lookahead may ask it again. Conditions widen once a
part is under way (height and gripper tell), so that noise on the action does not send it back.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.manipulation.model import PEG
from envs.manipulation.nut import (
    _BASE,
    NutParams,
    NutState,
    handle_of,
    lagged_frames,
    lagged_ring,
    rotation_matrix,
)

GAIN = 12.0  # 1/m, action per distance
TURN = 2.0  # action per rad
HOVER = 0.08  # m above the handle on the way
CARRY = 0.99  # m, height of the ring on its way to the peg
ALIGNED, LOST = (0.010, 0.12), (0.022, 0.30)  # m and rad: to go down; not to go up again
LEVEL = 0.012  # m, of the gripper above the handle: where it may close
OVER, DRIFTED = 0.009, 0.020  # m from the peg's axis: to lower; not to rise again
LOWER = 0.80  # m, height aimed at on the peg
CLOSED = 0.98  # command: the ring is lifted once it has reached it


def scripted_expert(
    key: jax.Array, state: NutState, observation: jax.Array, params: NutParams
) -> jax.Array:
    """Action [7]: hover over the handle, descend, grasp, lift, carry, lower onto the peg."""
    del key, observation, params
    at = lagged_frames(state)
    eef = jnp.stack(at.position) + _BASE
    axes = jnp.stack([jnp.stack(column) for column in at.rotation])  # rows
    position, quaternion = lagged_ring(state)
    ring = rotation_matrix(quaternion)
    handle = handle_of(position, quaternion)

    # the gripper closes along its x axis, which should lie along the handle's y axis, either way
    across = ring[:, 1] * jnp.where(jnp.sum(ring[:, 1] * axes[0]) < 0, -1.0, 1.0)
    flat = across * jnp.array([1.0, 1.0, 0.0])
    flat = flat / jnp.sqrt(jnp.sum(flat**2) + 1e-9)
    yaw = jnp.arctan2(axes[0, 0] * flat[1] - axes[0, 1] * flat[0], axes[0, :2] @ flat[:2])
    down = jnp.array([0.0, 0.0, -1.0])
    tilt = jnp.cross(axes[2], down)
    turn = jnp.clip(TURN * jnp.array([tilt[0], tilt[1], yaw]), -1.0, 1.0)

    off = handle - eef
    aside = jnp.sqrt(jnp.sum(off[:2] ** 2))
    above = -off[2]
    # on the way down it may stray farther before it goes up again
    low = above < 0.6 * HOVER
    near = aside < jnp.where(low, LOST[0], ALIGNED[0])
    straight = jnp.abs(yaw) < jnp.where(low, LOST[1], ALIGNED[1])
    ready = near & straight
    height = jnp.where(ready, 0.0, HOVER)
    reach = jnp.append(off[:2], off[2] + height)
    around = ready & (jnp.abs(above) < LEVEL)
    holding = state.touching | (around & (state.command > 0.5))

    peg = jnp.array(PEG[:2]) - position[:2]
    beside = jnp.sqrt(jnp.sum(peg**2))
    lowering = position[2] < CARRY - 0.03
    over = beside < jnp.where(lowering, DRIFTED, OVER)
    lifted = position[2] > CARRY - 0.02
    rise = CARRY - position[2]
    carry = jnp.where(
        over,
        jnp.append(peg, LOWER - position[2]),
        jnp.where(lifted, jnp.append(peg, rise), jnp.append(0.0 * peg, rise)),
    )
    carry = carry.at[2].set(jnp.where(over, jnp.maximum(carry[2], -0.5 / GAIN), carry[2]))
    carry = jnp.where(state.touching & (state.command > CLOSED), carry, 0.0)

    move = jnp.clip(GAIN * jnp.where(holding, carry, reach), -1.0, 1.0)
    move = move.at[2].set(jnp.where(holding, move[2], jnp.maximum(move[2], -0.6)))
    turn = jnp.where(holding, 0.5 * turn.at[2].set(0.0), turn)
    grip = jnp.where(around | holding, 1.0, -1.0)
    return jnp.concatenate([move, turn, grip[None]])
