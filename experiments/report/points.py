"""Result files as groups of runs, and the intervals that tables, figures and notebooks share."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from experiments.engine.config_file import read_config
from experiments.engine.csv_file import numbers, read_table
from experiments.engine.fields import read_fields, read_json
from experiments.engine.files import write_text_atomic
from experiments.engine.run_folder import CONFIG, EVALUATION, SUMMARY
from experiments.engine.runtime import UserError
from experiments.engine.settings import RENAMED, RENAMED_VALUES
from ppl_jax.algorithms import settings as default_settings
from ppl_jax.config import did_you_mean
from ppl_jax.config import values as setting_values
from ppl_jax.statistics import Interval, mean_interval, paired_difference

Frame: TypeAlias = Any  # pandas.DataFrame: pandas is imported when it is used
RESULTS, EPISODES = "results.csv", "episodes.csv"
SCORES = ("success", "episodic_return", "progress", "episodic_cost", "length")
COUNTS = ("human_data_usage", "human_cost_steps", "takeovers", "training_cost")
MEASURED = (*COUNTS, *SCORES)
_NOT_SETTINGS = {"run", "env", "algorithm", "seed", "status", "step", "total_steps", *MEASURED}
_NOT_SETTINGS |= {"scenario", "engine", "wall_s", "compile_s"}
BOTH, SEEDS, SCENARIOS, NOTHING = "seeds and scenarios", "seeds", "scenarios", ""


def known(name: str, value: str, allowed: Sequence[str]) -> None:
    """Refuse a name that is not among the allowed ones, with the nearest that is.

    Raises:
        UserError: One line.
    """
    if value not in allowed:
        listed = ", ".join(repr(one) for one in allowed)
        raise UserError(
            f"{name} must be one of {listed}, got {value!r}{did_you_mean(value, allowed)}"
        )


@dataclasses.dataclass
class Point:
    """Runs with the same settings at one step.

    Attributes:
        env, algorithm, step: Environment, method and environment steps.
        values: Settings that differ between runs of the same environment and method.
        seeds: Seeds of the runs, sorted.
        measured: Column -> [seeds] values; columns that the file lacks are missing.
        episodes: Column -> [seeds, scenarios], where there is a row per scenario; else empty.
        scenarios: Their numbers, or none.
    """

    env: str
    algorithm: str
    values: dict[str, str]
    step: int
    seeds: list[int]
    measured: dict[str, np.ndarray]
    episodes: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    scenarios: list[int] = dataclasses.field(default_factory=list)

    @property
    def label(self) -> str:
        """Name of a row."""
        return " ".join([self.algorithm, *(f"{k}={v}" for k, v in self.values.items())])

    @property
    def over(self) -> str:
        """Samples that intervals are over: seeds and scenarios, as far as the files have them."""
        several = len(self.seeds) > 1
        if self.scenarios:
            return BOTH if several else SCENARIOS
        return SEEDS if several else NOTHING

    def scores(self, column: str, over: str | None = None) -> np.ndarray:
        """Values of a column, [seeds, scenarios], or [seeds, 1] where intervals are over seeds."""
        known("column", column, list(self.measured))
        wanted = self.over if over is None else over
        if wanted in (BOTH, SCENARIOS) and column in self.episodes:
            return self.episodes[column]
        return self.measured[column][:, None]

    def interval(self, column: str, over: str | None = None) -> Interval:
        """Mean with its 95% interval over what `over` says (default: all there is)."""
        return mean_interval(self.scores(column, over))


def difference(ours: Point, theirs: Point, column: str = "success") -> Interval | None:
    """Mean of `ours - theirs`, paired by seed and, where both have them, by scenario.

    `ppl table`, `ppl compare` and notebooks all call this one: the same runs, the same interval.

    Returns:
        None where no seed is common to both.
    """
    both = sorted(set(ours.seeds) & set(theirs.seeds))
    if not both:
        return None
    same = bool(ours.scenarios) and ours.scenarios == theirs.scenarios
    rows = []
    for point in (ours, theirs):
        at = [point.seeds.index(seed) for seed in both]
        rows.append(point.scores(column, BOTH if same else SEEDS)[at])
    return paired_difference(*rows)


def common_over(points: Sequence[Point]) -> str | None:
    """Samples under all intervals of one picture; None where each point keeps its own."""
    kinds = {point.over for point in points}
    return SEEDS if kinds == {BOTH, SEEDS} else None


def describe(points: Sequence[Point], over: str | None = None) -> str:
    """A sentence that says what the intervals of these points are over."""
    found: dict[str, list[str]] = {}
    for point in points:
        kind = point.over if over is None else over
        seeds, scenarios = f"{len(point.seeds)} seeds", f"{len(point.scenarios)} held-out scenarios"
        text = {
            BOTH: f"over {seeds} and {scenarios}",
            SEEDS: f"over {seeds}",
            SCENARIOS: f"over {scenarios} of one seed (other seeds are not in them)",
            NOTHING: "not given for one seed without a row per scenario",
        }[kind]
        found.setdefault(text, []).append(point.label)
    if len(found) == 1:
        return f"95% bootstrap intervals {next(iter(found))}"
    parts = [
        f"{text} ({', '.join(dict.fromkeys(labels))})"
        if len(found) < 4 and len(labels) < 6
        else text
        for text, labels in found.items()
    ]
    return "95% bootstrap intervals " + "; ".join(parts)


def is_run(path: Path) -> bool:
    """Whether a folder is that of a single run."""
    return (path / CONFIG).is_file() and not (path / RESULTS).is_file()


def results_path(path: Path) -> Path:
    """A results file, or that of a folder.

    Raises:
        UserError: If there is none.
    """
    found = path / RESULTS if path.is_dir() else path
    if not found.is_file():
        raise UserError(
            f"{str(path)!r} is neither a results file nor a folder with {RESULTS}, nor a run folder"
        )
    return found


def read_csv(path: Path) -> Frame:
    """A CSV file with every cell as text, under today's names, by the line that each row is in.

    Raises:
        UserError: If it cannot be read.
    """
    import pandas as pd

    columns, rows, lines = read_table(path)
    frame: Frame = pd.DataFrame(rows, columns=columns, index=lines, dtype=object)
    frame = frame.rename(columns=RENAMED)
    for column, renamed in RENAMED_VALUES.items():
        if column in frame:
            frame[column] = frame[column].replace(renamed)
    return frame


def number_column(path: Path, frame: Frame, name: str, **allowed: Any) -> Any:
    """A column of `read_csv` as numbers (see `experiments.engine.csv_file.numbers`).

    Raises:
        UserError: If it is missing, or one line of the first cell that is no such number.
    """
    import pandas as pd

    if name not in frame:
        raise UserError(f"{str(path)!r} has no column {name!r}")
    found = numbers(frame[name].tolist(), frame.index.tolist(), name, path, **allowed)
    return pd.Series(found, index=frame.index, dtype=float)


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write dictionaries as a CSV file; the first one names the columns."""
    import pandas as pd

    frame = pd.DataFrame(list(rows), columns=list(rows[0]), dtype=object)
    write_text_atomic(path, frame.to_csv(index=False, lineterminator="\n"))


def _read_run(path: Path) -> Frame:
    """The evaluations of a single run, a row per step and scenario."""
    if not (path / EVALUATION).is_file():
        raise UserError(f"run {str(path)!r} has no {EVALUATION} yet: nothing was evaluated")
    config = read_config(path)
    frame = read_csv(path / EVALUATION)
    for name in ("env", "algorithm", "seed"):
        frame[name] = str(config.get(name, "0" if name == "seed" else ""))
    if (path / SUMMARY).is_file():
        kinds = {"training_cost": float, "total_steps": int}
        summary = read_fields(read_json(path / SUMMARY), kinds, repr(str(path / SUMMARY)))
        if kinds.keys() <= summary.keys():
            step = number_column(path / EVALUATION, frame, "step", whole=True, low=0)
            last = step == summary["total_steps"]
            frame["training_cost"] = np.where(last, f"{summary['training_cost']:g}", "")
    return frame


def read_frame(path: Path) -> Frame:
    """Result rows of a folder, a file or a single run, as text, without failed runs.

    Raises:
        UserError: If they are no results.
    """
    if path.is_dir() and is_run(path):
        frame, named, path = _read_run(path), path.name, path / EVALUATION
    else:
        path = results_path(path)
        frame, named = read_csv(path), path.stem
    if frame.empty or "success" not in frame or not {"seed", "scenario"} & set(frame.columns):
        raise UserError(
            f"{str(path)!r} holds no results of ppl train, sweep, compare, ablation or tune"
        )
    if "step" not in frame and "total_steps" in frame:
        frame["step"] = frame["total_steps"]
    for name, value in {"env": "", "algorithm": named, "seed": "0", "step": "0"}.items():
        if name not in frame:
            frame[name] = value
    if "status" in frame:
        frame = frame[frame["status"] == "done"].copy()
    for name in ("seed", "step", *(["scenario"] if "scenario" in frame else [])):
        frame[name] = number_column(path, frame, name, whole=True, low=0).astype(int)
    for name in MEASURED:
        if name in frame:
            allowed = _RANGES.get(name, {}) | {"empty": name != "success"}
            frame[name] = number_column(path, frame, name, **allowed)
    for name in _settings(frame):
        frame[name] = frame[name].map(_plain)
    return _once(path, frame)


_RANGES = {"success": {"low": 0, "high": 1}}
_RANGES |= {name: {"low": 0} for name in (*COUNTS, "episodic_cost", "length")}


def _settings(frame: Frame) -> list[str]:
    return [name for name in frame.columns if name not in _NOT_SETTINGS]


def _once(path: Path, frame: Frame) -> Frame:
    """Every run's row at a step (and scenario) once, where it is there several times.

    Raises:
        UserError: If two such rows contradict each other.
    """
    names = ["env", "algorithm", *_settings(frame), "seed", "step"]
    names += ["scenario"] if "scenario" in frame else []
    which = frame.groupby(names, sort=False).ngroup().to_numpy()
    _, first = np.unique(which, return_index=True)
    if len(first) == len(frame):
        return frame
    measured = [name for name in MEASURED if name in frame]
    values = frame[measured].to_numpy(float)
    before = first[which]
    differs = (values != values[before]) & ~(np.isnan(values) & np.isnan(values[before]))
    if differs.any():
        at, column = np.argwhere(differs)[0]
        row, lines = frame.iloc[at], [frame.index[i] for i in (before[at], at)]
        what = f"{row['algorithm']}, seed {row['seed']}, step {row['step']}"
        found = " and ".join(f"{values[i, column]:g}" for i in (before[at], at))
        raise UserError(
            f"{str(path)!r}, rows {lines[0]} and {lines[1]}: the same run ({what}) has "
            f"{measured[column]} {found}"
        )
    return frame.iloc[np.sort(first)].copy()


def _plain(value: str) -> str:
    """Numbers as `ppl sweep` writes them: 4.0 is 4."""
    try:
        return f"{float(value):g}"
    except ValueError:
        return value


def read_points(path: Path) -> list[Point]:
    """Everything in results, in their order; runs that failed or diverged are left out.

    Args:
        path: A run folder; a folder of ppl sweep, compare, ablation or tune; or a file of theirs,
            with a row per run and evaluation or per scenario. Beside RESULTS.csv a row per scenario
            is looked for in episodes.csv or RESULTS_episodes.csv (either may be a .csv.gz).

    Raises:
        UserError: If there are no results.
    """
    frame = read_frame(path)
    settings = _settings(frame)
    played = frame if "scenario" in frame else _episodes(path)
    points = []
    for (env, algorithm), mine in frame.groupby(["env", "algorithm"], sort=False):
        axes = [name for name in settings if mine[name].nunique() > 1]
        for key, group in mine.groupby([*axes, "step"], sort=False):
            *values, step = key
            points.append(
                _point(
                    env=str(env),
                    algorithm=str(algorithm),
                    values=dict(zip(axes, values, strict=True)),
                    step=int(step),
                    group=group,
                    played=group if "scenario" in frame else played,
                )
            )
    return points


def _point(
    *,
    env: str,
    algorithm: str,
    values: dict[str, str],
    step: int,
    group: Frame,
    played: Frame | None,
) -> Point:
    """The runs of a group, and their episodes where all of them have the same scenarios."""
    whole = [name for name in MEASURED if name in group and not group[name].isna().any()]
    by_seed = group.groupby("seed")[whole].mean()
    seeds = [int(seed) for seed in by_seed.index]
    measured = {name: by_seed[name].to_numpy(float) for name in whole}
    point = Point(
        env=env, algorithm=algorithm, values=values, step=step, seeds=seeds, measured=measured
    )
    if played is None:
        return point
    mine = played[played["step"] == step]
    if "run" in mine and "run" in group:
        mine = mine[mine["run"].isin(group["run"])]
    else:
        mine = mine[(mine["algorithm"] == algorithm) & mine["seed"].isin(seeds)]
    if mine.empty or mine.duplicated(["seed", "scenario"]).any():
        return point
    table = mine.pivot(index="seed", columns="scenario", values=[n for n in SCORES if n in mine])
    if len(table) == len(seeds) and not table.isna().any().any():
        names = table.columns.get_level_values(0).unique()
        point.episodes = {str(name): table[name].to_numpy(float) for name in names}
        point.scenarios = [int(number) for number in table[names[0]].columns]
    return point


def _episodes(path: Path) -> Frame | None:
    """The rows per scenario that belong to a results file, if they are there."""
    results = results_path(path)
    names = [f"{results.stem}_{EPISODES}", *([EPISODES] if results.name == RESULTS else [])]
    for name in (name + ending for name in names for ending in ("", ".gz")):
        if (results.parent / name).is_file():
            return read_frame(results.parent / name)
    return None


def at_step(points: Sequence[Point], step: int | None) -> list[Point]:
    """Points at one step, or each run's last.

    Raises:
        UserError: If nothing was evaluated then.
    """
    if step is not None:
        found = [point for point in points if point.step == step]
        if not found:
            there = ", ".join(str(s) for s in sorted({point.step for point in points}))
            raise UserError(f"step {step} was not evaluated, only {there}")
        return found
    last: dict[tuple[str, str], Point] = {}
    for point in points:
        key = (point.env, point.label)
        if key not in last or point.step > last[key].step:
            last[key] = point
    return list(last.values())


def reference_point(points: Sequence[Point], env: str, against: str | None = None) -> Point:
    """The row that others are compared with.

    Args:
        points: Points of one environment, at the steps that are compared.
        env: Its name; "" where the file names none.
        against: Label of the row (default: the method's default settings where the grid holds
            them, else the first row).

    Raises:
        UserError: If there is no such row.
    """
    if against is not None:
        known("against", against, [point.label for point in points])
        return next(point for point in points if point.label == against)
    for algorithm in dict.fromkeys(point.algorithm for point in points):
        mine = [point for point in points if point.algorithm == algorithm]
        if not mine[0].values:
            continue
        defaults = _defaults(algorithm, env or "driving")
        for point in mine:
            if all(defaults.get(name) == value for name, value in point.values.items()):
                return point
    return points[0]


def _defaults(algorithm: str, env: str) -> dict[str, str]:
    """A method's default settings in an environment, as text; empty where either is unknown."""
    try:
        found = default_settings(algorithm, env)
    except ValueError:
        return {}
    return {k: _plain(str(v)) for k, v in setting_values(*found).items()}
