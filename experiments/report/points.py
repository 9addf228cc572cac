"""Result files as groups of runs, and `ppl table`: Markdown, LaTeX or plain text from them."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.runtime import UserError
from experiments.report import paper
from experiments.report.tables import RESULTS, print_table
from ppl_jax.statistics import (
    Interval,
    interquartile_interval,
    mean_interval,
    paired_difference,
    probability_of_improvement,
)

if TYPE_CHECKING:
    from experiments.cli import Table

MEASURED = (
    "human_data_usage",
    "takeovers",
    "training_cost",
    "success",
    "episodic_return",
    "progress",
    "episodic_cost",
    "length",
)
_NOT_SETTINGS = {"run", "env", "algorithm", "seed", "status", "step", "total_steps", *MEASURED}


@dataclasses.dataclass
class Point:
    """Runs with the same settings at one step.

    Attributes:
        env, algorithm, step: What and when.
        values: Settings that differ between runs of the same world and method.
        seeds: Of the runs, sorted.
        measured: Column -> [seeds] values; columns that the file lacks are missing.
    """

    env: str
    algorithm: str
    values: dict[str, str]
    step: int
    seeds: list[int]
    measured: dict[str, np.ndarray]

    @property
    def label(self) -> str:
        """Of a row."""
        return " ".join([self.algorithm, *(f"{k}={v}" for k, v in self.values.items())])

    def interval(self, column: str) -> Interval:
        """Mean over seeds with its 95% interval."""
        return mean_interval(self.measured[column][:, None], np.random.default_rng(0))


def results_path(path: Path) -> Path:
    """A results file, or that of a folder.

    Raises:
        UserError: If there is none.
    """
    found = path / RESULTS if path.is_dir() else path
    if not found.is_file():
        raise UserError(f"{str(path)!r} is neither a results file nor a folder with {RESULTS}")
    return found


def read_points(path: Path) -> list[Point]:
    """Everything in a results file, in its order; runs that failed or diverged are left out.

    Raises:
        UserError: If the file is none of `ppl sweep`, `compare` or `ablation`.
    """
    with open(results_path(path), newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or not {"algorithm", "seed", "step", "success"} <= set(rows[0]):
        raise UserError(f"{str(path)!r} holds no results of ppl sweep, compare or ablation")
    rows = [row for row in rows if row.get("status", "done") == "done"]
    axes = _axes(rows)
    found: dict[tuple, list[dict[str, str]]] = {}
    for row in rows:
        where = (row.get("env", ""), row["algorithm"])
        values = tuple((name, row[name]) for name in axes[where])
        found.setdefault((*where, values, int(row["step"])), []).append(row)
    points = []
    for (env, algorithm, values, step), mine in found.items():
        mine.sort(key=lambda row: int(row["seed"]))
        measured = {
            name: np.array([float(row[name]) for row in mine])
            for name in MEASURED
            if all(row.get(name) for row in mine)
        }
        seeds = [int(row["seed"]) for row in mine]
        points.append(Point(env, algorithm, dict(values), step, seeds, measured))
    return points


def _axes(rows: Iterable[Mapping[str, str]]) -> dict[tuple[str, str], list[str]]:
    """By world and method, the settings that take more than one value."""
    seen: dict[tuple[str, str], dict[str, set[str]]] = {}
    for row in rows:
        mine = seen.setdefault((row.get("env", ""), row["algorithm"]), {})
        for name, value in row.items():
            if name not in _NOT_SETTINGS:
                mine.setdefault(name, set()).add(value)
    return {
        where: [name for name, values in columns.items() if len(values) > 1]
        for where, columns in seen.items()
    }


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


def show(interval: Interval, digits: int) -> str:
    """`mean [low, high]`."""
    return f"{interval.mean:.{digits}f} [{interval.low:.{digits}f}, {interval.high:.{digits}f}]"


HEADER = [
    "method",
    "seeds",
    "human data",
    "total data",
    "success",
    "IQM",
    "return",
    "completion",
    "cost",
]


def table_rows(points: Sequence[Point]) -> list[list[str]]:
    """A line per point, under `HEADER`."""
    lines = []
    for point in points:
        human = point.measured["human_data_usage"].mean()
        scores = point.measured["success"][None]
        lines.append(
            [
                point.label,
                str(len(point.seeds)),
                f"{human:.0f} ({human / max(point.step, 1):.2f})",
                str(point.step),
                show(point.interval("success"), 2),
                show(interquartile_interval(scores, np.random.default_rng(0)), 2),
                show(point.interval("episodic_return"), 0),
                show(point.interval("progress"), 2),
                show(point.interval("episodic_cost"), 2),
            ]
        )
    return lines


def comparison_rows(points: Sequence[Point], baseline: Point) -> list[list[str]]:
    """Each other point against one: paired difference of success, and who is likely better."""
    lines = []
    for point in points:
        if point is baseline:
            continue
        both = sorted(set(point.seeds) & set(baseline.seeds))
        ours, theirs = (
            np.array([p.measured["success"][p.seeds.index(seed)] for seed in both])
            for p in (point, baseline)
        )
        paired = "-"
        if both:
            gap = paired_difference(ours[:, None], theirs[:, None], np.random.default_rng(0))
            paired = show(gap, 2)
        chance = probability_of_improvement(
            point.measured["success"][None],
            baseline.measured["success"][None],
            np.random.default_rng(0),
        )
        lines.append([f"{point.label} against {baseline.label}", paired, show(chance, 2)])
    return lines


def table(command: Table) -> None:
    """Print a table of results.

    Raises:
        UserError: If the file, the step or the row is not there.
    """
    points = at_step(read_points(command.results), command.step)
    for env in dict.fromkeys(point.env for point in points):
        mine = [point for point in points if point.env == env]
        header, rows = list(HEADER), table_rows(mine)
        name = env or command.env
        if command.paper:
            reported = {**paper.METHODS.get(name or "driving", {}), **paper.ABLATION}
            header.append("paper: human/total, success, return, completion")
            for point, row in zip(mine, rows, strict=True):
                row.append(_reported(reported.get(point.algorithm)))
        if name:
            print(f"\n{name}\n")
        write_table(header, rows, command.format)
        baseline = mine[0]
        if command.against is not None:
            named = [point for point in mine if point.label == command.against]
            if not named:
                labels = ", ".join(repr(point.label) for point in mine)
                raise UserError(f"against must be one of {labels}, got {command.against!r}")
            baseline = named[0]
        if len(mine) > 1 and min(len(point.seeds) for point in mine) > 1:
            print()
            compared = ["success", "paired difference", "P(improvement)"]
            write_table(compared, comparison_rows(mine, baseline), command.format)
    print(
        "\nMeans over seeds with 95% bootstrap intervals; IQM is the interquartile mean; held-out "
        "scenarios, each once, without the expert."
    )
    if command.paper:
        print("The paper's figures are from another simulator and another expert.")


def _reported(row: paper.Reported | None) -> str:
    if row is None:
        return "-"
    data = f"{row.human_data or '-'}/{row.total_data or '-'}"
    rest = (row.success, row.episodic_return, row.route_completion)
    return ", ".join([data, *(value or "-" for value in rest)])


def write_table(header: Sequence[str], rows: Sequence[Sequence[str]], kind: str) -> None:
    """Print as "text", "markdown" or "latex" (with booktabs)."""
    if kind == "text":
        print_table(header, rows)
    elif kind == "markdown":
        for line in (header, ["---"] * len(header), *rows):
            print("| " + " | ".join(line) + " |")
    else:
        print(r"\begin{tabular}{l" + "r" * (len(header) - 1) + "}\n" + r"\toprule")
        print(" & ".join(_latex(cell) for cell in header) + r" \\" + "\n" + r"\midrule")
        for row in rows:
            print(" & ".join(_latex(cell) for cell in row) + r" \\")
        print(r"\bottomrule" + "\n" + r"\end{tabular}")


def _latex(cell: Any) -> str:
    for sign in ("_", "%", "&", "#"):
        cell = cell.replace(sign, "\\" + sign)
    return cell.replace("±", r"$\pm$")
