"""The world held against recordings of the real simulator."""

import json

import jax
import numpy as np
import pytest

from envs.driving import fidelity
from envs.driving.blocks import BLOCK_KINDS, first_block
from envs.driving.make import make_driving
from envs.driving.recorded import load_recording, load_recordings, recording_paths
from envs.driving.roads import DECORATION


@pytest.fixture(scope="module")
def figures(recordings):
    return fidelity.compare(fidelity.load(recordings))


@pytest.mark.parametrize(
    ("name", "bound"),
    [
        ("obs_max_abs_error", 2e-3),
        ("lidar_mean_abs_error", 0.01),
        ("position_error_1s_median", 0.10),
        ("position_error_1s_p95", 0.5),
    ],
)
def test_errors_against_the_recordings(figures, name, bound):
    assert figures[name] <= bound


def test_rewards_against_the_recordings(figures):
    assert figures["reward_agreement"] >= 0.98


def test_the_recorded_expert_drives_here_about_as_well_as_at_home(recordings):
    policy = fidelity.recorded_expert(recordings / "neural_expert.npz")
    assert fidelity.success_rate(policy, make_driving()) >= 0.65


def test_recorded_actions_come_from_recorded_observations(recordings):
    policy = jax.jit(jax.vmap(fidelity.recorded_expert(recordings / "neural_expert.npz")))
    with np.load(recording_paths(recordings)[0]) as z:
        np.testing.assert_allclose(policy(z["obs"][:-1]), z["action"], atol=1e-4)


def test_the_block_builders_rebuild_every_recorded_map_lane_for_lane(recordings):
    for path in recording_paths(recordings):
        with np.load(path) as z:
            blocks = json.loads(str(z["meta"]))["blocks"]
        recorded = load_recording(path).network
        assert any(_same(recorded, built) for built in _all_maps(blocks)), path


def _all_maps(blocks):
    start = first_block(3, 3.5)

    def extend(network, entry, i):
        if i == len(blocks):
            yield network
            return
        parameters = dict(blocks[i]["config"])
        parameters["t_type"] = parameters.get("t_intersection_type", parameters.get("t_type"))
        block = BLOCK_KINDS[blocks[i]["id"]].build(network, entry, i, parameters)
        for socket in block.sockets:
            yield from extend(network.merged(block.network), socket, i + 1)

    yield from extend(start.network, start.sockets[0], 1)


def _same(recorded, built):
    if set(recorded.roads) != set(built.roads):
        return False
    for road, lanes in recorded.roads.items():
        mine = built.roads[road]
        if len(mine) != len(lanes):
            return False
        for a, b in zip(mine, lanes, strict=True):
            same = np.allclose(a.start, b.start, atol=1e-3) and np.allclose(a.end, b.end, atol=1e-3)
            if not same or a.kerb != b.kerb or (road == DECORATION and a.taper != b.taper):
                return False
    return True


def test_recordings_become_worlds(recordings):
    world = make_driving(scenarios=recordings)
    count = len(recording_paths(recordings))
    assert world.scenario_count(world.default_params) == count
    with np.load(recording_paths(recordings)[0]) as z:
        first = z["obs"][0]
    np.testing.assert_allclose(world.default_params.start_observations[0], first, atol=2e-3)


def test_a_broken_or_missing_recording_is_named(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        load_recordings(tmp_path / "none")
    with pytest.raises(ValueError, match="holds no md_"):
        load_recordings(tmp_path)
    (tmp_path / "md_1.npz").write_bytes(b"no recording")
    with pytest.raises(ValueError, match=r"md_1\.npz is not a recorded scenario: it is no \.npz"):
        load_recordings(tmp_path)
