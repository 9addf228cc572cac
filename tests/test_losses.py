import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ppl_jax.losses import bc_loss, cpo_loss

RNG = np.random.default_rng(0)
MEAN, GOOD, BAD, OTHER = (RNG.uniform(-1, 1, (7, 3)).astype(np.float32) for _ in range(4))


def energy(mean, action, kind):
    """Minus the log-likelihood, by a loop."""
    square = sum((float(m) - float(a)) ** 2 for m, a in zip(mean, action, strict=True))
    return square if kind == "gaussian" else (math.sqrt(square + 0.01) - 0.1) / 0.1


KINDS = pytest.mark.parametrize("kind", ["gaussian", "laplace"])


@KINDS
@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_bc_is_a_loop_over_samples(kind, reduction):
    expected = sum(energy(m, a, kind) for m, a in zip(MEAN, GOOD, strict=True)) / len(MEAN)
    expected /= 3 if reduction == "mean" else 1
    loss, _ = bc_loss(MEAN, GOOD, kind, reduction)
    assert float(loss) == pytest.approx(expected, rel=1e-5)


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


@pytest.mark.parametrize(("kind", "overshoots"), [("gaussian", True), ("laplace", False)])
def test_only_the_gaussian_pushes_past_the_preferred_action(kind, overshoots):
    """Minimise the paper's loss on one pair: where does the action end?"""
    good, bad = jnp.array([[0.2, 0.0]]), jnp.array([[-0.2, 0.0]])

    def step(mean, _):
        gradient = jax.grad(lambda m: cpo_loss(m, good, m, bad, 1.0, 1.0, kind)[0])(mean)
        return jnp.clip(mean - 0.05 * gradient, -1.0, 1.0), None

    mean = jax.lax.scan(step, jnp.zeros((1, 2)), None, length=400)[0]
    assert (float(mean[0, 0]) > 0.9) is overshoots
    assert float(mean[0, 0]) > 0.15


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
