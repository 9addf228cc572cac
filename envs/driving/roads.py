"""Lanes and road networks in NumPy: what map generation and recorded maps are made of.

Frame: x forward, y left, metres and radians; a lane's lateral coordinate grows to its RIGHT.
Node names and lane numbering (0 is the leftmost lane of a road) are MetaDrive's.
"""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np

Road = tuple[str, str]

FIRST_NODES = (">", ">>", ">>>")
DECORATION: Road = ("decoration", "decoration_")

STRAIGHT, SHRINK, EXTEND = 0, 1, 2  # how a lane's width varies along it


@dataclasses.dataclass(frozen=True)
class Lane:
    """One lane: a straight line (`turn == 0`) or a circular arc.

    Attributes:
        start, end: Centre line ends, m, shape [2].
        length: Centre line length, m.
        width: m.
        turn: 0 straight, +1 anticlockwise, -1 clockwise.
        center, radius, phase, angle: An arc: m, m, rad (position of the start seen from the
            centre), rad (> 0).
        kerb: Whether a sidewalk runs along the right edge.
        taper: STRAIGHT, SHRINK or EXTEND: a constant width, or one that ends or begins at zero.
    """

    start: np.ndarray
    end: np.ndarray
    length: float
    width: float
    turn: int = 0
    center: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))
    radius: float = 0.0
    phase: float = 0.0
    angle: float = 0.0
    kerb: bool = False
    taper: int = STRAIGHT

    def heading_at(self, long: float) -> float:
        """Heading of the centre line at `long`, rad."""
        if self.turn == 0:
            return float(np.arctan2(*(self.end - self.start)[::-1]))
        return self.phase + self.turn * (long / self.radius + np.pi / 2)

    def position(self, long: float, lateral: float) -> np.ndarray:
        """World position of the point (`long`, `lateral`), m, shape [2]."""
        return self.positions(np.array([long]), lateral)[0]

    def positions(self, longs: np.ndarray, lateral: float) -> np.ndarray:
        """World positions of many points at one lateral, [N] -> [N, 2]."""
        if self.turn == 0:
            forward = (self.end - self.start) / self.length
            right = np.array([forward[1], -forward[0]])
            return self.start + longs[:, None] * forward + lateral * right
        phi = self.turn * longs / self.radius + self.phase
        circle = np.stack([np.cos(phi), np.sin(phi)], -1)
        return self.center + (self.radius + lateral * self.turn) * circle

    def local(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(long, lateral) of world points, shapes [..., 2] -> [...], [...]."""
        if self.turn == 0:
            forward = (self.end - self.start) / self.length
            delta = points - self.start
            return delta @ forward, delta @ np.array([forward[1], -forward[0]])
        delta = points - self.center
        phi = self.turn * (np.arctan2(delta[..., 1], delta[..., 0]) - self.phase) - self.angle / 2
        long = ((phi + np.pi) % (2 * np.pi) - np.pi + self.angle / 2) * self.radius
        return long, self.turn * (np.hypot(delta[..., 0], delta[..., 1]) - self.radius)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which world points lie on the lane, shapes [..., 2] -> [...] bool."""
        long, lateral = self.local(points)
        return (long >= 0) & (long <= self.length) & (np.abs(lateral) <= self.width / 2)


def straight(start, end, width: float, kerb: bool = False, *, taper: int = STRAIGHT) -> Lane:
    """A straight lane between two points."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    return Lane(
        start=start,
        end=end,
        length=float(np.hypot(*(end - start))),
        width=width,
        kerb=kerb,
        taper=taper,
    )


def arc(center, radius: float, phase: float, angle: float, *, turn: int, width: float, kerb=False):
    """A circular lane; `turn` is +1 anticlockwise, -1 clockwise."""
    center = np.asarray(center, float)

    def point(phi):
        return center + radius * np.array([np.cos(phi), np.sin(phi)])

    return Lane(
        start=point(phase),
        end=point(phase + turn * angle),
        length=radius * angle,
        width=width,
        turn=turn,
        center=center,
        radius=radius,
        phase=phase,
        angle=angle,
        kerb=kerb,
    )


def extend(lane: Lane, length: float, kerb: bool = False) -> Lane:
    """The straight lane that carries `lane` on for `length` m."""
    return straight(lane.end, lane.position(lane.length + length, 0.0), lane.width, kerb)


def bend(lane: Lane, length: float, radius: float, angle: float, *, clockwise: bool, kerb=False):
    """An arc that leaves the end of a straight lane, and the straight of `length` m after it."""
    sign = 1 if clockwise else -1
    right = lane.position(0.0, 1.0) - lane.position(0.0, 0.0)
    center = lane.position(lane.length, sign * radius)
    phase = np.arctan2(right[1], right[0]) + (np.pi if clockwise else 0.0)
    curve = arc(center, radius, phase, angle, turn=-sign, width=lane.width, kerb=kerb)
    heading = curve.heading_at(curve.length)
    forward = np.array([np.cos(heading), np.sin(heading)])
    return curve, straight(curve.end, curve.end + length * forward, lane.width, kerb)


def beside(lane: Lane, offset: float, kerb: bool) -> Lane:
    """The parallel lane `offset` m to the right (negative: left)."""
    if lane.turn == 0:
        return straight(
            lane.position(0.0, offset), lane.position(lane.length, offset), lane.width, kerb
        )
    return arc(
        lane.center,
        lane.radius + offset * lane.turn,
        lane.phase,
        lane.angle,
        turn=lane.turn,
        width=lane.width,
        kerb=kerb,
    )


def reverse_road(road: Road) -> Road:
    """The oncoming road's name: nodes swapped, each with its minus sign toggled."""

    def toggle(node):
        return node[1:] if node.startswith("-") else "-" + node

    return toggle(road[1]), toggle(road[0])


def is_oncoming(road: Road) -> bool:
    """Whether a road belongs to the oncoming direction."""
    return road[0].startswith("-") or road[1].startswith("-")


class RoadNetwork:
    """Roads by name, each a list of lanes from left to right."""

    def __init__(self, roads: dict[Road, list[Lane]] | None = None):
        self.roads: dict[Road, list[Lane]] = roads if roads is not None else {}

    def add_lane(self, road: Road, lane: Lane) -> None:
        """Append a lane on the right of a road (made when new)."""
        self.roads.setdefault(road, []).append(lane)

    def add_road(self, road: Road, lane: Lane, count: int, *, leftward=True, kerb=True) -> None:
        """Add `count` parallel lanes starting from `lane`.

        `lane` becomes the rightmost one (`leftward`) or the leftmost. The rightmost lane gets
        the kerb.
        """
        step = -lane.width if leftward else lane.width
        lanes = [beside(lane, i * step, False) for i in range(count)]
        if leftward:
            lanes.reverse()
        lanes[-1] = dataclasses.replace(lanes[-1], kerb=kerb)
        for item in lanes:
            self.add_lane(road, item)

    def add_oncoming(self, road: Road, kerb=True) -> None:
        """Add the oncoming twin of `road`, mirrored about its left edge."""
        lanes = self.roads[road]
        last = lanes[-1]
        offset = -(2 * len(lanes) - 1) * last.width
        if last.turn == 0:
            lane = straight(
                last.position(last.length, offset), last.position(0.0, offset), last.width
            )
        else:
            lane = arc(
                last.center,
                last.radius + offset * last.turn,
                last.phase + last.turn * last.angle,
                last.angle,
                turn=-last.turn,
                width=last.width,
            )
        self.add_road(reverse_road(road), lane, len(lanes), kerb=kerb)

    def remove(self, road: Road) -> None:
        """Remove a road if it is there."""
        self.roads.pop(road, None)

    def merged(self, other: RoadNetwork) -> RoadNetwork:
        """A new network with the roads of both."""
        roads = {road: list(lanes) for road, lanes in self.roads.items()}
        for road, lanes in other.roads.items():
            roads.setdefault(road, []).extend(lanes)
        return RoadNetwork(roads)

    def shortest_route(self, start: str, goal: str) -> list[str] | None:
        """Nodes of a route with the fewest roads, or None."""
        successors: dict[str, list[str]] = {}
        for origin, target in self.roads:
            successors.setdefault(origin, []).append(target)
        queue, seen = deque([[start]]), {start}
        while queue:
            path = queue.popleft()
            if path[-1] == goal:
                return path
            for node in successors.get(path[-1], []):
                if node not in seen:
                    seen.add(node)
                    queue.append([*path, node])
        return None
