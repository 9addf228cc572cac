"""What the description of a recorded scenario has to hold, and the check of one."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

Kind = Callable[[Any, str], None]
"""`kind(value, place)` raises `ValueError` with a line where the value is none of it."""


def _refuse(value: Any, place: str, allowed: str) -> None:
    text = repr(value)
    raise ValueError(
        f"{place} must be {allowed}, got {text if len(text) < 60 else text[:57] + '...'}"
    )


def _is_number(value: Any) -> bool:
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    return plain and abs(value) < 1e9 and math.isfinite(value)


def _number(value: Any, place: str) -> None:
    if not _is_number(value):
        _refuse(value, place, "a finite number")


def _positive(value: Any, place: str) -> None:
    if not (_is_number(value) and value > 0):
        _refuse(value, place, "a positive number")


def _whole(value: Any, place: str) -> None:
    if not (_is_number(value) and value >= 0 and value == int(value)):
        _refuse(value, place, "a whole number of 0 or more")


def _text(value: Any, place: str) -> None:
    if not isinstance(value, str):
        _refuse(value, place, "text")


def _one_of(*allowed: Any) -> Kind:
    def check(value: Any, place: str) -> None:
        if value not in allowed:
            _refuse(value, place, f"one of {', '.join(map(str, allowed))}")

    return check


def _list_of(kind: Kind, least: int = 0) -> Kind:
    def check(value: Any, place: str) -> None:
        if not isinstance(value, list) or len(value) < least:
            _refuse(value, place, f"a list of at least {least}" if least else "a list")
        for i, one in enumerate(value):
            kind(one, f"{place}[{i}]")

    return check


def _row_of(*kinds: Kind) -> Kind:
    def check(value: Any, place: str) -> None:
        if not isinstance(value, list) or len(value) != len(kinds):
            _refuse(value, place, f"a list of {len(kinds)}")
        for i, (kind, one) in enumerate(zip(kinds, value, strict=True)):
            kind(one, f"{place}[{i}]")

    return check


def _object(**fields: Kind) -> Kind:
    def check(value: Any, place: str) -> None:
        if not isinstance(value, dict):
            _refuse(value, place, "an object")
        for name, kind in fields.items():
            if name not in value:
                raise ValueError(f"{place} lacks {name!r}")
            kind(value[name], f"{place}.{name}".removeprefix("meta."))

    return check


_POINT = _row_of(_number, _number)
_LANE_INDEX = _row_of(_text, _text, _whole)
_ANY_LANE = {"index": _LANE_INDEX, "width": _positive, "line_types": _row_of(_text, _text)}
_LANES = {
    "StraightLane": _object(**_ANY_LANE, start=_POINT, end=_POINT),
    "ExtendingLane": _object(**_ANY_LANE, start=_POINT, end=_POINT),
    "CircularLane": _object(
        **_ANY_LANE,
        center=_POINT,
        radius=_positive,
        start_phase=_number,
        angle=_positive,
        direction=_one_of(1, -1),
    ),
}


def _lane(value: Any, place: str) -> None:
    _object(type=_one_of(*_LANES))(value, place)
    _LANES[value["type"]](value, place)
    if value.get("start", 0) == value.get("end", 1):
        _refuse(value["end"], f"{place}.end", "another point than start")


def _thing(value: Any, place: str) -> None:
    pose = _row_of(_number, _number, _number)
    _object(cls=_text, pose=pose, length=_positive, width=_positive)(value, place)
    if value["cls"] in ("TrafficCone", "TrafficWarning"):
        _object(radius=_positive)(value, place)
    if value.get("lane_index") is not None:
        _LANE_INDEX(value["lane_index"], f"{place}.lane_index")


_DESCRIPTION = _object(
    seed=_whole,
    blocks=_list_of(_object(id=_text), least=1),
    checkpoints=_list_of(_text, least=2),
    spawn_lane_index=_LANE_INDEX,
    ego=_object(max_engine_force=_positive, max_brake_force=_positive, wheel_friction=_positive),
    lanes=_list_of(_lane, least=1),
    objects=_list_of(_thing),
    traffic=_list_of(
        _object(
            length=_positive,
            width=_positive,
            mass=_positive,
            max_engine_force=_positive,
            max_brake_force=_positive,
            trigger_road=_row_of(_text, _text),
            spawn_lane_index=_LANE_INDEX,
            spawn_longitude=_number,
            destination_checkpoints=_list_of(_text, least=2),
        )
    ),
)


def check_description(meta: Any) -> None:
    """Check a recording's `meta`; fields beside those that are needed may be anything.

    Raises:
        ValueError: One line naming the field, its place, what was found and what is allowed; or a
            road or lane that the map lacks.
    """
    _DESCRIPTION(meta, "meta")
    lanes: dict[tuple[str, str], int] = {}
    for entry in meta["lanes"]:
        road = tuple(entry["index"][:2])
        lanes[road] = lanes.get(road, 0) + 1

    def known_road(road: tuple[str, str], place: str) -> None:
        if road not in lanes:
            raise ValueError(f"{place} uses the road {list(road)}, which no lane is of")

    def known_lane(index: list[Any], place: str) -> None:
        known_road((index[0], index[1]), place)
        if index[2] >= lanes[index[0], index[1]]:
            _refuse(index[2], f"{place}[2]", f"below {lanes[index[0], index[1]]}, the road's lanes")

    def known_way(nodes: list[str], place: str) -> None:
        for i, road in enumerate(zip(nodes[:-1], nodes[1:], strict=True)):
            known_road(road, f"{place}[{i}]")

    known_way(meta["checkpoints"], "checkpoints")
    known_lane([*meta["checkpoints"][:2], meta["spawn_lane_index"][2]], "spawn_lane_index")
    for i, vehicle in enumerate(meta["traffic"]):
        known_lane(vehicle["spawn_lane_index"], f"traffic[{i}].spawn_lane_index")
        known_way(vehicle["destination_checkpoints"], f"traffic[{i}].destination_checkpoints")
    for i, thing in enumerate(meta["objects"]):
        if thing.get("lane_index") is not None:
            known_lane(thing["lane_index"], f"objects[{i}].lane_index")
