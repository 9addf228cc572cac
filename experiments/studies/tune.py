"""The same small search for every method, on training scenarios; what it found is committed.

Four settings per method: two learning rates by two values of what matters most to it. Held-out
scenarios are never played.
"""

from __future__ import annotations

import csv
import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.engine.runtime import UserError
from experiments.report.tables import RESULTS, print_table, write_rows
from experiments.studies.compare import Row, budget, run_rows
from ppl_jax import algorithms

if TYPE_CHECKING:
    from experiments.cli import Tune


def points(name: str) -> list[dict[str, float | str]]:
    """The settings that are tried for a method."""
    grid = algorithms.method(name).grid
    return [dict(zip(grid, chosen, strict=True)) for chosen in itertools.product(*grid.values())]


def tune(command: Tune) -> None:
    """Try every setting with every seed; print and write tuning.csv, best setting first.

    What counts is the success on training scenarios, averaged over the later half of the
    evaluations and over seeds.

    Raises:
        UserError: If a method has no grid, or a run failed (the others go on).
    """
    tuned = [name for name in algorithms.registered() if algorithms.method(name).grid]
    names = command.algorithms or tuple(tuned)
    rows, found = [], {}
    for name in names:
        if name not in tuned:
            raise UserError(f"no grid for {name!r}: choose among {', '.join(tuned)}")
        for i, point in enumerate(points(name)):
            words = ["--algorithm", name, "--evaluate-on", "training"]
            for field, value in point.items():
                words += [f"--{field.replace('_', '-')}", str(value)]
            words += _length(command, name)
            row = Row(f"{name} {i}", f"{name}-{i}", tuple(words))
            rows.append(row)
            found[row.label] = (name, point)
    run_rows(command, rows)
    scores = _scores(command.out / RESULTS)
    table = [
        {
            "algorithm": name,
            "setting": ", ".join(f"{field} {value}" for field, value in point.items()),
            "seeds": len(command.seeds),
            "success": round(float(np.mean(scores[label])), 4),
            "lowest": round(float(np.min(scores[label])), 4),
            "highest": round(float(np.max(scores[label])), 4),
        }
        for label, (name, point) in found.items()
    ]
    order = {name: i for i, name in enumerate(names)}
    table.sort(key=lambda row: (order[row["algorithm"]], -row["success"]))
    write_rows(command.out / "tuning.csv", table)
    print_table(list(table[0]), [[str(value) for value in row.values()] for row in table])


def _length(command: Tune, name: str) -> list[str]:
    if name == "bc":
        return []  # its demonstrations are its whole run
    if name == "gail":  # as many rounds as fit a search; its full run is ten times longer
        return ["--total-steps", str(command.gail_steps)]
    return budget(command)


def _scores(path: Path) -> dict[str, list[float]]:
    """Success per seed, averaged over the later half of the evaluations."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    found: dict[str, list[float]] = {}
    for label in dict.fromkeys(row["algorithm"] for row in rows):
        mine = [row for row in rows if row["algorithm"] == label]
        steps = sorted({int(row["step"]) for row in mine})
        late = set(steps[len(steps) // 2 :])
        for seed in sorted({row["seed"] for row in mine}):
            successes = [
                float(row["success"])
                for row in mine
                if row["seed"] == seed and int(row["step"]) in late
            ]
            found.setdefault(label, []).append(float(np.mean(successes)))
    return found
