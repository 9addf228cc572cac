"""The theorem on random tabular MDPs, and its parts against plain loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax import bounds

S, A, L = 6, 3, 5


def case(key, horizon, beta, sharpness, quality):
    """A random world, an expert, a novice that resembles it or not, and its preference pairs."""
    keys = jax.random.split(key, 4)
    mdp = bounds.random_mdp(keys[0], S, A)
    expert = bounds.random_policy(keys[1], S, A, sharpness)
    other = bounds.random_policy(keys[2], S, A, sharpness)
    novice = quality * expert + (1 - quality) * other
    taken_over = jax.random.dirichlet(keys[3], jnp.ones(S))
    pairs = bounds.preference_pairs(
        mdp, expert, novice, taken_over, preference_horizon=horizon, max_horizon=L
    )
    return (
        mdp,
        expert,
        novice,
        taken_over,
        pairs,
        bounds.bound(mdp, expert, novice, pairs, beta=beta),
    )


many = jax.jit(jax.vmap(lambda *at: case(*at)[-1]))


def test_the_theorem_holds_on_thousands_of_mdps():
    n = 4000
    keys = jax.random.split(jax.random.key(0), n)
    rng = np.random.default_rng(0)
    horizon = jnp.asarray(rng.integers(1, L + 1, n))
    beta, sharpness = (jnp.asarray(10 ** rng.uniform(-2, 0.5, n), jnp.float32) for _ in range(2))
    quality = jnp.asarray(rng.uniform(0, 1, n), jnp.float32)
    found = many(keys, horizon, beta, sharpness, quality)
    assert np.all(np.isfinite(np.asarray(found.bound)))
    assert np.all(np.asarray(found.gap) <= np.asarray(found.bound) + 1e-4)
    for name in ("delta_dist", "delta_pref"):
        error = np.asarray(getattr(found, name))
        assert np.all((error >= -1e-5) & (error <= 1 + 1e-5))


def test_an_expert_that_is_copied_leaves_no_gap():
    *_, found = case(jax.random.key(3), 2, 0.1, 1.0, 1.0)
    assert float(found.gap) == pytest.approx(0, abs=1e-4)
    assert float(found.epsilon) == pytest.approx(0, abs=1e-5)


def test_a_longer_horizon_covers_more_and_labels_worse():
    """What the choice of L balances, in the mean over worlds with the pairs' states predicted."""
    keys = jax.random.split(jax.random.key(1), 500)
    ones = jnp.ones(500)
    short, long = (many(keys, ones * horizon, ones * 0.1, ones, ones * 0.5) for horizon in (1, L))
    assert float(jnp.mean(long.delta_dist)) < float(jnp.mean(short.delta_dist))


def test_the_parts_against_loops():
    mdp, expert, novice, taken_over, pairs, found = case(jax.random.key(7), 3, 0.2, 2.0, 0.3)
    p, r, d0 = (np.asarray(x, np.float64) for x in (mdp.transition, mdp.reward, mdp.start))
    h, n, begun = (np.asarray(x, np.float64) for x in (expert, novice, taken_over))
    gamma = 0.9

    def rollout(policy, at):
        """Distribution over time and discounted return of a start distribution."""
        total, visited = 0.0, np.zeros(S)
        for t in range(400):
            visited += (1 - gamma) * gamma**t * at
            after = np.zeros(S)
            for s in range(S):
                for a in range(A):
                    total += gamma**t * at[s] * policy[s, a] * r[s, a]
                    after += at[s] * policy[s, a] * p[s, a]
            at = after
        return total, visited

    own, visited = rollout(n, d0)
    assert float(found.gap) == pytest.approx(rollout(h, d0)[0] - own, abs=1e-4)
    np.testing.assert_allclose(bounds.occupancy(mdp, novice), visited, atol=1e-5)
    q = np.array([[r[s, a] + gamma * rollout(h, p[s, a])[0] for a in range(A)] for s in range(S)])
    np.testing.assert_allclose(bounds.action_values(mdp, expert), q, rtol=1e-4)
    assert float(found.spread) == pytest.approx((q.max(1) - q.min(1)).max(), rel=1e-4)

    joint = np.zeros((S, A, A))
    for s in range(S):
        for good in range(A):
            for bad in range(A):
                at = np.eye(S)[s]
                for _ in range(1 + 3):  # the present state and L = 3 predicted ones
                    joint[:, good, bad] += begun[s] * h[s, good] * n[s, bad] * at / 4
                    at = at @ p[:, bad]
    np.testing.assert_allclose(pairs, joint, atol=1e-6)
    states = joint.sum((1, 2))
    wrong = sum(
        0.5 * states[s] * np.abs(np.outer(h[s], n[s]) - joint[s] / states[s]).sum()
        for s in range(S)
    )
    assert float(found.delta_pref) == pytest.approx(wrong, abs=1e-5)
    assert float(found.delta_dist) == pytest.approx(0.5 * np.abs(visited - states).sum(), abs=1e-5)

    def loss(policy):
        total = 0.0
        for s in range(S):
            for good in range(A):
                for bad in range(A):
                    margin = 0.2 * np.log(policy[s, good] / policy[s, bad])
                    total += joint[s, good, bad] * np.log(1 + np.exp(-margin))
        return total

    assert float(found.epsilon) == pytest.approx(loss(n) - loss(h), abs=1e-5)


def test_shapes_that_do_not_fit_are_refused():
    mdp = bounds.random_mdp(jax.random.key(0), S, A)
    policy = bounds.random_policy(jax.random.key(1), S, A)
    pairs = jnp.ones((S, A, A)) / (S * A * A)
    for call in (
        lambda: bounds.action_values(mdp, policy.T),
        lambda: bounds.occupancy(mdp, policy[0]),
        lambda: bounds.total_variation(policy, policy[0]),
        lambda: bounds.preference_loss(pairs[:, 0], policy, 0.1),
        lambda: bounds.bound(mdp, policy, policy[:, :1], pairs, beta=0.1),
        lambda: bounds.preference_pairs(
            mdp, policy, policy, policy, preference_horizon=1, max_horizon=L
        ),
    ):
        with pytest.raises(AssertionError, match="shape"):
            call()
