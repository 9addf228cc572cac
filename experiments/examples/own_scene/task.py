"""The task: state, observation, reward and success of holding the pointer at a goal in the air."""

from __future__ import annotations

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.control.operational_space import free_steps
from envs.manipulation.scenes.model import INITIAL_JOINTS, INITIAL_NOISE, JOINT_LIMIT
from envs.manipulation.tasks.base import ArmTask, site_rotation
from ppl_jax.types import EnvSpec, Outcome

from .scene import BASE, PROBE

NEAR, HELD = 0.02, 10  # m; steps within it that solve the task
CENTRE, REACH = np.array([0.1, 0.0, 1.1]), np.array([0.1, 0.2, 0.1])  # m, where goals lie


@flax.struct.dataclass
class HoverState:
    """Joints and their speeds, [6] rad and rad/s; orientation goal [3, 3]; goal [3] m; counts."""

    joints: jax.Array
    speeds: jax.Array
    goal_rotation: jax.Array
    goal: jax.Array
    held: jax.Array
    scenario: jax.Array
    time: jax.Array


@flax.struct.dataclass
class HoverParams:
    """Numbers of the scenarios, [S]: each is the seed of a start."""

    number: jax.Array


class Hover(ArmTask):
    """Hold the pointer's tip within 2 cm of the goal for ten steps."""

    name = "hover"
    max_episode_steps = 100
    spec = EnvSpec(
        observation_size=6,
        action_size=6,
        observation_mean=np.zeros(6, np.float32),
        observation_scale=np.array([0.1] * 3 + [0.3] * 3, np.float32),
    )
    tool = PROBE
    base = np.array(BASE, np.float32)

    def reset_to(self, index: jax.Array, key: jax.Array, params: HoverParams) -> HoverState:
        """The start of scenario `index`."""
        key_joints, key_goal = jax.random.split(jax.random.key(params.number[index]))
        joints = jnp.asarray(INITIAL_JOINTS) + INITIAL_NOISE * jax.random.normal(key_joints, (6,))
        none = jnp.zeros((), jnp.int32)
        return HoverState(
            joints=joints,
            speeds=jnp.zeros(6),
            goal_rotation=site_rotation(joints, PROBE),
            goal=jnp.asarray(CENTRE) + REACH * jax.random.uniform(key_goal, (3,), minval=-1.0),
            held=none,
            scenario=jnp.asarray(index, jnp.int32),
            time=none,
        )

    def observe(self, state: HoverState, params: HoverParams) -> jax.Array:
        """Way to the goal, [3] m, and the tip's velocity, [3] m/s."""
        tip, velocity = self.grip_position(state), self.grip_velocity(state)
        return jnp.concatenate([state.goal - tip, velocity])

    def transition(
        self, key: jax.Array, state: HoverState, action: jax.Array, params: HoverParams
    ) -> tuple[HoverState, Outcome]:
        """One control step of 0.05 s: the arm moves, nothing touches it."""
        joints, speeds, rotation = free_steps(
            state.joints, state.speeds, action, held=state.goal_rotation, tool=PROBE
        )
        moved = dataclasses.replace(state, joints=joints, speeds=speeds, goal_rotation=rotation)
        away = jnp.linalg.norm(state.goal - self.grip_position(moved))
        held, time = jnp.where(away < NEAR, state.held + 1, 0), state.time + 1
        success = held >= HELD
        unsafe = jnp.any(JOINT_LIMIT - jnp.abs(joints) < 0.1)
        return dataclasses.replace(moved, held=held, time=time), Outcome(
            reward=1.0 - jnp.tanh(10.0 * away),
            terminated=success | unsafe,
            truncated=time >= self.max_episode_steps,
            cost=unsafe.astype(jnp.float32),
            success=success,
            unsafe=unsafe,
            progress=jnp.clip(held / HELD, 0.0, 1.0),
            speed=jnp.linalg.norm(self.grip_velocity(moved)),
        )
