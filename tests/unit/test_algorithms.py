"""Every method: its losses by NumPy loops, its data, and what it learns in probe worlds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax import algorithms, buffers, checkpoint
from ppl_jax.algorithms import eil, gail, haco, ppl, pvp, replay, thrifty_dagger
from ppl_jax.algorithms.ensemble_dagger import ensemble_variance
from ppl_jax.config import HParams
from ppl_jax.evaluation import make_evaluate
from ppl_jax.experts import SavedPolicy, act
from ppl_jax.networks import Network, ensemble_layers, make_critic, make_ensemble, make_policy
from ppl_jax.training import make_train, phases
from ppl_jax.types import PreferenceBatch
from tests.helpers import OWN, Balance, Goal, Probe, plain_settings, probe_settings

RNG = np.random.default_rng(1)
B, K, A = 6, 2, 3
NAMES = algorithms.registered()
HP = HParams(learning_rate=3e-3)
PROBES = {"gail": Goal}  # it has to see the expert succeed


def pairwise(a, b):
    return zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)


def uniform(*shape):
    return RNG.uniform(-1, 1, shape).astype(np.float32)


def coins(*shape):
    return RNG.integers(0, 2, shape).astype(bool)


def functions(name, probe=None, **changes):
    probe = probe or Probe()
    config, hparams = probe_settings(name, **changes)
    return make_train(probe, probe.scripted_expert, algorithms.method(name).make, config), hparams


def success(probe, fns, learner):
    spec = probe.spec
    layers = fns.algorithm.policy(learner.algorithm)
    policy = SavedPolicy(layers, "relu", "tanh", spec.observation_mean, spec.observation_scale)
    run = make_evaluate(probe, lambda key, state, observation, params: act(policy, observation))
    return float(np.mean(jax.jit(run)(probe.held_out_params, jax.random.key(0)).success))


# --- losses, by loops ---


def test_proxy_value_loss():
    ours, theirs, mask, weight = uniform(K, B), uniform(K, B), coins(B), np.abs(uniform(B))
    expected = 0.0
    for k in range(K):
        for b in range(B):
            if mask[b]:  # the mean is over the whole batch, not over the masked part
                each = (ours[k, b] - 1) ** 2 + (theirs[k, b] + 1) ** 2
                expected += weight[b] * each / B
    assert float(pvp.proxy_value_loss(ours, theirs, mask, weight)) == pytest.approx(
        expected, rel=1e-5
    )


def test_td_target_and_loss():
    following, terminated = uniform(K, B), coins(B)
    paid, entropy = uniform(B), uniform(B)
    target = replay.td_target(following, terminated, 0.9, paid=paid, entropy=entropy)
    value, weight = uniform(K, B), np.abs(uniform(B))
    expected = 0.0
    for b in range(B):
        y = paid[b]
        if not terminated[b]:
            y += 0.9 * (min(following[0, b], following[1, b]) + entropy[b])
        assert float(target[b]) == pytest.approx(y, rel=1e-5)
        for k in range(K):
            expected += weight[b] * (value[k, b] - y) ** 2 / B
    assert float(replay.td_loss(value, target, weight)) == pytest.approx(expected, rel=1e-5)
    # the target gets no gradient
    assert not np.any(jax.grad(lambda y: replay.td_loss(value, y, weight))(target))


def test_pvp_policy_loss():
    value, log_pi, mask, weight = uniform(B), uniform(B), coins(B), np.abs(uniform(B))
    expected = sum(-weight[b] * (value[b] + 0.7 * mask[b] * log_pi[b]) / B for b in range(B))
    assert float(pvp.policy_loss(value, log_pi, mask, weight, bc_weight=0.7)) == pytest.approx(
        expected, rel=1e-5
    )


def test_haco_losses():
    executed, novices, target = uniform(K, B), uniform(K, B), uniform(B)
    mask, weight = coins(B), np.abs(uniform(B))
    expected = 0.0
    for k in range(K):
        for b in range(B):
            each = 0.5 * (executed[k, b] - target[b]) ** 2
            each -= 10.0 * mask[b] * (executed[k, b] - novices[k, b])
            expected += weight[b] * each / B
    loss = haco.proxy_loss(executed, novices, target, mask, weight=weight, conservative_weight=10.0)
    assert float(loss) == pytest.approx(expected, rel=1e-4)
    log_pi, costs = uniform(B), uniform(K, B)
    expected = sum(
        weight[b] * (0.3 * log_pi[b] - executed[:, b].min() + costs[:, b].min()) / B
        for b in range(B)
    )
    assert float(haco.policy_loss(log_pi, executed, costs, 0.3, weight=weight)) == pytest.approx(
        expected, rel=1e-4
    )
    a, b = uniform(B, A), uniform(B, A)
    a[0] = 0.0
    cost = haco.intervention_cost(a, b)
    for i in range(B):
        norms = np.linalg.norm(a[i]) * np.linalg.norm(b[i])
        assert float(cost[i]) == pytest.approx(1 - a[i] @ b[i] / norms if i else 0.0, abs=1e-5)


def test_the_squashed_gaussian_is_scipys():
    from scipy import integrate, stats

    key, mean, log_std = jax.random.key(0), np.float32([0.3]), np.float32([-0.5])
    action, log_pi = haco.squashed_gaussian(key, mean, log_std)
    u = np.arctanh(float(action[0]))
    normal = stats.norm(0.3, np.exp(-0.5))
    expected = normal.logpdf(u) - np.log(1 - float(action[0]) ** 2)
    assert float(log_pi) == pytest.approx(expected, abs=1e-4)
    density = lambda a: normal.pdf(np.arctanh(a)) / (1 - a * a)  # noqa: E731
    assert integrate.quad(density, -1, 1)[0] == pytest.approx(1.0, abs=1e-4)
    # finite where tanh saturates
    far = haco.squashed_gaussian(key, 50.0 * np.ones(1, np.float32), log_std)
    assert np.isfinite(far[1])


def test_eil_hinges():
    value, good = uniform(K, B), coins(B)
    ours, others, distance = uniform(K, B), uniform(K, 4, B), np.abs(uniform(4, B))
    m = 0.4
    expected = np.zeros(3)
    for k in range(K):
        for b in range(B):
            if good[b]:
                expected[0] += max(0, m - value[k, b]) / B
            else:
                expected[1] += max(0, m + value[k, b]) / B
            for n in range(4):
                gap = ours[k, b] - others[k, n, b]
                expected[2] += max(0, m * distance[n, b] - gap) / (4 * B)
    np.testing.assert_allclose(
        eil.hinge_losses(value, good, ours, others, distance=distance, margin=m),
        expected,
        rtol=1e-5,
    )
    # without a margin, knowing nothing costs nothing
    zero = np.zeros_like
    nothing = eil.hinge_losses(
        zero(value), good, zero(ours), zero(others), distance=distance, margin=0.0
    )
    assert sum(map(float, nothing)) == 0.0


def test_thrifty_risk_target_and_quantiles():
    solved, ended, following = coins(B), coins(B), np.abs(uniform(B))
    expected = [
        1.0 if solved[b] else (0.0 if ended[b] else 0.9999 * following[b]) for b in range(B)
    ]
    np.testing.assert_allclose(
        thrifty_dagger.risk_target(solved, ended, following), expected, rtol=1e-6
    )
    buffer = buffers.init_buffer(jnp.zeros(()), 8)
    for value in (5.0, 1.0, 3.0, 2.0, 4.0):
        buffer = buffers.add(buffer, jnp.array([value]), jnp.ones(1, bool))
    for share, expected in ((0.0, 1.0), (0.5, 3.0), (1.0, 5.0), (0.24, 1.0), (0.76, 4.0)):
        assert float(thrifty_dagger.quantile(buffer, buffer.data, share)) == expected


def test_gail_losses():
    ours, theirs = 3 * uniform(B), 3 * uniform(B)
    p, q = 1 / (1 + np.exp(-ours)), 1 / (1 + np.exp(-theirs))
    expected = sum(-np.log(p[b]) - np.log(1 - q[b]) for b in range(B)) / B
    assert float(gail.discriminator_loss(ours, theirs)) == pytest.approx(expected, rel=1e-4)
    for correction in (0.0, 1.0):
        expected = [-np.log(1 - x) + correction * np.log(x) for x in p]
        np.testing.assert_allclose(gail.imitation_reward(ours, correction), expected, rtol=1e-4)


def test_ppl_sums_both_losses_by_their_weights():
    """With the terms one by one; without pairs only cloning is left."""
    config, hparams = plain_settings("ppl", beta=0.3, bc_weight=0.7, preference_weight=2.0)
    policy = Network(init=lambda key: None, apply=lambda params, observation: params + observation)
    means, expert, good, bad = (uniform(B, A) for _ in range(4))
    pairs = PreferenceBatch(
        observation=means, preferred_action=good, rejected_action=bad, rejected_observation=None
    )
    bc = np.mean(np.sum((means - expert) ** 2, -1))
    delta = -np.sum((means - good) ** 2, -1) + 0.5 * np.sum((means - bad) ** 2, -1)
    preference = np.mean(np.log1p(np.exp(-0.3 * delta)))
    for has_pairs in (0.0, 1.0):
        loss, _ = ppl.ppl_loss(
            0.0,
            (means, expert),
            pairs,
            jnp.float32(has_pairs),
            hparams=hparams,
            policy=policy,
            config=config,
        )
        expected = 0.7 * bc + 2.0 * has_pairs * preference
        assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_a_loss_of_a_method_refuses_shapes_that_do_not_fit():
    """Each would broadcast to a number that means nothing."""
    batch, both, column = np.zeros(B), np.zeros((K, B)), np.zeros((B, 1))
    for call in (
        lambda: pvp.proxy_value_loss(both, both, column, batch),
        lambda: pvp.policy_loss(batch, column, batch, batch, bc_weight=1.0),
        lambda: replay.td_target(both, column, 0.9),
        lambda: replay.td_target(both, batch, 0.9, paid=column),
        lambda: replay.td_loss(both, column, batch),
        lambda: replay.td_loss(both.T, batch, batch),
        lambda: haco.proxy_loss(both, both, batch, column, weight=batch, conservative_weight=1.0),
        lambda: haco.policy_loss(batch, both, both.T, 1.0, weight=batch),
        lambda: haco.intervention_cost(column, batch),
        lambda: eil.hinge_losses(both, column, both, both[:, None], distance=both, margin=0.1),
        lambda: gail.discriminator_loss(batch, column),
        lambda: thrifty_dagger.risk_target(batch, batch, column),
    ):
        with pytest.raises(AssertionError, match=r"shape|rank|broadcast"):
            call()


# --- networks and data ---


def test_an_ensemble_is_one_network_and_its_members_are_independent():
    spec = Probe().spec
    ensemble = make_ensemble(spec, (8, 8), 3)
    params = ensemble.init(jax.random.key(0))
    x = uniform(B, 3)
    policy = SavedPolicy(
        ensemble_layers(params), "relu", "tanh", spec.observation_mean, spec.observation_scale
    )
    np.testing.assert_allclose(act(policy, x), ensemble.apply(params, x), atol=1e-6)
    members = np.asarray(ensemble.members(params, x))
    np.testing.assert_allclose(
        np.arctanh(ensemble.apply(params, x)), np.arctanh(members).mean(0), atol=1e-5
    )
    np.testing.assert_allclose(
        ensemble_variance(ensemble, params, x), members.var(0).mean(-1), rtol=1e-4
    )
    np.testing.assert_allclose(ensemble.each(params, np.stack([x] * 3)), members, atol=1e-6)
    assert all(np.abs(members[i] - members[j]).max() > 0.01 for i, j in ((0, 1), (0, 2), (1, 2)))


def test_ensembles_have_data_sets_of_their_own():
    fns, hparams = functions("ensemble_dagger")
    learner, _ = jax.jit(fns.train)(jax.random.key(0), hparams)
    copies = np.asarray(learner.algorithm.human.copies)  # [C, K]
    assert copies.mean() == pytest.approx(1.0, abs=0.1)
    assert copies.var() == pytest.approx(1.0, abs=0.15)  # Poisson
    assert np.abs(np.corrcoef(copies.T) - np.eye(3)).max() < 0.15
    # a member that lacks a row is not changed by it: with every copy taken away nothing moves
    state = learner.algorithm
    human = dataclasses.replace(state.human, copies=0.0 * state.human.copies.at[:, 1].set(0.0))
    human = dataclasses.replace(human, copies=human.copies.at[:, 0].set(1.0))
    fresh = fns.algorithm.init(jax.random.key(1))
    before = fresh.learned.params
    after, _ = fns.algorithm.update(
        dataclasses.replace(fresh, human=human), jax.random.key(2), hparams
    )
    for old, new in zip(
        jax.tree.leaves(before), jax.tree.leaves(after.learned.params), strict=True
    ):
        assert np.any(old[0] != new[0])
        np.testing.assert_array_equal(old[1:], new[1:])


def next_observation(observation, action):
    """The probe world's next observation, by hand."""
    sign, error, one = observation
    miss = abs(action[0] - Probe.answer(sign))
    return [sign, error + miss if miss > Probe.tolerance else 0.0, one]


@pytest.mark.parametrize("name", ["pvp", "haco", "thrifty_dagger"])
def test_next_observations_are_right_at_every_end_of_a_segment(name):
    fns, hparams = functions(name, total_steps=400)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), hparams)
    if name == "thrifty_dagger":
        held = [learner.algorithm.steps]
    else:
        held = [learner.algorithm.replay.human, learner.algorithm.replay.robot]
    human = int(learner.counters.human_data)
    assert [int(b.added) for b in held] in ([400], [human, 400 - human])
    for buffer in held:
        count = int(buffer.added)
        assert count > 20
        steps = jax.tree.map(lambda leaf, n=count: np.asarray(leaf)[:n], buffer.data)
        executed = steps.action if name == "thrifty_dagger" else steps.executed_action
        expected = [
            next_observation(o, a) for o, a in zip(steps.observation, executed, strict=True)
        ]
        np.testing.assert_allclose(steps.next_observation, expected, atol=1e-5)
        if name != "thrifty_dagger":
            # masks mean what they say
            assert (steps.takeover == (buffer is held[0])).all()
            ours = np.where(steps.takeover[:, None], steps.expert_action, steps.novice_action)
            np.testing.assert_array_equal(steps.executed_action, ours)
            np.testing.assert_allclose(
                steps.expert_action[:, 0], Probe.answer(steps.observation[:, 0]), atol=1e-6
            )
    if name != "thrifty_dagger":
        starts = int(np.sum(held[0].data.takeover_start))
        assert starts == int(learner.counters.takeovers) > 0


def test_eil_judges_the_window_before_an_intervention_bad_and_all_else_good():
    """A made-up run against a plain list: n novice, h expert, e the end of an episode."""
    window = 3
    story = "nnnnnhhnnhhhnnnnnenneh" + "nnnnhn"
    robot = buffers.init_buffer(
        eil.LabelledSteps(jnp.zeros(1), jnp.zeros(1), jnp.zeros((), bool)), 64
    )
    waiting = eil.PendingSteps(
        jnp.zeros((window, 1)), jnp.zeros((window, 1)), jnp.zeros((), jnp.int32)
    )
    judge = jax.jit(eil.judge)
    expected, unjudged, before = {}, [], ""
    for t, what in enumerate(story):
        takeover = what == "h"
        start = takeover and before != "h"
        if start:
            expected |= {s: s < t - window for s in unjudged}
            unjudged = []
        elif not takeover:
            unjudged.append(t)
            if what == "e":
                expected |= dict.fromkeys(unjudged, True)
                unjudged = []
        step = fake_step(t, takeover, start, what == "e")
        robot, waiting = judge(robot, waiting, step)
        before = what
    count = int(robot.added)
    judged = np.asarray(robot.data.action)[:count, 0].astype(int).tolist()
    found = dict(zip(judged, np.asarray(robot.data.good)[:count].tolist(), strict=True))
    expected |= {s: True for s in unjudged if len(story) - 1 - s >= window}
    assert found == expected
    assert count == len(found)  # nothing twice


def fake_step(t, takeover, start, done):
    from ppl_jax.types import Interaction

    flag = functools.partial(jnp.asarray, dtype=bool)
    number = jnp.array([float(t)])
    zero = jnp.zeros(())
    return Interaction(
        observation=number,
        next_observation=number,
        novice_action=number,
        expert_action=number,
        executed_action=number,
        takeover=flag(takeover),
        takeover_start=flag(start),
        reward=zero,
        cost=zero,
        terminated=flag(done),
        truncated=flag(False),
        success=flag(False),
        predicted=None,
    )


def test_balanced_batches():
    split = buffers.init_split(jnp.zeros(()), 10, 10)
    for value in range(3):
        split = buffers.add_split(split, jnp.float32(value), jnp.zeros((), bool))
    items, weight = buffers.sample_split(split, jax.random.key(0), 8)
    np.testing.assert_array_equal(weight, [0, 0, 0, 0, 2, 2, 2, 2])  # nothing of the expert's yet
    split = buffers.add_split(split, jnp.float32(7.0), jnp.ones((), bool))
    items, weight = buffers.sample_split(split, jax.random.key(0), 8)
    np.testing.assert_array_equal(weight, np.ones(8))
    np.testing.assert_array_equal(items[:4], 7 * np.ones(4))
    assert set(np.asarray(items[4:]).tolist()) <= {0.0, 1.0, 2.0}
    items, weight = buffers.sample_both(split, jax.random.key(0), 4000)
    np.testing.assert_array_equal(weight, np.ones(4000))
    assert np.mean(np.asarray(items) == 7) == pytest.approx(0.25, abs=0.03)


def test_batches_of_eil_and_thrifty_dagger():
    """The novice's half of a batch weighs nothing while it is empty; solved steps get a share."""
    config, _ = probe_settings("eil")
    spec, key = Probe().spec, jax.random.key(0)
    networks = eil.Networks(make_policy(spec, (4,)), make_critic(spec, (4,), 2))
    state = eil.init_state(key, networks, spec, config)
    batch = eil.sample_batch(state, key, 4)
    assert float(batch.weight) == 0.0
    assert batch.others.shape == (eil.OTHERS + 1, 4, spec.action_size)
    labelled = jax.tree.map(lambda leaf: leaf[:1], state.robot_buffer.data)
    robot = buffers.add(state.robot_buffer, labelled, jnp.ones(1, bool))
    state = dataclasses.replace(state, robot_buffer=robot)
    assert float(eil.sample_batch(state, key, 4).weight) == 1.0

    config, _ = probe_settings("thrifty_dagger")
    networks = thrifty_dagger.Networks(make_ensemble(spec, (4,), 3), make_critic(spec, (4,), 2))
    state = thrifty_dagger.init_state(key, networks, spec, config)
    row = jax.tree.map(lambda leaf: leaf[:1], state.steps.data)
    goal = dataclasses.replace(row, success=jnp.ones(1, bool))
    state = dataclasses.replace(state, steps=buffers.add(state.steps, row, jnp.ones(1, bool)))
    assert not np.any(thrifty_dagger.sample_steps(state, key, key, 20).success)
    state = dataclasses.replace(state, goals=buffers.add(state.goals, goal, jnp.ones(1, bool)))
    assert int(np.sum(thrifty_dagger.sample_steps(state, key, key, 20).success)) == 2


@pytest.mark.parametrize("which", ["preferred", "rejected"])
def test_random_pairs_are_drawn_once_and_change_nothing_else(which):
    fns, hparams = functions("ppl", total_steps=200, **{which: "random"})
    learner, _ = jax.jit(fns.train)(jax.random.key(0), hparams)
    state = learner.algorithm
    count = int(state.preference_buffer.added)
    assert 20 < count < 2000
    pairs = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], state.preference_buffer.data)
    drawn = np.asarray(state.random_actions)[int(which == "rejected"), :count]
    np.testing.assert_array_equal(getattr(pairs, f"{which}_action"), drawn)
    assert -1 <= drawn.min() < -0.8 < 0.8 < drawn.max() <= 1  # uniform on the box
    if which == "rejected":
        answer = Probe.answer(pairs.observation[:, 0])
        np.testing.assert_allclose(pairs.preferred_action[:, 0], answer, atol=1e-6)
    shown = np.asarray(state.human_buffer.data[1])[: int(state.human_buffer.added), 0]
    np.testing.assert_allclose(np.abs(shown), 0.6, atol=1e-6)


# --- learning ---


@functools.cache
def trained(name):
    """Two seeds at once."""
    fns, hparams = functions(name, PROBES.get(name, Probe)())
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    learners, _ = jax.jit(jax.vmap(fns.train, in_axes=(0, None)))(keys, hparams)
    return fns, hparams, learners


def lane(tree, i):
    return jax.tree.map(lambda leaf: leaf[i], tree)


@pytest.mark.parametrize("name", NAMES)
def test_a_probe_world_is_solved(name):
    fns, _, learners = trained(name)
    assert not np.any(learners.diverged)
    for i in range(2):
        assert success(PROBES.get(name, Probe)(), fns, lane(learners, i)) == 1.0


@pytest.mark.parametrize("name", NAMES)
def test_human_data_is_counted_exactly(name):
    _, _, learners = trained(name)
    config, _ = probe_settings(name)
    for i in range(2):
        learner = lane(learners, i)
        human = int(learner.counters.human_data)
        assert int(learner.counters.steps) == config.total_steps
        assert human >= config.demonstrations
        if name in ("bc", "gail"):
            assert human == config.demonstrations  # nobody takes over
        else:
            assert 0 < human < config.total_steps
        state = learner.algorithm
        held = {
            "human_buffer": lambda state: state.human_buffer,
            "human": lambda state: state.human.buffer,
            "steps": lambda state: state.steps.human,
            "replay": lambda state: state.replay.human,
        }
        field = next(f for f in held if hasattr(state, f))
        assert int(held[field](state).added) == human


@pytest.mark.parametrize("name", algorithms.registered(variants=False))
def test_a_vmapped_lane_is_the_run_alone_in_chunks_saved_and_restored(name, tmp_path):
    """One lane of two seeds and learning rates, against the same run in pieces on its own."""
    changes = {"total_steps": 40, "rollout_steps": 20, "batch_size": 8}
    changes |= {"demonstrations": 20, "offline_updates": 10} if name in OWN else {}
    fns, hparams = functions(name, **changes)
    config, _ = probe_settings(name, **changes)
    keys = jax.vmap(jax.random.key)(jnp.arange(2))
    rates = jnp.array([3e-3, 1e-3])
    together, _ = jax.jit(
        jax.vmap(lambda key, rate: fns.train(key, hparams.replace(learning_rate=rate)))
    )(keys, rates)
    pieces = jax.jit(fns.init)(keys[1], hparams.replace(learning_rate=1e-3))
    chunk = jax.jit(fns.run_chunk, static_argnums=(1, 2))
    for phase, length in phases(config):
        for _ in range(length // 20 or 1):
            pieces, _ = chunk(pieces, min(length, 20) // config.decision_interval, phase)
            checkpoint.save(tmp_path, 1, pieces)
            pieces = checkpoint.restore(tmp_path, pieces, lambda line: None)[1]
    for a, b in pairwise(pieces, lane(together, 1)):
        if not jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            # where a gradient vanishes, Adam makes whole steps of what rounding leaves of it
            np.testing.assert_allclose(a, b, atol=2 * 1e-3, rtol=1e-3)
            assert np.mean(np.abs(np.float64(a) - np.float64(b)) > 3e-4) < 0.02


# --- what theory says must fail ---

WATCHED = [
    name for name in NAMES if name not in ("bc", "gail", "ensemble_dagger", "thrifty_dagger", "iwr")
]


@pytest.mark.parametrize("name", WATCHED)
def test_nothing_is_learnt_where_nobody_intervenes(name):
    probe = Probe()
    config, hparams = probe_settings(name, min_speed=0.0, total_steps=100)
    watched = algorithms.method(name).make

    def careless(spec, config):
        never = lambda state, point, hparams: jnp.zeros((), bool)  # noqa: E731
        return watched(spec, config)._replace(decide=never)

    fns = make_train(probe, probe.scripted_expert, careless, config)
    start = jax.jit(fns.init)(jax.random.key(0), hparams)
    end, _ = jax.jit(fns.run_chunk, static_argnums=1)(start, 10)
    assert int(end.counters.human_data) == 0
    for a, b in pairwise(start.algorithm.learned, end.algorithm.learned):
        np.testing.assert_array_equal(a, b)


FAILS = {
    # a single member never disagrees with itself: without the discrepancy test it never asks
    "an ensemble of one": ("ensemble_dagger", {"members": 1, "max_discrepancy": 1e9}),
    # preferring noise to the novice's action says nothing about the expert's
    "ppl with random preferred actions alone": ("ppl", {"preferred": "random", "bc_weight": 0.0}),
}


@pytest.mark.parametrize("case", FAILS)
def test_a_variant_fails_where_theory_says_so(case):
    name, changes = FAILS[case]
    changes = dict(changes)
    if name == "ensemble_dagger":  # demonstrations of one kind of episode only
        changes |= {"demonstrations": 5, "offline_updates": 20}
    fns, hparams = functions(name, **changes)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), hparams)
    assert success(Probe(), fns, learner) < 1.0
    if name == "ensemble_dagger":
        assert int(learner.counters.human_data) == 5  # it never asked


def test_demonstrations_do_not_teach_to_come_back_and_interventions_do():
    """Covariate shift: in its own episodes the expert never strays.

    Half of the clones extrapolate well enough by chance, so a single seed says nothing.
    """
    results = {}
    for name in ("bc", "hg_dagger"):
        probe = Balance()
        fns, hparams = functions(name, probe)
        train = jax.jit(jax.vmap(fns.train, in_axes=(0, None)))
        learners, _ = train(jax.random.split(jax.random.key(0), 20), hparams)
        each = [jax.tree.map(lambda leaf, i=i: leaf[i], learners) for i in range(20)]
        results[name] = np.mean([success(probe, fns, learner) for learner in each])
    assert results["bc"] <= 0.8
    assert results["hg_dagger"] >= 0.95


@pytest.mark.parametrize(("correction", "solves"), [(1.0, True), (0.0, False)])
def test_a_reward_that_is_never_negative_makes_gail_loiter(correction, solves):
    """Where success ends the episode, -log(1 - D) >= 0 pays for not getting there."""
    probe = Goal()
    fns, hparams = functions("gail", probe, survival_correction=correction)
    learner, _ = jax.jit(fns.train)(jax.random.key(0), hparams)
    assert (success(probe, fns, learner) > 0.9) is solves
