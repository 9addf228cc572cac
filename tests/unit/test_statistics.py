import numpy as np
import pytest
import scipy.stats

from ppl_jax import statistics
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


def test_interquartile_mean_is_scipys_trimmed_mean():
    for size in (4, 5, 7, 10, 50):
        scores = np.random.default_rng(size).normal(size=size)
        expected = scipy.stats.trim_mean(scores, 0.25)
        assert statistics.interquartile_mean(scores) == pytest.approx(expected)


def test_interval_of_the_interquartile_mean_is_scipys():
    scores = np.random.default_rng(1).normal(size=20)
    ours = statistics.interquartile_interval(
        scores[None], np.random.default_rng(0), level=0.95, replicates=20_000
    )
    theirs = scipy.stats.bootstrap(
        (scores,),
        lambda x, axis: scipy.stats.trim_mean(x, 0.25, axis=axis),
        n_resamples=20_000,
        method="percentile",
        random_state=np.random.default_rng(1),
    ).confidence_interval
    assert ours.low == pytest.approx(theirs.low, abs=0.02)
    assert ours.high == pytest.approx(theirs.high, abs=0.02)


def test_the_interval_keeps_to_its_tasks():
    """Two tasks of one run each cannot vary: strata are resampled within, never across."""
    ours = statistics.interquartile_interval([[0.0], [1.0]], np.random.default_rng(0))
    assert (ours.mean, ours.low, ours.high) == (0.5, 0.5, 0.5)


def test_probability_of_improvement_is_mann_whitneys():
    rng = np.random.default_rng(3)
    ours, theirs = rng.integers(0, 6, 9), rng.integers(0, 5, 7)
    expected = scipy.stats.mannwhitneyu(ours, theirs).statistic / (9 * 7)
    found = statistics.probability_of_improvement(ours[None], theirs[None], rng)
    assert found.mean == pytest.approx(expected)
    assert found.low < found.mean < found.high
    sure = statistics.probability_of_improvement([[2.0, 3.0]], [[0.0, 1.0]], rng)
    assert (sure.mean, sure.low, sure.high) == (1.0, 1.0, 1.0)


def test_one_seed_has_an_interval_over_scenarios_and_one_number_has_none():
    scores = np.random.default_rng(0).random((1, 50))
    one = mean_interval(scores)
    assert one.known
    assert one.mean == pytest.approx(scores.mean())
    assert one.low < one.mean < one.high
    alone = mean_interval([[0.28]])
    assert alone.mean == 0.28
    assert not alone.known


def test_the_generator_is_the_same_unless_one_is_given():
    scores = np.random.default_rng(3).random((4, 10))
    assert mean_interval(scores) == mean_interval(scores, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (
            lambda: mean_interval(np.ones(5)),
            r"scores must be \[seeds, scenarios\].*got shape \(5,\)",
        ),
        (lambda: mean_interval(np.ones((0, 3))), r"not empty, got shape \(0, 3\)"),
        (lambda: mean_interval([[1, 2]], level=95), "level must lie between 0 and 1, got 95"),
        (lambda: mean_interval([[1, 2]], replicates=0), "replicates must be at least 1, got 0"),
        (
            lambda: paired_difference(np.ones((4, 1)), np.ones((4, 3))),
            r"same shape, got \(4, 1\) and \(4, 3\)",
        ),
        (lambda: interquartile_mean([]), "scores must not be empty"),
        (
            lambda: statistics.probability_of_improvement(np.ones((1, 3)), np.ones((2, 3))),
            "same tasks, got 1 and 2",
        ),
    ],
)
def test_scores_of_another_shape_are_refused(call, told):
    with pytest.raises(ValueError, match=told):
        call()
