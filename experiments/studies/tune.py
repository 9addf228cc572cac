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

if TYPE_CHECKING:
    from experiments.cli import Tune

_LIKELIHOOD = ("likelihood", ("gaussian", "laplace"))
_FAST, _SLOW = ("learning_rate", (3e-4, 1e-3)), ("learning_rate", (1e-4, 3e-4))

GRID: dict[str, tuple[tuple[str, tuple], ...]] = {
    "ppl": (_FAST, _LIKELIHOOD),
    "bc": (_FAST, _LIKELIHOOD),
    "gail": (("discriminator_rate", (1e-4, 3e-4)), ("survival_correction", (0.0, 1.0))),
    "hg_dagger": (_FAST, _LIKELIHOOD),
    "ensemble_dagger": (_FAST, ("max_discrepancy", (0.02, 0.1))),
    "thrifty_dagger": (_FAST, ("switch_rate", (0.05, 0.2))),
    "iwr": (_FAST, _LIKELIHOOD),
    "eil": (_SLOW, ("margin", (0.1, 1.0))),
    "haco": (_SLOW, ("conservative_weight", (1.0, 10.0))),
    "pvp": (_SLOW, ("discount", (0.9, 0.99))),
}


def points(name: str) -> list[dict[str, float | str]]:
    """The settings that are tried for a method."""
    names = [field for field, _ in GRID[name]]
    values = itertools.product(*[choices for _, choices in GRID[name]])
    return [dict(zip(names, chosen, strict=True)) for chosen in values]


def tune(command: Tune) -> None:
    """Try every setting with every seed; print and write tuning.csv, best setting first.

    What counts is the success on training scenarios, averaged over the later half of the
    evaluations and over seeds.

    Raises:
        UserError: If a method has no grid, or a run failed (the others go on).
    """
    names = command.algorithms or tuple(GRID)
    rows, found = [], {}
    for name in names:
        if name not in GRID:
            raise UserError(f"no grid for {name!r}: choose among {', '.join(GRID)}")
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
            "seeds": command.seeds,
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
