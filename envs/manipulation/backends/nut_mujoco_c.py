"""Nut assembly on C MuJoCo: slow, and the oracle of the other two."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from envs.manipulation.control.on_mujoco_c import goal_of, torque
from envs.manipulation.physics.analytic import gripper
from envs.manipulation.physics.analytic.quaternion import rotation_matrix
from envs.manipulation.physics.may_close import on_long_sides
from envs.manipulation.physics.mujoco_c import MujocoC, MujocoState, nut_xml
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import ARM_JOINTS, SUBSTEPS, TIMESTEP
from envs.manipulation.tasks.nut import NutState

# MuJoCo numbers joints by their place in the tree: arm, left and right knuckle, ring
_ARM, _KNUCKLES, _RING = slice(0, 6), slice(6, 8), slice(8, 15)


class NutMujocoC:
    """25 steps of 2 ms of the MJCF, one environment after another."""

    name = "mujoco_c"

    def __init__(self) -> None:
        """Compile the scene."""
        self.scene = MujocoC(
            nut_xml(),
            joints=ARM_JOINTS,
            handled=["ring"],
            moved=[n for s in gripper.SIDES for n in (*gripper.PADS[s], *gripper.TIPS[s])],
            groups=[("handle", f"{side}_") for side in gripper.SIDES],
            may_close=on_long_sides,
        )

    def advance(self, state: NutState, action: jax.Array, factors: Factors = NOMINAL) -> NutState:
        """The state after one control step of 0.05 s; see `NutAnalytic.advance`."""
        scene, turn = self.scene, rotation_matrix(state.quaternion)
        start = MujocoState(
            qpos=jnp.concatenate(
                [state.joints, state.fingers[::3], state.position, state.quaternion]
            ),
            qvel=jnp.concatenate(
                [state.speeds, state.finger_speeds[::3], state.velocity, turn.T @ state.spin]
            ),
            warm=jnp.concatenate([state.acceleration[:11], turn.T @ state.acceleration[11:]]),
        )
        goal = goal_of(scene.measure(start, factors), action[:6], state.goal_rotation.T)
        grip = gripper.RAMP * jnp.sign(action[6])

        def step(carry: tuple[MujocoState, NutState], _: None) -> tuple:
            now, s = carry
            command = jnp.clip(s.command + grip, -1.0, 1.0)
            knuckles, inner, outer = s.fingers[::3], s.fingers[1::3], s.fingers[2::3]
            servo = gripper.servo(command, knuckles, s.finger_speeds[::3])
            now, touched = scene.step(
                now,
                torque(scene, now, goal, factors).at[_KNUCKLES].set(servo),
                factors=factors,
                places=gripper.pad_spheres(knuckles, inner).reshape(-1, 3),
            )
            knuckles, speeds = now.qpos[_KNUCKLES], now.qvel[_KNUCKLES]
            inner_speed, outer_speed = gripper.follow(knuckles, inner, outer, touched.normal)
            inner, outer = inner + TIMESTEP * inner_speed, outer + TIMESTEP * outer_speed
            return (
                now,
                dataclasses.replace(
                    s,
                    fingers=jnp.stack([knuckles, inner, outer], -1).reshape(6),
                    finger_speeds=jnp.stack([speeds, inner_speed, outer_speed], -1).reshape(6),
                    command=command,
                    touching=jnp.all(touched.closed),
                ),
            ), None

        (now, moved), _ = jax.lax.scan(step, (start, state), None, length=SUBSTEPS)
        ring, motion, last = now.qpos[_RING], now.qvel[8:], now.warm
        turn = rotation_matrix(ring[3:])
        return dataclasses.replace(
            moved,
            joints=now.qpos[_ARM],
            speeds=now.qvel[_ARM],
            acceleration=jnp.concatenate([last[:11], turn @ last[11:]]),
            goal_rotation=goal[1].T,
            position=ring[:3],
            quaternion=ring[3:],
            velocity=motion[:3],
            spin=turn @ motion[3:],
        )
