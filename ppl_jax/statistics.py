"""Statistics over seeds and scenarios, in NumPy.

Intervals are stratified bootstraps: scenarios are resampled within each seed and seeds are
resampled too, so both kinds of chance are in them (Agarwal et al. 2021, "Deep RL at the edge of
the statistical precipice"). The generator is a new one with seed 0 unless one is given: the same
scores have the same interval everywhere.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Interval(NamedTuple):
    """A mean and its bootstrap interval; the ends are NaN where nothing can be resampled."""

    mean: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether there is an interval, not only a mean."""
        return not math.isnan(self.low)


def _matrix(name: str, values: ArrayLike, axes: str) -> np.ndarray:
    """Scores as floats with two axes.

    Raises:
        ValueError: One line that names the argument and its shape.
    """
    scores = np.asarray(values, float)
    if scores.ndim != 2 or not scores.size:
        raise ValueError(f"{name} must be [{axes}] and not empty, got shape {scores.shape}")
    return scores


def _check(level: float, replicates: int) -> None:
    """Refuse settings of the bootstrap that mean nothing."""
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level}")
    if replicates < 1:
        raise ValueError(f"replicates must be at least 1, got {replicates}")


def _generator(rng: np.random.Generator | None) -> np.random.Generator:
    return np.random.default_rng(0) if rng is None else rng


def _ends(mean: float, drawn: np.ndarray, level: float) -> Interval:
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return Interval(mean=float(mean), low=float(low), high=float(high))


def _resampled_means(scores: np.ndarray, rng: np.random.Generator, replicates: int) -> np.ndarray:
    seeds, scenarios = scores.shape
    out = np.empty(replicates)
    for i in range(replicates):
        row = rng.integers(seeds, size=seeds)
        column = rng.integers(scenarios, size=(seeds, scenarios))
        out[i] = scores[row[:, None], column].mean()
    return out


def mean_interval(
    scores: ArrayLike,
    rng: np.random.Generator | None = None,
    *,
    level: float = 0.95,
    replicates: int = 2000,
) -> Interval:
    """Mean with a two-sided bootstrap interval.

    Args:
        scores: [seeds, scenarios]. With one seed the interval is over scenarios alone, with one
            scenario (or a mean over them) over seeds alone; of a single number there is none.
        rng: Generator of the bootstrap (default: a new one with seed 0).
        level: Share of the bootstrap inside the interval.
        replicates: Number of resamples.

    Raises:
        ValueError: If the scores have another shape.
    """
    scores = _matrix("scores", scores, "seeds, scenarios")
    _check(level, replicates)
    if scores.size == 1:
        return Interval(mean=float(scores.mean()), low=math.nan, high=math.nan)
    return _ends(scores.mean(), _resampled_means(scores, _generator(rng), replicates), level)


def paired_difference(
    ours: ArrayLike,
    theirs: ArrayLike,
    rng: np.random.Generator | None = None,
    *,
    level: float = 0.95,
    replicates: int = 2000,
) -> Interval:
    """Mean of `ours - theirs` with its interval; seeds and scenarios are paired.

    Args:
        ours: [seeds, scenarios].
        theirs: The same seeds and scenarios, in the same order.
        rng: Generator of the bootstrap (default: a new one with seed 0).
        level: Share of the bootstrap inside the interval.
        replicates: Number of resamples.

    Raises:
        ValueError: If the shapes differ.
    """
    ours = _matrix("ours", ours, "seeds, scenarios")
    theirs = _matrix("theirs", theirs, "seeds, scenarios")
    if ours.shape != theirs.shape:
        raise ValueError(
            f"ours and theirs must have the same shape, got {ours.shape} and {theirs.shape}"
        )
    return mean_interval(ours - theirs, rng, level=level, replicates=replicates)


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores, of any shape."""
    flat = np.sort(np.ravel(np.asarray(scores, float)))
    if not flat.size:
        raise ValueError("scores must not be empty")
    cut = len(flat) // 4
    return float(flat[cut : len(flat) - cut].mean())


def interquartile_interval(
    scores: ArrayLike,
    rng: np.random.Generator | None = None,
    *,
    level: float = 0.95,
    replicates: int = 2000,
) -> Interval:
    """Interquartile mean with a stratified bootstrap interval.

    Runs are resampled within each task and the tasks stay (Agarwal et al. 2021, section 4.1).

    Args:
        scores: [tasks, runs].
        rng: Generator of the bootstrap (default: a new one with seed 0).
        level: Share of the bootstrap inside the interval.
        replicates: Number of resamples.

    Raises:
        ValueError: If the scores have another shape.
    """
    scores = _matrix("scores", scores, "tasks, runs")
    _check(level, replicates)
    drawn = _resampled_runs(scores, _generator(rng), replicates).reshape(replicates, -1)
    drawn.sort(axis=1)
    cut = drawn.shape[1] // 4
    return _ends(interquartile_mean(scores), drawn[:, cut : drawn.shape[1] - cut].mean(1), level)


def _resampled_runs(scores: np.ndarray, rng: np.random.Generator, replicates: int) -> np.ndarray:
    """Runs drawn within each task, [replicates, tasks, runs]."""
    chosen = rng.integers(scores.shape[1], size=(replicates, *scores.shape))
    return np.take_along_axis(scores[None], chosen, 2)


def _probability(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """P(X > Y) + P(X = Y) / 2 over the last axis of each, averaged over tasks: [...]."""
    x, y = ours[..., :, None], theirs[..., None, :]
    return ((x > y) + 0.5 * (x == y)).mean((-3, -2, -1))


def probability_of_improvement(
    ours: ArrayLike,
    theirs: ArrayLike,
    rng: np.random.Generator | None = None,
    *,
    level: float = 0.95,
    replicates: int = 2000,
) -> Interval:
    """P(X > Y) + P(X = Y) / 2 of a run of ours and one of theirs, averaged over tasks.

    The Mann-Whitney statistic over the number of pairs; runs of both are resampled within each
    task for the interval (Agarwal et al. 2021, section 4.3).

    Args:
        ours: [tasks, runs] scores.
        theirs: [tasks, runs] scores of the same tasks; the number of runs may differ.
        rng: Generator of the bootstrap (default: a new one with seed 0).
        level: Share of the bootstrap inside the interval.
        replicates: Number of resamples.

    Raises:
        ValueError: If the scores have another shape, or the tasks differ in number.
    """
    ours = _matrix("ours", ours, "tasks, runs")
    theirs = _matrix("theirs", theirs, "tasks, runs")
    if len(ours) != len(theirs):
        raise ValueError(
            f"ours and theirs must have the same tasks, got {len(ours)} and {len(theirs)}"
        )
    _check(level, replicates)
    rng = _generator(rng)
    drawn = [_resampled_runs(scores, rng, replicates) for scores in (ours, theirs)]
    return _ends(float(_probability(ours, theirs)), _probability(*drawn), level)
