"""Plans of sweeps: axes, studies, and the groups of runs that share a compiled program."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings, program_key
from ppl_jax.config import catalogue, replace, values

Values = Mapping[str, Sequence[Any]]


@dataclasses.dataclass(frozen=True)
class Study:
    """A named grid.

    Attributes:
        title: Its question, in words.
        algorithms: Methods, where none are asked for.
        axes: Values of each setting.
        total_steps: Factor on the environment's own length, and the evaluations within it.
        evaluations: Over the whole run.
        randomise: Its runs are in randomised worlds.
    """

    title: str
    algorithms: tuple[str, ...]
    axes: Values
    length: float = 1.0
    evaluations: int = 5
    randomise: bool = False


NOISES = (0.0, 0.0625, 0.125, 0.25, 0.5, 1.0)
HORIZONS = (1, 2, 4, 6, 8, 10)
RANGES = (0.0, 0.1, 0.25, 0.5, 1.0)

# H and the other settings are the paper's own; L beyond an environment's H is left out
STUDIES = {
    "horizon": Study(
        title="the effect of L (Fig. 8), at the paper's length and half as far again",
        algorithms=("ppl",),
        axes={"preference_horizon": HORIZONS},
        length=1.5,
        evaluations=3,
    ),
    "horizon_beta": Study(
        title="L x beta",
        algorithms=("ppl",),
        axes={"preference_horizon": (1, 2, 4, 6, 8), "beta": (0.03, 0.1, 0.3, 1.0)},
    ),
    "prediction_noise": Study(
        title="noise of the predicted states (Fig. 7)",
        algorithms=("ppl", "pvp"),
        axes={"prediction_noise": NOISES},
    ),
    "expert_noise": Study(
        title="an imperfect expert",
        algorithms=("ppl", "pvp"),
        axes={"expert_noise": (0.0, 0.1, 0.2, 0.4)},
    ),
    "predictor": Study(
        title="what the predictor knows",
        algorithms=("ppl",),
        axes={"predictor": ("simulator", "kinematic")},
    ),
}


def _randomised(title: str, name: str, values: Sequence[float]) -> Study:
    """A study over one of the ranges that worlds are drawn within."""
    return Study(title=title, algorithms=("ppl", "pvp"), axes={name: values}, randomise=True)


STUDIES |= {
    "friction": _randomised("randomised friction of contacts", "friction_range", RANGES),
    "mass": _randomised("randomised mass of what is handled", "mass_range", RANGES),
    "damping": _randomised("randomised damping of the arm's joints", "damping_range", RANGES),
    "gains": _randomised("randomised stiffness of the controller", "gain_range", RANGES),
    "start_noise": _randomised(
        "noise on the joints at a start", "start_noise", (0, 0.02, 0.05, 0.1)
    ),
    "sensor_noise": _randomised("noise on observations", "sensor_noise", (0, 0.01, 0.03, 0.1)),
}


def register_study(name: str, study: Study) -> None:
    """Make a study known by name, to `ppl sweep --study NAME`.

    Raises:
        ValueError: If the name is taken.
    """
    if name in STUDIES:
        raise ValueError(f"study {name!r} is registered already")
    STUDIES[name] = study


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of a sweep.

    Attributes:
        name: Name of its row: environment, label, values and seed.
        values: Value of every axis.
        settings: Settings of the run.
        label: Its name in tables; the method where it is empty.
    """

    name: str
    values: tuple[tuple[str, Any], ...]
    settings: RunSettings
    label: str = ""


@dataclasses.dataclass
class Group:
    """Runs that differ only in what is traced.

    Attributes:
        settings: Settings of its first run.
        runs: In order.
    """

    settings: RunSettings
    runs: list[Run]


def points(axes: Values) -> list[dict[str, Any]]:
    """Every combination of the axes' values, the last axis fastest."""
    for name, listed in axes.items():
        if len(set(listed)) != len(listed):
            raise UserError(f"{name}: every value once, got {', '.join(map(str, listed))}")
    return [dict(zip(axes, chosen, strict=True)) for chosen in itertools.product(*axes.values())]


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
    """Equal for runs that share their programs and are evaluated at the same steps."""
    config = settings.config
    length = config.total_steps, config.offline_updates, settings.evaluate_every
    return (*program_key(settings), *length)


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
    """Runs with one bound on L per environment, method and H, so that another L compiles nothing.

    A run of a method without such a bound stays as it is.
    """
    bound = "max_preference_horizon"
    most: dict[tuple, int] = {}
    for run in runs:
        mine = values(run.settings.config, run.settings.hparams)
        if bound in mine:
            most[_where(run)] = max(most.get(_where(run), 1), mine[bound])
    widened = []
    for run in runs:
        settings = run.settings
        if _where(run) in most:
            config, hparams = replace(
                settings.config, settings.hparams, **{bound: most[_where(run)]}
            )
            settings = dataclasses.replace(settings, config=config, hparams=hparams)
        widened.append(dataclasses.replace(run, settings=settings))
    return widened


def _where(run: Run) -> tuple:
    """Equal for runs whose static settings differ at most in the bound on L."""
    mine = catalogue(run.settings.config, run.settings.hparams).values()
    static = (str((one.name, one.value)) for one in mine if not one.traced)
    kept = [text for text in static if "max_preference_horizon" not in text]
    return (run.settings.env, run.settings.algorithm, *kept)
