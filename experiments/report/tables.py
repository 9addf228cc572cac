"""`ppl table`, and the tables that other commands print, from result files alone."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.engine.config_file import read_config
from experiments.engine.evaluate import EvaluationRow
from experiments.engine.fields import read_fields, read_json
from experiments.engine.run_folder import SUMMARY
from experiments.engine.runtime import UserError
from experiments.report.paper import ABLATION, METHODS, Reported
from experiments.report.points import (
    EPISODES,
    RESULTS,
    SCORES,
    Point,
    at_step,
    describe,
    difference,
    is_run,
    read_csv,
    read_points,
    reference_point,
    write_rows,
)
from ppl_jax.statistics import (
    Interval,
    interquartile_interval,
    mean_interval,
    probability_of_improvement,
)

__all__ = ["EPISODES", "RESULTS", "SCORES", "print_table", "show", "table", "write_rows"]

FORMATS = ("text", "markdown", "latex")
SYMBOLS = {
    "preference_horizon": "$L$",
    "prediction_horizon": "$H$",
    "decision_interval": "$K$",
    "beta": r"$\beta$",
    "prediction_noise": r"$\epsilon$",
    "expert_noise": r"$\sigma_h$",
    "learning_rate": r"$\eta$",
    "discount": r"$\gamma$",
    "gae_lambda": r"$\lambda$",
    "polyak_tau": r"$\tau$",
    "seed": "seed",
}


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A plain table with aligned columns."""
    table = [list(header), *[list(row) for row in rows]]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    table.insert(1, ["-" * width for width in widths])
    for row in table:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())


def write_table(header: Sequence[str], rows: Sequence[Sequence[str]], format: str) -> None:
    """Print as "text", "markdown" or "latex" (for the package booktabs)."""
    if format == "text":
        print_table(header, rows)
    elif format == "markdown":
        for line in (header, ["---"] * len(header), *rows):
            print("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |")
    else:
        print(r"\begin{tabular}{l" + "r" * (len(header) - 1) + "}\n" + r"\toprule")
        print(" & ".join(SYMBOLS.get(cell) or _latex(cell) for cell in header) + r" \\")
        print(r"\midrule")
        for row in rows:
            print(" & ".join(_latex(cell) for cell in row) + r" \\")
        print(r"\bottomrule" + "\n" + r"\end{tabular}")


def _latex(cell: str) -> str:
    cell = cell.replace("\\", r"\textbackslash ")
    cell = re.sub(r"([_%&#$])", r"\\\1", cell).replace("~", r"\textasciitilde ")
    cell = cell.replace("^", r"\textasciicircum ").replace("±", r"$\pm$")
    return re.sub(r"(?<![\w.])-(?=\d)", "$-$", cell)


def show(interval: Interval, digits: int) -> str:
    """`mean [low, high]`, or the mean alone where there is no interval."""
    mean = f"{interval.mean:.{digits}f}"
    if not interval.known:
        return mean
    return f"{mean} [{interval.low:.{digits}f}, {interval.high:.{digits}f}]"


def paper_cell(row: Reported | None) -> str:
    """The paper's figures of a row in one cell."""
    if row is None:
        return "-"
    data = f"{row.human_data or '-'}/{row.total_data or '-'}"
    rest = (row.success, row.episodic_return, row.route_completion)
    return ", ".join([data, *(value or "-" for value in rest)])


_SHOWN = {"success": 2, "episodic_return": 0, "progress": 2, "episodic_cost": 2}
_TITLES = {"episodic_return": "return", "progress": "completion", "episodic_cost": "cost"}
_PAPER = "paper*: human/total, success, return, completion"


def table_of(
    points: Sequence[Point], reported: Mapping[str, Reported] | None = None
) -> tuple[list[str], list[list[str]]]:
    """Header and rows, one per point, with a column per setting that varies."""
    axes = _axes(points)
    several = any(len(point.seeds) > 1 for point in points)
    trained = any("training_cost" in point.measured for point in points)
    header = ["method", *axes, "seeds", "human data", "total data", "success"]
    header += ["IQM"] if several else []
    header += [_TITLES[name] for name in _SHOWN if name in _TITLES]
    header += ["cost in training"] if trained else []
    rows = []
    for point in points:
        row = [point.algorithm, *(point.values.get(name, "-") for name in axes)]
        row += [str(len(point.seeds)), _human(point), str(point.step)]
        cells = [
            show(point.interval(name), digits) if name in point.measured else "-"
            for name, digits in _SHOWN.items()
        ]
        if several:
            cells.insert(1, _interquartile(point))
        row += cells
        if trained:
            row.append(_mean(point, "training_cost"))
        rows.append(row)
    if reported:
        header.append(_PAPER)
        for point, row in zip(points, rows, strict=True):
            row.append(paper_cell(reported.get(point.algorithm)))
    return header, rows


def _axes(points: Sequence[Point]) -> list[str]:
    return list(dict.fromkeys(name for point in points for name in point.values))


def _mean(point: Point, name: str) -> str:
    return f"{point.measured[name].mean():.0f}" if name in point.measured else "-"


def _human(point: Point) -> str:
    if "human_data_usage" not in point.measured:
        return "-"
    human = point.measured["human_data_usage"].mean()
    return f"{human:.0f} ({human / max(point.step, 1):.2f})"


def _interquartile(point: Point) -> str:
    if len(point.seeds) < 2:
        return "-"
    return show(interquartile_interval(point.measured["success"][None]), 2)


def comparison_of(points: Sequence[Point], reference: Point) -> list[list[str]]:
    """Each other point against one: paired difference of success, and P(improvement)."""
    axes = _axes(points)
    rows = []
    for point in points:
        if point is reference:
            continue
        gap = difference(point, reference)
        chance = "-"
        if min(len(point.seeds), len(reference.seeds)) > 1:
            ours, theirs = (one.measured["success"][None] for one in (point, reference))
            chance = show(probability_of_improvement(ours, theirs), 2)
        values = [point.values.get(name, "-") for name in axes]
        rows.append([point.algorithm, *values, "-" if gap is None else show(gap, 2), chance])
    return rows


def print_points(
    points: Sequence[Point],
    *,
    env: str = "",
    format: str = "text",
    against: str | None = None,
    reported: Mapping[str, Reported] | None = None,
) -> None:
    """Rows of one environment, then each against the reference row.

    Raises:
        UserError: If `against` names no row.
    """
    reference = reference_point(points, env, against)
    write_table(*table_of(points, reported), format)
    labels = {point.label for point in points}
    if len(labels) == len(points) > 1:
        print()
        header = ["method", *_axes(points), "paired difference", "P(improvement)"]
        print(f"Success less that of {reference.label}:\n" if format != "latex" else "")
        write_table(header, comparison_of(points, reference), format)
    text = f"\nMeans with {describe(points)}; held-out scenarios, each once, without the expert."
    if any(len(point.seeds) > 1 for point in points):
        text += " IQM (interquartile mean) and P(improvement) are over seeds."
    print(text)
    if reported:
        print("* The paper's figures are from another simulator and another expert.")


def table(
    results: Path,
    *,
    step: int | None = None,
    format: str = "text",
    against: str | None = None,
    paper: bool = False,
    env: str | None = None,
) -> None:
    """`ppl table`: print results.

    Args:
        results: Run folder, folder of several runs, or a file of theirs.
        step: Environment steps (default: the end of each run; all of a single run).
        format: "text", "markdown" or "latex".
        against: Label of the reference row.
        paper: Whether to show the paper's own figures beside ours.
        env: Environment of results that do not name theirs.

    Raises:
        UserError: If the file, the step or the row is not there.
    """
    if results.is_file() and {"setting", "lowest"} <= set((frame := read_csv(results)).columns):
        write_table(list(frame.columns), frame.to_numpy().tolist(), format)  # `ppl tune`'s own
        return
    points = read_points(results)
    single = results.is_dir() and is_run(results) and step is None
    points = points if single else at_step(points, step)
    if not points:
        raise UserError(f"{str(results)!r}: no run finished, every one failed or diverged")
    for name in dict.fromkeys(point.env for point in points):
        mine = [point for point in points if point.env == name]
        shown = name or env or ""
        if shown:
            print(f"\n{shown}\n")
        print_points(
            mine,
            env=shown,
            format=format,
            against=against,
            reported=_reported(shown) if paper else None,
        )


def _reported(env: str) -> dict[str, Reported]:
    return {**METHODS.get(env or "driving", {}), **ABLATION}


def print_comparison(path: Path, reported: Mapping[str, Reported] | None = None) -> None:
    """Methods side by side at their last evaluation, as `ppl table` of the same folder.

    Args:
        path: An episodes.csv; nothing is printed where there is none.
        reported: The paper's own figures by row, shown beside ours.
    """
    if path.is_file():
        points = at_step(read_points(path), None)
        for env in dict.fromkeys(point.env for point in points):
            mine = [point for point in points if point.env == env]
            print_points(mine, env=env, reported=reported)


def print_run(run: Path) -> None:
    """The evaluation table of a run folder, one line per evaluation."""
    config, kinds = read_config(run), {"episodes": int, "wall_s": float, "compile_s": float}
    where = repr(str(run / SUMMARY))
    summary = read_fields(read_json(run / SUMMARY), kinds, where, needed=tuple(kinds))
    columns = {"success": 2, "progress": 2, "episodic_return": 0, "episodic_cost": 2, "length": 0}
    rows = []
    for point in read_points(run):
        means = [f"{point.measured[name].mean():.{digits}f}" for name, digits in columns.items()]
        rows.append([str(point.step), _mean(point, "human_data_usage"), *means])
    print(
        f"\n{config['algorithm']} on {config['env']}, seed {config['seed']}: "
        f"{summary['episodes']} held-out scenarios, each played once, without the expert"
    )
    print_table(["step", "human data", "success", "route", "return", "cost", "length"], rows)
    print(
        f"\n{summary['wall_s']:.0f} s in all, {summary['compile_s']:.0f} s of it compiling; "
        f"the run folder is {run}"
    )


def print_evaluation(name: str, rows: Sequence[EvaluationRow]) -> None:
    """One policy's evaluation with intervals over scenarios."""
    print(f"{name}: {len(rows)} scenarios, each once; 95% bootstrap intervals over them")
    columns = {"success": 2, "progress": 2, "episodic_return": 0, "episodic_cost": 2, "length": 0}
    cells = [
        show(mean_interval(np.array([[getattr(row, column) for row in rows]])), digits)
        for column, digits in columns.items()
    ]
    print_table(["success", "route", "return", "cost", "length"], [cells])
