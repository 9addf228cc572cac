"""Lift: a UR5e and its two-finger gripper lift a cube from a table (robosuite's Lift)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.derivatives import length
from envs.manipulation.control.gripper_on_mjx import TwoFingerGripper
from envs.manipulation.control.on_mjx import ur5e
from envs.manipulation.physics.analytic import grasp_contact, gripper
from envs.manipulation.physics.may_close import over_table
from envs.manipulation.physics.mjx.scene import Scene
from envs.manipulation.physics.mujoco_c import grasp_softness
from envs.manipulation.scenes.lift import CUBE_HALF, TABLE, lift_scene
from envs.manipulation.scenes.model import (
    GRIPPER,
    INITIAL_JOINTS,
)
from envs.manipulation.tasks.base import HELD_OUT_SCENARIOS, TRAINING_SCENARIOS, first_pose
from envs.manipulation.tasks.scene_task import SceneState, SceneTask, Start, Verdict
from ppl_jax.types import Expert

# robosuite 1.4.1, environments/manipulation/lift.py
PLACE = 0.03  # m: the cube starts within it of the table's centre, in x and in y
DROP = 0.01  # m: from so high above the table it falls at the start
LIFTED = 0.04  # m: height of the cube's centre above the table that solves the task
BEST, GRASP = 2.25, 0.25  # reward of a lifted cube, and of a grasp
FALLEN = 0.05  # m below the table's top, where the cube has left it for good

# what a network sees is (observation - MEAN) / SCALE: millimetres between hand and cube decide, and
# joints say it again in a nonlinear way, so they are kept quiet (as in nut assembly)
MEAN = np.concatenate(
    [[0.0, 0.0, TABLE[2] + CUBE_HALF], np.zeros(4), np.zeros(3), np.cos(INITIAL_JOINTS),
     np.sin(INITIAL_JOINTS), np.zeros(6), [0.0, -0.05, 0.9], [-1.0, 0.03, 0.0, 0.0],
     [0.2, -0.27, 0.0] * 2, np.zeros(6)]
).astype(np.float32)  # fmt: skip
SCALE = np.concatenate(
    [np.full(3, 0.02), np.full(4, 0.5), np.full(3, 0.02), np.full(12, 3.0), np.full(6, 3.0),
     [0.1, 0.1, 0.05], np.full(4, 0.3), np.full(6, 0.1), np.full(6, 10.0)]
).astype(np.float32)  # fmt: skip


@flax.struct.dataclass
class Cube:
    """The cube and the hand as a step senses them.

    Attributes:
        position, quaternion: [3] m and [4] w x y z of the cube.
        hand: [4] w x y z of the hand.
        grasped: Both pads touch the cube.
    """

    position: jax.Array
    quaternion: jax.Array
    hand: jax.Array
    grasped: jax.Array


def lift_xml() -> str:
    """MJCF of lift with nut assembly's contact parameters."""
    return lift_scene(
        pads=gripper.PADS,
        tips=gripper.TIPS,
        soft=grasp_softness(),
        friction=grasp_contact.FRICTION,
        knuckle_inertia=gripper.SERVO_INERTIA,
    )


def shaped_reward(eef: jax.Array, cube: jax.Array, grasped: jax.Array) -> jax.Array:
    """Robosuite's shaped reward, normalised to 1 for a lifted cube.

        r = 2.25 where lifted, else 1 - tanh(10 |eef - cube|) + 0.25 [grasped], all over 2.25

    Args:
        eef, cube: [3] of grip site and cube's centre, m.
        grasped: Both pads touch the cube.
    """
    reach = 1 - jnp.tanh(10 * length(eef - cube))
    return jnp.where(lifted(cube), BEST, reach + jnp.where(grasped, GRASP, 0.0)) / BEST


def lifted(cube: jax.Array) -> jax.Array:
    """Whether a cube with this centre, [3] m, is lifted."""
    return cube[2] > TABLE[2] + LIFTED


class Lift(SceneTask):
    """Lift as pure functions. Build one with `make_lift`."""

    name = "lift"
    max_episode_steps = 500
    observation_mean, observation_scale = MEAN, SCALE

    def __init__(
        self,
        training: Sequence[int] = TRAINING_SCENARIOS,
        held_out: Sequence[int] = HELD_OUT_SCENARIOS,
        *,
        experts: Mapping[str, Expert] | None = None,
        solver: str | None = None,
    ):
        """Compile the scene.

        Args:
            training, held_out: Numbers of the scenarios to train and to evaluate on.
            experts: By name.
            solver: Of contacts; see `Scene`.
        """
        scene = Scene(lift_xml(), solver=solver, may_close=over_table(TABLE))
        arm = ur5e(scene, GRIPPER)
        self.cube, self.hand = scene.body("cube"), scene.body("hand")
        self.cube_at, _ = scene.free_joint("cube")
        super().__init__(
            scene,
            arm,
            gripper=TwoFingerGripper(scene, holds="cube"),
            handled=["cube"],
            training=training,
            held_out=held_out,
            experts=experts,
        )

    def draw(self, key: jax.Array) -> Start:
        """Joints about robosuite's pose; the cube about the table's centre, turned any way."""
        key_joints, key_cube = jax.random.split(key)
        joints = first_pose(key_joints)
        x, y, half_yaw = jax.random.uniform(key_cube, (3,), jnp.float32, minval=-1.0) * jnp.array(
            [PLACE, PLACE, jnp.pi / 2], jnp.float32
        )
        cube = jnp.stack(
            [x, y, jnp.float32(TABLE[2] + CUBE_HALF + DROP), jnp.cos(half_yaw), 0.0, 0.0,
             jnp.sin(half_yaw)]
        )  # fmt: skip
        qpos = jnp.zeros(self.scene.model.nq, jnp.float32).at[self.arm.qpos].set(joints)
        return Start(qpos.at[self.cube_at].set(cube))

    def sense(self, data: Any) -> Cube:
        """Cube, hand and grasp."""
        touching = [self.scene.touching(data, rows) for rows in self.gripper.contacts]
        return Cube(
            position=data.xpos[self.cube],
            quaternion=data.xquat[self.cube],
            hand=data.xquat[self.hand],
            grasped=jnp.all(jnp.stack(touching)),
        )

    def judge(self, before: SceneState, after: SceneState) -> Verdict:
        """Robosuite's shaped reward; a cube off the table ends the episode."""
        del before
        cube = after.sensed
        reward = shaped_reward(after.site.position, cube.position, cube.grasped)
        return Verdict(
            reward=reward,
            success=lifted(cube.position),
            unsafe=cube.position[2] < TABLE[2] - FALLEN,
            progress=reward,
        )

    def see(self, state: SceneState) -> jax.Array:
        """The 47 values, in robosuite 1.4.1's order.

        0-2 cube, 3-6 its quaternion (x y z w), 7-9 grip site less cube, 10-15 cos q, 16-21 sin q,
        22-27 dq, 28-30 grip site, 31-34 hand (x y z w), 35-40 gripper joints, 41-46 their speeds.
        """
        cube, bodies = state.sensed, state.bodies
        joints = bodies.qpos[self.arm.qpos]
        fingers, finger_speeds = self.gripper.joints(bodies, state.fingers)
        return jnp.concatenate(
            [
                cube.position,
                jnp.roll(cube.quaternion, -1),
                state.site.position - cube.position,
                jnp.cos(joints),
                jnp.sin(joints),
                bodies.qvel[self.arm.dofs],
                state.site.position,
                jnp.roll(cube.hand, -1),
                fingers,
                finger_speeds,
            ]
        )

    def readings(self, state: SceneState) -> list[tuple[str, str]]:
        """Whether the cube is held."""
        return [("cube held", "yes" if bool(state.sensed.grasped) else "no")]
