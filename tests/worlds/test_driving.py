"""The driving world against brute force, properties and known answers."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.driving import geometry, lidar, observation, vehicle
from envs.driving import navigation as nav
from envs.driving import traffic as traffic_model
from envs.driving.env import contacts
from envs.driving.make import make_driving
from envs.driving.maps import MapSettings, _draw_blocks, generate
from envs.driving.scenario import Capacity, pack, tree_index
from ppl_jax.evaluation import evaluate


def step_of(world, params):
    return jax.jit(lambda key, state, action: world.step(key, state, action, params))


def segments(pose, half):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
    corners = corners @ np.array([[c, s], [-s, c]]) + pose[:2]
    return list(zip(corners, np.roll(corners, -1, 0), strict=True))


def ray_hits(origin, angle, boxes, halves, circles):
    """Nearest hit by intersecting the ray with every side and circle, one at a time."""
    d = np.array([np.cos(angle), np.sin(angle)])
    best = np.inf
    for box, half in zip(boxes, halves, strict=True):
        for a, b in segments(box, half):
            e = b - a
            denominator = d[0] * -e[1] + d[1] * e[0]
            if abs(denominator) < 1e-12:
                continue
            r = a - origin
            t = (r[0] * -e[1] + r[1] * e[0]) / denominator
            u = (d[0] * r[1] - d[1] * r[0]) / denominator
            if t >= 0 and 0 <= u <= 1:
                best = min(best, t)
    for x, y, radius in circles:
        along = d @ (np.array([x, y]) - origin)
        inside = radius**2 - (np.hypot(x - origin[0], y - origin[1]) ** 2 - along**2)
        if inside >= 0 and along - np.sqrt(inside) >= 0:
            best = min(best, along - np.sqrt(inside))
    return best


def test_lidar_against_ray_by_ray_intersection():
    rng = np.random.default_rng(1)
    scan = jax.jit(lidar.scan)
    for _ in range(5):
        pose = np.array([*rng.uniform(-3, 3, 2), rng.uniform(-3, 3)])
        boxes = np.concatenate(
            [rng.uniform(8, 40, (4, 2)) * rng.choice([-1, 1], (4, 2)), rng.uniform(-3, 3, (4, 1))],
            1,
        )
        halves = rng.uniform(0.5, 3, (4, 2))
        circles = np.concatenate(
            [
                rng.uniform(6, 30, (3, 2)) * rng.choice([-1, 1], (3, 2)),
                rng.uniform(0.1, 0.6, (3, 1)),
            ],
            1,
        )
        ours = np.asarray(scan(*map(jnp.float32, (pose, boxes, halves, circles))))
        theirs = np.array(
            [
                min(
                    ray_hits(pose[:2], pose[2] + np.radians(1.5 * i), boxes, halves, circles) / 50,
                    1,
                )
                for i in range(240)
            ]
        )
        # a ray that grazes a corner may go either way in single precision
        assert (np.abs(ours - theirs) > 1e-3).sum() <= 1


def test_arctan2_is_arctan2():
    x, y = np.random.default_rng(0).normal(size=(2, 1000)).astype(np.float32)
    np.testing.assert_allclose(geometry.arctan2(y, x), np.arctan2(y, x), atol=1e-6)


def test_lane_coordinates_invert_positions_on_every_lane():
    description = generate(117)
    capacity = Capacity.of([description])
    lanes = jax.tree.map(jnp.asarray, pack(description, capacity).lanes)
    members = [lane for road in description.network.roads.values() for lane in road]
    rng = np.random.default_rng(0)
    points, longs, laterals = [], [], []
    for lane in members:
        longs.append(rng.uniform(0.1, lane.length - 0.1))
        laterals.append(rng.uniform(-1.5, 1.5))
        points.append(lane.position(longs[-1], laterals[-1]))
    n = len(members)
    mine = jax.tree.map(lambda leaf: leaf[:n], lanes)
    long, lateral = geometry.lane_coordinates(mine, jnp.asarray(points, jnp.float32))
    np.testing.assert_allclose(long, longs, atol=2e-3)
    np.testing.assert_allclose(lateral, laterals, atol=2e-3)
    back = geometry.lane_position(mine, long, lateral)
    np.testing.assert_allclose(back, points, atol=2e-3)


def test_speed_limit_engine_brake_and_drag():
    """Known answers of the simulator's car (784.16 N, 114.16 N s per wheel, 1100 kg)."""
    drive = jax.jit(
        lambda ego, action: vehicle.drive(
            ego, action, engine_force=784.16, brake_force=114.16, friction=0.9
        )
    )

    def speeds(v0, pedal, steps):
        ego = vehicle.place(jnp.zeros(3), jnp.array([v0, 0.0]), jnp.zeros(()), jnp.zeros(2))
        out = []
        for _ in range(steps):
            ego = drive(ego, jnp.array([0.0, pedal]))
            out.append(float(ego.velocity[0]))
        return out

    assert np.diff(speeds(0.0, 1.0, 5)) == pytest.approx(0.2851, abs=1e-3)
    assert np.diff(speeds(10.0, 0.0, 5)) == pytest.approx(-0.0364, abs=2e-3)
    assert np.diff(speeds(20.0, -0.1, 5)) == pytest.approx(-0.2076, abs=5e-3)
    assert -1.5 < np.diff(speeds(20.0, -1.0, 5)).mean() < -1.2
    assert 22.0 < speeds(21.0, 1.0, 40)[-1] < 22.6
    assert speeds(0.5, -1.0, 10)[-1] == pytest.approx(0.0, abs=1e-3)


def test_first_positions_from_standstill_lag_the_speed():
    ego = vehicle.place(jnp.zeros(3), jnp.zeros(2), jnp.zeros(()), jnp.zeros(2))
    track = []
    for _ in range(3):
        ego = vehicle.drive(
            ego, jnp.array([0.0, 1.0]), engine_force=784.16, brake_force=114.16, friction=0.9
        )
        track.append(float(ego.pose[0]))
    # figures of the real simulator: 0.007, 0.034 + 0.007, ...
    np.testing.assert_allclose(np.diff([0.0, *track]), [0.007, 0.034, 0.063], atol=1e-3)


def test_mirrored_steering_gives_a_mirrored_track():
    def end(steer):
        ego = vehicle.place(jnp.zeros(3), jnp.array([8.0, 0.0]), jnp.zeros(()), jnp.zeros(2))
        for _ in range(10):
            ego = vehicle.drive(
                ego, jnp.array([steer, 0.3]), engine_force=784.16, brake_force=114.16, friction=0.9
            )
        return np.asarray(ego.pose)

    left, right = end(0.3), end(-0.3)
    np.testing.assert_allclose(left * [1, -1, -1], right, atol=1e-4)
    assert left[1] > 0.5  # positive steering is to the left


def test_equal_numbers_give_equal_scenarios_and_others_differ():
    first, again, other = generate(123), generate(123), generate(124)
    capacity = Capacity.of([first, other])
    for a, b in zip(
        jax.tree.leaves(pack(first, capacity)), jax.tree.leaves(pack(again, capacity)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    assert first.blocks != other.blocks or first.objects != other.objects


@pytest.mark.parametrize(
    "settings",
    [
        MapSettings(blocks=1, lanes=1, traffic_density=0.0, accident_probability=0.0),
        MapSettings(blocks=5, lanes=2, traffic_density=0.2),
        MapSettings(blocks=2, lanes=4, kinds="O"),
        MapSettings(blocks=2, kinds="rR", accident_probability=1.0),
    ],
)
def test_other_densities_block_counts_and_lanes(settings):
    description = generate(7, settings)
    assert len(description.blocks) == settings.blocks + 1
    assert set(description.blocks[1:]) <= set(settings.kinds)
    assert len(description.network.roads[(">", ">>")]) == settings.lanes
    if settings.traffic_density == 0:
        assert not description.traffic
    if settings.accident_probability == 0:
        assert not description.objects
    pack(description, Capacity.of([description]))


def test_bad_map_settings_are_named():
    with pytest.raises(ValueError, match=r"lanes must be 1 to 4, got 9"):
        MapSettings(lanes=9)
    with pytest.raises(ValueError, match="traffic_density must not be negative"):
        MapSettings(traffic_density=-1.0)


def test_routes_are_connected_and_blocks_do_not_cross():
    for number in range(60, 80):
        d = generate(number)
        roads = list(zip(d.nodes[:-1], d.nodes[1:], strict=True))
        for here, there in zip(roads[:-1], roads[1:], strict=True):
            gaps = [
                np.hypot(*(a.end - b.start))
                for a, b in zip(d.network.roads[here], d.network.roads[there], strict=False)
            ]
            assert max(gaps) < 0.01

        rng = np.random.default_rng([number, 2025])
        blocks, _ = _draw_blocks(rng, MapSettings())
        for i, later in enumerate(blocks):
            lanes = [lane for road in later.network.roads.values() for lane in road]
            middles = np.array([lane.position(lane.length / 2, 0.0) for lane in lanes])
            for earlier in blocks[:i]:
                for road in earlier.network.roads.values():
                    assert not any(lane.contains(middles).any() for lane in road)


def test_auto_reset_starts_somewhere_new(world):
    params = world.default_params
    step = step_of(world, params)
    _, state = world.reset(jax.random.key(0), params)
    seen, key = [], jax.random.key(1)
    for _ in range(400):
        key, sub = jax.random.split(key)
        before = int(state.scenario)
        obs, state, _, terminated, truncated, info = step(sub, state, jnp.array([0.5, 1.0]))
        if bool(terminated | truncated):
            seen.append((before, int(state.scenario)))
            assert int(state.time) == 0
            assert not np.array_equal(obs, info.final_observation)
            np.testing.assert_allclose(obs, world.observe(state, params), atol=1e-6)
        else:
            np.testing.assert_array_equal(obs, info.final_observation)
    assert len(seen) >= 4
    assert len({after for _, after in seen}) >= 3


def test_vmapped_worlds_are_single_worlds(world):
    params = world.default_params
    keys = jax.random.split(jax.random.key(0), 5)
    _, states = jax.vmap(world.reset, in_axes=(0, None))(keys, params)
    actions = jax.random.uniform(jax.random.key(1), (30, 5, 2), minval=-0.3, maxval=1.0)
    batch = jax.jit(
        lambda s, a: jax.vmap(world.transition, in_axes=(None, 0, 0, None))(None, s, a, params)
    )
    one = jax.jit(lambda s, a: world.transition(None, s, a, params))
    singles = [jax.tree.map(lambda x, i=i: x[i], states) for i in range(5)]
    for t in range(30):
        states, outcome = batch(states, actions[t])
        for i in range(5):
            singles[i], alone = one(singles[i], actions[t, i])
            np.testing.assert_allclose(outcome.reward[i], alone.reward, atol=1e-3)
    for i in range(5):
        np.testing.assert_allclose(states.ego.pose[i], singles[i].ego.pose, atol=1e-3)


def test_observations_stay_in_the_box_and_have_259_values(world):
    params = world.default_params
    step = step_of(world, params)
    obs, state = world.reset(jax.random.key(3), params)
    for i in range(100):
        action = jax.random.uniform(jax.random.key(i), (2,), minval=-1, maxval=1)
        obs, state, *_ = step(jax.random.key(i), state, action)
        assert obs.shape == (259,)
        assert float(obs.min()) >= 0.0
        assert float(obs.max()) <= 1.0


def test_the_scripted_expert_arrives_everywhere(world):
    for params in (world.default_params, world.held_out_params):
        episodes = evaluate(world, world.scripted_expert, params, jax.random.key(0))
        assert bool(jnp.all(episodes.success))
        assert float(jnp.median(episodes.episodic_cost)) <= 2


def test_the_scripted_expert_recovers_after_a_random_driver(world):
    """Takes over mid-way from random actions, wherever they led on the road."""
    params = world.held_out_params

    @jax.jit
    @jax.vmap
    def run(index, key):
        state = world.reset_to(index, key, params)

        def wild(carry, key):
            state, alive = carry
            nice = world.scripted_expert(key, state, None, params)
            action = jnp.clip(nice + 0.4 * jax.random.normal(key, (2,)), -1, 1)
            after, out = world.transition(None, state, action, params)
            return (after, alive & ~out.terminated), None

        (state, alive), _ = jax.lax.scan(
            wild, (state, jnp.ones((), bool)), jax.random.split(key, 80)
        )

        def drive(carry, _):
            state, alive, success = carry
            action = world.scripted_expert(None, state, None, params)
            after, out = world.transition(None, state, action, params)
            return (after, alive & ~out.terminated, success | (alive & out.success)), None

        (_, _, success), _ = jax.lax.scan(drive, (state, alive, ~alive & False), None, length=900)
        return alive, success

    alive, success = run(jnp.arange(6), jax.random.split(jax.random.key(0), 6))
    assert int(alive.sum()) >= 4
    assert float(success.sum() / alive.sum()) >= 0.8


def test_the_scripted_expert_gets_free_of_what_a_blind_driver_ran_into():
    """Handed over 1.5 s after the first contact, it does not push on: seconds of cost, not minutes.

    The blind driver is the expert itself on a road that it believes to be empty.
    """
    world = make_driving(training=[2000, 2005, 2038, 2057, 2086, 2092], held_out=[1000])
    params = world.default_params
    objects = params.scenarios.objects
    nothing = dataclasses.replace(objects, lane=jnp.full_like(objects.lane, -1))
    empty = params.replace(scenarios=dataclasses.replace(params.scenarios, objects=nothing))
    removed = traffic_model.REMOVED

    def step(carry, _):
        state, over, since, cost, success = carry
        blind = state.replace(
            traffic=dataclasses.replace(
                state.traffic, status=jnp.full_like(state.traffic.status, removed)
            )
        )
        handed_over = since > 15
        action = jnp.where(
            handed_over,
            world.scripted_expert(None, state, None, params),
            world.scripted_expert(None, blind, None, empty),
        )
        after, out = world.transition(None, state, action, params)
        costs = ~over & (out.cost > 0)
        after = jax.tree.map(lambda new, old: jnp.where(over, old, new), after, state)
        since = since + (~over & ((since > 0) | costs))
        cost, success = cost + (costs & handed_over), success | (~over & out.success)
        return (after, over | out.terminated, since, cost, success), None

    def run(index):
        no, zero = jnp.zeros((), bool), jnp.zeros((), jnp.int32)
        start = world.reset_to(index, None, params), no, zero, zero, no
        (_, _, since, cost, success), _ = jax.lax.scan(step, start, None, length=700)
        return since > 15, cost, success

    handed_over, cost, success = jax.jit(lambda which: jax.lax.map(run, which))(jnp.arange(6))
    assert int(handed_over.sum()) >= 5
    assert bool(jnp.all(success[handed_over]))
    assert int(cost.max()) <= 40  # before wrecks were tracked one was pushed for 500 steps


def test_the_clearance_is_the_distance_to_edges_and_things(world):
    params = world.default_params
    state = world.reset_to(jnp.int32(0), None, params)
    after, outcome = jax.jit(world.transition)(None, state, jnp.zeros(2), params)
    scenario = tree_index(params.scenarios, after.scenario)
    sides = float(jnp.minimum(after.left, after.right)) - vehicle.HALF_SIZE[1]
    poses = np.concatenate([traffic_model.poses(scenario, after.traffic), after.box_pose])
    half = np.concatenate([scenario.traffic.half, scenario.objects.box_half])

    def corners(pose, half):
        signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return pose[:2] + (signs * half) @ np.array([[c, s], [-s, c]])

    mine, gaps = corners(np.asarray(after.ego.pose), np.array(vehicle.HALF_SIZE)), []
    for pose, size in zip(poses, half, strict=True):
        theirs, apart = corners(pose, size), []
        for heading in (float(after.ego.pose[2]), pose[2]):
            for angle in (heading, heading + np.pi / 2):
                axis = np.array([np.cos(angle), np.sin(angle)])
                a, b = mine @ axis, theirs @ axis
                apart.append(max(b.min() - a.max(), a.min() - b.max()))
        gaps.append(max(apart))
    assert float(outcome.clearance) == pytest.approx(min(sides, *gaps), abs=2e-3)
    assert float(outcome.clearance) < 2.0


def test_a_wreck_is_pushed_and_a_cone_is_not_in_the_way():
    from envs.driving.env import make_params

    for kind, lost in (("vehicle", True), ("cone", False)):
        number = next(
            n for n in range(200, 300) if any(o.kind == kind for o in generate(n).objects)
        )
        description = generate(number)
        thing = next(o for o in description.objects if o.kind == kind)
        params = make_params([description])
        world = make_driving(training=[100], held_out=[1000])
        state = world.reset_to(jnp.int32(0), None, params)
        ahead = np.array([np.cos(thing.heading), np.sin(thing.heading)])
        place = np.array([thing.x, thing.y]) - 8 * ahead
        ego = vehicle.place(
            jnp.array([*place, thing.heading], jnp.float32),
            jnp.asarray(8 * ahead, jnp.float32),
            jnp.zeros(()),
            jnp.zeros(2),
        )
        state = state.replace(ego=ego)
        step = jax.jit(lambda s, p=params, w=world: w.transition(None, s, jnp.zeros(2), p))
        cost = 0.0
        for _ in range(12):
            state, outcome = step(state)
            cost += float(outcome.cost)
        assert cost > 0
        assert (float(outcome.speed) < 5.5) == lost
        moved = np.abs(np.asarray(state.box_pose - params.scenarios.objects.box_pose[0])).max()
        assert (moved > 1.0) == lost


def test_contacts_by_sampling_points(world):
    scenario = tree_index(world.default_params.scenarios, 0)
    rng = np.random.default_rng(0)
    touch = jax.jit(
        lambda p, t, b: contacts(
            scenario, p, traffic_pose=t, present=jnp.ones(len(t), bool), box_pose=b
        )
    )
    half = np.array(vehicle.HALF_SIZE)
    n = scenario.traffic.half.shape[0]
    for _ in range(40):
        others = np.full((n, 3), 1e5)
        others[0] = [*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)]
        pose = np.array([0.0, 0.0, rng.uniform(-3, 3)])
        found = touch(
            jnp.float32(pose), jnp.float32(others), jnp.full_like(scenario.objects.box_pose, 1e6)
        )
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 60)] * 2), -1).reshape(-1, 2) * half
        c, s = np.cos(pose[2]), np.sin(pose[2])
        world_points = grid @ np.array([[c, s], [-s, c]]) - others[0, :2]
        c, s = np.cos(others[0, 2]), np.sin(others[0, 2])
        local = np.abs(world_points @ np.array([[c, -s], [s, c]]))
        other_half = np.asarray(scenario.traffic.half[0])
        overlap = (local <= other_half).all(1).any()
        depth = float(found.depth[0])
        if abs(depth) > 0.15:  # the grid is not finer than that
            assert (depth > 0) == overlap


def test_traffic_stops_behind_a_standing_ego_and_goes_on_round_the_map():
    world = make_driving(training=[100], held_out=range(1000, 1010))
    params = world.held_out_params

    @jax.jit
    @jax.vmap
    def run(index):
        state = world.reset_to(index, None, params)
        # wake everything
        traffic = state.traffic.replace(status=jnp.where(state.traffic.status == 1, 2, 0))
        state = state.replace(traffic=traffic)

        def step(state, _):
            state, _ = world.transition(None, state, jnp.array([0.0, -1.0]), params)
            return state, (state.traffic.speed, state.traffic.status)

        return jax.lax.scan(step, state, None, length=600)[1]

    speed, status = map(np.asarray, run(jnp.arange(10)))
    assert np.isfinite(speed).all()
    assert speed.max() * 3.6 < 31.0  # IDM's target is 30 km/h
    started = status[:, 0] == 2
    assert started.sum() > 20
    # most arrive and are removed; none comes back
    assert (status[:, -1][started] == 0).mean() > 0.5
    assert not ((np.diff(status, axis=1) > 0) & (status[:, :-1] == 0)).any()


def test_kerbs_are_felt_at_the_edge(world):
    params = world.default_params
    scenario = tree_index(params.scenarios, 0)
    state = world.reset_to(jnp.int32(0), None, params)
    touches = jax.jit(
        lambda pose: geometry.touches_sidewalk(
            scenario.lanes, scenario.kerbs, pose, jnp.array(vehicle.HALF_SIZE)
        )
    )
    # on the straight first road the right kerb starts at y = -1.95
    y_touch = -1.95 + vehicle.HALF_SIZE[1]
    assert not bool(touches(jnp.array([25.0, y_touch + 0.05, 0.0])))
    assert bool(touches(jnp.array([25.0, y_touch - 0.05, 0.0])))
    _, found = nav.localise(scenario, state.navigation, jnp.array([25.0, 0.0, 0.0]))
    assert bool(found.on_lane)


def test_an_observation_is_both_parts_in_a_row_however_it_is_batched_or_differentiated():
    features, rays = jnp.linspace(0.1, 1.0, 19), jnp.linspace(0.0, 0.9, lidar.RAYS)
    weights = jnp.linspace(-1.0, 1.0, observation.SIZE)
    many = jnp.stack([features, 2 * features]), jnp.stack([rays, 3 * rays])

    def joined(features, rays):
        return jnp.sum(weights * observation.join(features, rays) ** 2)

    def plain(features, rays):
        return jnp.sum(weights * jnp.concatenate([features, rays]) ** 2)

    def results(f):
        return (
            f(features, rays),
            jax.vmap(f)(*many),
            jax.vmap(f, (0, None))(many[0], rays),
            jax.vmap(jax.vmap(f, (None, 0)), (0, None))(*many),
            jax.grad(f, (0, 1))(features, rays),
            jax.vmap(jax.grad(f, (0, 1)))(*many),
            jax.grad(lambda *parts: jnp.sum(jax.vmap(f)(*parts)), (0, 1))(*many),
            jax.jvp(f, (features, rays), (features, rays)),
        )

    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-8),
        jax.jit(lambda: results(joined))(),
        results(plain),
    )
