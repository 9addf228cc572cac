"""Several methods with the same seeds, as run folders, and one long results.csv."""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.runtime import UserError
from experiments.tables import write_rows
from ppl_jax.algorithms import ALGORITHMS
from ppl_jax.runlog import CONFIG, EVALUATION, SUMMARY, RunFolder

if TYPE_CHECKING:
    from experiments.cli import Compare


def compare(command: Compare) -> None:
    """Train every method with every seed, several processes at a time; resumes.

    On a CPU a process per core beats one vmapped program: a single update fills a core.

    Raises:
        UserError: If a method is unknown or a run failed (the others go on).
    """
    for algorithm in command.algorithms:
        if algorithm not in ALGORITHMS:
            raise UserError(
                f"unknown algorithm {algorithm!r}: choose one of {', '.join(ALGORITHMS)}"
            )
    for name in ("seeds", "processes"):
        if getattr(command, name) < 1:
            raise UserError(f"{name} must be at least 1, got {getattr(command, name)}")
    waiting = [
        (algorithm, seed) for seed in range(command.seeds) for algorithm in command.algorithms
    ]
    running: dict[tuple[str, int], subprocess.Popen] = {}
    failed = []
    while waiting or running:
        while waiting and len(running) < command.processes:
            job = waiting.pop(0)
            run = command.out / f"{job[0]}-{job[1]}"
            if not (run / SUMMARY).is_file():
                running[job] = _start(command, job, run)
        for job, process in list(running.items()):
            if process.poll() is not None:
                del running[job]
                print(f"{job[0]} seed {job[1]}: {'done' if not process.returncode else 'FAILED'}")
                if process.returncode:
                    failed.append(f"{job[0]}-{job[1]}")
        time.sleep(0.2)
    write_rows(command.out / "results.csv", _collect(command))
    if failed:
        raise UserError(f"these runs failed, see their output above: {', '.join(failed)}")


def _start(command: Compare, job: tuple[str, int], run: Path) -> subprocess.Popen:
    words = [
        sys.executable,
        "-m",
        "experiments.cli",
        "train",
        command.env,
        "--algorithm",
        job[0],
        "--seed",
        str(job[1]),
        "--out",
        str(run),
    ]
    names = ("preset", "total_steps", "evaluate_every", "gate", "min_return", "max_departure")
    names += ("scenarios", "held_out_scenarios")
    for name in names:
        value = getattr(command, name)
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    if (run / CONFIG).exists():
        words.append("--resume")
    return subprocess.Popen(words, stdout=subprocess.DEVNULL)


def _collect(command: Compare) -> list[dict]:
    """One row per method, seed, evaluation and scenario."""
    rows = []
    for algorithm in command.algorithms:
        for seed in range(command.seeds):
            run = RunFolder(command.out / f"{algorithm}-{seed}")
            if not (run.path / SUMMARY).is_file():
                continue
            hparams = run.config()["hparams"]
            with open(run.path / EVALUATION, newline="") as file:
                rows += [
                    {"algorithm": algorithm, "seed": seed}
                    | {name: f"{value:g}" for name, value in hparams.items()}
                    | row
                    for row in csv.DictReader(file)
                ]
    return rows
