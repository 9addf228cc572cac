"""Table wiping: a UR5e presses a wiper on a dirty table (robosuite 1.4.1's Wipe)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.derivatives import length
from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import (
    Frames,
    frames,
    jacobian,
    twist_of,
)
from envs.manipulation.physics.analytic.collision import arm_hits
from envs.manipulation.physics.analytic.quaternion import hand_quaternion
from envs.manipulation.physics.analytic.wipe_contact import (
    POINTS,
    TABLE_CENTRE,
    TABLE_HALF,
    TABLE_TOP,
    over_table,
)
from envs.manipulation.randomisation import Ranges
from envs.manipulation.scenes.model import (
    INITIAL_JOINTS,
    JOINT_LIMIT,
    TIMESTEP,
    WIPER,
    WIPING_BASE,
    WIPING_TABLE,
)
from envs.manipulation.tasks.base import ArmTask, first_pose, lagged_frames
from envs.manipulation.tasks.markers import COUNT, draw_markers
from ppl_jax.types import EnvSpec, Outcome

OBSERVATION_SIZE, ACTION_SIZE = 34, 6
HORIZON = 1000  # control steps of 0.05 s

# reward (robosuite 1.4.1, environments/manipulation/wipe.py), before scaling
WIPED, COMPLETE, CONTACT, COLLISION = 50.0, 25.5, 0.01, -10.0
REACH, REACH_RATE = 5.0, 5.0
FORCE_RANGE, EXCESS = (0.5, 60.0), 0.05  # N
NORMALISATION = 1000.0 / (COUNT * WIPED + HORIZON * (CONTACT + COMPLETE))
CONTACT_FORCE = 1.0  # N above the bias: the contact flag
MANY_CONTACTS = 50
HALF_FACE = (0.06, 0.025)  # m, of the rectangle of the wiper's corner spheres
WIPE_DEPTH = 0.02  # m below which a marker under the face is not wiped
LIMIT_MARGIN = 0.1  # rad before a joint's limit, where an episode ends

BASE = np.array(WIPING_BASE, np.float32)
_CENTRE, _HALF, _TOP = WIPING_TABLE
_FAR = -10.0  # height of "no table", m
_SPHERES = (
    np.stack(np.meshgrid([-0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06], [-0.025, 0.025]), -1)
    .reshape(-1, 2)
    .astype(np.float32)
)
_SPHERE_RADIUS = 0.001
_TOOL_ENDS = ((-0.045, 0.0, -0.01), (0.045, 0.0, -0.01))


@flax.struct.dataclass
class WipingState:
    """Everything that the next step depends on.

    Attributes:
        joints, speeds: [6] rad, rad/s.
        acceleration: [6] of the last physics step, where the contact solver starts.
        goal_rotation: [3, 3] rows are the axes of the controller's orientation goal.
        force: [3] of the wrist's sensor, N, in the grip site's frame.
        force_bias: [3] what the contact flag compares it with: the first step's.
        contact: The contact flag as observed.
        markers: [100, 2] in the world, m.
        wiped: [100] gone.
        shown: [100] gone when the observation was taken, one step earlier.
        scenario, time: Number and steps so far.
    """

    joints: jax.Array
    speeds: jax.Array
    acceleration: jax.Array
    goal_rotation: jax.Array
    force: jax.Array
    force_bias: jax.Array
    contact: jax.Array
    markers: jax.Array
    wiped: jax.Array
    shown: jax.Array
    scenario: jax.Array
    time: jax.Array


@flax.struct.dataclass
class WipingParams:
    """Starts of the pool, and what a study may change.

    Attributes:
        joints: [S, 6] rad. markers: [S, 100, 2] in the world, m. number: [S] of the scenarios.
        reward_scale: Factor on robosuite's raw reward.
        ranges: Of the domain randomisation, or None.
    """

    joints: jax.Array
    markers: jax.Array
    number: jax.Array
    reward_scale: jax.Array | float = NORMALISATION
    ranges: Ranges | None = None


def gap_below(at: Frames) -> jax.Array:
    """Height of the wiper's face above the table, m."""
    return at.position[2] - TABLE_TOP


def contact_count(at: Frames, table: jax.Array) -> jax.Array:
    """Number of contacts in MuJoCo: lower corners of the wiper's boxes, and its spheres."""
    x, y, _ = at.rotation
    height = at.position[2] - table
    corners = height + POINTS[:, 0] * x[2] + POINTS[:, 1] * y[2]
    spheres = height - _SPHERE_RADIUS + _SPHERES[:, 0] * x[2] + _SPHERES[:, 1] * y[2]
    return jnp.sum(corners < 0, dtype=jnp.int32) + jnp.sum(spheres < 0, dtype=jnp.int32)


def under_face(at: Frames, markers: jax.Array) -> jax.Array:
    """Which markers [100, 2] (in the base's frame) the wiper wipes, [100].

    The plane through the wiper's corners must lie 0 to 2 cm below the marker, and the marker's
    projection strictly inside the rectangle of the corners.
    """
    x, y, z = at.rotation
    east, north = markers[:, 0] - at.position[0], markers[:, 1] - at.position[1]
    up = TABLE_TOP - at.position[2]
    along, across, below = (east * axis[0] + north * axis[1] + up * axis[2] for axis in (x, y, z))
    inside = (jnp.abs(along) < HALF_FACE[0]) & (jnp.abs(across) < HALF_FACE[1])
    return inside & (below < 0) & (below > -WIPE_DEPTH)


def remaining(markers: jax.Array, wiped: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Share wiped; of what is left, the radius about its centroid, and the centroid [3]."""
    left = ~wiped
    count = jnp.maximum(jnp.sum(left, dtype=jnp.float32), 1.0)
    centroid = jnp.sum(jnp.where(left[:, None], markers, 0.0), 0) / count
    away = markers - centroid
    radius = jnp.sqrt(jnp.max(jnp.where(left, jnp.sum(away * away, -1), 0.0)))
    some = jnp.any(left)
    where = jnp.where(some, jnp.append(centroid, _TOP), 0.0)
    return jnp.mean(wiped.astype(jnp.float32)), jnp.where(some, radius, 0.0), where


class Moved(NamedTuple):
    """The arm after a control step of the physics.

    Attributes:
        joints, speeds, acceleration, goal_rotation: As in `WipingState`.
        push: [3] force on the wiper, N, in the world's axes.
    """

    joints: jax.Array
    speeds: jax.Array
    acceleration: jax.Array
    goal_rotation: jax.Array
    push: jax.Array


def reward_of(
    newly: jax.Array,
    wiped: jax.Array,
    *,
    markers: jax.Array,
    eef: jax.Array,
    force: jax.Array,
    contact: jax.Array,
    count: jax.Array,
) -> jax.Array:
    """Robosuite's shaped reward of a step without collision, before scaling.

        50 per marker + 5 (1 - tanh 5 |centroid - eef|) [while any is left] + 25.5 [when none is]
        + 0.01 in contact - 0.05 F where F > 60 N, else + 0.01 + 0.01 F (+ 0.1 where > 50 contacts)

    Args:
        newly: Number of markers wiped in this step.
        wiped: [100] after it. markers: [100, 2], m.
        eef: [3] grip site, m.
        force: F, N, at the start of the step.
        contact, count: Contact flag and number of contacts at its end.
    """
    _, _, centroid = remaining(markers, wiped)
    away = centroid - eef
    reach = REACH * (1 - jnp.tanh(REACH_RATE * length(away)))
    done = jnp.all(wiped)
    low, high = FORCE_RANGE
    pressing = CONTACT + 0.01 * force + jnp.where(count > MANY_CONTACTS, 10 * CONTACT, 0.0)
    pressing = jnp.where((force > low) & (count > 1), pressing, 0.0)
    return (
        WIPED * newly
        + jnp.where(done, COMPLETE, reach)
        + jnp.where((count > 0) & contact, CONTACT, 0.0)
        + jnp.where(force > high, -EXCESS * force, pressing)
    )


# what a network sees is (observation - MEAN) / SCALE
MEAN = np.concatenate(
    [[0.5, 0.15, 0.15, 0.0, 0.9], [0.0, 0.0, 0.0], np.cos(INITIAL_JOINTS),
     np.sin(INITIAL_JOINTS), np.zeros(6), [0.15, 0.0, 0.9], [-1.0, 0.03, 0.0, 0.0], [0.5]]
).astype(np.float32)  # fmt: skip
# distances to the dirt and the height over the table decide; the joints, which say the same again
# in a nonlinear way, are kept quiet (chosen by cloning on scenarios 2000-2049)
SCALE = np.concatenate(
    [[0.3, 0.1, 1.0, 1.0, 0.3], [0.1, 0.1, 0.01], np.full(12, 3.0), np.full(6, 3.0),
     [1.0, 1.0, 0.01], np.full(4, 0.3), [0.5]]
).astype(np.float32)  # fmt: skip


class TableWiping(ArmTask):
    """Table wiping as pure functions. Build one with `make_table_wiping`."""

    name = "table_wiping"
    spec = EnvSpec(
        observation_size=OBSERVATION_SIZE,
        action_size=ACTION_SIZE,
        observation_mean=MEAN,
        observation_scale=SCALE,
    )
    max_episode_steps = HORIZON
    tool = WIPER
    base = BASE

    def reset_to(self, index: jax.Array, key: jax.Array, params: WipingParams) -> WipingState:
        """The start of scenario `index` of the pool."""
        del key  # a scenario is deterministic
        joints = self.first_joints(params.joints[index], index, params)
        at = frames(list(joints), WIPER)
        return WipingState(
            joints=joints,
            speeds=jnp.zeros(6, jnp.float32),
            acceleration=jnp.zeros(6, jnp.float32),
            goal_rotation=unrolled_linalg.array(at.rotation),
            force=jnp.zeros(3, jnp.float32),
            force_bias=jnp.zeros(3, jnp.float32),
            contact=jnp.zeros((), bool),
            markers=params.markers[index],
            wiped=jnp.zeros(COUNT, bool),
            shown=jnp.zeros(COUNT, bool),
            scenario=jnp.asarray(index, jnp.int32),
            time=jnp.zeros((), jnp.int32),
        )

    def transition(
        self, key: jax.Array, state: WipingState, action: jax.Array, params: WipingParams
    ) -> tuple[WipingState, Outcome]:
        """One control step of 0.05 s, without reset."""
        del key  # the world is deterministic
        moved = self.backend.advance(
            state, jnp.clip(action, -1.0, 1.0), self.factors(state, params)
        )
        return self.finish(state, moved, params)

    def finish(
        self, state: WipingState, moved: Moved, params: WipingParams
    ) -> tuple[WipingState, Outcome]:
        """The result of a control step, given its physics (see `Backend.advance`)."""
        joints, speeds, acceleration, goal_rotation, push = moved
        physics_diverged = ~jnp.all(
            jnp.isfinite(jnp.concatenate([joints, speeds, acceleration, push]))
        )

        def sound(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(physics_diverged, old, new)

        joints, speeds = sound(joints, state.joints), sound(speeds, state.speeds)
        arm = dataclasses.replace(
            state,
            joints=joints,
            speeds=speeds,
            acceleration=sound(acceleration, state.acceleration),
            goal_rotation=sound(goal_rotation, state.goal_rotation),
        )
        at = lagged_frames(arm, WIPER)
        turn = unrolled_linalg.array(at.rotation)
        heavier = self.factors(state, params).mass
        weight = jnp.array([0.0, 0.0, -9.81 * WIPER.mass], jnp.float32) * heavier
        force = sound(-turn @ (push + weight), state.force)
        contact = length(force - state.force_bias) > CONTACT_FORCE
        over = over_table(jnp.stack(at.position[:2]))
        count = contact_count(at, jnp.where(over, TABLE_TOP, _FAR))
        at_limit = jnp.any(JOINT_LIMIT - jnp.abs(joints) < LIMIT_MARGIN)
        hit = arm_hits(at, _TOOL_ENDS, (TABLE_CENTRE, TABLE_HALF, TABLE_TOP))
        unsafe = hit | at_limit
        newly = under_face(at, state.markers - BASE[:2]) & ~state.wiped & (count > 0) & ~unsafe
        wiped = state.wiped | newly
        reward = reward_of(
            jnp.sum(newly, dtype=jnp.float32),
            wiped,
            markers=state.markers,
            eef=jnp.stack(at.position) + BASE,
            force=length(state.force),
            contact=contact,
            count=count,
        )
        success = jnp.all(wiped) & ~physics_diverged
        time = state.time + 1
        first = length(state.force_bias) == 0
        new = dataclasses.replace(
            arm,
            force=force,
            force_bias=jnp.where(first, force, state.force_bias),
            contact=contact,
            wiped=wiped,
            shown=state.wiped,
            time=time,
        )
        reward = jnp.where(
            physics_diverged, 0.0, params.reward_scale * jnp.where(unsafe, COLLISION, reward)
        )
        return new, Outcome(
            reward=reward,
            terminated=success | unsafe | physics_diverged,
            truncated=time >= HORIZON,
            cost=unsafe.astype(jnp.float32),
            success=success,
            unsafe=unsafe,
            progress=jnp.mean(wiped.astype(jnp.float32)),
            speed=length(jnp.stack(twist_of(jacobian(at), list(speeds))[0])),
            physics_diverged=physics_diverged,
        )

    def readings(self, state: WipingState) -> list[tuple[str, str]]:
        """Markers left, and whether the wiper touches the table."""
        left = COUNT - int(np.asarray(state.wiped).sum())
        return [
            ("dirt left", f"{left} of {COUNT}"),
            ("touching", "yes" if bool(state.contact) else "no"),
        ]

    def observe(self, state: WipingState, params: WipingParams) -> jax.Array:
        """The 34 values, in robosuite 1.4.1's order.

        0 share wiped, 1 radius of what is left, 2-4 its centroid, 5-7 centroid from the grip site,
        8-13 cos q, 14-19 sin q, 20-25 dq, 26-28 grip site, 29-32 hand (x y z w), 33 contact.
        """
        lagged = list(state.joints - TIMESTEP * state.speeds)
        eef = jnp.stack(frames(lagged, WIPER).position) + BASE
        share, radius, centroid = remaining(state.markers, state.shown)
        seen = jnp.concatenate(
            [
                jnp.stack([share, radius]),
                centroid,
                centroid - eef,
                jnp.cos(state.joints),
                jnp.sin(state.joints),
                state.speeds,
                eef,
                hand_quaternion(lagged),
                state.contact.astype(jnp.float32)[None],
            ]
        )
        return self.with_sensor_noise(seen, state, params)


def make_params(numbers: Sequence[int]) -> WipingParams:
    """Starts of the scenarios with these numbers."""

    def start(number: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_joints, key_markers = jax.random.split(jax.random.key(number))
        markers = draw_markers(key_markers, _HALF) + jnp.array(_CENTRE, jnp.float32)
        return first_pose(key_joints), markers

    number = jnp.asarray(tuple(numbers), jnp.int32)
    joints, markers = jax.jit(jax.vmap(start))(number)
    return WipingParams(
        joints=joints,
        markers=markers,
        number=number,
        reward_scale=jnp.float32(NORMALISATION),
    )
