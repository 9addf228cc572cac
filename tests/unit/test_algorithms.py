"""Every method: its losses by NumPy loops, its networks and its data."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax import buffers
from ppl_jax.algorithms import eil, gail, haco, ppl, pvp, replay, thrifty_dagger
from ppl_jax.algorithms.ensemble_dagger import ensemble_variance
from ppl_jax.config import HParams, as_arrays
from ppl_jax.distributions import surrogate
from ppl_jax.experts import SavedPolicy, act
from ppl_jax.interaction import learn
from ppl_jax.networks import (
    ensemble_layers,
    layers,
    make_critic,
    make_ensemble,
    make_policy,
    make_raw,
)
from ppl_jax.policies import Novice
from ppl_jax.types import PreferenceBatch
from tests.helpers import Probe, functions, plain_settings, probe_settings

RNG = np.random.default_rng(1)
B, K, A = 6, 2, 3
HP = HParams(learning_rate=3e-3)


def uniform(*shape):
    return RNG.uniform(-1, 1, shape).astype(np.float32)


def coins(*shape):
    return RNG.integers(0, 2, shape).astype(bool)


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
    policy = Novice(
        init=lambda key: None,
        output=lambda params, observation: params + observation,
        act=lambda params, key, observation: observation,
        likelihood=lambda hparams: surrogate("gaussian"),
        layers=lambda params: [],
    )
    means, expert, good, bad = (uniform(B, A) for _ in range(4))
    pairs = PreferenceBatch(
        observation=means, preferred_action=good, rejected_action=bad, rejected_observation=None
    )
    bc = np.mean(np.sum((means - expert) ** 2, -1))
    delta = np.sum((means - bad) ** 2, -1) - np.sum((means - good) ** 2, -1)
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


@pytest.mark.parametrize("outputs", [1, 2, 3])
def test_a_network_and_its_gradient_are_those_of_plain_products(outputs):
    network = make_raw(Probe().spec, (8, 8), outputs)
    params = network.init(jax.random.key(0))
    x, target = uniform(B, 3), uniform(B, outputs)

    def plain(params, x):
        *hidden, (w, b) = layers(params)
        for kernel, bias in hidden:
            x = jnp.maximum(x @ kernel + bias, 0)
        return x @ w + b

    def slope(apply, transform=lambda function: function):
        return jax.grad(lambda params: jnp.mean((transform(apply)(params, x) - target) ** 2))(
            params
        )

    each = functools.partial(jax.vmap, in_axes=(None, 0))
    for found in (slope(network.apply), slope(network.apply, each)):
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6), found, slope(plain)
        )
    assert network.apply(params, x[0]).shape == (outputs,)


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


# --- what no update can do ---


@pytest.mark.parametrize("part", ["loss", "params", "opt_state", "average"])
def test_an_update_that_leaves_a_number_that_is_not_finite_changes_nothing(part):
    learner = functions("ppl")[0].init(jax.random.key(0), HParams(method=ppl.PPLHParams()))

    def update(state, key, hparams):
        learned = jax.tree.map(lambda leaf: leaf + 1, state.learned)
        loss = jnp.where(part == "loss", jnp.inf, 1.0)
        if part != "loss":
            sick = jax.tree.map(lambda leaf: leaf * jnp.nan, getattr(learned, part))
            learned = dataclasses.replace(learned, **{part: sick})
        return dataclasses.replace(state, learned=learned), {"bc_loss": loss}

    after, _ = learn(learner, update)
    assert bool(after.diverged)
    before = learner.algorithm.learned
    for old, new in zip(*map(jax.tree.leaves, (before, after.algorithm.learned)), strict=True):
        np.testing.assert_array_equal(old, new)


def test_an_l_beyond_the_program_is_refused_or_where_it_is_traced_flagged():
    made, hparams = functions("ppl", max_preference_horizon=4)
    method = dataclasses.replace(hparams.method, preference_horizon=5)
    beyond = dataclasses.replace(hparams, method=method)
    with pytest.raises(ValueError, match=r"must not exceed max_preference_horizon \(4\), got 5"):
        made.init(jax.random.key(0), beyond)
    learner = made.init(jax.random.key(0), hparams)
    update = jax.jit(made.algorithm.update)
    for asked, flag in ((hparams, 0.0), (beyond, 1.0)):
        _, metrics = update(learner.algorithm, jax.random.key(1), as_arrays(asked))
        assert float(metrics["horizon_cut"]) == flag
