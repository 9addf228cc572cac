"""Many runs side by side: all methods, or all ablations, as run folders and result files."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.engine.progress import Progress
from experiments.engine.run_folder import CONFIG, EVALUATION, SUMMARY, RunFolder
from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings, traced_values
from experiments.report.tables import EPISODES, RESULTS, write_rows
from ppl_jax.cards import card

if TYPE_CHECKING:
    from experiments.cli import Ablation, Compare, Tune

    Settings = Ablation | Compare | Tune

OPTIONS = ("preset", "gate", "min_return", "max_departure", "min_log_density", "batch_size")
OPTIONS += ("expert", "scenarios", "held_out_scenarios")


SCORES = ("success", "episodic_return", "progress", "episodic_cost", "length")


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a comparison.

    Attributes:
        label: As in the table and in the result files.
        folder: Its runs are FOLDER-SEED.
        words: Of its command line beside environment, seed and folder.
    """

    label: str
    folder: str
    words: tuple[str, ...]


def compare(command: Compare) -> None:
    """Train every method with every seed, several processes at a time; resumes.

    On a CPU a process per core beats one vmapped program: a single update fills a core.

    Raises:
        UserError: If a method is unknown or a run failed (the others go on).
    """
    from ppl_jax import algorithms

    names = command.algorithms or tuple(algorithms.registered(variants=False))
    rows = []
    for name in names:
        try:
            changes = algorithms.method(name).changes(card(command.env))
        except ValueError as error:
            raise UserError(str(error)) from error
        words = ["--algorithm", name]
        # demonstrations are a method's own budget; the comparison's is that of the others
        if "total_steps" not in changes:
            words += budget(command)
        rows.append(Row(name, name, tuple(words)))
    run_rows(command, rows)


def budget(command: Settings) -> list[str]:
    """The comparison's length and evaluations, as words of a run's command line."""
    words = []
    for name in ("total_steps", "evaluate_every"):
        value = getattr(command, name)
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return words


def run_rows(command: Settings, rows: Sequence[Row]) -> None:
    """Train every row with every seed and write the results of what has finished.

    Raises:
        UserError: If a setting is wrong or a run failed (the others go on).
    """
    check_counts(command)
    _same_settings(command)
    jobs = [(row, seed) for seed in command.seeds for row in rows]
    waiting = [job for job in jobs if not (_run(command, *job) / SUMMARY).is_file()]
    running: dict[tuple[Row, int], subprocess.Popen] = {}
    cores = _cores(command.processes)
    held: dict[tuple[Row, int], int | None] = {}
    failed = []
    done = len(jobs) - len(waiting)
    with Progress(len(jobs), f"runs on {command.env}", done) as progress:
        progress.start()
        while waiting or running:
            while waiting and len(running) < command.processes:
                job = waiting.pop(0)
                free = [core for core in cores if core not in held.values() or core is None]
                held[job] = free[0]
                running[job] = _start(command, *job, free[0])
            for job, process in list(running.items()):
                if process.poll() is None:
                    continue
                del running[job], held[job]
                done += 1
                row, seed = job
                if process.returncode:
                    failed.append(_run(command, *job).name)
                    _tell(_run(command, *job).with_suffix(".log"))
                state = "FAILED" if process.returncode else "done"
                progress.update(done, f"{row.label} seed {seed} {state}")
            time.sleep(0.2)
    _collect(command, rows)
    if failed:
        raise UserError(
            f"these runs failed ({len(jobs) - len(failed)} of {len(jobs)} are there; the same "
            f"command tries them again): {', '.join(failed)}"
        )


def check_counts(command: Settings) -> None:
    """Refuse what cannot be run.

    Raises:
        UserError: One line naming field, value and what is allowed.
    """
    if command.processes < 1:
        raise UserError(f"processes must be at least 1, got {command.processes}")


def _same_settings(command: Settings) -> None:
    """Keep the settings with the runs: a folder holds runs of one kind.

    Raises:
        UserError: If the folder's runs were made with others.
    """
    may_differ = ("algorithms", "seeds", "processes", "out")
    settings = {k: v for k, v in dataclasses.asdict(command).items() if k not in may_differ}
    path = command.out / "settings.json"
    if not path.is_file():
        if any(command.out.glob(f"*/{CONFIG}")):
            raise UserError(
                f"{str(command.out)!r} holds runs of something else: give another --out"
            )
        command.out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(settings, indent=2) + "\n")
    before = json.loads(path.read_text())
    for name, value in settings.items():
        if before.get(name) != value:
            raise UserError(
                f"the runs in {str(command.out)!r} were made with {name} {before.get(name)!r}, "
                f"asked for {value!r}: give another --out"
            )


def _run(command: Settings, row: Row, seed: int) -> Path:
    return command.out / f"{row.folder}-{seed}"


def _tell(log: Path) -> None:
    lines = log.read_text().strip().splitlines()
    print(lines[-1] if lines else f"no output in {log}", file=sys.stderr)


def _start(command: Settings, row: Row, seed: int, core: int | None) -> subprocess.Popen:
    run = _run(command, row, seed)
    # the program that was called: it may have registered methods or worlds of its own
    words = [sys.executable, sys.argv[0], "train", command.env, *row.words]
    words += ["--seed", str(seed), "--out", str(run)]
    for name in OPTIONS:
        value = getattr(command, name, None)
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    if (run / CONFIG).exists():
        words.append("--resume")
    with open(run.with_suffix(".log"), "w") as log:
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=log)
    if core is not None:
        os.sched_setaffinity(process.pid, {core})
    return process


def _cores(processes: int) -> list[int | None]:
    """A core for each process, where they are to share them out; else wherever they like.

    Two runs that spread over the same cores slow each other down several times.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [None] * processes
    cores = sorted(os.sched_getaffinity(0))
    return list(cores[:processes]) if processes == len(cores) else [None] * processes


def _collect(command: Settings, rows: Sequence[Row]) -> None:
    """Write results.csv (a row per run and evaluation) and episodes.csv (of each run's last)."""
    points, episodes = [], []
    for row in rows:
        for seed in command.seeds:
            run = RunFolder(_run(command, row, seed))
            if not (run.path / SUMMARY).is_file():
                continue
            summary, config = run.read_json(SUMMARY), run.config()
            named = {"algorithm": row.label, "seed": seed, "total_steps": summary["total_steps"]}
            settings = {
                name: f"{value:g}"
                for name, value in traced_values(RunSettings.from_json(config)).items()
            }
            with open(run.path / EVALUATION, newline="") as file:
                played = list(csv.DictReader(file))
            for step in sorted({int(line["step"]) for line in played}):
                at = [line for line in played if int(line["step"]) == step]
                means = {
                    name: f"{sum(float(line[name]) for line in at) / len(at):.6g}"
                    for name in SCORES
                }
                human = {"human_data_usage": at[0]["human_data_usage"]}
                points.append(named | {"step": step} | human | means | settings)
            cost = {"training_cost": f"{summary['training_cost']:g}"}
            episodes += [named | cost | line for line in at]
    if points:
        write_rows(command.out / RESULTS, points)
        write_rows(command.out / EPISODES, episodes)
