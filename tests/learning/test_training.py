import dataclasses
import re

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax import algorithms, experts
from ppl_jax.algorithms.base import Algorithm
from ppl_jax.algorithms.ppl import make_ppl
from ppl_jax.config import replace, validate
from ppl_jax.evaluation import make_evaluate
from ppl_jax.training import make_train
from tests.helpers import Probe, tiny_settings

SMALL = {
    "total_steps": 600,
    "batch_size": 32,
    "hidden": (32,),
    "prediction_horizon": 6,
    "decision_interval": 5,
    "max_preference_horizon": 6,
    "human_capacity": 600,
    "preference_capacity": 2000,
    "learning_rate": 3e-3,
}


def small(algorithm="ppl", **changes):
    return tiny_settings(algorithm, SMALL, **changes)


def set_to(hparams, **changes):
    return replace(small()[0], hparams, **changes)[1]


TINY, HP = small()


def functions(dependent=True, algorithm="ppl", **changes):
    probe = Probe(dependent)
    config, _ = small(algorithm, **changes)
    return probe, make_train(
        probe, probe.scripted_expert, algorithms.method(algorithm).make, config
    )


def success(probe, fns, learner):
    layers, spec = fns.algorithm.policy(learner.algorithm), probe.spec
    policy = experts.SavedPolicy(
        layers, "relu", "tanh", spec.observation_mean, spec.observation_scale
    )
    run = make_evaluate(probe, lambda k, s, o, p: experts.act(policy, o))
    return float(np.mean(jax.jit(run)(probe.held_out_params, jax.random.key(0)).success))


@pytest.mark.parametrize("algorithm", ["ppl", "hg_dagger"])
@pytest.mark.parametrize("dependent", [False, True])
def test_probe_worlds_are_solved(algorithm, dependent):
    probe, fns = functions(dependent, algorithm)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), small(algorithm)[1])
    assert success(probe, fns, learner) == 1.0
    for sign in probe.default_params.signs:
        action = fns.algorithm.act(learner.algorithm, None, jnp.array([sign, 0.0, 1.0]))
        assert float(action[0]) == pytest.approx(float(probe.answer(sign)), abs=probe.tolerance)
    assert int(learner.counters.human_data) < 400  # the expert is needed less and less


def test_a_gate_by_action_probability():
    """The expert takes over where its density of the novice's action is low, and nowhere else."""
    probe, weight = Probe(), np.zeros((3, 1), np.float32)
    weight[0] = np.arctanh(0.6)
    policy = experts.SavedPolicy(
        [(weight, np.zeros(1))], "relu", "tanh", np.zeros(3), np.ones(3), np.log([0.2])
    )
    expert = experts.neural_expert(policy)
    np.testing.assert_allclose(expert(None, None, jnp.array([-1.0, 0.3, 1.0]), None), [-0.6])
    config, hparams = small(gate="action_probability", min_log_density=-1.0)
    fns = make_train(probe, expert, make_ppl, config)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), hparams)
    assert success(probe, fns, learner) == 1.0
    assert 0 < int(learner.counters.human_data) < 400
    run = jax.jit(lambda learner: fns.run_chunk(learner, 1))
    for wrong, takes_over in ((0.6, False), (0.55, False), (-0.6, True), (0.0, True)):
        # at -1: a distance of 0.44 or more is that unlikely
        start = fns.init(jax.random.key(1), set_to(hparams, learning_rate=0.0))
        bias = jnp.arctanh(wrong * start.env_state.sign)
        start = jax.tree.map(jnp.zeros_like, start.algorithm.learned.params), start
        params = {**start[0]}
        last = params["params"]["Dense_1"]
        last["bias"] = last["bias"] + bias
        learned = dataclasses.replace(start[1].algorithm.learned, params=params)
        algorithm = dataclasses.replace(start[1].algorithm, learned=learned)
        after, _ = run(dataclasses.replace(start[1], algorithm=algorithm))
        assert (int(after.counters.human_data) > 0) == takes_over
    with pytest.raises(
        ValueError, match="gate 'action_probability' needs an expert with a density"
    ):
        make_train(probe, probe.scripted_expert, make_ppl, config)


def test_the_released_settings_run_and_solve_the_probe():
    probe = Probe()
    config, hparams = algorithms.settings(
        "ppl",
        "driving",
        "reference",
        total_steps=600,
        batch_size=32,
        hidden=(32,),
        predictor="simulator",
        learning_rate=3e-3,
        min_return=-3.0,
    )
    fns = make_train(probe, probe.scripted_expert, make_ppl, config)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), hparams)
    assert success(probe, fns, learner) == 1.0


def test_without_an_expert_in_reach_nothing_is_learnt():
    # a gate that never fires: no data, no update
    probe, fns = functions()
    algorithm = fns.algorithm._replace(decide=lambda state, point, hparams: jnp.zeros((), bool))
    fns = make_train(probe, probe.scripted_expert, lambda spec, config: algorithm, TINY)
    start = fns.init(jax.random.key(0), HP)
    learner, _ = jax.jit(fns.run_chunk)(start, 4)
    assert int(learner.counters.human_data) == 0
    for a, b in zip(
        jax.tree.leaves(start.algorithm.learned),
        jax.tree.leaves(learner.algorithm.learned),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_a_vmapped_batch_is_the_runs_one_by_one():
    _, fns = functions(total_steps=100)
    seeds = jnp.arange(4)
    swept = {
        "preference_horizon": jnp.array([1.0, 3.0, 6.0, 4.0]),
        "beta": jnp.array([0.1, 0.3, 1.0, 0.0]),
        "prediction_noise": jnp.array([0.0, 0.1, 0.2, 0.0]),
        "expert_noise": jnp.array([0.0, 0.0, 0.1, 0.2]),
        "learning_rate": jnp.full(4, 1e-3),
    }
    grid = set_to(HP, **swept)
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, grid)
    keys = jax.vmap(jax.random.key)(seeds)
    together, metrics = jax.jit(jax.vmap(fns.train, in_axes=(0, axes)))(keys, grid)
    train = jax.jit(fns.train)
    for i in range(4):
        one = set_to(HP, **{name: column[i] for name, column in swept.items()})
        alone, alone_metrics = train(keys[i], jax.tree.map(jnp.float32, one))
        assert int(alone.counters.human_data) == int(together.counters.human_data[i])
        for a, b in zip(
            jax.tree.leaves(alone.algorithm.learned),
            jax.tree.leaves(jax.tree.map(lambda x, i=i: x[i], together.algorithm.learned)),
            strict=True,
        ):
            np.testing.assert_allclose(a, b, atol=2e-4)
        np.testing.assert_allclose(
            alone_metrics["train/loss_bc"], metrics["train/loss_bc"][i], rtol=2e-2, atol=1e-4
        )
    assert train._cache_size() == 1  # another L, beta, noise or seed compiles nothing


def test_lanes_without_a_takeover_do_not_pay_for_the_lookahead():
    """Counts calls of the transition under vmap: a batched cond would run it in every lane."""
    calls = []

    class Counting(Probe):
        def transition(self, key, state, action, params):
            jax.debug.callback(lambda *_: calls.append(1), state.time)
            return super().transition(key, state, action, params)

    probe = Counting()
    probe.tolerance = 3.0  # no episode ends, and with it no decision is due between the first ones
    config = dataclasses.replace(TINY, total_steps=5)
    gate = make_train(probe, probe.scripted_expert, make_ppl, config).algorithm
    # the expert takes over in the lanes whose observation shows +1
    gate = gate._replace(
        decide=lambda state, point, hparams: point.trajectory.observation[0, 0] > 0,
        needs_expert_rollout=True,
    )
    fns = make_train(probe, probe.scripted_expert, lambda spec, config: gate, config)
    keys = jax.random.split(jax.random.key(0), 8)
    learners, _ = jax.jit(jax.vmap(fns.train, in_axes=(0, None)))(keys, HP)
    jax.effects_barrier()
    taken = int(jnp.sum(learners.counters.human_data))
    assert 0 < taken < 8 * 5
    # two lookaheads of the gate in each lane, every step, and what the experts' steps look ahead
    assert len(calls) == 8 * (2 * 6 + 5) + 6 * taken


ALWAYS = lambda state, point, hparams: jnp.ones((), bool)  # noqa: E731


def test_every_episode_begins_with_a_decision():
    """Episodes of 20 steps end within blocks of 7: not one step is left to the novice."""
    probe, fns = functions(total_steps=140, decision_interval=7)
    algorithm = fns.algorithm._replace(decide=ALWAYS)
    config, _ = small(total_steps=140, decision_interval=7)
    fns = make_train(probe, probe.scripted_expert, lambda spec, config: algorithm, config)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), HP)
    assert int(learner.counters.human_data) == 140
    assert int(learner.counters.takeovers) == int(learner.counters.episodes) == 7


@flax.struct.dataclass
class Heard:
    """What the stub below was asked and shown."""

    learned: jax.Array
    proposals: jax.Array


@pytest.mark.parametrize("random_steps", [0, 40])
@pytest.mark.parametrize("together", [False, True])
def test_the_gate_judges_the_action_that_is_then_executed(random_steps, together):
    """A novice that draws actions says the same to the gate and in the step; so do random ones."""
    probe = Probe()
    probe.tolerance = 3.0
    config, hparams = small(total_steps=40, decision_interval=1, random_steps=random_steps)

    def make(spec, config):
        return Algorithm(
            name="stub",
            init=lambda key: Heard(learned=jnp.zeros(1), proposals=jnp.zeros(())),
            act=lambda state, key, observation: jax.random.uniform(key, (1,), minval=-1.0),
            # the gate's view of the proposal is the takeover: compared with the step's below
            decide=lambda state, point, hparams: point.novice_action[0] > 0,
            store=lambda state, step, hparams: state.replace(
                proposals=state.proposals + ((step.novice_action[0] > 0) != step.takeover)
            ),
            update=lambda state, key, hparams: (state, {"loss": jnp.zeros(())}),
            policy=lambda state: [],
        )

    train = make_train(probe, probe.scripted_expert, make, config).train
    if together:
        keys = jax.random.split(jax.random.key(0), 3)
        learners, _ = jax.jit(jax.vmap(train, in_axes=(0, None)))(keys, hparams)
    else:
        learners, _ = jax.jit(train)(jax.random.key(0), hparams)
    assert float(jnp.sum(learners.algorithm.proposals)) == 0
    assert np.all((learners.counters.human_data > 5) & (learners.counters.human_data < 35))


class Costly(Probe):
    """Every step costs."""

    def transition(self, key, state, action, params):
        state, outcome = super().transition(key, state, action, params)
        return state, dataclasses.replace(outcome, cost=jnp.ones(()))


@pytest.mark.parametrize(("patience", "episodes"), [(0, 6), (3, 40), (50, 6)])
def test_a_hopeless_episode_may_be_given_up(patience, episodes):
    world, config = Costly(), dataclasses.replace(TINY, total_steps=120)
    gate = make_ppl(world.spec, config)._replace(decide=ALWAYS)
    fns = make_train(world, world.scripted_expert, lambda *_: gate, config)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), set_to(HP, give_up_after=patience))
    counters = learner.counters
    assert int(counters.human_cost_steps) == int(counters.human_data) == 120
    assert int(counters.episodes) == episodes
    assert int(counters.successes) == (episodes if patience != 3 else 0)


@pytest.mark.parametrize("noise_at", ["pairs", "gate", "both"])
def test_prediction_noise_goes_where_it_is_told(noise_at):
    """At the gate it changes what the prediction says, in the pairs what they are about."""
    probe = Probe()
    config, hparams = small(total_steps=5, noise_at=noise_at)  # a single decision
    outcome = {}
    for epsilon in (0.0, 1.0):
        seen = []

        def decide(state, point, hparams, seen=seen):
            jax.debug.callback(lambda x: seen.append(np.array(x)), point.trajectory.observation)
            return jnp.ones((), bool)

        algorithm = make_ppl(probe.spec, config)._replace(decide=decide, needs_expert_rollout=True)
        fns = make_train(probe, probe.scripted_expert, lambda *_, a=algorithm: a, config)
        learner, _ = jax.jit(fns.train)(
            jax.random.key(0), set_to(hparams, prediction_noise=epsilon)
        )
        jax.effects_barrier()
        pairs = learner.algorithm.preference_buffer
        outcome[epsilon] = np.array(seen), np.asarray(pairs.data.observation)[: int(pairs.added)]
    (gate, pairs), (noisy_gate, noisy_pairs) = outcome[0.0], outcome[1.0]
    assert np.array_equal(gate, noisy_gate) is (noise_at == "pairs")
    signs = np.abs(noisy_pairs[:, 0])  # +1 or -1 unless disturbed
    assert np.allclose(signs, 1.0) is (noise_at == "gate")
    assert np.allclose(np.abs(pairs[:, 0]), 1.0)


def test_chunks_are_the_whole_run_bit_for_bit():
    _, fns = functions(total_steps=60)
    chunk = jax.jit(fns.run_chunk)
    start = jax.jit(fns.init)(jax.random.key(3), HP)
    halves = start
    for _ in range(4):
        halves, _ = chunk(halves, 3)
    whole, _ = chunk(start, 12)
    for a, b in zip(jax.tree.leaves(halves), jax.tree.leaves(whole), strict=True):
        if not jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(a, b)


def test_buffers_hold_what_algorithm_1_says():
    """Replay the run step by step in Python and compare the data sets."""
    probe, fns = functions(total_steps=100)
    hparams = set_to(HP, preference_horizon=2)
    learner = jax.jit(fns.init)(jax.random.key(0), hparams)
    chunk = jax.jit(fns.run_chunk)
    learner, _ = chunk(learner, 20)
    human, pairs = learner.algorithm.human_buffer, learner.algorithm.preference_buffer
    count = int(human.added)
    assert count == int(learner.counters.human_data) > 0
    observations, actions = (np.asarray(x)[:count] for x in human.data)
    np.testing.assert_allclose(actions[:, 0], 0.6 * observations[:, 0], atol=1e-6)
    held = int(pairs.added)
    assert 2 * count <= held <= 3 * count  # at s_t and L = 2 predicted states, or where it ends
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:held], pairs.data)
    at = 0
    for observation, action in zip(observations, actions, strict=True):
        sign, error, one = observation
        miss = np.abs(rows.rejected_action[at, 0] - probe.answer(sign))
        ahead = [error + i * miss if i == 0 or miss > probe.tolerance else 0.0 for i in range(3)]
        states = [[sign, e, one] for e in ahead[: 1 + next((i for i in (1, 2) if ahead[i] > 1), 2)]]
        mine = 0  # the time limit may end a prediction as well
        while mine < len(states) and at + mine < held:
            if not np.allclose(rows.observation[at + mine], states[mine], atol=1e-5):
                break
            np.testing.assert_array_equal(rows.preferred_action[at + mine], action)
            mine += 1
        assert mine >= 2
        at += mine
    assert at == held


def test_a_diverged_run_is_flagged_and_frozen():
    _, fns = functions(total_steps=100)
    learner = jax.jit(fns.init)(jax.random.key(0), HP)
    broken = jax.tree.map(lambda x: x.at[...].set(jnp.nan), learner.algorithm.learned.params)
    learned = learner.algorithm.learned.replace(params=broken)
    learner = learner.replace(algorithm=learner.algorithm.replace(learned=learned))
    learner, _ = jax.jit(fns.run_chunk)(learner, 2)
    assert bool(learner.diverged)
    assert int(learner.counters.steps) == 10


@pytest.mark.parametrize(
    ("algorithm", "changes", "message"),
    [
        ("ppl", {"total_steps": 0}, "total_steps must be at least 1, got 0"),
        ("ppl", {"total_steps": 7}, "total_steps must be a multiple of decision_interval"),
        ("ppl", {"demonstrations": 7}, "demonstrations must be a multiple of decision_interval"),
        ("ppl", {"demonstrations": 605}, "demonstrations must not exceed total_steps"),
        (
            "ppl",
            {"offline_updates": 10},
            "offline_updates needs demonstrations to learn from, got 10",
        ),
        ("pvp", {"discount": 1.5}, "discount must lie between 0 and 1, got 1.5"),
        ("eil", {"margin": -1.0}, "margin must not be negative, got -1"),
        ("ensemble_dagger", {"members": 0}, "members must be at least 1, got 0"),
        ("ppl", {"preference_horizon": 0}, "preference_horizon must be at least 1, got 0"),
        ("ppl", {"preference_horizon": 7}, "preference_horizon must not exceed prediction_horizon"),
        ("ppl", {"beta": -0.1}, "beta must not be negative, got -0.1"),
        ("ppl", {"beta": float("nan")}, "beta must not be negative, got nan"),
        ("ppl", {"beta": float("inf")}, "beta must be a finite number, got inf"),
        ("ppl", {"prediction_noise": -1.0}, "prediction_noise must not be negative"),
        ("ppl", {"hidden": ()}, "hidden must name at least one width"),
        ("ppl", {"hidden": (8, 0)}, "hidden must be at least 1, got"),
        ("ppl", {"policy": "gaussian", "objective": "dpo"}, "policy must be deterministic with"),
        ("ppl", {"policy": "beta"}, "policy must be one of deterministic, gaussian, got 'beta'"),
        ("ppl", {"laplace_core": 0.0}, "laplace_core must be at least 0.001, got 0"),
        ("ppl", {"recency": -1.0}, "recency must not be negative, got -1"),
        ("ppl", {"likelihood": "student"}, "likelihood must be one of gaussian, laplace, got"),
    ],
)
def test_bad_settings_are_one_clear_line(algorithm, changes, message):
    with pytest.raises(ValueError, match=message) as error:
        validate(*small(algorithm, **changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"beat": 0.1}, "unknown setting 'beat': did you mean 'beta'?"),
        ({"margin": 0.1}, "unknown setting 'margin'"),
        ({"gate": "low_retrun"}, "got 'low_retrun': did you mean 'low_return'?"),
    ],
)
def test_unknown_settings_are_refused_with_a_near_name(changes, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        algorithms.settings("ppl", "driving", **changes)
