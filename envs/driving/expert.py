"""The scripted driving expert: a pure function of the state.

It picks a lane that is free ahead, follows its centre line by pure pursuit, slows for bends and
for what is ahead, and never looks at anything but the state: called from any state, in a lookahead
or after a takeover, it does the right thing from there.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.derivatives import length
from envs.driving import traffic as traffic_model
from envs.driving.env import DrivingParams, DrivingState
from envs.driving.geometry import lane_coordinates, lane_position, to_body
from envs.driving.scenario import Scenario, tree_index
from envs.driving.vehicle import HALF_SIZE, MASS, MAX_STEERING, SUBSTEP, WHEELBASE
from ppl_jax.types import Array

CRUISE_SPEED = 12.0  # m/s
CAUTIOUS_SPEED = 5.0  # m/s: what a single look at the road tells is then enough
LATERAL_ACCELERATION = 3.5  # m/s^2, allowed in bends
COMFORT_BRAKING = 3.0  # m/s^2, when slowing for a bend or an object
CREEP_SPEED = 1.5  # m/s, to steer round something from standstill
STAND_OFF = 5.0  # m kept to something at rest: room to steer round it
SIGHT = 60.0  # m along the route
LANES = 5  # lane numbers looked at
_HALF_LENGTH, _HALF_WIDTH = HALF_SIZE
_SIDE_MARGIN = 0.35  # m kept beside things
# what a lane change, an outer lane and passing on the right are worth, m of free road
_LANE_CHANGE_COST, _EDGE_COST, _RIGHT_COST = 6.0, 12.0, 3.0
_PREVIEW = 0.25  # s: the yaw rate follows the wheel that much later


class Things(NamedTuple):
    """Objects on the route around the ego, [J], in road coordinates.

    Attributes:
        ahead: Distance along the route from the ego's centre, m; inf off the route.
        lateral: Position across the reference road, m right of its leftmost lane's centre.
        half_length, half_width: m.
        speed: m/s.
    """

    ahead: jax.Array
    lateral: jax.Array
    half_length: jax.Array
    half_width: jax.Array
    speed: jax.Array


def _along_route(scenario: Scenario, road: jax.Array, long: jax.Array) -> jax.Array:
    """Distance from the start of the route, m."""
    lengths = scenario.lanes.length[scenario.route_lane]
    lengths = jnp.where(
        jnp.arange(lengths.shape[0], dtype=jnp.int32) < scenario.route_roads, lengths, 0.0
    )
    starts = jnp.cumsum(lengths) - lengths
    return starts[road] + long


def _point_ahead(
    scenario: Scenario, road: jax.Array, long: jax.Array, lateral: jax.Array
) -> tuple[jax.Array, Array]:
    """World point and signed curvature at `long` m along the route from the start of `road`.

    `long` may run past the end of the road on to the two after it.
    """
    last = scenario.route_roads - 1
    for _ in range(2):
        length = scenario.lanes.length[scenario.route_lane[road]]
        over = (long > length) & (road < last)
        long = jnp.where(over, long - length, long)
        road = jnp.where(over, road + 1, road)
    lane = tree_index(scenario.lanes, scenario.route_lane[road])
    radius = jnp.maximum(lane.radius + lateral * lane.turn, 3.0)
    return lane_position(lane, long, lateral), lane.turn / radius


def scripted_expert(
    key: jax.Array, state: DrivingState, observation: jax.Array, params: DrivingParams
) -> jax.Array:
    """Steer and throttle/brake in [-1, 1], [2].

    Args:
        key: Unused: the expert is deterministic.
        state: State of the environment.
        observation: Unused: it sees the state.
        params: Parameters of the environment.
    """
    del key, observation
    return drive(state, params, CRUISE_SPEED)


def cautious_expert(
    key: jax.Array, state: DrivingState, observation: jax.Array, params: DrivingParams
) -> jax.Array:
    """`scripted_expert`, slower: a neural expert first learns from it."""
    del key, observation
    return drive(state, params, CAUTIOUS_SPEED)


def drive(state: DrivingState, params: DrivingParams, cruise_speed: float) -> jax.Array:
    """The experts' action, [2], at no more than `cruise_speed` m/s.

    Args:
        state, params: State and parameters of the environment.
        cruise_speed: m/s.
    """
    scenario = tree_index(params.scenarios, state.scenario)
    lanes, ego = scenario.lanes, state.ego
    road = state.navigation.road
    reference = tree_index(lanes, scenario.route_lane[road])
    long, lateral = lane_coordinates(reference, ego.pose[:2])
    speed = length(ego.velocity)
    width = reference.width
    here = lateral / width  # lane number as a real number
    ego_along = _along_route(scenario, road, long)

    things = _things(scenario, state, ego_along)
    target = _choose_lane(scenario, road, here, things=things, speed=speed, width=width)

    # steering: pure pursuit of the target lane's centre line
    reach = jnp.clip(0.5 * speed + 2.0, 4.0, 9.0)
    slant = jnp.where(speed < 4.0, 0.6, 0.25) * reach
    shift = jnp.clip(target * width - lateral, -slant, slant)
    begin = long + _PREVIEW * speed
    goal, _ = _point_ahead(scenario, road, begin + reach, lateral + shift)
    heading = ego.pose[2] + _PREVIEW * ego.yaw_rate
    origin = ego.pose[:2] + _PREVIEW * ego.velocity
    local = to_body(goal - origin, heading)
    bend = 2.0 * local[1] / jnp.maximum(jnp.sum(local * local), 1.0)
    steer = jnp.arctan(WHEELBASE * bend) / MAX_STEERING

    # speed: bends ahead, then what is in the way of where the car is and where it goes
    distances = jnp.arange(0.0, 41.0, 4.0, dtype=jnp.float32)
    _, curvature = jax.vmap(lambda d: _point_ahead(scenario, road, long + d, target * width))(
        distances
    )
    bend_speed = jnp.sqrt(LATERAL_ACCELERATION / jnp.maximum(jnp.abs(curvature), 1e-3))
    allowed = jnp.sqrt(bend_speed**2 + 2 * COMFORT_BRAKING * jnp.maximum(distances - 3.0, 0.0))
    wish = jnp.minimum(jnp.min(allowed), cruise_speed)
    gap = things.ahead - things.half_length - _HALF_LENGTH
    reach_side = things.half_width + _HALF_WIDTH + _SIDE_MARGIN
    from_here = jnp.abs(things.lateral - lateral)
    from_target = jnp.abs(things.lateral - target * width)
    in_way = (things.ahead > 0) & ((from_here < reach_side) | (from_target < reach_side))
    keep = jnp.where(things.speed < 0.5, STAND_OFF, 2.0)
    room = jnp.maximum(gap - keep - 0.3 * speed, 0.0)
    follow = jnp.sqrt(things.speed**2 + 2 * COMFORT_BRAKING * room)
    follow = jnp.where(gap < 1.5, jnp.minimum(follow, 0.8 * things.speed), follow)
    # on its way past something at rest beside the target lane the car may creep
    passing = (things.speed < 0.5) & (from_target > reach_side)
    follow = jnp.where(passing, jnp.maximum(follow, CREEP_SPEED), follow)
    wish = jnp.minimum(wish, jnp.min(jnp.where(in_way, follow, jnp.inf)))
    wish = jnp.minimum(wish, _crossing_limit(scenario, state))

    # the throttle or brake that gives the wanted acceleration
    wanted = 1.2 * (wish - speed)
    engine = 4 * scenario.engine_force / MASS
    brake = 4 * scenario.brake_force / (MASS * SUBSTEP)
    pedal = jnp.where(wanted >= -0.2, wanted / engine, wanted / brake)
    return jnp.clip(jnp.stack([steer, pedal]), -1.0, 1.0)


def _crossing_limit(scenario: Scenario, state: DrivingState) -> jax.Array:
    """Speed allowed by vehicles close ahead that turn off or cross, m/s."""
    traffic, ego = state.traffic, state.ego
    pose, half, speed = traffic_model.poses(scenario, traffic), scenario.traffic.half, traffic.speed
    there = traffic.status != traffic_model.REMOVED
    local = to_body(pose[:, :2] - ego.pose[:2], ego.pose[2])
    same_way = jnp.cos(pose[:, 2] - ego.pose[2])
    in_front = (
        there
        & (local[:, 0] > 0)
        & (local[:, 0] < 20.0)
        & (jnp.abs(local[:, 1]) < half[:, 1] + _HALF_WIDTH + _SIDE_MARGIN)
        & (same_way > -0.5)
    )
    gap = local[:, 0] - half[:, 0] - _HALF_LENGTH
    pace = speed * jnp.maximum(same_way, 0.0)
    allowed = jnp.sqrt(pace**2 + 2 * COMFORT_BRAKING * jnp.maximum(gap - 1.0, 0.0))
    return jnp.min(jnp.where(in_front, allowed, jnp.inf))


def _things(scenario: Scenario, state: DrivingState, ego_along: jax.Array) -> Things:
    """Traffic, and objects where they were pushed to."""
    lanes, objects, traffic = scenario.lanes, scenario.objects, state.traffic
    plan = scenario.traffic
    leg = jnp.take_along_axis(plan.way_first, traffic.leg[:, None], 1)[:, 0]
    present = traffic.status != traffic_model.REMOVED
    lane = jnp.concatenate([jnp.where(present, leg + traffic.number, -1), objects.lane])
    route = jnp.where(lane >= 0, lanes.route[lane], -1)
    # positions on curved lanes, scaled to the leftmost lane's length
    own = leg + traffic.number
    reference = scenario.route_lane[jnp.maximum(lanes.route[own], 0)]
    share = traffic.long / lanes.length[own] * lanes.length[reference]
    offset = traffic.number.astype(jnp.float32) * lanes.width[own] + traffic.lateral
    half = jnp.concatenate([plan.half, objects.box_half, jnp.repeat(objects.circle[:, 2:], 2, 1)])
    strayed = jnp.sum((state.box_pose - objects.box_pose)[:, :2] ** 2, -1) > 0.25
    vehicles, boxes = traffic.status.shape[0], strayed.shape[0]
    road = scenario.route_lane[jnp.maximum(route[vehicles : vehicles + boxes], 0)]
    place = lane_coordinates(tree_index(lanes, road), state.box_pose[:, :2])
    along, across = (
        jnp.asarray(x).at[:boxes].set(jnp.where(strayed, now, x[:boxes]))
        for x, now in zip((objects.along, objects.across), place, strict=True)
    )
    ahead = (
        _along_route(scenario, jnp.maximum(route, 0), jnp.concatenate([share, along])) - ego_along
    )
    return Things(
        ahead=jnp.where(route >= 0, ahead, jnp.inf),
        lateral=jnp.concatenate([offset, across]),
        half_length=half[:, 0],
        half_width=half[:, 1],
        speed=jnp.concatenate([traffic.speed, jnp.zeros_like(objects.long)]),
    )


def _choose_lane(
    scenario: Scenario,
    road: jax.Array,
    here: jax.Array,
    *,
    things: Things,
    speed: jax.Array,
    width: Array,
) -> jax.Array:
    """The lane to head for, the present one or a neighbour: the one with most free road."""
    number = jnp.arange(LANES, dtype=jnp.float32)
    sizes = scenario.route_size.astype(jnp.float32)
    following = jnp.minimum(road + 1, scenario.route_roads - 1)
    size = sizes[road]
    usable = jnp.minimum(size, sizes[following])
    current = jnp.clip(jnp.round(here), 0, size - 1)

    across = jnp.abs(things.lateral - number[:, None] * width)
    on = across < things.half_width + _HALF_WIDTH + _SIDE_MARGIN
    gap = things.ahead - things.half_length - _HALF_LENGTH
    worth = gap + 4.0 * jnp.minimum(things.speed, speed)
    free = jnp.min(jnp.where(on & (things.ahead > 0), worth, SIGHT), -1)
    # something alongside, or about to be
    behind = things.ahead + things.half_length + _HALF_LENGTH
    closing = jnp.maximum(things.speed - speed, 0.0)
    level = (gap < 1.5) & (behind > -1.0 - 2.0 * closing)
    beside = jnp.any(on & level, -1)

    value = jnp.minimum(free, SIGHT) - _LANE_CHANGE_COST * jnp.abs(number - here)
    edge = (number == 0) | (number == usable - 1)
    value = value - jnp.where(edge & (usable > 2), _EDGE_COST, 0.0)
    value = value - jnp.where(number > here, _RIGHT_COST, 0.0)
    value = jnp.where(number < usable, value, value - 200.0)
    # a lane beyond an occupied neighbour is out of reach
    step = jnp.sign(number - current)
    neighbour = jnp.clip(current + step, 0, LANES - 1).astype(jnp.int32)
    shut = (step != 0) & beside[neighbour]
    value = jnp.where(shut, value - 500.0, value)
    value = jnp.where(number < size, value, -1e4)
    best = jnp.argmax(value).astype(jnp.float32)
    return jnp.clip(best, current - 1, current + 1)
