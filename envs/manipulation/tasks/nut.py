"""Nut assembly: a UR5e lifts a ring by its handle and puts it on a peg (NutAssemblyRound)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.derivatives import length
from envs.manipulation.physics.analytic import gripper, unrolled_linalg
from envs.manipulation.physics.analytic.arm import frames, jacobian, twist_of
from envs.manipulation.physics.analytic.quaternion import (
    hand_quaternion,
    multiply,
    rotation_matrix,
    turned,
)
from envs.manipulation.randomisation import Ranges
from envs.manipulation.scenes.model import (
    GRIPPER,
    HANDLE,
    INITIAL_JOINTS,
    NUT_BASE,
    PEG,
    TIMESTEP,
)
from envs.manipulation.tasks.base import ArmTask, first_pose, lagged_frames
from ppl_jax.types import EnvSpec, Outcome

OBSERVATION_SIZE, ACTION_SIZE = 51, 7
HORIZON = 1000  # control steps of 0.05 s

# reward and success (robosuite 1.4.1, environments/manipulation/nut_assembly.py)
REACH, GRASP, LIFT, HOVER = 0.1, 0.35, 0.5, 0.7
LIFT_HEIGHT = 0.995  # m, of the table's centre plus 0.2
DISTRACTED = 43  # steps in which the parked square nut, still falling, counts as lifted
PEG_RANGE, PEG_HEIGHT = 0.03, 0.87  # m, of the ring's centre about the peg; below which it is on
PRESENCE = 0.6  # largest 1 - tanh(10 distance) of gripper to ring for success
PLACE_X, PLACE_Y, PLACE_Z = (-0.115, -0.11), (-0.225, -0.11), 0.89  # m, where the ring starts
FALLEN = 0.75  # m, below which the ring has left the table for good

BASE = np.array(NUT_BASE, np.float32)


@flax.struct.dataclass
class NutState:
    """Everything that the next step depends on.

    Attributes:
        joints, speeds: [6] rad, rad/s.
        acceleration: [14] of the last physics step, where the contact solver starts.
        goal_rotation: [3, 3] rows are the axes of the controller's orientation goal.
        fingers, finger_speeds: [6] gripper joints (left knuckle, inner finger, inner knuckle;
            right), rad, rad/s.
        command: Gripper command, -1 open to 1 closed.
        touching: Both pads touch the ring.
        position, quaternion: [3] m in the world, [4] w x y z of the ring.
        velocity, spin: [3] m/s and rad/s of the ring, world axes.
        scenario, time: Number and steps so far.
    """

    joints: jax.Array
    speeds: jax.Array
    acceleration: jax.Array
    goal_rotation: jax.Array
    fingers: jax.Array
    finger_speeds: jax.Array
    command: jax.Array
    touching: jax.Array
    position: jax.Array
    quaternion: jax.Array
    velocity: jax.Array
    spin: jax.Array
    scenario: jax.Array
    time: jax.Array


@flax.struct.dataclass
class NutParams:
    """Starts of the pool, and what a study may change.

    Attributes:
        joints: [S, 6] rad. place: [S, 3] x, y (m, world) and yaw of the ring. number: [S].
        reward_scale: Factor on robosuite's reward.
        ranges: Of the domain randomisation, or None.
    """

    joints: jax.Array
    place: jax.Array
    number: jax.Array
    reward_scale: jax.Array | float = 1.0
    ranges: Ranges | None = None


def lagged_ring(state: NutState) -> tuple[jax.Array, jax.Array]:
    """Position and quaternion of the ring one physics step ago."""
    position = state.position - TIMESTEP * state.velocity
    return position, turned(state.quaternion, state.spin, -TIMESTEP)


def handle_of(position: jax.Array, quaternion: jax.Array) -> jax.Array:
    """Centre of the handle, [3]."""
    return position + rotation_matrix(quaternion) @ jnp.array(HANDLE, jnp.float32)


def stages(
    eef: jax.Array,
    position: jax.Array,
    handle: jax.Array,
    *,
    touching: jax.Array,
    time: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Robosuite's staged reward (reach, grasp, lift, hover), [4], and whether the ring is on.

        reach 0.1 (1 - tanh 10 d), grasp 0.35, lift 0.35 + 0.15 (1 - tanh 15 max(0.995 - z, 0)),
        hover lift + 0.2 (1 - tanh 10 |xy - peg|)

    Args:
        eef, position, handle: [3] grip site, ring's centre and its handle, m.
        touching: Both pads touch the ring.
        time: Steps since the start, this one included.
    """
    reach = REACH * (1 - jnp.tanh(10 * length(eef - handle)))
    missing = jnp.where(time <= DISTRACTED, 0.0, jnp.maximum(LIFT_HEIGHT - position[2], 0.0))
    lift = jnp.where(touching, GRASP + (LIFT - GRASP) * (1 - jnp.tanh(15 * missing)), 0.0)
    away = position[:2] - jnp.array(PEG[:2], jnp.float32)
    hover = lift + (HOVER - LIFT) * (1 - jnp.tanh(10 * length(away)))
    on = jnp.all(jnp.abs(away) < PEG_RANGE) & (position[2] < PEG_HEIGHT)
    return jnp.stack([reach, jnp.where(touching, GRASP, 0.0), lift, hover]), on


# what a network sees is (observation - MEAN) / SCALE
MEAN = np.concatenate(
    [[*PEG[:2], 0.9], [0.0, 0.0, 0.5, 0.0], [0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0],
     np.cos(INITIAL_JOINTS), np.sin(INITIAL_JOINTS), np.zeros(6), [0.0, -0.13, 0.95],
     [-1.0, 0.03, 0.0, 0.0], [0.2, -0.27, 0.0] * 2, np.zeros(6)]
).astype(np.float32)  # fmt: skip
# what has to be done next shows in millimetres between gripper and handle and between ring and peg;
# joints and their speeds say it again in a nonlinear way and are kept quiet (chosen by cloning on
# scenarios 2000-2049: 0.48 with the ring seen in units of 15 and 5 cm, 0.94 in units of 2 cm)
SCALE = np.concatenate(
    [[0.02, 0.02, 0.02], np.full(4, 0.5), [0.02, 0.02, 0.02], np.full(4, 0.3),
     np.full(12, 3.0), np.full(6, 3.0), [0.15, 0.1, 0.02], np.full(4, 0.3),
     np.full(6, 0.1), np.full(6, 10.0)]
).astype(np.float32)  # fmt: skip


class NutAssembly(ArmTask):
    """Nut assembly as pure functions. Build one with `make_nut_assembly`."""

    name = "nut_assembly"
    spec = EnvSpec(
        observation_size=OBSERVATION_SIZE,
        action_size=ACTION_SIZE,
        observation_mean=MEAN,
        observation_scale=SCALE,
    )
    max_episode_steps = HORIZON
    tool = GRIPPER
    base = BASE

    def reset_to(self, index: jax.Array, key: jax.Array, params: NutParams) -> NutState:
        """The start of scenario `index` of the pool."""
        del key  # a scenario is deterministic
        joints = self.first_joints(params.joints[index], index, params)
        place = params.place[index]
        at = frames(list(joints), GRIPPER)
        zero = jnp.zeros((), jnp.float32)
        return NutState(
            joints=joints,
            speeds=jnp.zeros(6, jnp.float32),
            acceleration=jnp.zeros(14, jnp.float32),
            goal_rotation=unrolled_linalg.array(at.rotation),
            fingers=jnp.asarray(gripper.INITIAL, jnp.float32),
            finger_speeds=jnp.zeros(6, jnp.float32),
            command=zero,
            touching=jnp.zeros((), bool),
            position=jnp.append(place[:2], PLACE_Z),
            quaternion=jnp.stack([jnp.cos(place[2] / 2), zero, zero, jnp.sin(place[2] / 2)]),
            velocity=jnp.zeros(3, jnp.float32),
            spin=jnp.zeros(3, jnp.float32),
            scenario=jnp.asarray(index, jnp.int32),
            time=jnp.zeros((), jnp.int32),
        )

    def transition(
        self, key: jax.Array, state: NutState, action: jax.Array, params: NutParams
    ) -> tuple[NutState, Outcome]:
        """One control step of 0.05 s, without reset."""
        del key  # the world is deterministic
        moved = self.backend.advance(
            state, jnp.clip(action, -1.0, 1.0), self.factors(state, params)
        )
        return self.finish(state, moved, params)

    def finish(
        self, state: NutState, moved: NutState, params: NutParams
    ) -> tuple[NutState, Outcome]:
        """The result of a control step, given its physics (see `Backend.advance`)."""
        values = [leaf for leaf in jax.tree.leaves(moved) if leaf.dtype == jnp.float32]
        physics_diverged = ~jnp.all(
            jnp.isfinite(jnp.concatenate([jnp.ravel(leaf) for leaf in values]))
        )
        new = jax.tree.map(lambda a, b: jnp.where(physics_diverged, b, a), moved, state)
        new = dataclasses.replace(new, time=state.time + 1)
        at = lagged_frames(new, GRIPPER)
        eef = jnp.stack(at.position) + BASE
        position, quaternion = lagged_ring(new)
        staged, on = stages(
            eef,
            position,
            handle_of(position, quaternion),
            touching=new.touching,
            time=new.time,
        )
        near = 1 - jnp.tanh(10 * length(eef - position))
        success = on & (near < PRESENCE) & ~physics_diverged
        fallen = position[2] < FALLEN
        # as in robosuite, a ring on the peg no longer counts in the stages
        reward = jnp.where(success, 1.0, jnp.max(staged))
        lost = fallen | physics_diverged
        return new, Outcome(
            reward=jnp.where(physics_diverged, 0.0, params.reward_scale * reward),
            terminated=success | lost,
            truncated=new.time >= HORIZON,
            cost=fallen.astype(jnp.float32),
            success=success,
            unsafe=fallen,
            progress=jnp.where(success, 1.0, jnp.max(staged)),
            speed=length(jnp.stack(twist_of(jacobian(at), list(new.speeds))[0])),
            physics_diverged=physics_diverged,
        )

    def readings(self, state: NutState) -> list[tuple[str, str]]:
        """Whether the ring is held."""
        return [("ring held", "yes" if bool(state.touching) else "no")]

    def observe(self, state: NutState, params: NutParams) -> jax.Array:
        """The 51 values, in robosuite 1.4.1's order.

        0-2 ring, 3-6 its quaternion (x y z w), 7-9 and 10-13 its position and quaternion in the
        hand's frame, 14-19 cos q, 20-25 sin q, 26-31 dq, 32-34 grip site, 35-38 hand (x y z w),
        39-44 gripper joints, 45-50 their speeds.
        """
        lagged = list(state.joints - TIMESTEP * state.speeds)
        at = frames(lagged, GRIPPER)
        eef = jnp.stack(at.position) + BASE
        hand = hand_quaternion(lagged)
        position, quaternion = lagged_ring(state)
        back = (hand[3], -hand[0], -hand[1], -hand[2])
        w, x, y, z = multiply(back, tuple(quaternion))
        relative = jnp.stack([x, y, z, w]) * jnp.where(w < 0, -1.0, 1.0)
        axes = unrolled_linalg.array(at.links[6][1])
        seen = jnp.concatenate(
            [
                position,
                jnp.roll(quaternion, -1),
                axes @ (position - eef),
                relative,
                jnp.cos(state.joints),
                jnp.sin(state.joints),
                state.speeds,
                eef,
                hand,
                state.fingers,
                state.finger_speeds,
            ]
        )
        return self.with_sensor_noise(seen, state, params)


def make_params(numbers: Sequence[int]) -> NutParams:
    """Starts of the scenarios with these numbers."""

    def start(number: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_joints, key_place = jax.random.split(jax.random.key(number))
        low = jnp.array([PLACE_X[0], PLACE_Y[0], 0.0], jnp.float32)
        high = jnp.array([PLACE_X[1], PLACE_Y[1], 2 * jnp.pi], jnp.float32)
        place = jax.random.uniform(key_place, (3,), jnp.float32, minval=low, maxval=high)
        return first_pose(key_joints), place

    number = jnp.asarray(tuple(numbers), jnp.int32)
    joints, place = jax.jit(jax.vmap(start))(number)
    return NutParams(
        joints=joints,
        place=place,
        number=number,
        reward_scale=jnp.float32(1.0),
    )
