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
