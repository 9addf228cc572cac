"""Recorded MetaDrive scenarios as scenarios of this environment.

A recording is one `md_<number>.npz` whose `meta` (a JSON string) lists every lane, the route, the
ego's parameters, objects and traffic. Only `meta` is needed to drive on it. No pickle is read.
"""

from __future__ import annotations

import json
from pathlib import Path

from envs.driving.recorded_fields import check_description
from envs.driving.roads import EXTEND, SHRINK, STRAIGHT, Lane, RoadNetwork, arc, straight
from envs.driving.scenario import Description, ObjectSpec, VehicleSpec
from ppl_jax.npz import read_npz

_OBJECT_KINDS = {"TrafficCone": "cone", "TrafficWarning": "warning", "TrafficBarrier": "barrier"}


def recording_paths(folder: str | Path) -> list[Path]:
    """The recordings of a folder, by number.

    Raises:
        ValueError: If the folder is missing or holds no recording.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"scenarios folder {str(folder)!r} does not exist")
    paths = sorted(folder.glob("md_*.npz"))
    if not paths:
        raise ValueError(f"scenarios folder {str(folder)!r} holds no md_<number>.npz recording")
    return paths


def load_recording(path: str | Path) -> Description:
    """Read one recording.

    Raises:
        ValueError: If the file is no recording, or a field that is needed is missing.
    """
    try:
        arrays = read_npz(path)
        if "meta" not in arrays:
            raise ValueError("it has no array 'meta'")
        try:
            meta = json.loads(str(arrays["meta"]))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"its meta is no JSON ({error})") from error
        check_description(meta)
        return _describe(meta)
    except ValueError as error:
        raise ValueError(f"{path} is not a recorded scenario: {error}") from error


def load_recordings(folder: str | Path) -> list[Description]:
    """Read all recordings of a folder (see `recording_paths`).

    Raises:
        ValueError: If one is no recording, or two have the same number.
    """
    found: dict[int, tuple[Path, Description]] = {}
    for path in recording_paths(folder):
        description = load_recording(path)
        number = description.number
        if number in found:
            raise ValueError(f"{path} has scenario number {number}, which {found[number][0]} has")
        found[number] = path, description
    return [description for _, description in found.values()]


def _describe(meta: dict) -> Description:
    network = RoadNetwork()
    blocks = "".join(block["id"] for block in meta["blocks"])
    # the wedge beside each ramp: the recording tells where it lies, the block which way it closes
    tapers = iter([SHRINK if kind == "r" else EXTEND for kind in blocks if kind in "rR"])
    for entry in meta["lanes"]:
        taper = STRAIGHT
        if entry["type"] == "ExtendingLane":
            taper = next(tapers, None)
            if taper is None:
                raise ValueError("lanes hold more wedges (ExtendingLane) than blocks (r, R) have")
        network.add_lane(tuple(entry["index"][:2]), _lane(entry, taper))
    ego = meta["ego"]
    return Description(
        number=int(meta["seed"]),
        blocks=blocks,
        network=network,
        nodes=tuple(meta["checkpoints"]),
        spawn_number=int(meta["spawn_lane_index"][2]),
        engine_force=ego["max_engine_force"],
        brake_force=ego["max_brake_force"],
        wheel_friction=ego["wheel_friction"],
        objects=tuple(_object(entry) for entry in meta["objects"]),
        traffic=tuple(_vehicle(entry) for entry in meta["traffic"]),
    )


def _lane(entry: dict, taper: int) -> Lane:
    kerb = entry["line_types"][1] == "ROAD_EDGE_BOUNDARY"
    if entry["type"] == "CircularLane":
        return arc(
            entry["center"],
            entry["radius"],
            entry["start_phase"],
            entry["angle"],
            turn=entry["direction"],
            width=entry["width"],
            kerb=kerb,
        )
    return straight(entry["start"], entry["end"], entry["width"], kerb, taper=taper)


def _object(entry: dict) -> ObjectSpec:
    x, y, heading = entry["pose"]
    lane = entry.get("lane_index")
    kind = _OBJECT_KINDS.get(entry["cls"], "vehicle")
    round_kind = kind in ("cone", "warning")
    length, width = entry["length"], entry["width"]
    if kind == "barrier":  # its "length" of 2 m lies across the lane
        length, width = width, length
    return ObjectSpec(
        kind=kind,
        x=x,
        y=y,
        heading=heading,
        length=length,
        width=entry["radius"] if round_kind else width,
        lane=None if lane is None else ((lane[0], lane[1]), int(lane[2])),
    )


def _vehicle(entry: dict) -> VehicleSpec:
    road, number = tuple(entry["spawn_lane_index"][:2]), int(entry["spawn_lane_index"][2])
    return VehicleSpec(
        length=entry["length"],
        width=entry["width"],
        trigger=tuple(entry["trigger_road"]),
        lane=(road, number),
        long=entry["spawn_longitude"],
        nodes=tuple(entry["destination_checkpoints"]),
        patience=0,
        mass=entry["mass"],
        engine_force=entry["max_engine_force"],
        brake_force=entry["max_brake_force"],
    )
