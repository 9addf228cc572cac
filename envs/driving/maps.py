"""Numbered scenarios, generated in NumPy: blocks, route, accident scenes, traffic.

Probabilities and ranges are MetaDrive 0.4.3's; the random numbers are this module's own, so
scenario 1000 here is not map 1000 there.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from envs.driving.blocks import BLOCK_KINDS, Block, first_block, traffic_roads
from envs.driving.roads import (
    DECORATION,
    FIRST_NODES,
    Lane,
    Road,
    RoadNetwork,
    is_oncoming,
    reverse_road,
)
from envs.driving.scenario import SIDEWALK, Description, ObjectSpec, VehicleSpec

ENGINE_FORCE, BRAKE_FORCE, WHEEL_FRICTION = (750.0, 850.0), (80.0, 180.0), 0.9
VEHICLE_GAP = 10.0  # m between places where traffic may start
_TRIALS = 5  # draws of a block's parameters before the block before it is drawn again


@dataclasses.dataclass(frozen=True)
class _Model:
    """A kind of traffic vehicle: share, size in m, kg, ranges of engine and brake force."""

    share: float
    length: float
    width: float
    mass: float
    engine: tuple[float, float]
    brake: tuple[float, float]


_MODELS = (
    _Model(share=0.2, length=4.3, width=1.7, mass=800.0, engine=(350.0, 550.0), brake=(35.0, 80.0)),
    _Model(
        share=0.3, length=4.6, width=1.85, mass=1200.0, engine=(650.0, 850.0), brake=(60.0, 150.0)
    ),
    _Model(
        share=0.3, length=4.87, width=2.046, mass=1300.0, engine=(450.0, 650.0), brake=(60.0, 120.0)
    ),
    _Model(
        share=0.2, length=5.74, width=2.3, mass=1600.0, engine=(500.0, 700.0), brake=(50.0, 100.0)
    ),
)


@dataclasses.dataclass(frozen=True)
class MapSettings:
    """Settings of generated maps.

    Attributes:
        blocks: Number of blocks after the first.
        lanes: Lanes per direction.
        lane_width: m.
        traffic_density: Vehicles per 10 m of lane.
        accident_probability: Probability of an accident scene on each block without junctions.
        kinds: Letters of the block kinds to draw from, with their usual relative probabilities.
    """

    blocks: int = 3
    lanes: int = 3
    lane_width: float = 3.5
    traffic_density: float = 0.06
    accident_probability: float = 0.8
    kinds: str = "CSrRXTO"

    def __post_init__(self):
        if self.blocks < 1:
            raise ValueError(f"blocks must be at least 1, got {self.blocks}")
        if not 1 <= self.lanes <= 4:
            raise ValueError(f"lanes must be 1 to 4, got {self.lanes}")
        if not 3.0 <= self.lane_width <= 4.5:
            raise ValueError(f"lane_width must be 3.0 to 4.5 m, got {self.lane_width}")
        if self.traffic_density < 0:
            raise ValueError(f"traffic_density must not be negative, got {self.traffic_density}")
        if not 0 <= self.accident_probability <= 1:
            raise ValueError(
                f"accident_probability must be in [0, 1], got {self.accident_probability}"
            )
        if not self.kinds or set(self.kinds) - set(BLOCK_KINDS):
            raise ValueError(f"kinds must be letters of {''.join(BLOCK_KINDS)}, got {self.kinds!r}")


def generate(number: int, settings: MapSettings | None = None) -> Description:
    """Scenario `number`. Equal arguments give equal scenarios."""
    settings = settings or MapSettings()
    rng = np.random.default_rng([number, 2025])
    blocks, network = _draw_blocks(rng, settings)
    goal = blocks[-1].sockets[rng.integers(len(blocks[-1].sockets))][1]
    nodes = network.shortest_route(FIRST_NODES[0], goal)
    if nodes is None:
        raise RuntimeError(f"scenario {number}: no route to {goal}")  # a bug in the blocks
    objects, closed = _accidents(rng, blocks, network, settings)
    return Description(
        number=number,
        blocks="".join(block.kind for block in blocks),
        network=network,
        nodes=tuple(nodes),
        spawn_number=int(rng.integers(settings.lanes)),
        engine_force=float(rng.uniform(*ENGINE_FORCE)),
        brake_force=float(rng.uniform(*BRAKE_FORCE)),
        wheel_friction=WHEEL_FRICTION,
        objects=tuple(objects),
        traffic=tuple(_traffic(rng, blocks, network, closed, settings=settings)),
    )


def _draw_blocks(
    rng: np.random.Generator, settings: MapSettings
) -> tuple[list[Block], RoadNetwork]:
    """Blocks that do not cross one another, and the network they make.

    As in MetaDrive's search, a block that crosses keeps its kind and socket and has its parameters
    drawn again, five times at most; then the block before it is drawn again.
    """
    kinds = [kind for kind in BLOCK_KINDS if kind in settings.kinds]
    weights = np.array([BLOCK_KINDS[kind].probability for kind in kinds])
    start = first_block(settings.lanes, settings.lane_width)
    blocks, networks = [start], [start.network]
    while len(blocks) <= settings.blocks:
        kind = BLOCK_KINDS[kinds[rng.choice(len(kinds), p=weights / weights.sum())]]
        entry = blocks[-1].sockets[rng.integers(len(blocks[-1].sockets))]
        for _ in range(_TRIALS):
            block = kind.build(networks[-1], entry, len(blocks), kind.draw(rng))
            if not _crosses(networks[-1], block.network):
                blocks.append(block)
                networks.append(networks[-1].merged(block.network))
                break
        else:
            if len(blocks) > 1:
                blocks.pop()
                networks.pop()
    return blocks, networks[-1]


def _crosses(base: RoadNetwork, new: RoadNetwork) -> bool:
    """Whether any new lane (with its sidewalk) lies on a lane that is there already."""
    points = []
    for road, lanes in new.roads.items():
        if road == DECORATION:
            continue
        for lane in lanes:
            longs = np.arange(1.0, lane.length - 0.5, 1.0)
            edge = lane.width / 2 + (SIDEWALK[1] if lane.kerb else -0.1)
            points += [lane.positions(longs, 0.0), lane.positions(longs, edge)]
    cloud = np.concatenate(points)
    return any(lane.contains(cloud).any() for lanes in base.roads.values() for lane in lanes)


def _accidents(
    rng: np.random.Generator, blocks: list[Block], network: RoadNetwork, settings: MapSettings
) -> tuple[list[ObjectSpec], set[tuple[Road, int]]]:
    """Accident scenes, and the lanes they stand on.

    On each S, C, r and R block with the accident probability: in one case of three a cone line
    that closes the outermost lane on either side, else a broken-down vehicle with a warning
    triangle 10 m before it, or a barrier. Source: `manager/object_manager.py`.
    """
    objects: list[ObjectSpec] = []
    closed: set[tuple[Road, int]] = set()
    for block in blocks:
        if not block.accident_roads or rng.random() > settings.accident_probability:
            continue
        is_ramp = block.kind in "rR"
        roads = block.accident_roads
        with_cones = rng.random() > 0.67
        if with_cones and block.kind == "C":
            road = roads[1]
        else:
            road = roads[rng.integers(len(roads))]
        lanes = network.roads[road]
        on_left = rng.random() > 0.5 or (is_ramp and road == roads[-1])
        if with_cones:
            number = 0 if on_left else len(lanes) - 1
            objects += _cones(lanes[number], (road, number), on_left)
        else:
            number = len(lanes) - 1
            if on_left and len(lanes) > 1:
                number = int(rng.integers(0, len(lanes) - 1))
            lane = lanes[number]
            long = (0.5 + rng.random() / 2) * lane.length
            if rng.random() > 0.5:
                model = _draw_model(rng)
                objects.append(
                    _placed(
                        "vehicle",
                        lane,
                        (road, number),
                        long,
                        length=model.length,
                        width=model.width,
                    )
                )
                objects.append(
                    _placed("warning", lane, (road, number), long - 10.0, length=0.5, width=0.5)
                )
            else:
                objects.append(
                    _placed("barrier", lane, (road, number), long, length=0.3, width=2.0)
                )
        closed.add((road, number))
    return objects, closed


def _placed(
    kind: str,
    lane: Lane,
    name: tuple[Road, int],
    long: float,
    *,
    length: float,
    width: float,
    lateral: float = 0.0,
) -> ObjectSpec:
    x, y = lane.position(long, lateral)
    return ObjectSpec(
        kind=kind,
        x=float(x),
        y=float(y),
        heading=lane.heading_at(long),
        length=length,
        width=width,
        lane=name,
    )


def _cones(lane: Lane, name: tuple[Road, int], on_left: bool) -> list[ObjectSpec]:
    """Twelve cones, 2 m apart, in from the road's edge by a metre each, along, and back out."""
    across = int(lane.width)
    offsets = [*range(across), *[across] * 6, *reversed(range(across))]
    first = -(len(offsets) // 2)
    middle = lane.length - 15.0
    sign = 1.0 if on_left else -1.0
    return [
        _placed(
            "cone",
            lane,
            name,
            middle + 2.0 * (first + i),
            length=0.2,
            width=0.2,
            lateral=sign * (offset - lane.width / 2),
        )
        for i, offset in enumerate(offsets)
    ]


def _draw_model(rng: np.random.Generator) -> _Model:
    return _MODELS[rng.choice(len(_MODELS), p=[model.share for model in _MODELS])]


def _traffic(
    rng: np.random.Generator,
    blocks: list[Block],
    network: RoadNetwork,
    closed: set[tuple[Road, int]],
    *,
    settings: MapSettings,
) -> list[VehicleSpec]:
    """Vehicles of each block, on places 10 m apart, woken when the ego is on the road before it.

    Their number is floor(floor(total lane length / 10 m) x density). Those that drive the ego's
    way go on to one of the last block's exits, oncoming ones back to the first block. Source:
    `manager/traffic_manager.py`.
    """
    vehicles: list[VehicleSpec] = []
    for i, block in enumerate(blocks[1:], 1):
        next_entry = blocks[i + 1].entry if i + 1 < len(blocks) else None
        places, total = [], 0.0
        for road in traffic_roads(block, next_entry):
            for number, lane in enumerate(network.roads[road]):
                total += lane.length
                if (road, number) not in closed:
                    slots = int(lane.length / VEHICLE_GAP)
                    places += [(road, number, VEHICLE_GAP * slot) for slot in range(slots)]
        count = int(int(total / VEHICLE_GAP) * settings.traffic_density)
        for j in rng.permutation(len(places))[:count]:
            road, number, long = places[j]
            nodes = _way(rng, blocks, network, road)
            if nodes is not None:
                model = _draw_model(rng)
                vehicles.append(
                    VehicleSpec(
                        length=model.length,
                        width=model.width,
                        trigger=block.entry,
                        lane=(road, number),
                        long=long,
                        nodes=nodes,
                        patience=int(rng.integers(50)),
                        mass=model.mass,
                        engine_force=float(rng.uniform(*model.engine)),
                        brake_force=float(rng.uniform(*model.brake)),
                    )
                )
    return vehicles


def _way(
    rng: np.random.Generator, blocks: list[Block], network: RoadNetwork, road: Road
) -> tuple[str, ...] | None:
    """Nodes from `road` to where its traffic is bound, or None if there is no way."""
    if is_oncoming(road):
        goal = reverse_road(blocks[0].sockets[0])[1]
    else:
        goal = blocks[-1].sockets[rng.integers(len(blocks[-1].sockets))][1]
    if road[1] == goal:
        return road
    rest = network.shortest_route(road[1], goal)
    return None if rest is None else (road[0], *rest)
