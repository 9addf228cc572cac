"""A trained expert as two files to ship: its policy, and a card that says how it was made."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import time
from pathlib import Path
from typing import Any

from envs import pretrained
from experiments.engine.config_file import read_config
from experiments.engine.csv_file import numbers, read_table
from experiments.engine.evaluate import (
    EvaluationRow,
    policy_path,
    read_evaluation,
    summarise_episodes,
)
from experiments.engine.expert_settings import read_settings
from experiments.engine.fields import read_fields, read_json
from experiments.engine.files import as_json, write_text_atomic
from experiments.engine.run_folder import EVALUATION, METRICS, SUMMARY, RunFolder, whole_lines
from experiments.engine.runtime import UserError
from experiments.options.expert import command_of
from experiments.report.tables import write_rows

TRAINING = ("episodic_return", "episodic_cost", "success_rate", "multiplier", "action_std")


def write_card(run: Path, out: Path, *, force: bool = False) -> None:
    """Write ENV.npz, ENV.json and ENV.csv (its curve) of a finished run of `ppl expert train`.

    Args:
        run: Run folder.
        out: Folder to write to; never the package's own.
        force: Whether existing files are replaced.

    Raises:
        UserError: If the run is none of an expert, or has not finished, or a file would be lost.
    """
    folder = RunFolder(run)
    settings = read_settings(folder)
    if not (run / SUMMARY).is_file():
        raise UserError(f"{str(run)!r} has not finished: ppl expert train --resume --out {run}")
    config, where, env = read_config(run), repr(str(run / SUMMARY)), settings.env
    kinds = {"total_steps": int, "wall_s": float, "steps_per_s": float}
    summary = read_fields(read_json(run / SUMMARY), kinds, where, needed=tuple(kinds))
    rows = read_evaluation(run)
    if not any(row.step == summary["total_steps"] for row in rows):
        raise UserError(f"{str(run / EVALUATION)!r} has no row of step {summary['total_steps']}")
    refuse_to_overwrite(out, env, force=force)
    out.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(policy_path(run), out / f"{env}.npz")
    write_rows(out / f"{env}.csv", curve(folder, rows))
    last = summarise_episodes([row for row in rows if row.step == summary["total_steps"]])
    first = summarise_episodes([row for row in rows if row.step == rows[0].step])
    card = {
        "world": env,
        "policy": f"{env}.npz",
        "command": command_of(settings),
        "date": time.strftime("%Y-%m-%d", time.gmtime((run / SUMMARY).stat().st_mtime)),
        "seed": settings.seed,
        "steps": summary["total_steps"],
        "demonstrations": settings.config.demonstrations,
        "held_out": {name: round(value, 4) for name, value in last.items()},
        f"held_out_at_{rows[0].step}_steps": {n: round(v, 4) for n, v in first.items()},
        "curve": f"{env}.csv",
        "hours": round(summary["wall_s"] / 3600, 2),
        "steps_per_s": summary["steps_per_s"],
        "config": dataclasses.asdict(settings.config),
        "hparams": {k: float(v) for k, v in dataclasses.asdict(settings.hparams).items()},
        **{name: config.get(name) for name in ("device", "versions", "revision")},
    }
    write_text_atomic(out / f"{env}.json", as_json(card, indent=2) + "\n")


def refuse_to_overwrite(out: Path, env: str, *, force: bool) -> None:
    """Check that a card written to `out` replaces neither a shipped file nor, unforced, another.

    Raises:
        UserError: One line naming the folder or file.
    """
    shipped = Path(pretrained.__file__).parent.resolve()
    if out.resolve().is_relative_to(shipped):
        raise UserError(f"out {str(out)!r} holds the shipped experts: give another --out")
    for ending in ("npz", "csv", "json"):
        path = out / f"{env}.{ending}"
        if path.exists() and not force:
            raise UserError(f"{str(path)!r} exists: give another --out, or --force to replace it")


def curve(folder: RunFolder, rows: list[EvaluationRow]) -> list[dict[str, Any]]:
    """A row per evaluation: means of training since the one before, and the held-out scenarios."""
    logged = _logged(folder.path / METRICS)
    table, before = [], -1
    for step in sorted({row.step for row in rows}):
        batches = [line for line in logged if before < line["step"] <= step]
        line: dict[str, Any] = {"step": step}
        for name in TRAINING:
            values = [value for b in batches if (value := b.get(f"train/{name}")) is not None]
            line[f"train_{name}"] = f"{sum(values) / len(values):.5g}" if values else ""
        scores = summarise_episodes([row for row in rows if row.step == step])
        line |= {f"held_out_{name}": f"{value:.5g}" for name, value in scores.items()}
        table.append(line)
        before = step
    return table


def _logged(path: Path) -> list[dict[str, Any]]:
    """The lines of a metrics.jsonl.

    Raises:
        UserError: One line naming the line that is none.
    """
    kinds = {"step": int} | {f"train/{name}": float | None for name in TRAINING}
    found = []
    for number, line in whole_lines(path):
        where = f"{str(path)!r}, line {number}"
        try:
            content = json.loads(line)
        except ValueError as error:
            raise UserError(f"{where} is no JSON ({error})") from error
        found.append(read_fields(content, kinds, where, needed=("step",)))
    return found


def read_curve(path: Path) -> list[dict[str, float]]:
    """A curve's rows as numbers; what was not measured is left out.

    Raises:
        UserError: One line naming row and column of what is no number.
    """
    table = read_table(path)
    columns = {
        name: numbers(table.column(name), table.lines, name, path, empty=True)
        for name in table.columns
    }
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    return [{k: v for k, v in row.items() if not math.isnan(v)} for row in rows]
