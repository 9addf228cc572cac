"""Tables, from result files only."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.engine.evaluate import EvaluationRow, read_evaluation, summarise_episodes
from experiments.engine.run_folder import SUMMARY, RunFolder
from experiments.report.paper import Reported
from ppl_jax.statistics import Interval, mean_interval, paired_difference


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A plain table with aligned columns."""
    table = [list(header), *[list(row) for row in rows]]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    for i, row in enumerate(table):
        print(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        )
        if i == 0:
            print("  ".join("-" * width for width in widths))


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write dictionaries as a CSV file."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def print_run(run: Path) -> None:
    """The evaluation table of a run folder, one line per evaluation."""
    folder = RunFolder(run)
    config, summary = folder.config(), folder.read_json(SUMMARY)
    rows = read_evaluation(run)
    human = {}  # an expert has none
    with open(run / "evaluation.csv", newline="") as file:
        for row in csv.DictReader(file):
            human[int(row["step"])] = row.get("human_data_usage", "-")
    lines = []
    for step in sorted({row.step for row in rows}):
        scores = summarise_episodes([row for row in rows if row.step == step])
        lines.append(
            [
                str(step),
                human[step],
                f"{scores['success_rate']:.2f}",
                f"{scores['route_completion']:.2f}",
                f"{scores['episodic_return']:.0f}",
                f"{scores['episodic_cost']:.2f}",
                f"{scores['episode_length']:.0f}",
            ]
        )
    print(
        f"\n{config['algorithm']} on {config['env']}, seed {config['seed']}: "
        f"{summary['episodes']} held-out scenarios, each played once, without the expert"
    )
    print_table(["step", "human data", "success", "route", "return", "cost", "length"], lines)
    print(
        f"\n{summary['wall_s']:.0f} s in all, {summary['compile_s']:.0f} s of it compiling; "
        f"the run folder is {run}"
    )


def print_evaluation(name: str, rows: list[EvaluationRow]) -> None:
    """One policy's evaluation with intervals over scenarios."""
    print(f"{name}: {len(rows)} scenarios, each once")
    rng = np.random.default_rng(0)

    def cell(values: list[float], digits: int) -> str:
        return show(mean_interval(np.array([values]), rng), digits)

    print_table(
        ["success", "route", "return", "cost", "length"],
        [
            [
                cell([row.success for row in rows], 2),
                cell([row.progress for row in rows], 2),
                cell([row.episodic_return for row in rows], 0),
                cell([row.episodic_cost for row in rows], 2),
                cell([row.length for row in rows], 0),
            ]
        ],
    )


def show(interval: Interval, digits: int) -> str:
    """`mean [low, high]`."""
    return f"{interval.mean:.{digits}f} [{interval.low:.{digits}f}, {interval.high:.{digits}f}]"


RESULTS, EPISODES = "results.csv", "episodes.csv"
COLUMNS = {"success": 2, "episodic_return": 0, "progress": 2, "episodic_cost": 2}


def read_episodes(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Each method's last evaluation: columns as [seeds, scenarios]."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    found = {}
    for label in dict.fromkeys(row["algorithm"] for row in rows):
        mine = [row for row in rows if row["algorithm"] == label]
        seeds = sorted({int(row["seed"]) for row in mine})
        found[label] = {
            column: np.array(
                [[float(row[column]) for row in mine if int(row["seed"]) == seed] for seed in seeds]
            )
            for column in (*COLUMNS, "human_data_usage", "total_steps", "training_cost")
        }
    return found


def print_comparison(path: Path, reported: Mapping[str, Reported] | None = None) -> None:
    """Methods side by side at their last evaluation, 95% intervals over seeds and scenarios.

    Args:
        path: An episodes.csv; nothing is printed where there is none.
        reported: The paper's own figures by row, shown beside ours.
    """
    if not path.is_file():
        return
    found, reported = read_episodes(path), reported or {}
    rng = np.random.default_rng(0)
    lines = []
    for label, scores in found.items():
        human, total = scores["human_data_usage"][:, 0], scores["total_steps"][0, 0]
        theirs = reported.get(label)
        lines.append(
            [
                label,
                str(len(human)),
                f"{human.mean():.0f} ({human.mean() / total:.2f})",
                f"{total:.0f}",
                *[show(mean_interval(scores[c], rng), digits) for c, digits in COLUMNS.items()],
                f"{scores['training_cost'][:, 0].mean():.0f}",
            ]
            + ([_cells(theirs)] if reported else [])
        )
    header = ["method", "seeds", "human data", "total", "success", "return", "route", "cost"]
    header.append("cost in training")
    print_table(header + ([_PAPER] if reported else []), lines)
    if reported:
        print("* the paper's own figures, from another simulator and another expert")
    first, *others = found
    for other in others:
        a, b = found[first]["success"], found[other]["success"]
        if a.shape == b.shape:
            print(
                f"success of {first} less {other}, paired: {show(paired_difference(a, b, rng), 2)}"
            )


_PAPER = "paper*: human/total, success, return, route"


def _cells(reported: Reported | None) -> str:
    if reported is None:
        return "-"
    data = f"{reported.human_data or '-'}/{reported.total_data or '-'}"
    rest = (reported.success, reported.episodic_return, reported.route_completion)
    return ", ".join([data, *(value or "-" for value in rest)])
