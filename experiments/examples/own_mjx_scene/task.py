"""The task: push the block until it lies on the goal."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.control.on_mjx import OperationalSpace
from envs.manipulation.physics.mjx.scene import Scene
from envs.manipulation.scenes.panda import JOINTS, REST, TORQUE_LIMIT
from envs.manipulation.tasks.scene_task import SceneTask, Start, Verdict

from .scene import BLOCK_HALF, xml

DONE, FAR = 0.015, 0.30  # m from block to goal: solved, and lost for good


@flax.struct.dataclass
class Block:
    """Position [3] m of the block, and the directions [2] that block and fork face."""

    position: jax.Array
    heading: jax.Array
    fork: jax.Array


class Push(SceneTask):
    """Push the block to the goal: six actions, which move and turn the fork."""

    name = "push"
    max_episode_steps = 100
    observation_mean = np.array([0, 0, 0.03, 0.15, 0, 1, 0, 1, 0, 0, 0, 0], np.float32)
    observation_scale = np.array([0.02] * 5 + [0.3] * 7, np.float32)

    def __init__(self, training=range(200), held_out=range(1000, 1020), experts=None):
        """Compile the scene and say what moves the arm."""
        scene = Scene(xml())
        arm = OperationalSpace(
            scene, joints=JOINTS, site="grip", torque_limit=TORQUE_LIMIT, rest=REST
        )
        self.block, self.hand = scene.body("block"), scene.body("hand")
        self.block_at, _ = scene.free_joint("block")
        super().__init__(
            scene, arm, handled=["block"], training=training, held_out=held_out, experts=experts
        )

    def draw(self, key):
        """A start: the block near the fork, the goal ahead of it."""
        low = jnp.array([0.46, -0.06, -0.2, 0.60, -0.08])
        high = jnp.array([0.50, 0.06, 0.2, 0.64, 0.08])
        x, y, yaw, goal_x, goal_y = jax.random.uniform(key, (5,), minval=low, maxval=high)
        zero = jnp.zeros(())
        block = jnp.stack(
            [x, y, zero + BLOCK_HALF[2], jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)]
        )
        qpos = jnp.zeros(self.scene.model.nq)
        qpos = qpos.at[self.arm.qpos].set(REST).at[self.block_at].set(block)
        mocap = jnp.stack([goal_x, goal_y, zero, zero + 1.0, zero, zero, zero])[None]
        return Start(qpos, mocap=mocap)

    def sense(self, data):
        """What reward and observation need of a physics step."""
        return Block(
            position=data.xpos[self.block],
            heading=data.xmat[self.block][:2, 0],
            fork=data.xmat[self.hand][:2, 0],
        )

    def way(self, state):
        """From the block to the goal, [2] m."""
        return state.bodies.mocap[0, :2] - state.sensed.position[:2]

    def judge(self, before, after):
        """Reward and ends of a step."""
        away = jnp.linalg.norm(self.way(after))
        reward = 1.0 - jnp.tanh(10.0 * away)
        return Verdict(reward=reward, success=away < DONE, unsafe=away > FAR, progress=reward)

    def see(self, state):
        """The observation: fork from block, goal from block, where both face, the fork's speed."""
        block = state.sensed
        off = state.site.position - block.position
        return jnp.concatenate(
            [off, self.way(state), block.heading, block.fork, state.site.velocity]
        )
