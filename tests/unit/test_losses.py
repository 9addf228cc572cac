import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax.distributions import (
    EDGE,
    SQUASHED,
    gaussian_log_prob,
    log_likelihood,
    mean_and_log_std,
    squashed_gaussian,
    squashed_log_prob,
    surrogate,
)
from ppl_jax.losses import bc_loss, pair_likelihoods, preference_loss

RNG = np.random.default_rng(0)
MEAN, GOOD, BAD, OTHER = (RNG.uniform(-1, 1, (7, 3)).astype(np.float32) for _ in range(4))


def energy(mean, action, kind):
    """Minus the log-likelihood, by a loop."""
    square = sum((float(m) - float(a)) ** 2 for m, a in zip(mean, action, strict=True))
    return square if kind == "gaussian" else (math.sqrt(square + 0.09) - 0.3) / 0.3


def cpo_loss(mean, good, other, bad, beta, bias=1.0, kind="gaussian"):
    return preference_loss(
        pair_likelihoods(mean, good, other, bad, bias=bias, likelihood=kind), beta, bias
    )


KINDS = pytest.mark.parametrize("kind", ["gaussian", "laplace"])


@KINDS
@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_bc_is_a_loop_over_samples(kind, reduction):
    expected = sum(energy(m, a, kind) for m, a in zip(MEAN, GOOD, strict=True)) / len(MEAN)
    expected /= 3 if reduction == "mean" else 1
    loss, _ = bc_loss(MEAN, GOOD, kind, reduction)
    assert float(loss) == pytest.approx(expected, rel=1e-5)


@KINDS
def test_a_weighted_bc_loss(kind):
    weight = RNG.uniform(0, 2, 7).astype(np.float32)
    expected = sum(w * energy(m, a, kind) / 7 for w, m, a in zip(weight, MEAN, GOOD, strict=True))
    assert float(bc_loss(MEAN, GOOD, kind, weight=weight)[0]) == pytest.approx(expected, rel=1e-5)


@KINDS
@pytest.mark.parametrize("bias", [0.5, 1.0])
@pytest.mark.parametrize("target", ["pair", "library"])
@pytest.mark.parametrize("objective", ["dpo", "ipo", "slic_hf", "imitation"])
def test_other_objectives_are_loops_over_pairs(objective, target, bias, kind):
    beta, expected = 0.2, 0.0
    frozen = RNG.uniform(-1, 1, (7, 3)).astype(np.float32)
    for m, f, good, bad in zip(MEAN, frozen, GOOD, BAD, strict=True):
        delta = -energy(m, good, kind) + bias * energy(m, bad, kind)
        reference = -energy(f, good, kind) + bias * energy(f, bad, kind)
        attained = bias * energy(good, bad, kind)  # of a policy that acts as preferred
        if objective == "dpo":
            each = np.log1p(np.exp(-beta * (delta - reference)))
        elif objective == "ipo":
            aim = 1 / (2 * beta) if target == "library" else max(attained - reference, 0)
            each = (delta - reference - aim) ** 2
        elif objective == "slic_hf":
            each = max(0.0, (1.0 if target == "library" else attained) - delta)
        else:
            each = energy(m, good, kind)
        expected += each / 7
    pairs = pair_likelihoods(
        MEAN, GOOD, MEAN, BAD, bias=bias, likelihood=kind, reference=(frozen, frozen)
    )
    loss, _ = preference_loss(pairs, beta, bias, objective=objective, target=target)
    assert float(loss) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("objective", ["ipo", "slic_hf"])
@pytest.mark.parametrize(("target", "corner"), [("library", True), ("pair", False)])
def test_only_library_targets_drive_an_action_to_the_corner(objective, target, corner):
    """Near actions cannot be told apart by as much as the libraries ask for."""
    good, bad = jnp.array([[0.2, 0.0]]), jnp.array([[-0.2, 0.0]])

    def loss(mean):
        pairs = pair_likelihoods(mean, good, mean, bad, reference=(0 * good, 0 * good))
        return preference_loss(pairs, 0.1, 1.0, objective=objective, target=target)[0]

    def step(mean, _):
        return jnp.clip(mean - 0.02 * jax.grad(loss)(mean), -1.0, 1.0), None

    mean = jax.lax.scan(step, jnp.zeros((1, 2)), None, length=500)[0]
    assert (float(mean[0, 0]) > 0.99) is corner
    assert float(mean[0, 0]) > 0.15


@KINDS
@pytest.mark.parametrize("beta", [0.0, 0.1, 5.0])
@pytest.mark.parametrize("bias", [0.5, 1.0])
@pytest.mark.parametrize("shifted", [False, True])
def test_cpo_is_a_loop_over_pairs(kind, beta, bias, shifted):
    rejected_mean = OTHER if shifted else MEAN
    expected = 0.0
    for m, r, good, bad in zip(MEAN, rejected_mean, GOOD, BAD, strict=True):
        logit = beta * (-energy(m, good, kind) + bias * energy(r, bad, kind))
        expected += np.log1p(np.exp(-logit)) / len(MEAN)
    loss, metrics = cpo_loss(MEAN, GOOD, rejected_mean, BAD, beta, bias, kind)
    assert float(loss) == pytest.approx(expected, rel=1e-5)
    better = [
        energy(m, g, kind) < energy(r, b, kind)
        for m, r, g, b in zip(MEAN, rejected_mean, GOOD, BAD, strict=True)
    ]
    assert float(metrics["preference_accuracy"]) == pytest.approx(np.mean(better))


def test_gradient_points_from_rejected_to_preferred():
    # Gaussian: d/dmu of -log sigmoid(beta(|mu-b|^2 - |mu-a|^2)) = 2 beta sigmoid(-z) (b - a)
    gradient = jax.grad(lambda m: cpo_loss(m, GOOD, m, BAD, 0.1, 1.0, "gaussian")[0])(
        jnp.asarray(MEAN)
    )
    z = 0.1 * (((MEAN - BAD) ** 2).sum(1) - ((MEAN - GOOD) ** 2).sum(1))
    expected = 0.2 / (1 + np.exp(z))[:, None] * (BAD - GOOD) / len(MEAN)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("kind", "overshoots"), [("gaussian", True), (surrogate("laplace", 0.1, 0.1), False)]
)
def test_only_the_gaussian_pushes_past_the_preferred_action(kind, overshoots):
    """Minimise the paper's loss on one pair: where does the action end?"""
    good, bad = jnp.array([[0.2, 0.0]]), jnp.array([[-0.2, 0.0]])

    def step(mean, _):
        gradient = jax.grad(lambda m: cpo_loss(m, good, m, bad, 1.0, 1.0, kind)[0])(mean)
        return jnp.clip(mean - 0.05 * gradient, -1.0, 1.0), None

    mean = jax.lax.scan(step, jnp.zeros((1, 2)), None, length=400)[0]
    assert (float(mean[0, 0]) > 0.9) is overshoots
    assert float(mean[0, 0]) > 0.15


@pytest.mark.parametrize(("scale", "core"), [(0.3, 0.3), (0.1, 0.3), (0.3, 0.05)])
def test_past_the_preferred_action_the_laplace_has_little_to_gain(scale, core):
    good, bad = jnp.array([0.2, 0.0]), jnp.array([-0.3, 0.0])
    mean = jnp.stack([jnp.linspace(0.2, 1.0, 50), jnp.zeros(50)], -1)
    delta = log_likelihood(mean, good + 0 * mean, "laplace", scale=scale, core=core)
    delta -= log_likelihood(mean, bad + 0 * mean, "laplace", scale=scale, core=core)
    gained = np.asarray(delta - delta[0])
    assert np.all(np.diff(gained) > -1e-4)
    assert gained[-1] <= core / scale


@KINDS
def test_gradients_are_finite_at_the_corners_of_the_action_box(kind):
    corner = jnp.ones((4, 2))
    for mean in (corner, -corner, 0 * corner):
        for beta in (0.1, 1e3):
            gradient = jax.grad(lambda m, b=beta: cpo_loss(m, corner, m, -corner, b, 1.0, kind)[0])(
                mean
            )
            assert bool(jnp.all(jnp.isfinite(gradient)))
        assert bool(jnp.all(jnp.isfinite(jax.grad(lambda m: bc_loss(m, corner, kind)[0])(mean))))


OUTPUTS = RNG.normal(0, 1.5, (7, 6)).astype(np.float32)


def test_a_squashed_density_is_that_of_its_samples_and_adds_up_to_one():
    mean, log_std = mean_and_log_std(OUTPUTS)
    assert float(log_std.min()) > -5.0
    assert float(log_std.max()) < 2.0
    sample, expected = squashed_gaussian(jax.random.key(0), 0.3 * mean, log_std)
    shrunk = np.concatenate([0.3 * OUTPUTS[:, :3], OUTPUTS[:, 3:]], -1)
    inside = np.all(np.abs(sample) < 1 - EDGE, -1)
    assert inside.sum() >= 3
    np.testing.assert_allclose(
        squashed_log_prob(shrunk, sample)[inside], expected[inside], rtol=1e-3, atol=1e-3
    )
    u = np.linspace(-9, 9, 20_001)  # the integral over the box, in the variable that has no edge
    for center, spread in ((0.0, 0.0), (0.8, -1.0), (-0.5, -0.6)):
        outputs = np.tile(np.float32([center, spread]), (len(u), 1))
        density = np.exp(squashed_log_prob(outputs, np.tanh(u)[:, None].astype(np.float32)))
        kept = np.abs(np.tanh(u)) < 1 - EDGE
        total = np.trapezoid((density * (1 - np.tanh(u) ** 2))[kept], u[kept])
        std = np.exp(mean_and_log_std(outputs[0])[1][0])
        reach = np.arctanh(1 - EDGE)
        tails = 0.5 * sum(math.erfc((reach + s * center) / (std * 2**0.5)) for s in (1, -1))
        assert total == pytest.approx(1 - tails, abs=2e-3)


def test_a_squashed_density_is_finite_at_the_edge_of_the_box():
    for action in (np.ones((7, 3)), -np.ones((7, 3)), np.float32(GOOD)):
        for scale in (1.0, 30.0):
            action = np.float32(action)
            value, gradient = jax.value_and_grad(
                lambda out, a=action: (
                    cpo_loss(out, a, out, BAD, 0.1, 1.0, SQUASHED)[0] + bc_loss(out, a, SQUASHED)[0]
                )
            )(scale * OUTPUTS)
            assert np.isfinite(value)
            assert np.all(np.isfinite(gradient))


def test_the_output_that_attains_an_action_is_most_likely_to_give_it():
    there = SQUASHED.attaining(OUTPUTS, 0.9 * GOOD)
    mean, log_std = mean_and_log_std(there)
    np.testing.assert_allclose(np.tanh(mean), 0.9 * GOOD, atol=1e-5)
    np.testing.assert_array_equal(log_std, mean_and_log_std(OUTPUTS)[1])
    np.testing.assert_array_equal(surrogate("laplace").attaining(MEAN, GOOD), GOOD)


def test_the_laplace_likelihood_has_its_scale_and_core():
    value = log_likelihood(MEAN, GOOD, "laplace", scale=0.3, core=0.5)
    square = np.sum((MEAN - GOOD) ** 2, -1)
    np.testing.assert_allclose(value, -(np.sqrt(square + 0.25) - 0.5) / 0.3, rtol=1e-5)
    assert float(bc_loss(MEAN, GOOD, surrogate("laplace", 0.3, 0.5))[0]) == pytest.approx(
        -float(np.mean(value)), rel=1e-6
    )


PAIRS = pair_likelihoods(MEAN, GOOD, MEAN, BAD)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: log_likelihood(MEAN, GOOD, "student"),
            "likelihood must be one of gaussian, laplace, got 'student'",
        ),
        (
            lambda: bc_loss(MEAN, GOOD, "gausian"),
            "got 'gausian': did you mean 'gaussian'?",
        ),
        (
            lambda: bc_loss(MEAN, GOOD, reduction="average"),
            "reduction must be one of sum, mean, got 'average'",
        ),
        (
            lambda: pair_likelihoods(MEAN, GOOD, MEAN, BAD, likelihood="laplac"),
            "got 'laplac': did you mean 'laplace'?",
        ),
        (
            lambda: preference_loss(PAIRS, 0.1, objective="slic"),
            "objective must be one of cpo, dpo, ipo, slic_hf, imitation, got 'slic'",
        ),
        (
            lambda: preference_loss(PAIRS, 0.1, objective="ipo", target="lib"),
            "target must be one of pair, library, got 'lib'",
        ),
        (
            lambda: preference_loss(PAIRS, 0.1, target="libary"),  # cpo has none, yet it is wrong
            "got 'libary': did you mean 'library'?",
        ),
    ],
)
def test_an_unknown_name_is_refused_with_those_that_there_are(call, message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        call()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "call",
    [
        lambda: bc_loss(jnp.zeros((4, 1)), jnp.arange(4.0)),
        lambda: bc_loss(MEAN, GOOD[:3]),
        lambda: bc_loss(MEAN, GOOD, weight=np.ones((7, 1))),
        lambda: bc_loss(MEAN, GOOD, weight=np.ones(3)),
        lambda: log_likelihood(MEAN, GOOD[0]),
        lambda: gaussian_log_prob(MEAN, np.zeros(2), GOOD),
        lambda: gaussian_log_prob(MEAN, np.zeros(3), GOOD[0]),
        lambda: squashed_gaussian(jax.random.key(0), MEAN, np.zeros(3)),
        lambda: pair_likelihoods(MEAN, GOOD, MEAN, BAD[:3]),
        lambda: pair_likelihoods(MEAN, GOOD, MEAN, BAD, reference=(MEAN, MEAN[:, :1])),
        lambda: pair_likelihoods(MEAN[0], GOOD[0], MEAN[0], BAD[0]),
        lambda: preference_loss(PAIRS._replace(rejected=np.zeros((7, 1))), 0.1),
        lambda: preference_loss(PAIRS._replace(reference=np.zeros((7, 1))), 0.1),
    ],
)
def test_shapes_that_do_not_fit_are_refused(call):
    with pytest.raises(AssertionError, match=r"shape|broadcast|rank") as error:
        call()
    assert "\n" not in str(error.value)
