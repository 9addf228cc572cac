"""`ppl tune`: the same search for every method, on scenarios that no result is reported on.

Four settings per method: two values of each of two settings, as its registration says
(`ppl_jax.algorithms.registry.AlgorithmSpec.grid`), the first value of each the published one (or,
where the paper leaves it open, the one that came before the search). Two rounds:

    1. every setting with `--seeds` seeds;
    2. the published setting and the best other one of round 1 with `--final-seeds` fresh seeds.

A run's score is its success on the set "tuning" (training scenarios and unseen ones), averaged over
its evaluations at 60, 80 and 100 % of its length. What is chosen is decided by round 2 alone: the
published setting, unless the other beats it by two standard errors of their difference.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.runtime import UserError
from experiments.report.points import write_rows
from experiments.report.tables import RESULTS, print_table
from experiments.studies import grid
from experiments.studies.compare import settings_of
from experiments.studies.grid import Run, plain, run_name
from experiments.studies.runner import Execution, execute
from ppl_jax import algorithms
from ppl_jax.cards import card
from ppl_jax.config import did_you_mean

if TYPE_CHECKING:
    from experiments.options.commands import Tune

TUNED = "tuning.csv"
EVALUATIONS, COUNTED = 5, 3  # of a run, and how many of the last of them its score averages
BEATEN_BY = 2.0  # standard errors

Point = dict[str, Any]


def points(name: str) -> list[Point]:
    """The settings that are tried for a method, the published one first."""
    return grid.points(algorithms.method(name).grid)


def tune(command: Tune) -> None:
    """Both rounds for every method; print and write tuning.csv. Resumes.

    Raises:
        UserError: If a method has no grid, seeds are used twice, or a run failed (the others are
            run all the same).
    """
    tuned = [name for name in algorithms.registered() if algorithms.method(name).grid]
    names = command.algorithms or tuple(tuned)
    for name in names:
        if name not in tuned:
            raise UserError(
                f"no grid for {name!r}: choose among {', '.join(tuned)}{did_you_mean(name, tuned)}"
            )
    twice = sorted(set(command.seeds) & set(command.final_seeds))
    if twice:
        raise UserError(
            f"final_seeds must be fresh, got {', '.join(map(str, twice))} of seeds again"
        )
    execution = Execution(processes=command.processes)
    first = {name: points(name) for name in names}
    runs = _runs(command, first, command.seeds)
    execute(runs, command.out, execution)
    scores = read_scores(command.out)

    def tried(name: str, point: Point, seeds: Sequence[int]) -> list[float]:
        return [scores[run_name(command.env, name, point, seed)] for seed in seeds]

    final = {
        name: finalists([(point, tried(name, point, command.seeds)) for point in first[name]])
        for name in names
    }
    execute([*runs, *_runs(command, final, command.final_seeds)], command.out, execution)
    scores = read_scores(command.out)
    table = []
    for name in names:
        played = [(point, tried(name, point, command.final_seeds)) for point in final[name]]
        chosen = choose(played)
        for point in first[name]:
            table.append(_row(name, point, 1, tried(name, point, command.seeds)))
        for point, found in played:
            table.append(_row(name, point, 2, found) | {"chosen": point == chosen})
    write_rows(command.out / TUNED, table)
    print_table(list(table[0]), [[str(value) for value in row.values()] for row in table])


def finalists(tried: Sequence[tuple[Point, Sequence[float]]]) -> list[Point]:
    """The published setting, which comes first, and the best other one by its mean score."""
    (published, _), *others = tried
    if not others:
        return [published]
    return [published, max(others, key=lambda one: float(np.mean(one[1])))[0]]


def choose(played: Sequence[tuple[Point, Sequence[float]]]) -> Point:
    """The published setting, which comes first, unless another beats it by two standard errors.

    mean(b) - mean(a) > 2 sqrt(var(a) / n_a + var(b) / n_b)
    """
    (best, scores), *others = played
    for point, found in others:
        error = np.sqrt(sum(np.var(one, ddof=1) / len(one) for one in (scores, found)))
        if np.mean(found) - np.mean(scores) > BEATEN_BY * error:
            best, scores = point, found
    return best


def _runs(command: Tune, wanted: dict[str, list[Point]], seeds: Sequence[int]) -> list[Run]:
    """The runs of a round."""
    runs = []
    evaluate_on = "tuning" if "tuning" in card(command.env).sets else "training"
    for name, mine in wanted.items():
        own_length = "total_steps" in algorithms.method(name).changes(card(command.env))
        for seed in seeds:
            for point in mine:
                given = dict(point)
                if name == "gail":  # its full run is ten times longer
                    given["total_steps"] = command.gail_steps
                settings = settings_of(
                    command, name, seed, given, own_length=own_length, evaluate_on=evaluate_on
                )
                if command.evaluate_every is None and not own_length:
                    block = settings.config.decision_interval
                    fifth = settings.config.total_steps // EVALUATIONS // block
                    settings = dataclasses.replace(settings, evaluate_every=max(fifth, 1) * block)
                label = run_name(command.env, name, point, seed)
                runs.append(Run(name=label, values=tuple(point.items()), settings=settings))
    return runs


def read_scores(folder: Path) -> dict[str, float]:
    """The score of every run in the results of a folder, by the run's name."""
    found: dict[str, list[tuple[int, float]]] = {}
    with open(folder / RESULTS, newline="") as file:
        for row in csv.DictReader(file):
            if row["success"]:
                found.setdefault(row["run"], []).append((int(row["step"]), float(row["success"])))
    return {
        name: float(np.mean([success for _, success in sorted(rows)[-COUNTED:]]))
        for name, rows in found.items()
    }


def _row(name: str, point: Point, number: int, scores: Sequence[float]) -> dict[str, Any]:
    """A row of the table."""
    error = np.std(scores, ddof=1) / np.sqrt(len(scores)) if len(scores) > 1 else np.nan
    return {
        "algorithm": name,
        "setting": ", ".join(f"{field} {plain(value)}" for field, value in point.items()),
        "round": number,
        "seeds": len(scores),
        "success": round(float(np.mean(scores)), 4),
        "standard_error": round(float(error), 4),
        "lowest": round(float(np.min(scores)), 4),
        "highest": round(float(np.max(scores)), 4),
        "chosen": "",
    }
