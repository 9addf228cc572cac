"""Operational-space control of the arm in C MuJoCo: the same law on MuJoCo's quantities."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.control.operational_space import applied_torque, arm_torque, shifted
from envs.manipulation.physics.mujoco_c import Measured, MujocoC, MujocoState
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import FRICTION_LOSS, TORQUE_LIMIT

Goal = tuple[jax.Array, jax.Array]


def goal_of(at: Measured, action: jax.Array, held: jax.Array) -> Goal:
    """Goal of a control step; see `operational_space.new_goal`. `held`: [3, 3] (columns)."""
    return shifted(at.position, at.rotation, action, held)


def torque(scene: MujocoC, state: MujocoState, goal: Goal, factors: Factors = NOMINAL) -> jax.Array:
    """Torque on all degrees of freedom, [nv] N m: the arm's motors, zero elsewhere.

    The joints' damping and the tool's drag are in the MJCF.
    """
    at, speeds = scene.measure(state, factors), state.qvel[scene.dofs]
    task = arm_torque(
        at.jacobian,
        at.mass,
        position=at.position,
        rotation=at.rotation,
        speeds=speeds,
        goal=goal,
        posture=jnp.zeros_like(speeds),
        gain=factors.gain,
    )
    applied = applied_torque(
        task,
        at.bias,
        limit=np.asarray(TORQUE_LIMIT, np.float32),
        speeds=speeds,
        damping=0.0,
        friction=FRICTION_LOSS,
        factor=factors.damping,
    )
    return jnp.zeros_like(state.qvel).at[scene.dofs].set(applied)
