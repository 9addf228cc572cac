"""A scripted expert for lift: a pure function of the state.

As in nut assembly, the part of the task it is in follows from where cube and gripper are: the
height over the cube is a funnel of the remaining error, so that it can take over anywhere.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.manipulation.physics.analytic.quaternion import rotation_matrix
from envs.manipulation.tasks.scene_task import SceneParams, SceneState

GAIN = 12.0  # 1/m, action per distance
TURN = 2.0  # action per rad
HOVER = 0.08  # m above the cube, where gripper and cube are not in line
ALIGNED, LOST = 0.4, 1.0  # misalignment up to which to be down, from which to be up
ASIDE, ASKEW = 0.03, 0.35  # m and rad, of misalignment 1
LEVEL = (0.012, 0.03)  # m, of the gripper above the cube: where it closes, and stays closed
TIGHT = (0.6, 1.0)  # command, between which the cube is lifted
RISE = 0.1  # m, what is aimed at above where the gripper is
UPWARDS = 0.5  # action, at most, with the cube in hand


def _ramp(value: jax.Array, low: float, high: float) -> jax.Array:
    """0 below `low`, 1 above `high`, straight between them."""
    return jnp.clip((value - low) / (high - low), 0.0, 1.0)


def scripted_expert(
    key: jax.Array, state: SceneState, observation: jax.Array, params: SceneParams
) -> jax.Array:
    """Action [7]: hover over the cube, turn to its nearest side, descend, close, lift."""
    del key, observation, params
    cube, eef, axes = state.sensed, state.site.position, state.site.rotation.T  # rows
    sides = rotation_matrix(cube.quaternion)

    # the gripper closes along its x axis, which should lie along one of the cube's level axes
    ahead = jnp.arctan2(sides[1, 0], sides[0, 0]) - jnp.arctan2(axes[0, 1], axes[0, 0])
    quarter = jnp.pi / 2
    yaw = (ahead + quarter / 2) % quarter - quarter / 2
    tilt = jnp.cross(axes[2], jnp.array([0.0, 0.0, -1.0], jnp.float32))
    turn = jnp.clip(TURN * jnp.array([tilt[0], tilt[1], yaw], jnp.float32), -1.0, 1.0)

    # height over the cube is a funnel: the better in line, the lower
    off = cube.position - eef
    aside = jnp.sqrt(jnp.sum(off[:2] ** 2) + 1e-12)
    wrong = jnp.maximum(aside / ASIDE, jnp.abs(yaw) / ASKEW)
    reach = off.at[2].add(HOVER * _ramp(wrong, ALIGNED, LOST))
    command = state.fingers.command
    level = LEVEL[0] + (LEVEL[1] - LEVEL[0]) * _ramp(command, -1.0, 0.0)
    around = (wrong < LOST) & (jnp.abs(off[2]) < level)

    lift = jnp.array([0.0, 0.0, RISE], jnp.float32) * _ramp(command, *TIGHT)
    move = jnp.clip(GAIN * jnp.where(cube.grasped, lift, reach), -1.0, 1.0)
    move = move.at[2].set(jnp.clip(move[2], -0.5, jnp.where(cube.grasped, UPWARDS, 1.0)))
    turn = jnp.where(cube.grasped, 0.5 * turn.at[2].set(0.0), turn)
    grip = jnp.where(around | cube.grasped, 1.0, -1.0)
    return jnp.concatenate([move, turn, grip[None]])
