"""Traffic: parked until woken, then the Intelligent Driver Model along the lanes.

A vehicle moves in the coordinates of its lane. Its throttle is MetaDrive's IDM (speeds v in km/h,
distances in m; target 30 km/h):

    a = 1 - (v / v_target)^10 - (d* / d)^2      d* = 10 + 1.5 v + v dv / (2 sqrt 5)

where d is the distance to the next object on its lane or the lane that continues it, within 30 m.
It changes lane when something slow has been ahead of it for 5 s and the neighbouring lane is free,
or when its own lane ends.
"""

from __future__ import annotations

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

    # what is on the lanes left, here and right of each vehicle: [N, 3, J]
    present = status != REMOVED
    objects = scenario.objects
    other_lane = jnp.concatenate(
        [
            jnp.where(present, lane, -2),
            ego_lane[None],
            jnp.where(objects.lane < 0, -2, objects.lane),
        ]
    )
    other_long = jnp.concatenate([traffic.long, ego_long[None], objects.long])
    other_speed = jnp.concatenate([traffic.speed, ego_speed[None], jnp.zeros_like(objects.long)])
    side = jnp.array([-1, 0, 1])
    beside_number = traffic.number[:, None] + side
    exists = (beside_number >= 0) & (beside_number < size[:, None])
    beside = jnp.where(exists, lane[:, None] + side, -1)[..., None]
    ahead_number = beside_number + shift[:, None]
    leads = continues[:, None] & (ahead_number >= 0) & (ahead_number < next_size[:, None])
    ahead = jnp.where(leads & exists, next_first[:, None] + ahead_number, -1)[..., None]
    here = other_lane == beside
    delta = other_long - traffic.long[:, None, None]
    left_over = (lanes.length[lane] - traffic.long)[:, None, None]
    front = jnp.where(here & (delta > 0), delta, jnp.inf)
    front = jnp.minimum(front, jnp.where(other_lane == ahead, left_over + other_long, jnp.inf))
    behind = jnp.where(here & (delta < 0), -delta, jnp.inf)
    nearest = jnp.argmin(front, -1)
    gap = jnp.minimum(jnp.min(front, -1), SIGHT)
    behind_gap = jnp.min(behind, -1)
    seen = gap < SIGHT
    front_speed = jnp.where(seen, other_speed[nearest], NO_LIMIT / 3.6) * 3.6

    # lane changes: because the lane ends, or past something slow
    free = exists & (behind_gap > SAFE_GAP)
    must = continues & ~leads[:, 1]
    toward = jnp.where(traffic.number + shift < 0, 2, 0)  # the neighbour on the road's side
    forced_free = jnp.take_along_axis(free, toward[:, None], 1)[:, 0] & (
        jnp.take_along_axis(gap, toward[:, None], 1)[:, 0] > SMALL_GAP
    )
    speed = traffic.speed * 3.6
    slow = (
        seen[:, 1]
        & (jnp.abs(front_speed[:, 1] - TARGET_SPEED) > 3.0)
        & (jnp.abs(speed - TARGET_SPEED) > 3.0)
        & (traffic.waited > PATIENCE)
    )
    better = free & (gap > SAFE_GAP) & (front_speed > front_speed[:, 1:2] + 10.0)
    better = better & (leads | ~continues[:, None])
    choice = jnp.where(better[:, 0], -1, jnp.where(better[:, 2], 1, 0))
    move = jnp.where(must, jnp.where(forced_free, toward - 1, 0), jnp.where(slow, choice, 0))
    move = jnp.where(driving, move, 0)
    target = jnp.where(must & ~forced_free, CREEP_SPEED, TARGET_SPEED)

    # the car-following law
    index = (move + 1)[:, None]
    distance = jnp.take_along_axis(gap, index, 1)[:, 0]
    ahead_speed = jnp.take_along_axis(front_speed, index, 1)[:, 0]
    has_front = jnp.take_along_axis(seen, index, 1)[:, 0]
    wanted = 10.0 + 1.5 * speed + speed * (speed - ahead_speed) / (2 * jnp.sqrt(5.0))
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
        waited=jnp.where(move != 0, CALM, traffic.waited + driving),
    )
