"""How close this environment is to recorded MetaDrive: `python -m envs.driving.fidelity DIR`.

Prints one JSON object for a folder of recordings (`md_<number>.npz`, and `neural_expert.npz` for
`expert_success`):

- `obs_max_abs_error`: values 0-18 but 7, from the recorded ego, traffic and navigation state; the
  second after a contact is left out: the car rocks on its springs then, and the recording does not
  hold its tilt;
- `lidar_mean_abs_error`: values 19-258, likewise;
- `position_error_1s_median`, `position_error_1s_p95`: m, after replaying ten recorded actions from
  every recorded state; windows with a contact are left out;
- `reward_agreement`: share of steps whose reward agrees within 0.05;
- `expert_success`: of the recorded neural expert on the 50 held-out scenarios of this environment
  (null without its file).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from envs.driving import env as driving
from envs.driving import navigation as nav
from envs.driving import observation as obs
from envs.driving import vehicle
from envs.driving.geometry import lane_coordinates, on_lanes
from envs.driving.make import make_driving
from envs.driving.recorded import load_recording, recording_paths
from envs.driving.scenario import Capacity, Scenario, pack

WINDOW = 10  # steps of a replay
SEEN_AHEAD = vehicle.SUBSTEP  # s: the recorded rays meet traffic one substep past its pose
PUSH_RANGE = 8.0  # m: a broken-down vehicle this near may be the one that was hit
_EXPERT_FILE = "neural_expert.npz"
_COMPARED = np.array([i for i in range(19) if i != 7])


class Recording:
    """Arrays of one recording, padded in time so that all share compiled functions."""

    def __init__(self, path: Path, capacity: Capacity, steps: int):
        description = load_recording(path)
        self.scenario: Scenario = jax.tree.map(jnp.asarray, pack(description, capacity))
        with np.load(path) as z:
            meta = json.loads(str(z["meta"]))
            self.steps = len(z["action"])

            def padded(array, size):
                return np.concatenate([array, np.repeat(array[-1:], size - len(array), 0)]).astype(
                    np.float32
                )

            self.ego = padded(z["ego"], steps + 1)
            self.action = padded(z["action"], steps)
            self.reward = padded(z["reward"], steps)
            self.obs = padded(z["obs"], steps + 1)
            self.flags = z["flags"]
            road = padded(z["nav"][:, 5], steps + 1).astype(np.int32)
            count = z["traffic"].shape[1]
            traffic = np.full((steps + 1, capacity.vehicles, 6), 0.0, np.float32)
            if count:
                traffic[:, :count] = padded(z["traffic"], steps + 1)
        lanes = {}
        for road_name, members in description.network.roads.items():
            for number in range(len(members)):
                lanes[*road_name, number] = len(lanes)
        lane = np.array([lanes[a, b, int(k)] for a, b, k in meta["lane_index_per_step"]], np.int32)
        lane = np.concatenate([lane, np.repeat(lane[-1:], steps + 1 - len(lane))])
        self.road, self.lane, self.traffic = road, lane, traffic
        self.boxes = self._box_poses(meta["objects"], steps)

    def _box_poses(self, objects: list[dict], steps: int) -> np.ndarray:
        """Poses of broken-down vehicles and barriers over time, [steps + 1, K, 3].

        The recording holds where a vehicle that was hit stood before and after; between the first
        and the last contact near it, it is taken to slide evenly.
        """
        start = np.asarray(self.scenario.objects.box_pose)
        poses = np.repeat(start[None], steps + 1, 0)
        # cones and warnings are round; the radius of a barrier, a box, is recorded as 0
        ends = [entry.get("pose_end") for entry in objects if not entry.get("radius")]
        for i, end in enumerate(ends):
            if end is None or np.hypot(*(np.array(end[:2]) - start[i, :2])) < 0.02:
                continue
            distance = np.hypot(*(self.ego[1 : self.steps + 1, :2] - start[i, :2]).T)
            hits = np.flatnonzero(self.flags[:, 2] & (distance < PUSH_RANGE)) + 1
            if len(hits):
                span = max(hits[-1] - hits[0], 1)
                share = np.clip((np.arange(steps + 1) - hits[0]) / span, 0.0, 1.0)[:, None]
                poses[:, i] = start[i] + share * (np.array(end) - start[i])
        return poses


def _navigation(lane: jax.Array, road: jax.Array) -> nav.Navigation:
    zero = jnp.zeros((), jnp.float32)
    return nav.Navigation(road=road, lane=lane, travelled=zero, last_long=zero)


def _ego(ego: jax.Array, before: jax.Array, action: jax.Array) -> vehicle.Ego:
    placed = vehicle.place(ego[:3], ego[3:5], ego[5], action)
    return dataclasses.replace(placed, last_pose=before[:3])


def _edges(scenario: Scenario, lane: jax.Array, road: jax.Array, pose: jax.Array):
    long, lateral = lane_coordinates(scenario.lanes, pose[:2])
    width = scenario.lanes.width[lane]
    left = lateral[scenario.route_lane[road]] + width / 2
    return long, lateral, left, scenario.route_size[road] * width - left


@jax.jit
@jax.vmap
def _observe(scenario, ego, before, action, *, lane, road, traffic, boxes):
    def one(ego, before, action, lane, road, traffic, boxes):
        _, lateral, left, right = _edges(scenario, lane, road, ego[:3])
        features = obs.ego_features(
            scenario,
            _ego(ego, before, action),
            _navigation(lane, road),
            left=left,
            right=right,
            lateral=lateral[lane],
        )
        traffic_pose = traffic[:, :3].at[:, :2].add(SEEN_AHEAD * traffic[:, 3:5])
        rays = obs.lidar_reading(
            scenario,
            ego[:3],
            traffic_pose=traffic_pose,
            present=traffic[:, 5] > 0,
            box_pose=boxes,
        )
        return jnp.concatenate([features, rays])

    return jax.vmap(one)(ego, before, action, lane, road, traffic, boxes)


@jax.jit
@jax.vmap
def _reward(scenario, ego, before, action, *, lane, road, traffic, boxes):
    params = driving.DrivingParams(scenarios=scenario)

    def one(ego, before, action, lane, road, traffic, boxes):
        long, lateral, left, right = _edges(scenario, lane, road, ego[:3])
        on_lane = jnp.any(on_lanes(scenario.lanes, long, lateral))
        found = nav.Localised(long=long, lateral=lateral, on_lane=on_lane, left=left, right=right)
        navigation = _navigation(lane, road)
        state = _ego(ego, before, action)
        touch = driving.contacts(
            scenario,
            ego[:3],
            traffic_pose=traffic[:, :3],
            present=traffic[:, 5] > 0,
            box_pose=boxes,
        )
        events = driving.Events(
            arrived=nav.arrived(scenario, navigation, found),
            off_road=driving.off_road(found, scenario, ego[:3]),
            crash_vehicle=touch.vehicle,
            crash_object=touch.object,
        )
        reward, _ = driving.reward_and_cost(
            params, scenario, events=events, navigation=navigation, long=long, ego=state
        )
        return reward

    return jax.vmap(one)(ego, before, action, lane, road, traffic, boxes)


@jax.jit
@jax.vmap
def _replay(scenario, ego, before, last_action, *, actions):
    """Positions after each of `WINDOW` recorded actions from every recorded state."""

    def one(ego, before, last_action, actions):
        def step(state, action):
            state = vehicle.drive(
                state,
                action,
                engine_force=scenario.engine_force,
                brake_force=scenario.brake_force,
                friction=scenario.wheel_friction,
            )
            return state, state.pose

        return jax.lax.scan(step, _ego(ego, before, last_action), actions)[1]

    return jax.vmap(one)(ego, before, last_action, actions)


def load(folder: str | Path) -> list[Recording]:
    """All recordings of a folder, padded to common shapes."""
    paths = recording_paths(folder)
    capacity = Capacity.of([load_recording(path) for path in paths])
    steps = 0
    for path in paths:
        with np.load(path) as z:
            steps = max(steps, len(z["action"]))
    return [Recording(path, capacity, steps) for path in paths]


def compare(recordings: list[Recording]) -> dict[str, float]:
    """The figures that need no policy (see the module's text)."""
    scenario = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[r.scenario for r in recordings])

    def all_of(name):
        return np.stack([getattr(r, name) for r in recordings])

    ego, action, lane, road, traffic, boxes = map(
        all_of, ("ego", "action", "lane", "road", "traffic", "boxes")
    )
    before = np.concatenate([ego[:, :1], ego[:, :-1]], 1)
    executed = np.concatenate([np.zeros_like(action[:, :1]), action], 1)
    ours = np.asarray(
        _observe(
            scenario, ego, before, executed, lane=lane, road=road, traffic=traffic, boxes=boxes
        )
    )
    rewards = _reward(
        scenario,
        ego[:, 1:],
        ego[:, :-1],
        action,
        lane=lane[:, 1:],
        road=road[:, 1:],
        traffic=traffic[:, 1:],
        boxes=boxes[:, 1:],
    )
    windows = action.shape[1] - WINDOW + 1
    index = np.arange(windows)[:, None] + np.arange(WINDOW)
    track = np.asarray(
        _replay(
            scenario,
            ego[:, :windows],
            before[:, :windows],
            executed[:, :windows],
            actions=action[:, index],
        )
    )
    features, rays, reward_errors, position = [], [], [], []
    for i, r in enumerate(recordings):
        error = np.abs(ours[i, : r.steps + 1] - r.obs[: r.steps + 1])
        contact = r.flags[:, 2] | r.flags[:, 3]
        settled = [not contact[max(t - WINDOW, 0) : t].any() for t in range(r.steps + 1)]
        features.append(error[settled][:, _COMPARED])
        rays.append(error[:, 19:].mean(1))
        reward_errors.append(np.abs(np.asarray(rewards[i])[: r.steps] - r.reward[: r.steps]))
        for t in range(r.steps - WINDOW + 1):
            if not contact[max(t - 1, 0) : t + WINDOW].any():
                end = r.ego[t + WINDOW, :2]
                position.append(np.hypot(*(track[i, t, -1, :2] - end)))
    return {
        "obs_max_abs_error": float(np.concatenate(features).max()),
        "lidar_mean_abs_error": float(np.concatenate(rays).mean()),
        "position_error_1s_median": float(np.median(position)),
        "position_error_1s_p95": float(np.percentile(position, 95)),
        "reward_agreement": float((np.concatenate(reward_errors) < 0.05).mean()),
    }


def recorded_expert(path: str | Path):
    """The recorded neural expert as `policy(observation) -> action`: two tanh layers, a mean."""
    with np.load(path) as z:
        layers = [
            (jnp.asarray(z[f"{name}_weight"]), jnp.asarray(z[f"{name}_bias"]))
            for name in ("mlp_extractor_policy_net_0", "mlp_extractor_policy_net_2", "action_net")
        ]

    def policy(observation):
        (w0, b0), (w1, b1), (w2, b2) = layers
        hidden = jnp.tanh(w1 @ jnp.tanh(w0 @ observation + b0) + b1)
        return jnp.clip(w2 @ hidden + b2, -1.0, 1.0)

    return policy


def success_rate(policy, env: driving.Driving) -> float:
    """Success of a policy over every held-out scenario once."""
    from ppl_jax.evaluation import evaluate

    def act(key, state, observation, params):
        return policy(observation)

    result = evaluate(env, act, env.held_out_params, jax.random.key(0))
    return float(np.mean(result.success))


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m envs.driving.fidelity", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folder", help="folder of md_<number>.npz recordings")
    folder = Path(parser.parse_args(argv).folder)
    try:
        figures: dict[str, float | None] = dict(compare(load(folder)))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    expert = folder / _EXPERT_FILE
    figures["expert_success"] = (
        success_rate(recorded_expert(expert), make_driving()) if expert.exists() else None
    )
    print(json.dumps(figures, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
