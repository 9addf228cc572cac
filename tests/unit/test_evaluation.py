import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.driving.rendering import Paths, Scene, draw, save_frames
from experiments.engine.evaluate import rows_of
from ppl_jax.evaluation import evaluate, make_evaluate
from tests.helpers import Probe


def test_evaluation_is_a_loop_over_scenarios(world):
    params = world.held_out_params

    def act(key, state, observation, params):
        return jnp.array([0.02, 0.6]) * observation[0]

    found = evaluate(world, act, params, jax.random.key(0))
    step = jax.jit(lambda s, o: world.transition(None, s, act(None, s, o, params), params))
    observe = jax.jit(lambda s: world.observe(s, params))
    for i in range(world.scenario_count(params)):
        state = world.reset_to(jnp.int32(i), None, params)
        total, cost, length = 0.0, 0.0, 0
        while True:
            state, out = step(state, observe(state))
            total, cost, length = total + float(out.reward), cost + float(out.cost), length + 1
            if bool(out.terminated | out.truncated):
                break
        assert int(found.length[i]) == length
        assert bool(found.success[i]) == bool(out.success)
        np.testing.assert_allclose(found.episodic_return[i], total, atol=0.1)
        np.testing.assert_allclose(found.episodic_cost[i], cost, atol=1e-3)
        np.testing.assert_allclose(found.progress[i], out.progress, atol=1e-3)


@pytest.mark.parametrize("one_by_one", [False, True])
def test_the_answer_is_known_on_the_probe(one_by_one):
    probe = Probe()
    params = probe.held_out_params

    def play(act):
        return jax.jit(make_evaluate(probe, act, one_by_one=one_by_one))(params, jax.random.key(0))

    good = play(lambda k, s, o, p: jnp.array([0.6]) * o[0])
    bad = play(lambda k, s, o, p: jnp.array([0.6]))
    assert good.success.tolist() == [True, True]
    assert good.length.tolist() == [20, 20]
    assert bad.success.tolist() == [True, False]
    assert bad.episodic_cost.tolist() == [0.0, 1.0]
    rows = rows_of(bad, probe.scenario_numbers(params), 7)
    assert [row.success for row in rows] == [1, 0]
    assert rows[0].step == 7


def test_one_by_one_leaves_out_ended_episodes():
    calls = []

    class Counting(Probe):
        def transition(self, key, state, action, params):
            jax.debug.callback(lambda *_: calls.append(1), state.time)
            return super().transition(key, state, action, params)

    probe = Counting()
    play = jax.jit(make_evaluate(probe, lambda k, s, o, p: jnp.array([0.6]), one_by_one=True))
    found = play(probe.held_out_params, jax.random.key(0))
    jax.effects_barrier()
    assert len(calls) == int(jnp.sum(found.length)) < 2 * int(jnp.max(found.length))


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.mp4"])
def test_pictures_show_road_ego_and_predicted_paths(world, tmp_path, name):
    params = world.held_out_params
    state = world.reset_to(jnp.int32(0), None, params)
    scene = Scene(jax.tree.map(lambda x: x[0], params.scenarios))
    ahead = np.array(state.ego.pose[:2]) + np.array([[4.0, 0], [8.0, 0], [12.0, 0]])
    plain = draw(scene, state, size=96)
    danger = draw(scene, state, Paths(ahead, True), size=96)
    safe = draw(scene, state, Paths(ahead, False), size=96)
    assert plain.shape == (96, 96, 3)

    def count(image, condition):
        r, g, b = (image[..., i].astype(int) for i in range(3))
        return int(condition(r, g, b).sum())

    assert count(plain, lambda r, g, b: (b > 150) & (r < 120)) > 5  # the ego
    assert count(danger, lambda r, g, b: (r > 180) & (g < 110) & (b < 110)) > 5
    assert count(safe, lambda r, g, b: (g > 130) & (r < 100)) > 5
    save_frames(tmp_path / name, [plain, danger, safe])
    assert (tmp_path / name).stat().st_size > 500
