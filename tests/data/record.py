"""Makes the two recordings beside this file: `python -m tests.data.record`.

`md_1021.npz` and `wipe_1002.npz` are of our OWN environments, driven by their scripted experts, in
the format of the recordings of MetaDrive and robosuite that the fidelity figures are taken from.
They say nothing about those simulators. They show that the code behind the figures is sound: held
against them, the environments must agree with themselves.

Only what the readers read is written: `envs.driving.recorded`, `envs.driving.fidelity` and
`envs.manipulation.fidelity`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.compiler import set_xla_flags
from envs.driving import traffic
from envs.driving.fidelity import SEEN_AHEAD
from envs.driving.make import make_driving
from envs.driving.maps import generate
from envs.driving.roads import STRAIGHT, Lane, Road
from envs.driving.scenario import Description, ObjectSpec, VehicleSpec, tree_index
from envs.driving.vehicle import MASS
from envs.manipulation.make import make_table_wiping
from envs.manipulation.scenes.model import WIPING_TABLE

FOLDER = Path(__file__).parent
DRIVING_NUMBER, DRIVING_STEPS = 1021, 120  # every kind of object, a bend, a ramp, moving traffic
WIPING_NUMBER, WIPING_STEPS = 1002, 40  # 41 of the 100 markers are wiped in them
_CLASSES = {"cone": "TrafficCone", "warning": "TrafficWarning", "barrier": "TrafficBarrier"}
_ROUND = ("cone", "warning")


def rollout(env: Any, steps: int) -> tuple[Any, np.ndarray, np.ndarray, Any]:
    """The scripted expert's first steps in the first held-out scenario.

    Returns:
        States and observations, [T + 1], actions and outcomes, [T].

    Raises:
        ValueError: If the episode ends before, or becomes unsafe.
    """
    key, params = jax.random.key(0), env.held_out_params

    def step(state: Any, _: None) -> Any:
        observation = env.observe(state, params)
        action = jnp.clip(env.scripted_expert(key, state, observation, params), -1.0, 1.0)
        after, outcome = env.transition(key, state, action, params)
        return after, (after, env.observe(after, params), action, outcome)

    @jax.jit
    def roll() -> Any:
        start = env.reset_to(jnp.int32(0), key, params)
        rows = jax.lax.scan(step, start, None, length=steps)[1]
        return start, env.observe(start, params), rows

    start, first, (states, observations, actions, outcomes) = roll()
    if bool(jnp.any(outcomes.unsafe | outcomes.terminated)):
        raise ValueError(f"the expert does not keep going safely for {steps} steps")
    states, observations = jax.tree.map(
        lambda one, rest: np.concatenate([one[None], rest]),
        (start, first),
        (states, observations),
    )
    return states, observations, np.asarray(actions), outcomes


def _lane(road: Road, number: int, lane: Lane) -> dict:
    entry = {
        "index": [*road, number],
        "width": lane.width,
        "line_types": ["", "ROAD_EDGE_BOUNDARY" if lane.kerb else ""],
    }
    if lane.turn:
        return entry | {
            "type": "CircularLane",
            "center": lane.center.tolist(),
            "radius": lane.radius,
            "start_phase": float(lane.phase),
            "angle": lane.angle,
            "direction": lane.turn,
        }
    return entry | {
        "type": "StraightLane" if lane.taper == STRAIGHT else "ExtendingLane",
        "start": lane.start.tolist(),
        "end": lane.end.tolist(),
    }


def _object(thing: ObjectSpec) -> dict:
    length, width = thing.length, thing.width
    if thing.kind == "barrier":  # its "length" lies across the lane
        length, width = width, length
    pose = [thing.x, thing.y, thing.heading]
    entry = {
        "cls": _CLASSES.get(thing.kind, "DefaultVehicle"),
        "length": length,
        "width": width,
        "pose": pose,
        "pose_end": pose,  # nothing is hit
        "lane_index": None if thing.lane is None else [*thing.lane[0], thing.lane[1]],
    }
    return entry | ({"radius": width} if thing.kind in _ROUND else {})


def _vehicle(vehicle: VehicleSpec) -> dict:
    return {
        "length": vehicle.length,
        "width": vehicle.width,
        "mass": vehicle.mass,
        "max_engine_force": vehicle.engine_force,
        "max_brake_force": vehicle.brake_force,
        "trigger_road": vehicle.trigger,
        "spawn_lane_index": [*vehicle.lane[0], vehicle.lane[1]],
        "spawn_longitude": vehicle.long,
        "destination_checkpoints": vehicle.nodes,
    }


def describe(d: Description) -> dict:
    """The recording's `meta` of a scenario: what `load_recording` makes a scenario of again."""
    return {
        "seed": d.number,
        "blocks": [{"id": kind} for kind in d.blocks],
        "checkpoints": d.nodes,
        "spawn_lane_index": [*d.nodes[:2], d.spawn_number],
        "ego": {
            "mass": MASS,
            "max_engine_force": d.engine_force,
            "max_brake_force": d.brake_force,
            "wheel_friction": d.wheel_friction,
        },
        "lanes": [
            _lane(road, number, lane)
            for road, lanes in d.network.roads.items()
            for number, lane in enumerate(lanes)
        ],
        "objects": [_object(thing) for thing in d.objects],
        "traffic": [_vehicle(vehicle) for vehicle in d.traffic],
    }


def driving(number: int = DRIVING_NUMBER, steps: int = DRIVING_STEPS) -> dict[str, np.ndarray]:
    """A drive without contacts, from the start.

    MetaDrive's rays meet traffic one substep ahead of the recorded poses. So the poses recorded
    here lie one substep behind those that our rays meet.
    """
    env = make_driving(training=[number], held_out=[number])
    states, observations, actions, outcomes = rollout(env, steps)
    description = generate(number)
    names = [
        [*road, lane]
        for road, lanes in description.network.roads.items()
        for lane in range(len(lanes))
    ]
    meta = describe(description)
    meta["lane_index_per_step"] = [names[i] for i in states.navigation.lane]
    ego = states.ego
    scenario = tree_index(env.held_out_params.scenarios, 0)
    pose = np.array(jax.vmap(lambda cars: traffic.poses(scenario, cars))(states.traffic))
    forward = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], -1)
    velocity = states.traffic.speed[..., None] * forward
    pose[..., :2] -= SEEN_AHEAD * velocity
    cars = np.concatenate([pose, velocity, states.traffic.status[..., None]], -1)
    nav = np.full((steps + 1, 8), np.nan)
    nav[:, 5] = states.navigation.road  # the only column that is read
    return {
        "meta": np.array(json.dumps(meta)),
        "ego": np.concatenate([ego.pose, ego.velocity, ego.yaw_rate[:, None], ego.action], -1),
        "traffic": cars[:, : len(description.traffic)].astype(np.float32),
        "nav": nav.astype(np.float32),
        "obs": observations,
        "action": actions,
        "reward": np.asarray(outcomes.reward),
        "flags": np.zeros((steps, 7), bool),  # `rollout` sees to it
    }


def wiping(number: int = WIPING_NUMBER, steps: int = WIPING_STEPS) -> dict[str, np.ndarray]:
    """The way down to the table, the landing and the first wipes."""
    numbers = range(number, number + 1)
    states, observations, actions, outcomes = rollout(make_table_wiping(numbers, numbers), steps)
    markers = np.asarray(states.markers[0])
    return {
        "qpos": states.joints,
        "qvel": states.speeds,
        "qacc_warmstart": states.acceleration,
        "goal_ori": states.goal_rotation.swapaxes(1, 2),
        "ee_force": states.force,
        "force_bias": states.force_bias,
        "marker_pos": np.pad(markers, ((0, 0), (0, 1)), constant_values=WIPING_TABLE[2]),
        "wiped": states.wiped,
        "timestep": states.time,
        "obs": observations,
        "action": actions,
        "reward": np.asarray(outcomes.reward),
    }


def main() -> None:
    """Write both recordings."""
    for name, arrays in (
        (f"md_{DRIVING_NUMBER}.npz", driving()),
        (f"wipe_{WIPING_NUMBER}.npz", wiping()),
    ):
        np.savez_compressed(FOLDER / name, **arrays)
        print(f"{name}: {(FOLDER / name).stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    set_xla_flags()
    main()
