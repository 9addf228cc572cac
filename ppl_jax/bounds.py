"""The theorem on PPL's performance gap, exactly on tabular MDPs.

Theorem 4.1 (formally F.1) of the paper bounds how far the novice's policy n falls behind the
expert's h by three errors. With D_TV(P, Q) = |P - Q|_1 / 2,

    delta_dist = D_TV(d_n, d_pref)                        states visited, states with preferences
    delta_pref = E_{s ~ d_pref} D_TV(rho_ideal^s, rho_pref^s)   pairs as they are, as they should be
    epsilon    = L_pref(n) - L_pref(h)                    preference loss not yet minimised

    rho_ideal^s(a+, a-) = h(a+ | s) n(a- | s)
    L_pref(pi) = -E_{D_pref} log sigmoid(beta log pi(a+ | s) - beta log pi(a- | s))

Its constants follow from its proof (appendix F), in steps that each function below names:

    (1 - gamma) (J(h) - J(n)) <= U (E_{d_pref} D_TV(h, n) + 2 delta_dist)             Lemma F.2
    g(n) - g(h) <= epsilon + 4 (beta M + log 2) delta_pref                            Lemma F.3
    E_{d_pref} D_TV(h, n) <= sqrt((g(n) - g(h)) / (2 beta) + beta M^2 / 8)            Lemma F.4

where g is L_pref on ideal pairs, U bounds |Q_h(s, a) - Q_h(s, a')|, M bounds
|log pi(a | s) - log pi(a' | s)| for both policies; so

    J(h) - J(n) <= U / (1 - gamma) [ 2 delta_dist
                   + sqrt((epsilon + 4 (beta M + log 2) delta_pref) / (2 beta) + beta M^2 / 8) ].

A longer preference horizon L moves d_pref towards d_n and pairs away from ideal ones.
"""

from __future__ import annotations

from typing import NamedTuple

import chex
import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.checks import check_limit


@flax.struct.dataclass
class TabularMDP:
    """A finite MDP with discount.

    Attributes:
        transition: [S, A, S] probabilities.
        reward: [S, A].
        start: [S] distribution of the first state.
        discount: gamma, below 1.
    """

    transition: jax.Array
    reward: jax.Array
    start: jax.Array
    discount: jax.Array | float


class Bound(NamedTuple):
    """Both sides of the theorem and their terms, scalars.

    Attributes:
        gap: J(h) - J(n), discounted returns.
        bound: The theorem's right-hand side.
        delta_dist, delta_pref, epsilon: The three errors.
        spread: U.
        log_ratio: M.
    """

    gap: jax.Array
    bound: jax.Array
    delta_dist: jax.Array
    delta_pref: jax.Array
    epsilon: jax.Array
    spread: jax.Array
    log_ratio: jax.Array


def total_variation(p: jax.Array, q: jax.Array, axis: int | tuple[int, ...] = -1) -> jax.Array:
    """D_TV = |P - Q|_1 / 2 over `axis`."""
    chex.assert_equal_shape([p, q], custom_message="p and q")
    return 0.5 * jnp.sum(jnp.abs(p - q), axis)


def _check(mdp: TabularMDP, *policies: jax.Array) -> None:
    """Check that an MDP's arrays and policies [S, A] fit each other."""
    states, actions = mdp.reward.shape
    chex.assert_shape(mdp.transition, (states, actions, states))
    chex.assert_shape(mdp.start, (states,))
    chex.assert_shape(policies, (states, actions))


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """The solution x [S] of matrix x = right, matrix [S, S], by Gauss-Jordan elimination.

    I - gamma P and its transpose are diagonally dominant by rows or columns, so no pivoting is
    needed. `jnp.linalg.solve` would do the same by LAPACK, which XLA's CPU backend calls on the
    threads that it computes on: under a `vmap` over thousands of problems, a machine with few cores
    can wait for itself without end.
    """
    chex.assert_shape(matrix, (right.shape[0], right.shape[0]))

    def eliminate(k: jax.Array | int, rows: jax.Array) -> jax.Array:
        pivot = rows[k] / rows[k, k]
        return (rows - jnp.outer(rows[:, k], pivot)).at[k].set(pivot)

    rows = jnp.concatenate([matrix, right[:, None]], -1)
    return jax.lax.fori_loop(0, right.shape[0], eliminate, rows)[:, -1]


def action_values(mdp: TabularMDP, policy: jax.Array) -> jax.Array:
    """Q of a policy [S, A]: Q = r + gamma P V, V = sum_a pi Q, [S, A]."""
    _check(mdp, policy)
    moves = jnp.einsum("sa,sat->st", policy, mdp.transition)
    paid = jnp.sum(policy * mdp.reward, -1)
    value = _solve(jnp.eye(paid.shape[0]) - mdp.discount * moves, paid)
    return mdp.reward + mdp.discount * mdp.transition @ value


def occupancy(mdp: TabularMDP, policy: jax.Array) -> jax.Array:
    """d_pi(s) = (1 - gamma) sum_t gamma^t P(s_t = s), [S]."""
    _check(mdp, policy)
    moves = jnp.einsum("sa,sat->st", policy, mdp.transition)
    matrix = jnp.eye(moves.shape[0]) - mdp.discount * moves.T
    return (1 - mdp.discount) * _solve(matrix, mdp.start)


def preference_pairs(
    mdp: TabularMDP,
    expert: jax.Array,
    novice: jax.Array,
    taken_over: jax.Array,
    *,
    preference_horizon: jax.Array | int,
    max_horizon: int,
) -> jax.Array:
    """The limit of D_pref: the joint distribution of (state, a+, a-), [S, A, A].

        rho(s', a+, a-) = 1/(L+1) sum_{i=0..L} sum_s taken_over(s) h(a+|s) n(a-|s) P_{a-}^i(s, s')

    Both actions are drawn where the expert takes over; the state is that one (i = 0) or is
    predicted from there by i steps with the novice's action held (Algorithm 1, section 4.1).

    Args:
        mdp: The environment; it is its own predictor.
        expert, novice: h and n, [S, A].
        taken_over: [S] distribution of states where the expert takes over.
        preference_horizon: L, 1 to `max_horizon`.
        max_horizon: Static.

    Raises:
        ValueError: If L, where it is not traced, exceeds `max_horizon`.
    """
    _check(mdp, expert, novice)
    check_limit("preference_horizon", preference_horizon, "max_horizon", max_horizon)
    chex.assert_equal_shape([taken_over, mdp.start], custom_message="taken_over and start")
    begun = jnp.einsum("s,sp,sn->nps", taken_over, expert, novice)  # [A-, A+, S]
    held = jnp.moveaxis(mdp.transition, 1, 0)  # [A-, S, S]

    def step(at: jax.Array, i: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = jnp.einsum("nps,nst->npt", at, held)
        return at, at * (i < preference_horizon)

    _, reached = jax.lax.scan(step, begun, jnp.arange(max_horizon))
    return jnp.transpose((begun + jnp.sum(reached, 0)) / (preference_horizon + 1), (2, 1, 0))


def preference_loss(pairs: jax.Array, policy: jax.Array, beta: jax.Array | float) -> jax.Array:
    """L_pref of a policy [S, A] on pairs [S, A, A]."""
    states, actions = policy.shape
    chex.assert_shape(pairs, (states, actions, actions))
    log = jnp.log(policy)
    margin = beta * (log[:, :, None] - log[:, None, :])
    return -jnp.sum(pairs * jax.nn.log_sigmoid(margin))


def bound(
    mdp: TabularMDP,
    expert: jax.Array,
    novice: jax.Array,
    pairs: jax.Array,
    *,
    beta: jax.Array | float,
) -> Bound:
    """Both sides of the theorem for policies h and n, [S, A] (all positive), and D_pref's pairs.

    Args:
        mdp: The environment.
        expert, novice: h and n.
        pairs: [S, A, A] distribution of (state, a+, a-), such as `preference_pairs` gives.
        beta: Temperature of the preference loss.
    """
    _check(mdp, expert, novice)
    values = action_values(mdp, expert)
    value = jnp.sum(expert * values, -1)
    own = jnp.sum(novice * action_values(mdp, novice), -1)
    gap = jnp.sum(mdp.start * (value - own))
    states = jnp.sum(pairs, (1, 2))
    ideal = expert[:, :, None] * novice[:, None, :]
    seen = states[:, None, None]
    given = jnp.where(seen > 0, pairs / jnp.where(seen > 0, seen, 1.0), ideal)
    delta_pref = jnp.sum(states * total_variation(ideal, given, (1, 2)))
    delta_dist = total_variation(occupancy(mdp, novice), states)
    epsilon = preference_loss(pairs, novice, beta) - preference_loss(pairs, expert, beta)
    spread = jnp.max(jnp.max(values, -1) - jnp.min(values, -1))
    logs = jnp.log(jnp.stack([expert, novice]))
    log_ratio = jnp.max(jnp.max(logs, -1) - jnp.min(logs, -1))
    wrong = 4 * (beta * log_ratio + jnp.log(2.0)) * delta_pref
    apart = jnp.sqrt(jnp.maximum(epsilon + wrong, 0) / (2 * beta) + beta * log_ratio**2 / 8)
    limit = spread / (1 - mdp.discount) * (2 * delta_dist + apart)
    return Bound(
        gap=gap,
        bound=limit,
        delta_dist=delta_dist,
        delta_pref=delta_pref,
        epsilon=epsilon,
        spread=spread,
        log_ratio=log_ratio,
    )


def random_mdp(key: jax.Array, states: int, actions: int, discount: float = 0.9) -> TabularMDP:
    """A random MDP: sparse-ish transitions, rewards in [0, 1]."""
    key_moves, key_reward, key_start = jax.random.split(key, 3)
    moves = jax.random.dirichlet(key_moves, jnp.full(states, 0.3), (states, actions))
    reward = jax.random.uniform(key_reward, (states, actions))
    start = jax.random.dirichlet(key_start, jnp.ones(states))
    return TabularMDP(transition=moves, reward=reward, start=start, discount=discount)


def random_policy(key: jax.Array, states: int, actions: int, sharpness: float = 1.0) -> jax.Array:
    """A random policy with full support, [S, A]."""
    return jax.nn.softmax(sharpness * jax.random.normal(key, (states, actions)), -1)
