"""Driving: reset, transition, observation, and pools of scenarios."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from envs.derivatives import length
from envs.driving import navigation as nav
from envs.driving import observation as obs
from envs.driving import traffic as traffic_model
from envs.driving import vehicle
from envs.driving.geometry import (
    box_contact,
    circle_depth,
    lane_coordinates,
    lane_heading,
    lane_position,
    to_body,
    touches_sidewalk,
)
from envs.driving.scenario import (
    SPAWN_LONG,
    Capacity,
    Description,
    Scenario,
    pack,
    stack,
    tree_index,
)
from ppl_jax.types import EnvSpec, Expert, Outcome

HORIZON = 1500  # steps of 0.1 s
CONTACT_MARGIN = 0.04  # m: closer than this counts as touching, as in the simulator
_COASTING = 0.364  # m/s^2: 4 wheels, 2 N s per 0.02 s, 1100 kg
_HALF = np.array(vehicle.HALF_SIZE, np.float32)


@flax.struct.dataclass
class DrivingState:
    """Everything that changes.

    Attributes:
        scenario: Index into the pool.
        ego: `vehicle.Ego`.
        navigation: `navigation.Navigation`.
        left, right: Distances to the reference road's edges, m.
        lateral: Lateral offset on the current lane, m.
        traffic: `traffic.Traffic`.
        box_pose, box_velocity: [K, 3], [K, 2] of the boxes: broken-down vehicles can be pushed.
        blocked: [N] bool, traffic vehicles that touch the ego and have it ahead.
        time: Steps since the start.
    """

    scenario: jax.Array
    ego: vehicle.Ego
    navigation: nav.Navigation
    left: jax.Array
    right: jax.Array
    lateral: jax.Array
    traffic: traffic_model.Traffic
    box_pose: jax.Array
    box_velocity: jax.Array
    blocked: jax.Array
    time: jax.Array


@flax.struct.dataclass
class DrivingParams:
    """Traced parameters of the environment.

    Attributes:
        scenarios: Pool with a leading [S] axis.
        starts: State at the start of each scenario, [S]; a start is looked up, not computed.
        start_observations: [S, 259].
        progress_weight, speed_weight: Weights of the reward's terms (per m; per share of 80 km/h).
        success_reward, off_road_penalty, crash_penalty: Replace the reward in that step.
        off_road_cost, crash_vehicle_cost, crash_object_cost: Per step.
    """

    scenarios: Scenario
    starts: DrivingState | None = None
    start_observations: jax.Array | None = None
    progress_weight: jax.Array | float = 1.0
    speed_weight: jax.Array | float = 0.1
    success_reward: jax.Array | float = 10.0
    off_road_penalty: jax.Array | float = 5.0
    crash_penalty: jax.Array | float = 5.0
    off_road_cost: jax.Array | float = 1.0
    crash_vehicle_cost: jax.Array | float = 1.0
    crash_object_cost: jax.Array | float = 1.0


class Events(NamedTuple):
    """Events of a step, booleans."""

    arrived: jax.Array
    off_road: jax.Array
    crash_vehicle: jax.Array
    crash_object: jax.Array


class Contacts(NamedTuple):
    """Contacts of the ego.

    Attributes:
        depth, out: [N + K] overlap with each traffic vehicle and box, m, and [N + K, 2] the
            direction out of it.
        traffic: [N] bool.
        vehicle, object: Whether it touches any vehicle, any object.
    """

    depth: jax.Array
    out: jax.Array
    traffic: jax.Array
    vehicle: jax.Array
    object: jax.Array


def contacts(
    scenario: Scenario,
    pose: jax.Array,
    *,
    traffic_pose: jax.Array,
    present: jax.Array,
    box_pose: jax.Array,
) -> Contacts:
    """Contacts of the ego at `pose` [3]."""
    objects = scenario.objects
    boxes = jnp.concatenate([jnp.where(present[:, None], traffic_pose, 1e6), box_pose])
    half = jnp.concatenate([scenario.traffic.half, objects.box_half])
    depth, out = box_contact(pose, jnp.asarray(_HALF), boxes, half)
    n = present.shape[0]
    hit, hit_box = depth[:n] > -CONTACT_MARGIN, depth[n:] > -CONTACT_MARGIN
    hit_circle = circle_depth(pose, _HALF, objects.circle) > -CONTACT_MARGIN
    return Contacts(
        depth=depth,
        out=out,
        traffic=hit,
        vehicle=jnp.any(hit) | jnp.any(hit_box & objects.box_is_vehicle),
        object=jnp.any(hit_box & ~objects.box_is_vehicle) | jnp.any(hit_circle),
    )


def off_road(found: nav.Localised, scenario: Scenario, pose: jax.Array) -> jax.Array:
    """Centre on no lane, or car on a sidewalk, or centre outside the reference road."""
    return (
        ~found.on_lane
        | touches_sidewalk(scenario.lanes, scenario.kerbs, pose, _HALF)
        | (found.left < 0)
        | (found.right < 0)
    )


def reward_and_cost(
    params: DrivingParams,
    scenario: Scenario,
    *,
    events: Events,
    navigation: nav.Navigation,
    long: jax.Array,
    ego: vehicle.Ego,
) -> tuple[jax.Array, jax.Array]:
    """Reward and cost of a step.

        reward = progress along the current lane + 0.1 speed / 80 km/h,
        replaced by +10 on arrival, else -5 off the road, else -5 in contact

    Progress is measured on the current lane where that is one of the reference road's, else on
    the road's leftmost lane. Source: `envs/metadrive_env.py` of MetaDrive 0.4.3.

    Args:
        long: [M] ego's position along every lane, m.
    """
    lanes = scenario.lanes
    on_reference = lanes.route[navigation.lane] == navigation.road
    lane_index = jnp.where(on_reference, navigation.lane, scenario.route_lane[navigation.road])
    lane = tree_index(lanes, lane_index)
    before, _ = lane_coordinates(lane, ego.last_pose[:2])
    speed = length(ego.velocity)
    reward = (
        params.progress_weight * (long[lane_index] - before)
        + params.speed_weight * speed / vehicle.MAX_SPEED
    )
    crashed = events.crash_vehicle | events.crash_object
    reward = jnp.where(crashed, -params.crash_penalty, reward)
    reward = jnp.where(events.off_road, -params.off_road_penalty, reward)
    reward = jnp.where(events.arrived, params.success_reward, reward)
    cost = jnp.where(
        events.off_road,
        params.off_road_cost,
        jnp.where(
            events.crash_vehicle,
            params.crash_vehicle_cost,
            jnp.where(events.crash_object, params.crash_object_cost, 0.0),
        ),
    )
    return reward, cost


def push(
    scenario: Scenario,
    ego: vehicle.Ego,
    traffic: traffic_model.Traffic,
    *,
    traffic_pose: jax.Array,
    box_pose: jax.Array,
    box_velocity: jax.Array,
    touch: Contacts,
) -> tuple[vehicle.Ego, traffic_model.Traffic, jax.Array, jax.Array]:
    """The effect of contacts: ego and the vehicle it runs into continue at their common speed.

    As in the simulator, where a car that hits a standing one loses half its speed and pushes it
    along, while cones, triangles and barriers do not hold it up at all. Both vehicles are taken
    to weigh the same; spin is not modelled.

    Returns:
        Ego, traffic, box poses, box velocities.
    """
    n = traffic_pose.shape[0]
    heading = jnp.stack([jnp.cos(traffic_pose[:, 2]), jnp.sin(traffic_pose[:, 2])], -1)
    velocity = jnp.concatenate([traffic.speed[:, None] * heading, box_velocity])
    is_vehicle = jnp.concatenate([jnp.ones(n, bool), scenario.objects.box_is_vehicle])
    depth = jnp.where(is_vehicle, jnp.maximum(touch.depth, 0.0), 0.0)
    worst = jnp.argmax(depth).astype(jnp.int32)
    out = touch.out[worst]
    closing = jnp.minimum(jnp.sum((ego.velocity - velocity[worst]) * out), 0.0)
    exchange = jnp.where(depth[worst] > 0, 0.5 * closing, 0.0) * out
    ego = dataclasses.replace(ego, velocity=ego.velocity - exchange)
    struck = (jnp.arange(depth.shape[0], dtype=jnp.int32) == worst) & (depth[worst] > 0)
    hit = struck[:, None].astype(jnp.float32)
    moved = velocity + hit * exchange
    shift = -hit * depth[worst] * out
    traffic = dataclasses.replace(
        traffic,
        speed=jnp.maximum(jnp.sum(moved[:n] * heading, -1), 0.0),
        long=traffic.long + jnp.sum(shift[:n] * heading, -1),
    )
    # a pushed wreck rolls on and slows as a car does that coasts
    rolling = moved[n:]
    pace = jnp.sqrt(jnp.sum(rolling**2, -1, keepdims=True) + 1e-12)
    rolling = rolling * jnp.maximum(1.0 - _COASTING * vehicle.CONTROL_STEP / pace, 0.0)
    place = box_pose.at[:, :2].add(shift[n:] + vehicle.CONTROL_STEP * rolling)
    return ego, traffic, place, rolling


def start_state(scenario: Scenario, index: jax.Array) -> DrivingState:
    """The ego standing 5 m along its lane, all traffic parked."""
    lane = tree_index(scenario.lanes, scenario.spawn_lane)
    long, zero = jnp.float32(SPAWN_LONG), jnp.zeros((), jnp.float32)
    position = lane_position(lane, long, zero)
    pose = jnp.append(position, lane_heading(lane, long))
    ego = vehicle.place(pose, jnp.zeros(2, jnp.float32), zero, jnp.zeros(2, jnp.float32))
    navigation, found = nav.localise(scenario, nav.start(scenario), pose)
    traffic = traffic_model.start(scenario)
    return DrivingState(
        scenario=jnp.asarray(index, jnp.int32),
        ego=ego,
        navigation=navigation,
        left=found.left,
        right=found.right,
        lateral=found.lateral[navigation.lane],
        traffic=traffic,
        box_pose=jnp.asarray(scenario.objects.box_pose),
        box_velocity=jnp.zeros_like(scenario.objects.box_pose[:, :2]),
        blocked=jnp.zeros(traffic.status.shape, bool),
        time=jnp.zeros((), jnp.int32),
    )


class Driving(Environment):
    """MetaDrive-like driving as pure functions. Build one with `make_driving`."""

    name = "driving"
    spec = EnvSpec(
        observation_size=obs.SIZE,
        action_size=2,
        observation_mean=obs.MEAN,
        observation_scale=obs.SCALE,
    )
    max_episode_steps = HORIZON

    def __init__(
        self,
        default_params: DrivingParams,
        held_out_params: DrivingParams,
        experts: Mapping[str, Expert],
    ):
        """Hold the pools of scenarios and the experts.

        Args:
            default_params, held_out_params: Scenarios to train on and to evaluate on.
            experts: By name; "scripted" is the usual one.
        """
        self.default_params = default_params
        self.held_out_params = held_out_params
        self.experts = experts
        self.predictors = {"simulator": self.transition, "kinematic": self.transition_kinematic}

    @property
    def scripted_expert(self) -> Expert:
        """The expert "scripted"."""
        return self.experts["scripted"]

    def scenario_numbers(self, params: DrivingParams) -> jax.Array:
        """Numbers of the pool's scenarios, [S]."""
        return jnp.asarray(params.scenarios.number)

    def scenario_count(self, params: DrivingParams) -> int:
        """Number of scenarios in the pool."""
        return params.scenarios.number.shape[0]

    def reset_to(self, index: jax.Array, key: jax.Array, params: DrivingParams) -> DrivingState:
        """The start of scenario `index` of the pool: standing, 5 m along its lane."""
        del key  # a scenario is deterministic
        assert params.starts is not None
        return tree_index(params.starts, index)

    def reset(self, key: jax.Array, params: DrivingParams) -> tuple[jax.Array, DrivingState]:
        """A random scenario's start."""
        index = jax.random.randint(key, (), 0, self.scenario_count(params), jnp.int32)
        assert params.starts is not None
        assert params.start_observations is not None
        return params.start_observations[index], tree_index(params.starts, index)

    def transition(
        self, key: jax.Array, state: DrivingState, action: jax.Array, params: DrivingParams
    ) -> tuple[DrivingState, Outcome]:
        """One control step of 0.1 s, without reset."""
        del key  # the environment is deterministic
        scenario = tree_index(params.scenarios, state.scenario)
        lane = tree_index(scenario.lanes, state.navigation.lane)
        ego_long, _ = lane_coordinates(lane, state.ego.pose[:2])
        speed = length(state.ego.velocity)
        traffic = traffic_model.advance(
            scenario,
            state.traffic,
            ego_lane=state.navigation.lane,
            ego_long=ego_long,
            ego_speed=speed,
            blocked=state.blocked,
        )
        ego = vehicle.drive(
            state.ego,
            action,
            engine_force=scenario.engine_force,
            brake_force=scenario.brake_force,
            friction=scenario.wheel_friction,
        )
        return self._finish(params, scenario, state, ego=ego, traffic=traffic, solid=True)

    def transition_kinematic(
        self, key: jax.Array, state: DrivingState, action: jax.Array, params: DrivingParams
    ) -> tuple[DrivingState, Outcome]:
        """The paper's rule-based prediction step: kinematic bicycle, traffic frozen."""
        del key
        scenario = tree_index(params.scenarios, state.scenario)
        ego = vehicle.drive_kinematic(
            state.ego, action, scenario.engine_force, scenario.brake_force
        )
        return self._finish(params, scenario, state, ego=ego, traffic=state.traffic, solid=False)

    def _finish(
        self,
        params: DrivingParams,
        scenario: Scenario,
        state: DrivingState,
        *,
        ego: vehicle.Ego,
        traffic: traffic_model.Traffic,
        solid: bool,
    ) -> tuple[DrivingState, Outcome]:
        present = traffic.status != traffic_model.REMOVED
        traffic_pose = traffic_model.poses(scenario, traffic)
        touch = contacts(
            scenario,
            ego.pose,
            traffic_pose=traffic_pose,
            present=present,
            box_pose=state.box_pose,
        )
        local = to_body(ego.pose[:2] - traffic_pose[:, :2], traffic_pose[:, 2])
        has_ego_ahead = (local[:, 0] > 0) & (jnp.abs(local[:, 1]) < vehicle.HALF_SIZE[1])
        box_pose, box_velocity = state.box_pose, state.box_velocity
        if solid:
            ego, traffic, box_pose, box_velocity = push(
                scenario,
                ego,
                traffic,
                traffic_pose=traffic_pose,
                box_pose=box_pose,
                box_velocity=box_velocity,
                touch=touch,
            )
        navigation, found = nav.localise(scenario, state.navigation, ego.pose)
        events = Events(
            arrived=nav.arrived(scenario, navigation, found),
            off_road=off_road(found, scenario, ego.pose),
            crash_vehicle=touch.vehicle,
            crash_object=touch.object,
        )
        reward, cost = reward_and_cost(
            params,
            scenario,
            events=events,
            navigation=navigation,
            long=found.long,
            ego=ego,
        )
        time = state.time + 1
        new_state = DrivingState(
            scenario=state.scenario,
            ego=ego,
            navigation=navigation,
            left=found.left,
            right=found.right,
            lateral=found.lateral[navigation.lane],
            traffic=traffic,
            box_pose=box_pose,
            box_velocity=box_velocity,
            blocked=touch.traffic & has_ego_ahead,
            time=time,
        )
        return new_state, Outcome(
            reward=reward,
            terminated=events.arrived | events.off_road,
            truncated=time >= HORIZON,
            cost=cost,
            success=events.arrived,
            unsafe=(events.off_road | events.crash_vehicle | events.crash_object) & ~events.arrived,
            progress=navigation.travelled / scenario.route_length,
            speed=length(ego.velocity),
            clearance=jnp.minimum(
                jnp.minimum(found.left, found.right) - vehicle.HALF_SIZE[1],
                -jnp.max(touch.depth),
            ),
        )

    def observe(self, state: DrivingState, params: DrivingParams) -> jax.Array:
        """The 259 values (see `envs.driving.observation`)."""
        return observe(tree_index(params.scenarios, state.scenario), state)


def observe(scenario: Scenario, state: DrivingState) -> jax.Array:
    """The 259 values of a state in its scenario."""
    features = obs.ego_features(
        scenario,
        state.ego,
        state.navigation,
        left=state.left,
        right=state.right,
        lateral=state.lateral,
    )
    rays = obs.lidar_reading(
        scenario,
        state.ego.pose,
        traffic_pose=traffic_model.poses(scenario, state.traffic),
        present=state.traffic.status != traffic_model.REMOVED,
        box_pose=state.box_pose,
    )
    return obs.join(features, rays)


@jax.jit
def _starts(pool: Scenario) -> tuple[DrivingState, jax.Array]:
    states = jax.vmap(start_state)(pool, jnp.arange(pool.number.shape[0], dtype=jnp.int32))
    return states, jax.vmap(observe)(pool, states)


def make_params(
    descriptions: Sequence[Description], capacity: Capacity | None = None
) -> DrivingParams:
    """Pack scenarios into parameters of the environment.

    Raises:
        ValueError: If there are none, or one does not fit `capacity`.
    """
    if not descriptions:
        raise ValueError("a driving environment needs at least one scenario")
    capacity = capacity or Capacity.of(descriptions)
    packed = stack([pack(description, capacity) for description in descriptions])
    pool = jax.tree.map(jnp.asarray, packed)
    starts, observations = _starts(pool)
    weights = {
        field.name: jnp.float32(field.default)
        for field in dataclasses.fields(DrivingParams)
        if isinstance(field.default, float)
    }
    return DrivingParams(scenarios=pool, starts=starts, start_observations=observations, **weights)
