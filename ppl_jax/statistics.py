"""Statistics over seeds and scenarios, in NumPy with an explicit generator.

Intervals are stratified bootstraps: scenarios are resampled within each seed and seeds are
resampled too, so both kinds of chance are in them (Agarwal et al. 2021, "Deep RL at the edge of
the statistical precipice").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Interval(NamedTuple):
    """A mean and its bootstrap interval."""

    mean: float
    low: float
    high: float


def _resampled_means(scores: np.ndarray, rng: np.random.Generator, replicates: int) -> np.ndarray:
    seeds, scenarios = scores.shape
    out = np.empty(replicates)
    for i in range(replicates):
        row = rng.integers(seeds, size=seeds)
        column = rng.integers(scenarios, size=(seeds, scenarios))
        out[i] = scores[row[:, None], column].mean()
    return out


def mean_interval(
    scores: np.ndarray, rng: np.random.Generator, level: float = 0.95, replicates: int = 2000
) -> Interval:
    """Mean of scores [seeds, scenarios] with a two-sided bootstrap interval."""
    scores = np.asarray(scores, float)
    means = _resampled_means(scores, rng, replicates)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(scores.mean()), float(low), float(high))


def paired_difference(
    ours: np.ndarray,
    theirs: np.ndarray,
    rng: np.random.Generator,
    level: float = 0.95,
    replicates: int = 2000,
) -> Interval:
    """Mean of `ours - theirs`, [seeds, scenarios] each, seeds and scenarios paired."""
    return mean_interval(np.asarray(ours, float) - theirs, rng, level, replicates)


def interquartile_mean(scores: np.ndarray) -> float:
    """Mean of the middle half of all scores."""
    flat = np.sort(np.ravel(scores))
    cut = len(flat) // 4
    return float(flat[cut : len(flat) - cut].mean())


def interquartile_interval(
    scores: np.ndarray, rng: np.random.Generator, level: float = 0.95, replicates: int = 2000
) -> Interval:
    """Interquartile mean of runs [tasks, runs] with a stratified bootstrap interval.

    Runs are resampled within each task and the tasks stay (Agarwal et al. 2021, section 4.1).
    """
    scores = np.asarray(scores, float)
    tasks, runs = scores.shape
    chosen = rng.integers(runs, size=(replicates, tasks, runs))
    drawn = np.take_along_axis(scores[None], chosen, 2).reshape(replicates, -1)
    drawn.sort(axis=1)
    cut = drawn.shape[1] // 4
    means = drawn[:, cut : drawn.shape[1] - cut].mean(1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Interval(interquartile_mean(scores), float(low), float(high))


def probability_of_improvement(
    ours: np.ndarray,
    theirs: np.ndarray,
    rng: np.random.Generator,
    level: float = 0.95,
    replicates: int = 2000,
) -> Interval:
    """P(X > Y) + P(X = Y) / 2 of a run of ours and one of theirs, averaged over tasks.

    The Mann-Whitney statistic over the number of pairs; runs of both are resampled within each
    task for the interval (Agarwal et al. 2021, section 4.3).

    Args:
        ours, theirs: [tasks, runs] scores; the numbers of runs may differ.
        rng: Of the bootstrap.
        level: Of the interval.
        replicates: Of the bootstrap.
    """
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)

    def probability(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        wins = (x[..., :, None] > y[..., None, :]) + 0.5 * (x[..., :, None] == y[..., None, :])
        return wins.mean((-3, -2, -1))

    def drawn(scores: np.ndarray) -> np.ndarray:
        chosen = rng.integers(scores.shape[1], size=(replicates, *scores.shape))
        return np.take_along_axis(scores[None], chosen, 2)

    found = probability(drawn(ours), drawn(theirs))
    low, high = np.quantile(found, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(probability(ours, theirs)), float(low), float(high))
