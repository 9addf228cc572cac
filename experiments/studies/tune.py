"""The same small search for every method, on training scenarios; what it found is committed.

Four settings per method: two learning rates by two values of what matters most to it, as each
method's registration says (`ppl_jax.algorithms.registry.AlgorithmSpec.grid`). Held-out scenarios
are never played.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.runtime import UserError
from experiments.report.points import Point, read_points, write_rows
from experiments.report.tables import RESULTS, print_table
from experiments.studies import grid
from experiments.studies.compare import settings_of
from experiments.studies.grid import Run, plain, run_name
from experiments.studies.runner import Execution, execute
from ppl_jax import algorithms
from ppl_jax.config import did_you_mean

if TYPE_CHECKING:
    from experiments.options.commands import Tune

TUNED = "tuning.csv"


def points(name: str) -> list[dict[str, Any]]:
    """The settings that are tried for a method."""
    return grid.points(algorithms.method(name).grid)


def tune(command: Tune) -> None:
    """Try every setting with every seed; print and write tuning.csv, best setting first.

    What counts is the success on training scenarios, averaged over the later half of the
    evaluations and over seeds.

    Raises:
        UserError: If a method has no grid, or a run failed (the others are run all the same).
    """
    tuned = [name for name in algorithms.registered() if algorithms.method(name).grid]
    names = command.algorithms or tuple(tuned)
    runs = []
    for name in names:
        if name not in tuned:
            raise UserError(
                f"no grid for {name!r}: choose among {', '.join(tuned)}{did_you_mean(name, tuned)}"
            )
        for seed in command.seeds:
            for point in points(name):
                given = dict(point)
                if name == "gail":  # its full run is ten times longer
                    given["total_steps"] = command.gail_steps
                settings = settings_of(
                    command,
                    name,
                    seed,
                    given,
                    own_length=name in ("bc", "gail"),
                    evaluate_on="training",
                )
                label = run_name(command.env, name, point, seed)
                runs.append(Run(name=label, values=tuple(point.items()), settings=settings))
    execute(runs, command.out, Execution(processes=command.processes))
    found = read_points(command.out / RESULTS)
    table = [_row(found, name, point) for name in names for point in points(name)]
    order = {name: i for i, name in enumerate(names)}
    table.sort(key=lambda row: (order[row["algorithm"]], -row["success"]))
    write_rows(command.out / TUNED, table)
    print_table(list(table[0]), [[str(value) for value in row.values()] for row in table])


def _row(found: list[Point], name: str, point: dict[str, Any]) -> dict[str, Any]:
    """A setting's success per seed, averaged over the later half of the evaluations."""
    shown = {field: plain(value) for field, value in point.items()}
    mine = [
        one
        for one in found
        if one.algorithm == name
        and all(plain(_number(one.values.get(k))) == v for k, v in shown.items())
    ]
    mine.sort(key=lambda one: one.step)
    late = mine[len(mine) // 2 :]
    scores = np.mean([one.measured["success"] for one in late], axis=0)
    return {
        "algorithm": name,
        "setting": ", ".join(f"{field} {value}" for field, value in point.items()),
        "seeds": len(scores),
        "success": round(float(np.mean(scores)), 4),
        "lowest": round(float(np.min(scores)), 4),
        "highest": round(float(np.max(scores)), 4),
    }


def _number(text: Any) -> Any:
    try:
        return float(text)
    except (TypeError, ValueError):
        return text
