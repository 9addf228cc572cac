"""The scripted driving expert: a pure function of the state.

It picks a lane that is free ahead, follows its centre line by pure pursuit, slows for bends and
for what is ahead, and never looks at anything but the state: called from any state, in a lookahead
or after a takeover, it does the right thing from there.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from envs.driving import traffic as traffic_model
from envs.driving.env import DrivingParams, DrivingState
from envs.driving.geometry import lane_coordinates, lane_position, to_body
from envs.driving.scenario import Scenario, take
from envs.driving.vehicle import MAX_STEERING, WHEELBASE

CRUISE_SPEED = 14.0  # m/s
LATERAL_ACCELERATION = 3.6  # m/s^2, allowed in bends
COMFORT_BRAKING = 3.0  # m/s^2, when slowing for a bend or an object
SIGHT = 60.0  # m along the route
LANES = 5  # lane numbers looked at
_CAR_LENGTH = 4.5
_LANE_CHANGE_COST, _EDGE_COST = 6.0, 4.0  # m of free road a lane change, an outer lane is worth


def _along_route(scenario: Scenario, road: jax.Array, long: jax.Array) -> jax.Array:
    """Distance from the start of the route, m."""
    lengths = scenario.lanes.length[scenario.route_lane]
    lengths = jnp.where(jnp.arange(lengths.shape[0]) < scenario.route_roads, lengths, 0.0)
    starts = jnp.cumsum(lengths) - lengths
    return starts[road] + long


def _point_ahead(
    scenario: Scenario, road: jax.Array, long: jax.Array, lateral: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """World point and signed curvature at `long` m along the route from the start of `road`.

    `long` may run past the end of the road on to the two after it.
    """
    last = scenario.route_roads - 1
    for _ in range(2):
        length = scenario.lanes.length[scenario.route_lane[road]]
        over = (long > length) & (road < last)
        long = jnp.where(over, long - length, long)
        road = jnp.where(over, road + 1, road)
    lane = take(scenario.lanes, scenario.route_lane[road])
    radius = jnp.maximum(lane.radius + lateral * lane.turn, 3.0)
    return lane_position(lane, long, lateral), lane.turn / radius


def scripted_expert(
    key: jax.Array, state: DrivingState, observation: jax.Array, params: DrivingParams
) -> jax.Array:
    """Steer and throttle/brake in [-1, 1], [2].

    Args:
        key: Unused: the expert is deterministic.
        state: Of the world.
        observation: Unused: it sees the state.
        params: Of the world.
    """
    del key, observation
    scenario = take(params.scenarios, state.scenario)
    lanes, ego = scenario.lanes, state.ego
    road = state.navigation.road
    reference = take(lanes, scenario.route_lane[road])
    long, lateral = lane_coordinates(reference, ego.pose[:2])
    speed = jnp.sqrt(jnp.sum(ego.velocity**2))
    width = reference.width
    here = lateral / width  # lane number as a real number
    ego_along = _along_route(scenario, road, long)

    free, front_speed, beside = _look(scenario, state, ego_along, long, lateral)
    target = _choose_lane(scenario, road, here, free, front_speed, beside, speed)

    # steering: pure pursuit of the target lane's centre line
    reach = jnp.clip(0.7 * speed + 3.0, 6.0, 14.0)
    shift = jnp.clip(target * width - lateral, -0.3 * reach, 0.3 * reach)
    goal, _ = _point_ahead(scenario, road, long + reach, lateral + shift)
    local = to_body(goal - ego.pose[:2], ego.pose[2])
    bend = 2.0 * local[1] / jnp.maximum(jnp.sum(local * local), 1.0)
    steer = jnp.arctan(WHEELBASE * bend) / MAX_STEERING

    # speed: bends ahead, then what is ahead on the lanes the car is on or moves to
    distances = jnp.arange(0.0, 41.0, 4.0)
    _, curvature = jax.vmap(lambda d: _point_ahead(scenario, road, long + d, target * width))(
        distances
    )
    bend_speed = jnp.sqrt(LATERAL_ACCELERATION / jnp.maximum(jnp.abs(curvature), 1e-3))
    allowed = jnp.sqrt(bend_speed**2 + 2 * COMFORT_BRAKING * jnp.maximum(distances - 2.0, 0.0))
    wish = jnp.minimum(jnp.min(allowed), CRUISE_SPEED)
    number = jnp.arange(LANES)
    in_way = (jnp.abs(number - here) < 0.75) | (number == target)
    room = jnp.maximum(free - 2.0 - 0.3 * speed, 0.0)
    follow = jnp.sqrt(front_speed**2 + 2 * COMFORT_BRAKING * room)
    follow = jnp.where(free < 1.0, jnp.minimum(follow, 0.8 * front_speed), follow)
    wish = jnp.minimum(wish, jnp.min(jnp.where(in_way, follow, jnp.inf)))
    wish = jnp.maximum(wish, 0.0)

    # the throttle or brake that gives the wanted acceleration
    wanted = 1.5 * (wish - speed)
    engine = 4 * scenario.engine_force / 1100.0
    brake = 4 * scenario.brake_force / (1100.0 * 0.02)
    pedal = jnp.where(wanted >= -0.2, wanted / engine, wanted / brake)
    return jnp.clip(jnp.stack([steer, pedal]), -1.0, 1.0)


def _look(
    scenario: Scenario,
    state: DrivingState,
    ego_along: jax.Array,
    long: jax.Array,
    lateral: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Free distance ahead, speed of what ends it, and whether something is beside, per lane.

    Returns:
        Three arrays [LANES]: m (at most `SIGHT`), m/s, bool.
    """
    lanes, objects, traffic = scenario.lanes, scenario.objects, state.traffic
    plan = scenario.traffic
    leg = jnp.take_along_axis(plan.way_first, traffic.leg[:, None], 1)[:, 0]
    present = traffic.status != traffic_model.REMOVED
    lane = jnp.concatenate([jnp.where(present, leg + traffic.number, -1), objects.lane])
    where = jnp.concatenate([traffic.long, objects.long])
    pace = jnp.concatenate([traffic.speed, jnp.zeros_like(objects.long)])
    half = jnp.concatenate([plan.half[:, 0], objects.box_half[:, 0], objects.circle[:, 2]])
    route = jnp.where(lane >= 0, lanes.route[lane], -1)
    # positions on curved lanes, scaled to the leftmost lane's length
    first = scenario.route_lane[jnp.maximum(route, 0)]
    share = where / lanes.length[lane] * lanes.length[first]
    ahead = _along_route(scenario, jnp.maximum(route, 0), share) - ego_along
    ahead = jnp.where(route >= 0, ahead, jnp.inf)
    number = lanes.number[lane]

    gap = ahead - half - _CAR_LENGTH / 2
    on = number[None] == jnp.arange(LANES)[:, None]
    in_front = on & (ahead > 0.0)
    gaps = jnp.where(in_front, gap, SIGHT)
    nearest = jnp.argmin(gaps, -1)
    free = jnp.minimum(jnp.min(gaps, -1), SIGHT)
    front_speed = jnp.where(free < SIGHT, pace[nearest], 30.0)
    # something overlapping lengthwise, or a vehicle about to draw level
    level = (ahead - half - _CAR_LENGTH / 2 < 1.5) & (ahead + half + _CAR_LENGTH / 2 > -2.0)
    return free, front_speed, jnp.any(on & level, -1)


def _choose_lane(
    scenario: Scenario,
    road: jax.Array,
    here: jax.Array,
    free: jax.Array,
    front_speed: jax.Array,
    beside: jax.Array,
    speed: jax.Array,
) -> jax.Array:
    """The lane to head for: the present one or a neighbour, by free road ahead."""
    number = jnp.arange(LANES)
    size = scenario.route_size[road]
    following = jnp.minimum(road + 1, scenario.route_roads - 1)
    usable = jnp.minimum(size, scenario.route_size[following])
    current = jnp.clip(jnp.round(here), 0, size - 1)
    value = jnp.minimum(free + 3.0 * jnp.minimum(front_speed, speed), SIGHT)
    value = value - _LANE_CHANGE_COST * jnp.abs(number - here)
    edge = (number == 0) | (number == usable - 1)
    value = value - jnp.where(edge, _EDGE_COST, 0.0) * (usable > 2)
    value = jnp.where(number < usable, value, -1e3)
    # a lane beyond an occupied neighbour is out of reach
    step = jnp.sign(number - current)
    neighbour = jnp.clip(current + step, 0, LANES - 1).astype(jnp.int32)
    shut = (step != 0) & beside[neighbour] & (jnp.abs(here - number) > 0.3)
    value = jnp.where(shut, value - 500.0, value)
    best = jnp.argmax(value)
    return jnp.clip(best, current - 1, current + 1).astype(jnp.float32)


def as_expert(world: Any) -> Any:
    """The default expert of the driving world."""
    del world
    return scripted_expert


__all__ = ["as_expert", "scripted_expert"]
