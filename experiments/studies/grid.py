"""What a sweep runs: axes, studies, and the groups of runs that share a compiled program."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.engine.run import RunSettings
from experiments.engine.runtime import UserError
from ppl_jax.config import HParams

Values = Mapping[str, Sequence[Any]]


@dataclasses.dataclass(frozen=True)
class Study:
    """A named grid.

    Attributes:
        title: What it asks, in words.
        algorithms: Methods, where none are asked for.
        axes: Values of each setting.
        total_steps: Factor on the world's own length, and the evaluations within it.
        evaluations: Over the whole run.
    """

    title: str
    algorithms: tuple[str, ...]
    axes: Values
    length: float = 1.0
    evaluations: int = 5


NOISES = (0.0, 0.0625, 0.125, 0.25, 0.5, 1.0)
HORIZONS = (1, 2, 4, 6, 8, 10)

# H and the other settings are the paper's own; L beyond a world's H is left out
STUDIES = {
    "horizon": Study(
        "the effect of L (Fig. 8), at the paper's length and half as far again",
        ("ppl",),
        {"preference_horizon": HORIZONS},
        length=1.5,
        evaluations=3,
    ),
    "horizon_beta": Study(
        "L x beta",
        ("ppl",),
        {"preference_horizon": (1, 2, 4, 6, 8), "beta": (0.03, 0.1, 0.3, 1.0)},
    ),
    "prediction_noise": Study(
        "noise of the predicted states (Fig. 7)",
        ("ppl", "pvp"),
        {"prediction_noise": NOISES},
    ),
    "expert_noise": Study(
        "an imperfect expert",
        ("ppl", "pvp"),
        {"expert_noise": (0.0, 0.1, 0.2, 0.4)},
    ),
    "predictor": Study(
        "what the predictor knows",
        ("ppl",),
        {"predictor": ("simulator", "kinematic")},
    ),
}


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of a sweep.

    Attributes:
        name: Of its row: world, method, values and seed.
        values: Of every axis.
        settings: Of the run.
    """

    name: str
    values: tuple[tuple[str, Any], ...]
    settings: RunSettings


@dataclasses.dataclass
class Group:
    """Runs that differ only in what is traced: one program.

    Attributes:
        settings: Of its first run.
        runs: In order.
    """

    settings: RunSettings
    runs: list[Run]


def points(axes: Values) -> list[dict[str, Any]]:
    """Every combination of the axes' values, the last axis fastest."""
    for name, values in axes.items():
        if len(set(values)) != len(values):
            raise UserError(f"{name}: every value once, got {', '.join(map(str, values))}")
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def run_name(env: str, algorithm: str, values: Mapping[str, Any], seed: int) -> str:
    """`driving/ppl/preference_horizon=4,beta=0.1/seed=0`."""
    return "/".join([env, algorithm, show(values) or "-", f"seed={seed}"])


def show(values: Mapping[str, Any]) -> str:
    """`preference_horizon=4,beta=0.1`."""
    return ",".join(f"{name}={plain(value)}" for name, value in values.items())


def plain(value: Any) -> str:
    """A value as in result files: numbers without a tail of zeros."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def group_key(settings: RunSettings) -> tuple:
    """Equal for runs that share a program."""
    traced = {"seed": 0, "hparams": HParams()}
    return tuple(str(x) for x in dataclasses.astuple(dataclasses.replace(settings, **traced)))


def groups(runs: Sequence[Run]) -> list[Group]:
    """Runs by program, in the order in which programs first occur.

    The static bound on L is the largest L of the group: it does not part runs.
    """
    found: dict[tuple, Group] = {}
    for run in runs:
        key = group_key(run.settings)
        found.setdefault(key, Group(run.settings, [])).runs.append(run)
    return list(found.values())


def widen(runs: Sequence[Run]) -> list[Run]:
    """Runs with one bound on L per world, method and H, so that another L compiles nothing."""

    def where(run: Run) -> tuple:
        config = dataclasses.replace(run.settings.config, max_preference_horizon=1)
        return group_key(dataclasses.replace(run.settings, config=config))

    most: dict[tuple, int] = {}
    for run in runs:
        bound = run.settings.config.max_preference_horizon
        most[where(run)] = max(most.get(where(run), 1), bound)
    return [
        dataclasses.replace(
            run,
            settings=dataclasses.replace(
                run.settings,
                config=dataclasses.replace(
                    run.settings.config, max_preference_horizon=most[where(run)]
                ),
            ),
        )
        for run in runs
    ]
