"""Traffic: parked until woken, then the Intelligent Driver Model along the lanes.

A vehicle moves in the coordinates of its lane. Its throttle is MetaDrive's IDM (speeds v in km/h,
distances in m; target 30 km/h):

    a = 1 - (v / v_target)^10 - (d* / d)^2      d* = 10 + 1.5 v + v dv / (2 sqrt 5)

where d is the distance to the next object on its lane or the lane that continues it, within 30 m.
It changes lane when something slow has been ahead of it for 5 s and the neighbouring lane is free,
or when its own lane ends.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from envs.driving.geometry import lane_heading, lane_position
from envs.driving.scenario import Scenario, tree_index
from envs.driving.vehicle import CONTROL_STEP
from ppl_jax.types import Array

REMOVED, PARKED, DRIVING = 0, 1, 2
TARGET_SPEED, CREEP_SPEED, NO_LIMIT = 30.0, 5.0, 100.0  # km/h
SIGHT = 30.0  # m
SAFE_GAP, SMALL_GAP = 15.0, 5.0  # m, to change lane: behind (and ahead), ahead when it must
PATIENCE, CALM = 50, 12  # steps: of waiting before a lane change, and already waited after one
_LATERAL_TIME, _LATERAL_SHARE = 1.0, 0.3  # s to settle on a lane; sideways over forward speed


@flax.struct.dataclass
class Traffic:
    """State of the traffic vehicles, [N].

    Attributes:
        status: REMOVED, PARKED or DRIVING.
        leg: Position of the vehicle's road on its way.
        number: Lane number on that road.
        long, lateral: On that lane, m, lateral positive to the right.
        slide: Sideways speed, m/s, positive to the right.
        speed: m/s.
        waited: Steps since the last lane change.
    """

    status: jax.Array
    leg: jax.Array
    number: jax.Array
    long: jax.Array
    lateral: jax.Array
    slide: jax.Array
    speed: jax.Array
    waited: jax.Array


def start(scenario: Scenario) -> Traffic:
    """All vehicles parked at their places."""
    plan = scenario.traffic
    zero = jnp.zeros_like(plan.long)
    return Traffic(
        status=jnp.where(plan.exists, PARKED, REMOVED).astype(jnp.int32),
        leg=jnp.zeros_like(plan.lane),
        number=jnp.asarray(plan.lane - plan.way_first[:, 0]),
        long=jnp.asarray(plan.long),
        lateral=zero,
        slide=zero,
        speed=zero,
        waited=jnp.asarray(plan.patience),
    )


def _lane_index(scenario: Scenario, traffic: Traffic) -> jax.Array:
    return _at(scenario.traffic.way_first, traffic.leg) + traffic.number


def _at(table: Array, leg: jax.Array) -> jax.Array:
    """table[i, leg[i]], [N, Q], [N] -> [N]."""
    return jnp.take_along_axis(table, leg[:, None], 1)[:, 0]


def poses(scenario: Scenario, traffic: Traffic) -> jax.Array:
    """World poses, [N, 3]."""
    lane = tree_index(scenario.lanes, _lane_index(scenario, traffic))
    position = lane_position(lane, traffic.long, traffic.lateral)
    lean = jnp.arctan2(traffic.slide, jnp.maximum(traffic.speed, 1.0))
    return jnp.concatenate([position, (lane_heading(lane, traffic.long) - lean)[:, None]], -1)


class _OnLanes(NamedTuple):
    """Vehicles, ego and objects, [J] each: index of the lane (-2 off them), m along it, m/s."""

    lane: jax.Array
    long: jax.Array
    speed: jax.Array


def _neighbours(
    others: _OnLanes,
    *,
    beside: jax.Array,
    ahead: jax.Array,
    long: jax.Array,
    left_over: jax.Array,
) -> jax.Array:
    """Distance to the next ahead, m, its speed, m/s, and distance to the last behind, [3, 3, N].

    Args:
        others: What is on the lanes.
        beside, ahead: [3, N] lanes left, here and right of each vehicle, and those they lead to.
        long, left_over: [N] m along the vehicle's lane, and to its end.

    Returns:
        The three, each on the lanes left, here and right; infinite (a speed 0) where there is none.
    """
    front = behind = jnp.full(beside.shape, jnp.inf, jnp.float32)
    speed = jnp.zeros(beside.shape, jnp.float32)
    # unrolled, as the lidar's boxes: a reduction over so few runs one number at a time
    for j in range(others.lane.shape[0]):
        here, delta = others.lane[j] == beside, others.long[j] - long
        distance = jnp.where(here & (delta > 0), delta, jnp.inf)
        beyond = jnp.where(others.lane[j] == ahead, left_over + others.long[j], jnp.inf)
        distance = jnp.minimum(distance, beyond)
        speed = jnp.where(distance < front, others.speed[j], speed)
        front = jnp.minimum(front, distance)
        behind = jnp.minimum(behind, jnp.where(here & (delta < 0), -delta, jnp.inf))
    # stored once: else the compiler computes the whole loop anew for each use
    return jax.lax.optimization_barrier(jnp.stack([front, speed, behind]))


def advance(
    scenario: Scenario,
    traffic: Traffic,
    *,
    ego_lane: jax.Array,
    ego_long: jax.Array,
    ego_speed: jax.Array,
    blocked: jax.Array,
) -> Traffic:
    """One control step of all vehicles.

    Args:
        scenario: The map.
        traffic: Before.
        ego_lane, ego_long, ego_speed: Lane index, m along it, m/s.
        blocked: [N] bool: vehicles that stand still because they touch the ego ahead of them.
    """
    plan, lanes = scenario.traffic, scenario.lanes
    lane = _lane_index(scenario, traffic)
    woken = (traffic.status == PARKED) & (lanes.route[ego_lane] >= plan.trigger)
    status = jnp.where(woken, DRIVING, traffic.status)
    driving = status == DRIVING

    size = _at(plan.way_size, traffic.leg)
    shift = _at(plan.way_shift, traffic.leg)
    following = jnp.minimum(traffic.leg + 1, plan.way_first.shape[1] - 1)
    next_first = jnp.where(following > traffic.leg, _at(plan.way_first, following), -1)
    next_size = _at(plan.way_size, following)
    continues = next_first >= 0

    # what is on the lanes left, here and right of each vehicle: [3, N]
    present = status != REMOVED
    objects = scenario.objects
    others = _OnLanes(
        lane=jnp.concatenate(
            [
                jnp.where(present, lane, -2),
                ego_lane[None],
                jnp.where(objects.lane < 0, -2, objects.lane),
            ]
        ),
        long=jnp.concatenate([traffic.long, ego_long[None], objects.long]),
        speed=jnp.concatenate([traffic.speed, ego_speed[None], jnp.zeros_like(objects.long)]),
    )
    side = jnp.array([-1, 0, 1], jnp.int32)[:, None]
    beside_number = traffic.number + side
    exists = (beside_number >= 0) & (beside_number < size)
    beside = jnp.where(exists, lane + side, -1)
    ahead_number = beside_number + shift
    leads = continues & (ahead_number >= 0) & (ahead_number < next_size)
    ahead = jnp.where(leads & exists, next_first + ahead_number, -1)
    front, its_speed, behind_gap = _neighbours(
        others,
        beside=beside,
        ahead=ahead,
        long=traffic.long,
        left_over=lanes.length[lane] - traffic.long,
    )
    gap = jnp.minimum(front, SIGHT)
    seen = gap < SIGHT
    front_speed = jnp.where(seen, its_speed, NO_LIMIT / 3.6) * 3.6

    # lane changes: because the lane ends, or past something slow
    free = exists & (behind_gap > SAFE_GAP)
    must = continues & ~leads[1]
    rightward = traffic.number + shift < 0  # where the neighbour on the road's side is
    open_gap = free & (gap > SMALL_GAP)
    forced_free = jnp.where(rightward, open_gap[2], open_gap[0])
    speed = traffic.speed * 3.6
    slow = (
        seen[1]
        & (jnp.abs(front_speed[1] - TARGET_SPEED) > 3.0)
        & (jnp.abs(speed - TARGET_SPEED) > 3.0)
        & (traffic.waited > PATIENCE)
    )
    better = free & (gap > SAFE_GAP) & (front_speed > front_speed[1] + 10.0)
    better = better & (leads | ~continues)
    choice = jnp.where(better[0], -1, jnp.where(better[2], 1, 0))
    forced = jnp.where(rightward, 1, -1)
    move = jnp.where(must, jnp.where(forced_free, forced, 0), jnp.where(slow, choice, 0))
    move = jnp.where(driving, move, 0)
    target = jnp.where(must & ~forced_free, CREEP_SPEED, TARGET_SPEED)

    # the car-following law
    distance, ahead_speed, has_front = (
        jnp.where(move < 0, each[0], jnp.where(move > 0, each[2], each[1]))
        for each in (gap, front_speed, seen)
    )
    wanted = 10.0 + 1.5 * speed + speed * (speed - ahead_speed) / (2 * 5.0**0.5)
    throttle = 1.0 - (speed / target) ** 10
    throttle = throttle - jnp.where(has_front, (wanted / jnp.maximum(distance, 0.1)) ** 2, 0.0)
    throttle = jnp.clip(throttle, -1.0, 1.0)
    force = jnp.where(throttle >= 0, plan.thrust * throttle, plan.braking * throttle)
    new_speed = jnp.maximum(traffic.speed + jnp.clip(force, -9.0, 5.0) * CONTROL_STEP, 0.0)
    new_speed = jnp.where(driving & ~blocked, new_speed, 0.0)

    # move along and across
    lateral = traffic.lateral - move * lanes.width[lane]
    bound = _LATERAL_SHARE * new_speed
    slide = jnp.clip(-lateral / _LATERAL_TIME, -bound, bound)
    number = traffic.number + move
    long = traffic.long + new_speed * CONTROL_STEP
    past_end = long >= lanes.length[lane + move]
    stays = number + shift
    passes = past_end & continues & (stays >= 0) & (stays < next_size)
    gone = past_end & ~passes
    return Traffic(
        status=jnp.where(driving & gone, REMOVED, status),
        leg=jnp.where(passes, following, traffic.leg),
        number=jnp.where(passes, stays, number),
        long=jnp.where(passes, long - lanes.length[lane + move], long),
        lateral=lateral + slide * CONTROL_STEP,
        slide=slide,
        speed=new_speed,
        waited=jnp.where(move != 0, CALM, traffic.waited + driving.astype(jnp.int32)),
    )
