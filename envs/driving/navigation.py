"""Where the ego is on its route: current lane, current road, progress."""

from __future__ import annotations

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from envs.driving.geometry import (
    lane_coordinates,
    on_lanes,
    runs_along,
)
from envs.driving.scenario import Scenario, tree_index

CHECKPOINT_RANGE = 5.0  # m after a road's start within which the route moves on to it


@flax.struct.dataclass
class Navigation:
    """Progress along the route.

    Attributes:
        road: Position of the current reference road on the route.
        lane: Index of the current lane (kept from before while the ego is on none).
        travelled: Progress summed along the reference roads' leftmost lanes, m.
        last_long: Position along the current one, m.
    """

    road: jax.Array
    lane: jax.Array
    travelled: jax.Array
    last_long: jax.Array


class Localised(NamedTuple):
    """Result of one localisation.

    Attributes:
        long, lateral: The ego's coordinates on every lane, [M], m.
        on_lane: Whether it is on any lane of the map.
        left, right: Distance to the edges of the reference road, m; its width is that of a lane
            times their number, as in MetaDrive, where a ramp's last lane tapers too.
    """

    long: jax.Array
    lateral: jax.Array
    on_lane: jax.Array
    left: jax.Array
    right: jax.Array


def start(scenario: Scenario) -> Navigation:
    """Before the first localisation."""
    zero = jnp.zeros((), jnp.float32)
    return Navigation(
        road=jnp.zeros((), jnp.int32),
        lane=jnp.asarray(scenario.spawn_lane),
        travelled=zero,
        last_long=zero,
    )


def localise(
    scenario: Scenario, navigation: Navigation, pose: jax.Array
) -> tuple[Navigation, Localised]:
    """Find the lane, move the route on, add up progress.

    The lane is the nearest one under the ego's centre that runs its way; lanes of the current
    road come first, then those of the next. The route moves on to road r within the first 5 m
    of any lane that starts at its first node.

    Args:
        scenario: The map.
        navigation: Before.
        pose: [3] x, y, heading.
    """
    lanes = scenario.lanes
    long, lateral = lane_coordinates(lanes, pose[:2])
    inside = on_lanes(lanes, long, lateral)
    along = runs_along(lanes, pose)
    distance = jnp.abs(lateral) + jnp.maximum(long - lanes.length, 0.0) + jnp.maximum(-long, 0.0)
    last_road = scenario.route_roads - 1
    is_next = (lanes.route == navigation.road + 1) & (navigation.road < last_road)
    rank = jnp.where(lanes.route == navigation.road, 0.0, jnp.where(is_next, 1e3, 2e3))
    score = jnp.where(inside & along, rank + distance, jnp.inf)
    best = jnp.argmin(score)
    lane = jnp.where(jnp.isfinite(score[best]), best.astype(jnp.int32), navigation.lane)

    node = lanes.node[lane]
    arrived = (
        (navigation.road < last_road)
        & (node > navigation.road)
        & (node <= last_road)
        & (long[lane] < CHECKPOINT_RANGE)
    )
    road = jnp.where(arrived, node, navigation.road)
    before = long[scenario.route_lane[navigation.road]]
    travelled = navigation.travelled + before - navigation.last_long
    reference = scenario.route_lane[road]
    width = lanes.width[lane]
    left = lateral[reference] + width / 2
    right = scenario.route_size[road].astype(jnp.float32) * width - left
    return (
        Navigation(road=road, lane=lane, travelled=travelled, last_long=long[reference]),
        Localised(long=long, lateral=lateral, on_lane=jnp.any(inside), left=left, right=right),
    )


def arrived(scenario: Scenario, navigation: Navigation, found: Localised) -> jax.Array:
    """Success: within 5 m of the end of the last lane, and laterally on the road."""
    final = tree_index(scenario.lanes, scenario.final_lane)
    long, lateral = found.long[scenario.final_lane], found.lateral[scenario.final_lane]
    width = scenario.lanes.width[navigation.lane]
    size = scenario.route_size[navigation.road].astype(jnp.float32)
    return (jnp.abs(long - final.length) < 5.0) & (
        (lateral <= width / 2) & (lateral >= (0.5 - size) * width)
    )
