"""The seven block kinds a map is made of, with MetaDrive 0.4.3's shapes and parameter ranges.

A block plugs into a *socket* of the map (a road out of it, with its oncoming twin) and offers
sockets of its own. Each builder is a function of the network so far, the socket, the block's
number and its parameters, and returns a `Block`. The numbers are those of MetaDrive's
`component/pg_space.py` and `component/pgblock/`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from envs.driving.roads import (
    DECORATION,
    EXTEND,
    FIRST_NODES,
    SHRINK,
    Lane,
    Road,
    RoadNetwork,
    bend,
    extend,
    is_oncoming,
    reverse_road,
    straight,
)

EXIT_LENGTH = 35.0  # m, of the arms of an intersection or a roundabout
ENTRANCE_LENGTH, FIRST_LENGTH = 10.0, 50.0  # m, of the first block


@dataclasses.dataclass(frozen=True)
class Block:
    """One block of a map.

    Attributes:
        kind: Its letter: I, S, C, r, R, X, T or O.
        network: The roads it adds.
        entry: The road it was plugged into.
        sockets: Roads it offers to the next block.
        arms: Oncoming roads on which traffic for the whole block may start (MetaDrive's
            "respawn roads"): those of the sockets, and the side road of an in-ramp.
        inner: Further roads on which traffic may start.
        accident_roads: The one or two roads on which an accident scene may stand.
        parameters: As drawn.
    """

    kind: str
    network: RoadNetwork
    entry: Road
    sockets: tuple[Road, ...]
    arms: tuple[Road, ...] = ()
    inner: tuple[Road, ...] = ()
    accident_roads: tuple[Road, ...] = ()
    parameters: dict[str, float] = dataclasses.field(default_factory=dict)


def node(block: int, kind: str, part: int, index: int) -> str:
    """MetaDrive's name of a road node."""
    return f"{block}{kind}{part}_{index}_"


def first_block(lanes: int, width: float) -> Block:
    """The straight on which the ego starts: 10 m, then 40 m."""
    network = RoadNetwork()
    right = straight((0.0, 0.0), (ENTRANCE_LENGTH, 0.0), width)
    spawn, exit_road = FIRST_NODES[:2], FIRST_NODES[1:]
    for road, lane in ((spawn, right), (exit_road, extend(right, FIRST_LENGTH - ENTRANCE_LENGTH))):
        network.add_road(road, lane, lanes)
        network.add_oncoming(road)
    return Block(kind="I", network=network, entry=spawn, sockets=(exit_road,))


def straight_block(base: RoadNetwork, entry: Road, number: int, p: dict) -> Block:
    """S: a straight road."""
    network, lanes = RoadNetwork(), base.roads[entry]
    road = (entry[1], node(number, "S", 0, 0))
    network.add_road(road, extend(lanes[-1], p["length"]), len(lanes))
    network.add_oncoming(road)
    return Block(
        kind="S",
        network=network,
        entry=entry,
        sockets=(road,),
        inner=(road,),
        accident_roads=(road,),
        parameters=p,
    )


def curve_block(base: RoadNetwork, entry: Road, number: int, p: dict) -> Block:
    """C: an arc and a straight."""
    network, lanes = RoadNetwork(), base.roads[entry]
    roads = (
        (entry[1], node(number, "C", 0, 0)),
        (node(number, "C", 0, 0), node(number, "C", 0, 1)),
    )
    parts = bend(
        lanes[-1], p["length"], p["radius"], math.radians(p["angle"]), clockwise=bool(p["dir"])
    )
    for road, lane in zip(roads, parts, strict=True):
        network.add_road(road, lane, len(lanes))
        network.add_oncoming(road)
    return Block(
        kind="C",
        network=network,
        entry=entry,
        sockets=roads[1:],
        inner=roads,
        accident_roads=roads,
        parameters=p,
    )


RAMP_RADIUS, RAMP_ANGLE, RAMP_LENGTH, RAMP_CONNECT = 40.0, math.radians(10.0), 15.0, 20.0
_RAMP_SPAN = (
    2 * math.sin(RAMP_ANGLE) * RAMP_RADIUS + math.cos(RAMP_ANGLE) * RAMP_CONNECT + RAMP_LENGTH
)


def in_ramp_block(base: RoadNetwork, entry: Road, number: int, p: dict) -> Block:
    """r: a one-lane ramp that joins from the right along an acceleration lane."""
    network, lanes = RoadNetwork(), base.roads[entry]
    count, width = len(lanes), lanes[-1].width
    before, after, out = (node(number, "r", 0, i) for i in range(3))
    approach, merge, socket = (entry[1], before), (before, after), (after, out)
    approach_lane = extend(lanes[-1], _RAMP_SPAN + 10.0)
    merge_lane = extend(approach_lane, p["length"] + p["extension_length"])
    for road, lane in (
        (approach, approach_lane),
        (merge, merge_lane),
        (socket, extend(merge_lane, 20.0)),
    ):
        network.add_road(road, lane, count, kerb=False)
        network.add_oncoming(road)

    lateral = (
        2 * (1 - math.cos(RAMP_ANGLE)) * RAMP_RADIUS + math.sin(RAMP_ANGLE) * RAMP_CONNECT + width
    )
    first = straight(
        approach_lane.position(10.0, lateral),
        approach_lane.position(10.0 + RAMP_LENGTH, lateral),
        width,
    )
    side = [node(number, "r", 1, i) for i in range(4)]
    left_bend, connect = bend(first, RAMP_CONNECT, RAMP_RADIUS, RAMP_ANGLE, clockwise=False)
    right_bend, acceleration = bend(connect, p["length"], RAMP_RADIUS, RAMP_ANGLE, clockwise=True)
    ramp = ((side[0], side[1]), (side[1], side[2]), (side[2], side[3]), (side[3], before))
    for road, lane in zip(ramp, (first, left_bend, connect, right_bend), strict=True):
        network.add_lane(road, lane)
    network.add_lane(merge, acceleration)
    network.add_lane(DECORATION, _extension(acceleration.end, p["extension_length"], width, SHRINK))
    return Block(
        kind="r",
        network=network,
        entry=entry,
        sockets=(socket,),
        inner=(approach, merge, *ramp),
        accident_roads=(approach, merge),
        parameters=p,
    )


def out_ramp_block(base: RoadNetwork, entry: Road, number: int, p: dict) -> Block:
    """R: a deceleration lane and a one-lane ramp that leaves to the right."""
    network, lanes = RoadNetwork(), base.roads[entry]
    count, width = len(lanes), lanes[-1].width
    before, out = node(number, "R", 0, 0), node(number, "R", 0, 1)
    leave, socket = (entry[1], before), (before, out)
    leave_lane = extend(lanes[-1], p["length"] + p["extension_length"])
    for road, lane in ((leave, leave_lane), (socket, extend(leave_lane, _RAMP_SPAN + 15.0))):
        network.add_road(road, lane, count, kerb=False)
        network.add_oncoming(road)

    # MetaDrive lays this wedge along the world's x axis whatever the road's heading, so the
    # deceleration lane starts beside the road only on eastbound roads. Kept: it is its map.
    wedge = _extension(leave_lane.position(0.0, width), p["extension_length"], width, EXTEND)
    network.add_lane(DECORATION, wedge)
    slow = straight(wedge.end, leave_lane.position(leave_lane.length, width), width)
    network.add_lane(leave, slow)
    right_bend, connect = bend(slow, RAMP_CONNECT, RAMP_RADIUS, RAMP_ANGLE, clockwise=True)
    left_bend, last = bend(connect, RAMP_LENGTH, RAMP_RADIUS, RAMP_ANGLE, clockwise=False)
    side = [node(number, "R", 1, i) for i in range(4)]
    ramp = ((before, side[0]), (side[0], side[1]), (side[1], side[2]), (side[2], side[3]))
    for road, lane in zip(ramp, (right_bend, connect, left_bend, last), strict=True):
        network.add_lane(road, lane)
    return Block(
        kind="R",
        network=network,
        entry=entry,
        sockets=(socket,),
        inner=(leave, socket, *ramp),
        accident_roads=(leave, socket),
        parameters=p,
    )


def _extension(start: np.ndarray, length: float, width: float, taper: int) -> Lane:
    return straight(start, start + np.array([length, 0.0]), width, taper=taper)


def intersection_block(base: RoadNetwork, entry: Road, number: int, p: dict, *, kind="X") -> Block:
    """X: a crossing of four arms; sockets right, ahead, left."""
    network = RoadNetwork()
    lanes = base.roads[entry]
    count, width, radius = len(lanes), lanes[-1].width, p["radius"]
    quarter = math.pi / 2
    exits = [(node(number, kind, i, 0), node(number, kind, i, 1)) for i in range(3)]
    targets = [*(road[0] for road in exits), reverse_road(entry)[0]]
    incoming = entry
    for part in range(4):
        left = bend(lanes[0], EXIT_LENGTH, radius + count * width, quarter, clockwise=False)[0]
        network.add_road((incoming[1], targets[2]), left, count, leftward=False, kerb=False)
        for lane in lanes:
            ahead = extend(lane, 2 * radius + (2 * count - 1) * width)
            network.add_lane((incoming[1], targets[1]), ahead)
        right, exit_lane = bend(lanes[-1], EXIT_LENGTH, radius, quarter, clockwise=True)
        network.add_road((incoming[1], targets[0]), right, count)
        targets = targets[1:] + targets[:1]
        if part < 3:
            network.add_road(exits[part], exit_lane, count)
            network.add_oncoming(exits[part])
            incoming = reverse_road(exits[part])
            lanes = network.roads[incoming]
    arms = tuple(reverse_road(road) for road in exits)
    return Block(
        kind=kind, network=network, entry=entry, sockets=tuple(exits), arms=arms, parameters=p
    )


def t_intersection_block(base: RoadNetwork, entry: Road, number: int, p: dict) -> Block:
    """T: an intersection with the right, far or left arm (`t_type` 0, 1, 2) taken away."""
    whole = intersection_block(base, entry, number, p, kind="T")
    removed = int(p["t_type"])
    network = whole.network
    # (way in, way out) of each arm, clockwise from the right one; the last is the entry's
    ways = [(reverse_road(road)[1], road[0]) for road in whole.sockets]
    ways.append((entry[1], reverse_road(entry)[0]))
    for i, (way_in, way_out) in enumerate(ways):
        if i != removed:
            network.remove((ways[removed][0], way_out))
            network.remove((way_in, ways[removed][1]))
    # the straight that passes the missing arm gets a kerb where that arm was
    passing = (ways[(removed + 3) % 4][0], ways[(removed + 1) % 4][1])
    lanes = network.roads[passing]
    lanes[-1] = dataclasses.replace(lanes[-1], kerb=True)
    gone = whole.sockets[removed]
    network.remove(gone)
    network.remove(reverse_road(gone))
    sockets = tuple(road for road in whole.sockets if road != gone)
    return dataclasses.replace(
        whole, sockets=sockets, arms=tuple(reverse_road(road) for road in sockets)
    )


def roundabout_block(base: RoadNetwork, entry: Road, number: int, p: dict) -> Block:
    """O: a roundabout with three exits; driven anticlockwise."""
    network = RoadNetwork()
    count, width = len(base.roads[entry]), base.roads[entry][-1].width
    exit_radius, angle = p["exit_radius"], math.radians(p["angle"])
    ring_radius = (2 * count - 1) * width + p["inner_radius"]
    inner_radius = ((2 * count - 1) * width / 2 + exit_radius) / math.cos(angle) - exit_radius
    sockets, ring = [], []
    incoming, lanes = entry, base.roads[entry]

    def tool(lane):  # a short stub that ends where `lane` starts
        return straight(lane.position(-5.0, 0.0), lane.position(0.0, 0.0), width)

    for part in range(4):
        names = [node(number, "O", part, i) for i in range(4)]
        enter, after_enter = bend(lanes[-1], 10.0, exit_radius, angle, clockwise=True)
        around, after_ring = bend(
            tool(after_enter), 10.0, ring_radius, 2 * angle - math.pi / 2, clockwise=False
        )
        leave, exit_lane = bend(tool(after_ring), EXIT_LENGTH, exit_radius, angle, clockwise=True)
        inner = bend(tool(after_ring), 5.0, inner_radius, math.pi - 2 * angle, clockwise=False)[0]
        way_out = names[2] if part < 3 else reverse_road(entry)[0]
        network.add_road((incoming[1], names[0]), enter, count)
        network.add_road((names[0], names[1]), around, count)
        network.add_road((names[1], way_out), leave, count)
        ring.append((names[0], names[1]))
        if part < 3:
            socket = (names[2], names[3])
            network.add_road(socket, exit_lane, count)
            network.add_oncoming(socket)
            sockets.append(socket)
            incoming = reverse_road(socket)
            lanes = network.roads[incoming]
        following = node(number, "O", (part + 1) % 4, 0)
        network.add_road((names[1], following), inner, count, kerb=False)
    return Block(
        kind="O",
        network=network,
        entry=entry,
        sockets=tuple(sockets),
        arms=tuple(reverse_road(road) for road in sockets),
        inner=tuple(ring),
        parameters=p,
    )


def _uniform(**ranges) -> Callable[[np.random.Generator], dict]:
    return lambda rng: {name: float(rng.uniform(*bounds)) for name, bounds in ranges.items()}


@dataclasses.dataclass(frozen=True)
class BlockKind:
    """How often a kind is drawn, how its parameters are drawn, how it is built."""

    probability: float
    draw: Callable[[np.random.Generator], dict]
    build: Callable[[RoadNetwork, Road, int, dict], Block]


BLOCK_KINDS: dict[str, BlockKind] = {
    "C": BlockKind(
        probability=0.3,
        draw=lambda rng: {
            **_uniform(length=(40, 80), radius=(25, 60), angle=(45, 135))(rng),
            "dir": int(rng.integers(2)),
        },
        build=curve_block,
    ),
    "S": BlockKind(probability=0.1, draw=_uniform(length=(40, 80)), build=straight_block),
    "r": BlockKind(
        probability=0.1,
        draw=_uniform(length=(20, 40), extension_length=(20, 40)),
        build=in_ramp_block,
    ),
    "R": BlockKind(
        probability=0.1,
        draw=_uniform(length=(20, 40), extension_length=(20, 40)),
        build=out_ramp_block,
    ),
    "X": BlockKind(probability=0.15, draw=lambda rng: {"radius": 10.0}, build=intersection_block),
    "T": BlockKind(
        probability=0.15,
        draw=lambda rng: {"radius": 10.0, "t_type": int(rng.integers(3))},
        build=t_intersection_block,
    ),
    "O": BlockKind(
        probability=0.1,
        draw=lambda rng: {
            **_uniform(exit_radius=(5, 15), inner_radius=(15, 45))(rng),
            "angle": 60.0,
        },
        build=roundabout_block,
    ),
}


def traffic_roads(block: Block, next_entry: Road | None) -> list[Road]:
    """Roads on which a block's traffic starts.

    Args:
        block: The block.
        next_entry: The socket the next block uses (its oncoming road then carries no traffic of
            this block), or None for the last block.
    """
    arms = [road for road in block.arms if next_entry is None or road != reverse_road(next_entry)]
    return [road for road in block.inner if not is_oncoming(road)] + arms
