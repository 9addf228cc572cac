import numpy as np
import pytest

from ppl_jax.statistics import interquartile_mean, mean_interval, paired_difference


def test_an_interval_holds_the_mean_and_narrows_with_data():
    rng = np.random.default_rng(0)
    few = mean_interval((rng.random((3, 10)) < 0.7).astype(float), rng)
    many = mean_interval((rng.random((20, 200)) < 0.7).astype(float), rng)
    assert few.low <= few.mean <= few.high
    assert many.low < 0.7 < many.high
    assert many.high - many.low < few.high - few.low


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(60):
        scores = (rng.random((5, 50)) < 0.8).astype(float)
        interval = mean_interval(scores, rng, replicates=300)
        inside += interval.low <= 0.8 <= interval.high
    assert inside >= 52


def test_pairing_removes_what_is_common():
    rng = np.random.default_rng(2)
    hard = rng.normal(0, 10, (1, 50))
    ours, theirs = hard + 1.0 + 0.1 * rng.normal(size=(5, 50)), np.repeat(hard, 5, 0)
    gap = paired_difference(ours, theirs, rng)
    assert gap.low > 0.9
    assert gap.high < 1.1


def test_the_same_generator_gives_the_same_interval():
    scores = np.random.default_rng(3).random((4, 10))
    assert mean_interval(scores, np.random.default_rng(0)) == mean_interval(
        scores, np.random.default_rng(0)
    )


def test_interquartile_mean_leaves_out_the_tails():
    assert interquartile_mean(np.array([-100.0, 1, 2, 3, 4, 5, 6, 100])) == pytest.approx(3.5)
