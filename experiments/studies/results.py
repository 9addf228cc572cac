"""The result files of a sweep: appended run by run, so that a kill costs what was under way."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.engine.csv_file import read_table
from experiments.engine.files import write_text_atomic
from experiments.engine.plan import evaluation_steps
from experiments.engine.runtime import UserError
from experiments.engine.settings import ADDED, traced_values
from experiments.report.points import COUNTS, SCORES
from experiments.report.tables import EPISODES, RESULTS
from experiments.studies.grid import Run, plain, show
from ppl_jax.config import values

DONE, DIVERGED, FAILED = "done", "diverged", "failed"
_STATIC = (
    "prediction_horizon",
    "batch_size",
    "predictor",
    "gate",
    "likelihood",
    "objective",
    "total_steps",
)


class Results:
    """results.csv (a row per run and evaluation) and episodes.csv (a row per scenario of each).

    Args:
        out: Folder of both.
        runs: Runs of the sweep, in order.
    """

    def __init__(self, out: Path, runs: Sequence[Run]):
        self.out, self.runs = out, list(runs)
        self.rows: dict[str, list[dict[str, str]]] = {}
        self.failures: dict[str, list[dict[str, str]]] = {}
        self.kept: dict[str, tuple[list[dict[str, str]], list[dict[str, str]]]] = {}
        self.episodes: dict[str, list[dict[str, str]]] = {}
        axes = dict.fromkeys(name for run in runs for name, _ in run.values)
        traced = list(dict.fromkeys(name for run in runs for name in traced_values(run.settings)))
        own = [name for name in axes if name not in traced and name not in _STATIC]
        where = ["run", "env", "algorithm", "seed"]
        self.columns = [*where, "status", "step", *COUNTS, *SCORES, *_STATIC, *own, *traced]
        self.episode_columns = [*where, *axes, "step", "human_data_usage", "scenario", *SCORES]

    @property
    def count(self) -> int:
        """Runs whose results are there."""
        return len(self.rows)

    def read(self, before: Mapping[str, Any]) -> set[str]:
        """Names of the runs that are there whole; what a kill cut off is dropped.

        A run counts as there where one with the same settings is, whatever it was called: another
        axis renames runs and adds columns. Runs that are not asked for now are kept.

        Args:
            before: The settings of the runs in the folder by name, as in its sweep.json.

        Raises:
            UserError: If the files are those of something else.
        """
        rows, columns = _read(self.out / RESULTS)
        episodes, episode_columns = _read(self.out / EPISODES)
        self.columns = list(dict.fromkeys([*self.columns, *columns]))
        self.episode_columns = list(dict.fromkeys([*self.episode_columns, *episode_columns]))
        known = {_key(settings): name for name, settings in before.items()}
        for run in self.runs:
            old = known.get(_key(json.loads(json.dumps(run.settings.as_json()))))
            if old is not None and old != run.name and old in rows and run.name not in rows:
                rows[run.name] = [self._renamed(run, row) for row in rows.pop(old)]
                episodes[run.name] = [self._renamed(run, row) for row in episodes.pop(old, [])]
        named = {run.name for run in self.runs}
        self.kept = {
            name: (mine, episodes.get(name, [])) for name, mine in rows.items() if name not in named
        }
        for run in self.runs:
            mine, played = rows.get(run.name, []), episodes.get(run.name, [])
            steps = evaluation_steps(run.settings.config, run.settings.evaluate_every)
            if [row.get("step") for row in mine] == [str(step) for step in steps] and played:
                whole = {(row["step"], row["scenario"]) for row in played}
                if len(whole) == len(played):
                    self.rows[run.name], self.episodes[run.name] = mine, played
        if rows or episodes:
            self.write_sorted()
        return set(self.rows)

    def _renamed(self, run: Run, row: dict[str, str]) -> dict[str, str]:
        """A row of a run that another sweep called otherwise."""
        values = {name: plain(value) for name, value in run.values}
        return row | {k: str(v) for k, v in self._where(run).items()} | values

    def add(self, run: Run, reply: dict[str, Any]) -> None:
        """A run that came back: its rows go to the files at once."""
        human = {row["step"]: row["human_data_usage"] for row in reply["rows"]}
        self.episodes[run.name] = [
            self._episode(run, human[row["step"]], row) for row in reply["episodes"]
        ]
        self.rows[run.name] = [self._row(run, row) for row in reply["rows"]]
        _append(self.out / EPISODES, self.episode_columns, self.episodes[run.name])
        _append(self.out / RESULTS, self.columns, self.rows[run.name])

    def fail(self, run: Run, why: str) -> None:
        """A run that failed is a row too, with the reason for its status."""
        self.failures[run.name] = [self._row(run, {"status": f"{FAILED}: {why}"})]
        _append(self.out / RESULTS, self.columns, self.failures[run.name])

    def _where(self, run: Run) -> dict[str, Any]:
        settings = run.settings
        return {
            "run": run.name,
            "env": settings.env,
            "algorithm": run.label or settings.algorithm,
            "seed": settings.seed,
        }

    def _row(self, run: Run, row: dict[str, Any]) -> dict[str, str]:
        settings = run.settings
        hparams = {k: f"{v:g}" for k, v in traced_values(run.settings).items()}
        mine = values(settings.config, settings.hparams)
        static = {name: mine.get(name, "") for name in _STATIC}
        whole = self._where(run) | static | hparams | dict(run.values) | row
        return {name: plain(whole.get(name, "")) for name in self.columns}

    def _episode(self, run: Run, human_data: int, row: dict[str, Any]) -> dict[str, str]:
        whole = self._where(run) | dict(run.values) | row
        whole |= {"human_data_usage": human_data}
        return {name: plain(whole.get(name, "")) for name in self.episode_columns}

    def note(self, run: Run) -> str:
        """The run that just came, and the best settings so far."""
        if run.name not in self.rows:
            return f"{run.name} FAILED"
        last = self.rows[run.name][-1]
        means: dict[tuple[str, ...], list[float]] = {}
        for other in self.runs:
            if other.name in self.rows:
                settings = other.settings
                key = (settings.env, settings.algorithm, show(dict(other.values)))
                means.setdefault(key, []).append(float(self.rows[other.name][-1]["success"]))
        best = max(means, key=lambda key: sum(means[key]) / len(means[key]))
        score = sum(means[best]) / len(means[best])
        state = f"success {float(last['success']):.2f}"
        if last["status"] != DONE:
            state += f" ({last['status'].upper()})"
        return f"{run.name} {state}; best so far {' '.join(best).strip()} {score:.2f}"

    def write_sorted(self) -> None:
        """Both files anew, in the order of the runs: the same however often it was resumed."""
        for at, name, columns, found in (
            (0, RESULTS, self.columns, self.rows | self.failures),
            (1, EPISODES, self.episode_columns, self.episodes),
        ):
            rows = [row for run in self.runs for row in found.get(run.name, [])]
            rows += [row for kept in self.kept.values() for row in kept[at]]
            text = io.StringIO()
            writer = csv.DictWriter(text, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
            write_text_atomic(self.out / name, text.getvalue())


def _key(settings: Mapping[str, Any]) -> str:
    """Equal for the same run; the bound on L, which only sets a buffer's width, does not matter."""
    kept = dict(settings)
    kept["settings"] = {
        k: v for k, v in (ADDED | kept.get("settings", {})).items() if k != "max_preference_horizon"
    }
    return json.dumps(kept, sort_keys=True)


def _read(path: Path) -> tuple[dict[str, list[dict[str, str]]], list[str]]:
    """Rows by run, and the columns; a last line without its end is left out."""
    if not path.is_file() or b"\n" not in path.read_bytes():  # killed within its first line
        return {}, []
    table = read_table(path, cut=True)
    if "run" not in table.columns:
        raise UserError(f"{str(path)!r} is not of this kind of results: give another --out")
    found: dict[str, list[dict[str, str]]] = {}
    for cells in table.rows:
        row = dict(zip(table.columns, cells, strict=True))
        for name in _COUNTED & row.keys():  # a program that has an empty cell in it makes it 200.0
            row[name] = row[name].removesuffix(".0")
        found.setdefault(row["run"], []).append(row)
    return found, table.columns


_COUNTED = {"step", "scenario", "seed", "human_data_usage", "human_cost_steps", "takeovers"}


def _append(path: Path, columns: Sequence[str], rows: Sequence[dict[str, str]]) -> None:
    new = not path.is_file()
    with open(path, "a", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)
        file.flush()
        os.fsync(file.fileno())
