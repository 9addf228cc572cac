"""A scenario as fixed-size arrays, and how a description in NumPy is packed into them.

Lanes, route, objects and traffic are padded to a `Capacity`, so that every scenario of a pool has
the same shapes and `reset` picks one by its index.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import flax.struct
import jax
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from envs.driving.roads import DECORATION, EXTEND, SHRINK, Lane, Road, RoadNetwork
from ppl_jax.types import Array

SIDEWALK = (0.2, 2.2)  # m beyond the outer lane edge: where the sidewalk starts and ends
SPAWN_LONG = 5.0  # m along its lane at which the ego starts
_FAR = 1e6  # m, where padding lies


T = TypeVar("T")


@flax.struct.dataclass
class Lanes:
    """All lanes of a map, [M]; lanes of one road are neighbours, left to right.

    Attributes:
        start, forward: Start point, m, and unit vector of travel there, [M, 2].
        length, width: m.
        turn: +1 anticlockwise arc, -1 clockwise, 0 straight.
        center, radius, phase, angle: Of an arc, m and rad; [M, 2] and [M].
        begin, reach: Longitudinal range that counts as on the lane, m. MetaDrive's lane surfaces
            run up to a metre over the ends.
        taper: 0 for a constant width, 1 shrinking to zero, 2 growing from zero.
        number: 0 for the leftmost lane of its road.
        road_size: Number of lanes of its road.
        route: Position of the lane's road on the ego's route, -1 off it.
        node: Position of the road's first node among the route's nodes, -1 off it.
    """

    start: Array
    forward: Array
    length: Array
    width: Array
    turn: Array
    center: Array
    radius: Array
    phase: Array
    angle: Array
    begin: Array
    reach: Array
    taper: Array
    number: Array
    road_size: Array
    route: Array
    node: Array


@flax.struct.dataclass
class Objects:
    """Static things on the road: `boxes` (broken-down vehicles, barriers) and `circles` (cones,
    warning triangles).

    Attributes:
        box_pose: [K, 3] x, y, heading (m, rad). Padding lies far away.
        box_half: [K, 2] half length and half width, m.
        box_is_vehicle: [K] bool: a hit counts as a vehicle crash.
        circle: [C, 3] x, y, radius, m.
        lane, long: [K + C] lane index (-1 none) and position along it, m, boxes first.
        along, across: [K + C] position along and right of the leftmost lane of that road, m.
    """

    box_pose: Array
    box_half: Array
    box_is_vehicle: Array
    circle: Array
    lane: Array
    long: Array
    along: Array
    across: Array


@flax.struct.dataclass
class TrafficPlan:
    """Where each traffic vehicle starts, what wakes it, and its way, [N] and [N, Q].

    Attributes:
        half: [N, 2] half length and half width, m.
        exists: [N] bool.
        trigger: [N] position on the ego's route of the road that wakes it.
        lane, long: [N] spawn lane index and position along it, m.
        way_first: [N, Q] index of the leftmost lane of each road of its way, -1 past the end.
        way_size: [N, Q] number of lanes of each road.
        way_shift: [N, Q] what to add to the lane number when moving on to the next road.
        patience: [N] steps it has waited already for a lane change (MetaDrive draws this).
        thrust, braking: [N] acceleration at full throttle and deceleration at full brake, m/s^2.
    """

    half: Array
    exists: Array
    trigger: Array
    lane: Array
    long: Array
    way_first: Array
    way_size: Array
    way_shift: Array
    patience: Array
    thrust: Array
    braking: Array


@flax.struct.dataclass
class Scenario:
    """One numbered scenario.

    Attributes:
        number: Its number.
        lanes: `Lanes`.
        kerbs: [W] indices of the lanes with a sidewalk along their right edge, -1 padding.
        route_lane: [R] index of the leftmost lane of each road of the route.
        route_size: [R] number of lanes of each road.
        route_roads: Number of roads on the route.
        route_length: Sum of the leftmost lanes' lengths, m.
        final_lane, spawn_lane: Lane indices; the ego starts `SPAWN_LONG` m along the latter.
        engine_force, brake_force: Largest per wheel, N, and N s per 0.02 s.
        wheel_friction: Tyre friction coefficient.
        objects, traffic: What else is there.
    """

    number: Array
    lanes: Lanes
    kerbs: Array
    route_lane: Array
    route_size: Array
    route_roads: Array
    route_length: Array
    final_lane: Array
    spawn_lane: Array
    engine_force: Array
    brake_force: Array
    wheel_friction: Array
    objects: Objects
    traffic: TrafficPlan


class ObjectSpec(NamedTuple):
    """A static object: kind is cone, warning, barrier or vehicle.

    `length` is along the heading, `width` across it (of round ones: the radius), m.
    """

    kind: str
    x: float
    y: float
    heading: float
    length: float
    width: float
    lane: tuple[Road, int] | None


class VehicleSpec(NamedTuple):
    """A traffic vehicle: where it starts, which road of the ego's wakes it, its route's nodes.

    Sizes in m, forces in N (engine) and N s per 0.02 s (brake) per wheel, mass in kg.
    """

    length: float
    width: float
    trigger: Road
    lane: tuple[Road, int]
    long: float
    nodes: tuple[str, ...]
    patience: int
    mass: float
    engine_force: float
    brake_force: float


@dataclasses.dataclass(frozen=True)
class Description:
    """A scenario in words and NumPy, before packing.

    Attributes:
        number: Scenario number.
        blocks: Letters of its blocks, I first.
        network: Its roads.
        nodes: The route's nodes.
        spawn_number: Lane number of the ego on the first road.
        engine_force, brake_force, wheel_friction: As in `Scenario`.
        objects, traffic: What else is there.
    """

    number: int
    blocks: str
    network: RoadNetwork
    nodes: tuple[str, ...]
    spawn_number: int
    engine_force: float
    brake_force: float
    wheel_friction: float
    objects: tuple[ObjectSpec, ...]
    traffic: tuple[VehicleSpec, ...]


@dataclasses.dataclass(frozen=True)
class Capacity:
    """Array sizes of a pool: lanes, kerbs, route roads, boxes, circles, vehicles, their roads."""

    lanes: int = 96
    kerbs: int = 32
    roads: int = 16
    boxes: int = 4
    circles: int = 16
    vehicles: int = 8
    way: int = 12

    @staticmethod
    def of(descriptions: Sequence[Description]) -> Capacity:
        """The smallest capacity, in round numbers, that holds all of `descriptions`."""

        def largest(measure, step):
            most = max((measure(d) for d in descriptions), default=0)
            return max(step, -(-most // step) * step)

        return Capacity(
            lanes=largest(lambda d: sum(map(len, d.network.roads.values())), 32),
            kerbs=largest(
                lambda d: sum(_has_kerb(lane) for r in d.network.roads.values() for lane in r), 16
            ),
            roads=largest(lambda d: len(d.nodes), 8),
            boxes=largest(lambda d: sum(o.kind in _BOXES for o in d.objects), 4),
            circles=largest(lambda d: sum(o.kind not in _BOXES for o in d.objects), 8),
            vehicles=largest(lambda d: len(d.traffic), 4),
            way=largest(lambda d: max((len(v.nodes) for v in d.traffic), default=0), 4),
        )


_BOXES = ("vehicle", "barrier")


def pack(description: Description, capacity: Capacity) -> Scenario:
    """Turn a description into arrays (NumPy leaves).

    Raises:
        ValueError: If it does not fit the capacity, or its route is broken.
    """
    d = description
    index: dict[tuple[Road, int], int] = {}
    lanes: list[tuple[Road, int, Lane]] = []
    for road, members in d.network.roads.items():
        for number, lane in enumerate(members):
            index[road, number] = len(lanes)
            lanes.append((road, number, lane))
    route = list(zip(d.nodes[:-1], d.nodes[1:], strict=True))
    for road in route:
        if road not in d.network.roads:
            raise ValueError(f"scenario {d.number}: the route uses the unknown road {road}")
    needed = Capacity.of([d])
    for field in dataclasses.fields(Capacity):
        if getattr(needed, field.name) > getattr(capacity, field.name):
            raise ValueError(
                f"scenario {d.number} needs capacity {field.name}={getattr(needed, field.name)}, "
                f"got {getattr(capacity, field.name)}"
            )
    return Scenario(
        number=np.asarray(d.number, np.int32),
        lanes=_pack_lanes(lanes, d.network, nodes=d.nodes, route=route, size=capacity.lanes),
        kerbs=_padded(
            [i for i, (_, _, lane) in enumerate(lanes) if _has_kerb(lane)],
            capacity.kerbs,
            -1,
            np.int32,
        ),
        route_lane=_padded([index[r, 0] for r in route], capacity.roads, 0, np.int32),
        route_size=_padded([len(d.network.roads[r]) for r in route], capacity.roads, 1, np.int32),
        route_roads=np.asarray(len(route), np.int32),
        route_length=np.asarray(sum(d.network.roads[r][0].length for r in route), np.float32),
        final_lane=np.asarray(index[route[-1], len(d.network.roads[route[-1]]) - 1], np.int32),
        spawn_lane=np.asarray(index[route[0], d.spawn_number], np.int32),
        engine_force=np.asarray(d.engine_force, np.float32),
        brake_force=np.asarray(d.brake_force, np.float32),
        wheel_friction=np.asarray(d.wheel_friction, np.float32),
        objects=_pack_objects(d, index, capacity),
        traffic=_pack_traffic(d, index, route, capacity),
    )


def stack(scenarios: Sequence[Scenario]) -> Scenario:
    """One `Scenario` whose leaves carry a leading [S] axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *scenarios)


def tree_index(pool: T, index: Array | int) -> T:
    """The entry at `index` of structs that are stacked along their leaves' first axis."""
    return jax.tree.map(lambda leaf: leaf[index], pool)


def _has_kerb(lane: Lane) -> bool:
    """Whether a sidewalk is drawn; bends too tight for one have none."""
    return lane.kerb and not (lane.turn and lane.width / 2 + SIDEWALK[1] > lane.radius)


def _padded(
    values: ArrayLike, size: int, fill: ArrayLike, dtype: DTypeLike = np.float32
) -> np.ndarray:
    values = np.asarray(values, dtype)
    out = np.full((size, *values.shape[1:]), fill, dtype)
    out[: len(values)] = values
    return out


def _pack_lanes(
    lanes: list[tuple[Road, int, Lane]],
    network: RoadNetwork,
    *,
    nodes: tuple[str, ...],
    route: list[Road],
    size: int,
) -> Lanes:
    route_position = {road: i for i, road in enumerate(route)}
    node_position = {name: i for i, name in enumerate(nodes)}

    def column(
        measure: Callable[[Road, int, Lane], Any],
        fill: float,
        dtype: DTypeLike = np.float32,
    ) -> np.ndarray:
        return _padded([measure(*entry) for entry in lanes], size, fill, dtype)

    def forward(road: Road, number: int, lane: Lane) -> ArrayLike:
        return np.cos(lane.heading_at(0.0)), np.sin(lane.heading_at(0.0))

    def reach(road: Road, number: int, lane: Lane) -> float:
        # the surface is drawn from points 1 m apart, the last at or past the end; an arc's has
        # one metre more at either end
        last = len(np.arange(0.0, lane.length + 1.0, 1.0)) - 1.0
        return last + (1.0 if lane.turn else 0.0)

    return Lanes(
        start=column(lambda r, n, lane: lane.start, _FAR),
        forward=column(forward, 0.0),
        length=column(lambda r, n, lane: lane.length, 1.0),
        width=column(lambda r, n, lane: lane.width, 0.0),
        turn=column(lambda r, n, lane: lane.turn, 0.0),
        center=column(lambda r, n, lane: lane.center, 0.0),
        radius=column(lambda r, n, lane: lane.radius if lane.turn else 1.0, 1.0),
        phase=column(lambda r, n, lane: lane.phase, 0.0),
        angle=column(lambda r, n, lane: lane.angle, 0.0),
        begin=column(lambda r, n, lane: -1.0 if lane.turn else 0.0, 0.0),
        reach=column(reach, -1.0),
        taper=column(lambda r, n, lane: {SHRINK: 1, EXTEND: 2}.get(lane.taper, 0), 0, np.int32),
        number=column(lambda r, n, lane: n, 0, np.int32),
        road_size=column(lambda r, n, lane: len(network.roads[r]), 1, np.int32),
        route=column(lambda r, n, lane: route_position.get(r, -1), -1, np.int32),
        node=column(
            lambda r, n, lane: -1 if r == DECORATION else node_position.get(r[0], -1), -1, np.int32
        ),
    )


def _pack_objects(d: Description, index: dict, capacity: Capacity) -> Objects:
    def rows(objects: list[ObjectSpec], size: int) -> tuple[np.ndarray, np.ndarray]:
        lane = _padded(
            [index[o.lane] if o.lane is not None else -1 for o in objects], size, -1, np.int32
        )
        place = np.zeros((size, 3), np.float32)
        for i, o in enumerate(objects):
            if o.lane is not None:
                members = d.network.roads[o.lane[0]]
                point = np.array([o.x, o.y])
                place[i] = members[o.lane[1]].local(point)[0], *members[0].local(point)
        return lane, place

    boxes = [o for o in d.objects if o.kind in _BOXES]
    circles = [o for o in d.objects if o.kind not in _BOXES]
    box_lane, box_place = rows(boxes, capacity.boxes)
    circle_lane, circle_place = rows(circles, capacity.circles)
    place = np.concatenate([box_place, circle_place])
    far = np.array([_FAR, _FAR, 0.0])
    return Objects(
        box_pose=_padded(
            np.array([[o.x, o.y, o.heading] for o in boxes]).reshape(-1, 3), capacity.boxes, far
        ),
        box_half=_padded(
            np.array([[o.length / 2, o.width / 2] for o in boxes]).reshape(-1, 2),
            capacity.boxes,
            0.1,
        ),
        box_is_vehicle=_padded([o.kind == "vehicle" for o in boxes], capacity.boxes, False, bool),
        circle=_padded(
            np.array([[o.x, o.y, o.width] for o in circles]).reshape(-1, 3),
            capacity.circles,
            np.array([_FAR, _FAR, 0.1]),
        ),
        lane=np.concatenate([box_lane, circle_lane]),
        long=place[:, 0],
        along=place[:, 1],
        across=place[:, 2],
    )


def _pack_traffic(
    d: Description, index: dict, route: list[Road], capacity: Capacity
) -> TrafficPlan:
    n, q = capacity.vehicles, capacity.way
    first = np.full((n, q), -1, np.int32)
    size = np.ones((n, q), np.int32)
    shift = np.zeros((n, q), np.int32)
    for i, vehicle in enumerate(d.traffic):
        way = list(zip(vehicle.nodes[:-1], vehicle.nodes[1:], strict=True))
        for j, road in enumerate(way):
            first[i, j] = index[road, 0]
            size[i, j] = len(d.network.roads[road])
            if j + 1 < len(way):
                shift[i, j] = _lane_shift(d.network.roads[road], d.network.roads[way[j + 1]])
    position = {road: i for i, road in enumerate(route)}
    vehicles = d.traffic
    return TrafficPlan(
        half=_padded(
            np.array([[v.length / 2, v.width / 2] for v in vehicles]).reshape(-1, 2), n, 0.1
        ),
        exists=_padded([True] * len(vehicles), n, False, bool),
        trigger=_padded([position.get(v.trigger, 10**6) for v in vehicles], n, 10**6, np.int32),
        lane=_padded([index[v.lane] for v in vehicles], n, 0, np.int32),
        long=_padded([v.long for v in vehicles], n, 0.0),
        way_first=first,
        way_size=size,
        way_shift=shift,
        patience=_padded([v.patience for v in vehicles], n, 0, np.int32),
        thrust=_padded([4 * v.engine_force / v.mass for v in vehicles], n, 1.0),
        braking=_padded([4 * v.brake_force / (v.mass * 0.02) for v in vehicles], n, 1.0),
    )


def _lane_shift(here: list[Lane], there: list[Lane]) -> int:
    """Lane number on the next road less lane number here, from where the lanes meet."""
    for i, lane in enumerate(here):
        for j, other in enumerate(there):
            if np.hypot(*(lane.end - other.start)) < 0.1:
                return j - i
    return 0
