"""The 259 values a MetaDrive policy sees, in its order, all in [0, 1].

| index | meaning |
| --- | --- |
| 0, 1 | distance to the left and right edge of the reference road / 18 m |
| 2 | 0.5 - 0.5 sin(heading - lane heading) |
| 3 | (speed + 1 km/h) / 81 km/h |
| 4 | (steer / 60 + 1) / 2 |
| 5, 6 | (action + 1) / 2 of the action just executed |
| 7 | unsigned yaw rate, rad/s |
| 8 | lateral offset on the current lane: (2 offset / 4.5 m + 1) / 2 |
| 9-13, 14-18 | end of the reference road and of the next one: forward and left part of the way there (cut to 50 m), radius, turn (1 clockwise, 0 anticlockwise, 0.5 straight), angle |
| 19-258 | lidar: ray i points 1.5 i degrees anticlockwise of the heading; distance / 50 m |

Source: `obs/state_obs.py` and `component/navigation_module/` of MetaDrive 0.4.3.
"""  # noqa: E501

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from envs.derivatives import length
from envs.driving import lidar
from envs.driving.geometry import lane_position, to_body, wrap
from envs.driving.navigation import Navigation
from envs.driving.scenario import Scenario, tree_index
from envs.driving.vehicle import CONTROL_STEP, Ego
from ppl_jax.types import Array

SIZE = 19 + lidar.RAYS
# a network sees (observation - MEAN) / SCALE: a ray that hits nothing is 0, and the few numbers
# that tell the place on the road weigh more than the many rays
MEAN = np.concatenate([np.full(19, 0.5), np.ones(lidar.RAYS)]).astype(np.float32)
SCALE = np.concatenate([np.full(19, 0.1), np.full(lidar.RAYS, 3.0)]).astype(np.float32)
_FULL_WIDTH = 18.0  # m: (3 + 1) lanes of 4.5 m
_WIDEST_LANE = 4.5  # m
_CHECKPOINT_RANGE = 50.0  # m
_LARGEST_RADIUS, _LARGEST_ANGLE = 60.0, jnp.pi * 135.0 / 180.0


def _checkpoint(scenario: Scenario, *, road: jax.Array, size: jax.Array, width: Array, ego: Ego):
    """Five values on the end of a route road, [5]."""
    lane = tree_index(scenario.lanes, scenario.route_lane[road])
    middle = (size / 2 - 0.5) * width
    way = lane_position(lane, lane.length, middle) - ego.pose[:2]
    distance = jnp.sqrt(jnp.sum(way * way) + 1e-12)
    way = way * jnp.minimum(1.0, _CHECKPOINT_RANGE / distance)
    local = to_body(way, ego.pose[2])
    is_arc = lane.turn != 0
    radius = jnp.where(is_arc, lane.radius / (_LARGEST_RADIUS + size * width), 0.0)
    angle = jnp.where(is_arc, lane.angle / _LARGEST_ANGLE, 0.0)
    return jnp.stack(
        [
            0.5 + local[0] / (2 * _CHECKPOINT_RANGE),
            0.5 + local[1] / (2 * _CHECKPOINT_RANGE),
            radius,
            0.5 - 0.5 * lane.turn,
            0.5 + 0.5 * angle,
        ]
    )


def ego_features(
    scenario: Scenario,
    ego: Ego,
    navigation: Navigation,
    *,
    left: jax.Array,
    right: jax.Array,
    lateral: jax.Array,
) -> jax.Array:
    """Values 0-18.

    Args:
        scenario: The map.
        ego: The ego vehicle.
        navigation: Its localisation.
        left, right: Distances to the reference road's edges, m.
        lateral: Lateral offset on the current lane, m.
    """
    lanes = scenario.lanes
    size = scenario.route_size[navigation.road].astype(jnp.float32)
    width = lanes.width[navigation.lane]
    # MetaDrive takes the rightmost lane for this; beside an out-ramp it is not parallel
    rightmost = scenario.route_lane[navigation.road] + scenario.route_size[navigation.road] - 1
    reference = tree_index(lanes, rightmost)
    # the right-hand normal of the lane at the ego; on an arc it is radial
    radial = (ego.pose[:2] - reference.center) * reference.turn
    normal = jnp.where(
        reference.turn != 0, radial, jnp.stack([reference.forward[1], -reference.forward[0]])
    )
    normal = normal / jnp.sqrt(jnp.sum(normal * normal) + 1e-12)
    heading = jnp.stack([jnp.cos(ego.pose[2]), jnp.sin(ego.pose[2])])
    speed = length(ego.velocity) * 3.6
    yaw = jnp.abs(wrap(ego.pose[2] - ego.last_pose[2])) / CONTROL_STEP
    following = jnp.minimum(navigation.road + 1, scenario.route_roads - 1)
    state = jnp.stack(
        [
            left / _FULL_WIDTH,
            right / _FULL_WIDTH,
            0.5 + 0.5 * jnp.sum(normal * heading),
            (speed + 1.0) / 81.0,
            (ego.action[0] / 60.0 + 1.0) / 2.0,
            (ego.action[0] + 1.0) / 2.0,
            (ego.action[1] + 1.0) / 2.0,
            yaw,
            (lateral * 2.0 / _WIDEST_LANE + 1.0) / 2.0,
        ]
    )
    ends = [
        _checkpoint(scenario, road=road, size=size, width=width, ego=ego)
        for road in (navigation.road, following)
    ]
    return jnp.clip(jnp.concatenate([state, *ends]), 0.0, 1.0)


def lidar_reading(
    scenario: Scenario,
    pose: jax.Array,
    *,
    traffic_pose: jax.Array,
    present: jax.Array,
    box_pose: jax.Array,
) -> jax.Array:
    """Values 19-258.

    Args:
        scenario: The map with its static objects.
        pose: [3] of the ego.
        traffic_pose: [N, 3].
        present: [N] bool: vehicles still in the world.
        box_pose: [K, 3] of the static boxes.
    """
    objects = scenario.objects
    away = jnp.where(present[:, None], traffic_pose, 1e6)
    return lidar.scan(
        pose,
        jnp.concatenate([away, box_pose]),
        jnp.concatenate([scenario.traffic.half, objects.box_half]),
        objects.circle,
    )


@jax.custom_jvp
def join(features: jax.Array, rays: jax.Array) -> jax.Array:
    """Both parts as one observation: [19], [240] -> [259].

    One world's parts are written side by side: as a concatenation they would be one kernel with a
    branch per ray (a step of the world takes three times as long). In a batch the concatenation
    is the faster of the two. The derivative is written out because a function with a batching rule
    of its own has none in reverse.
    """
    return _side_by_side(features, rays)


@join.defjvp
def _join_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    return join(*primals), jnp.concatenate(tangents)


@jax.custom_batching.custom_vmap
def _side_by_side(features: jax.Array, rays: jax.Array) -> jax.Array:
    whole = jax.lax.dynamic_update_slice(jnp.zeros(SIZE, jnp.float32), features, (0,))
    return jax.lax.dynamic_update_slice(whole, rays, (features.shape[0],))


@_side_by_side.def_vmap
def _concatenated(
    axis_size: int, in_batched: list[bool], features: jax.Array, rays: jax.Array
) -> tuple[jax.Array, bool]:
    parts = [
        part if batched else jnp.broadcast_to(part, (axis_size, *part.shape))
        for part, batched in zip((features, rays), in_batched, strict=True)
    ]
    return jnp.concatenate(parts, -1), True
