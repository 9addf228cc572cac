"""A worker of a sweep: compiles each program once and runs what it is given."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.preparation import prepare
from ppl_jax.plugins import VARIABLE

if TYPE_CHECKING:
    from experiments.engine.plan import Chunk
    from experiments.engine.programs import Look, Programs
    from experiments.engine.settings import RunSettings
    from ppl_jax.types import Env

Job = dict[str, Any]
Reply = dict[str, Any]
BEAT_S = 2.0
ALIVE: Reply = {"alive": True}
READY: Reply = {"ready": True}


class Worker:
    """Keeps the programs it has compiled.

    A job is `{"settings": ..., "runs": [{"index", "seed", "hparams"}, ...], "side_by_side"}`; the
    reply `{"compile_s", "seconds", "runs": [{"index", "rows", "episodes"}, ...]}` or `{"error"}`.

    Args:
        missing: What could not be prepared, a line each: said where a name is not known.
    """

    def __init__(self, missing: Sequence[str] = ()) -> None:
        self.missing = missing
        self.programs: dict[tuple[Any, ...], Programs] = {}

    def run(self, job: Job) -> Reply:
        """Result of a job; a mistake or a failure is a reply too."""
        from experiments.engine.runtime import UserError

        try:
            return self._run(job)
        except UserError as error:
            return {"error": str(error)}
        except Exception as error:
            first = (str(error).splitlines() or [""])[0]
            return {"error": f"{type(error).__name__}: {first}"}

    def _run(self, job: Job) -> Reply:
        from experiments.engine.plan import plan
        from experiments.engine.settings import RunSettings

        self._refuse_unknown(job["settings"])
        settings = RunSettings.from_json(job["settings"])
        programs = self._programs(settings, job["side_by_side"])
        chunks = plan(settings.config, settings.evaluate_every)
        numbers = programs.env.scenario_numbers(programs.pool)
        began, compiled = time.perf_counter(), programs.compile_s
        runs = []
        for run, looks, layers in _played(programs, settings, job, chunks):
            runs.append({"index": run["index"]} | _rows(looks, numbers))
            if job.get("policies"):
                _save_policy(job["policies"], run, settings, programs.env, layers=layers)
        compile_s = programs.compile_s - compiled
        seconds = time.perf_counter() - began - compile_s
        return {"compile_s": compile_s, "seconds": seconds, "runs": runs}

    def _refuse_unknown(self, settings: Mapping[str, Any]) -> None:
        """Say why a name that the parent knows is not known here."""
        from envs.registry import known
        from experiments.engine.runtime import UserError
        from ppl_jax import algorithms, gates, predictors

        given = settings["settings"]
        for what, name, there in (
            ("environment", settings["env"], known(settings["env"])),
            ("method", settings["algorithm"], settings["algorithm"] in algorithms.registered()),
            ("gate", given["gate"], given["gate"] in gates.registered_gates()),
            (
                "predictor",
                given["predictor"],
                given["predictor"] in predictors.registered_predictors(),
            ),
        ):
            if not there:
                why = "; ".join(self.missing) or (
                    f"name the module that registers it in {VARIABLE}=MODULE"
                )
                raise UserError(f"a worker process does not know {what} {name!r}: {why}")

    def _programs(self, settings: RunSettings, side_by_side: bool) -> Programs:
        """The programs of these settings: the same for runs of most lengths."""
        from experiments.engine.programs import Programs
        from experiments.engine.run import algorithm_factory, make_env_and_expert
        from experiments.engine.settings import program_key
        from ppl_jax.training import make_train

        key = (*program_key(settings), side_by_side)
        if key not in self.programs:
            env, expert = make_env_and_expert(settings)
            functions = make_train(env, expert, algorithm_factory(settings, env), settings.config)
            self.programs[key] = Programs(
                env,
                functions,
                settings.config.decision_interval,
                on=settings.evaluate_on,
                side_by_side=side_by_side,
            )
        return self.programs[key]


def _played(
    programs: Programs, settings: RunSettings, job: Job, chunks: list[Chunk]
) -> Iterator[tuple[dict[str, Any], list[Look], Any]]:
    """Each run of a job with what its evaluations found, and its policy's layers."""
    import jax

    from ppl_jax.config import replace
    from ppl_jax.sweep import split, stack

    batch = job["runs"]
    keys = jax.vmap(jax.random.key)(np.array([run["seed"] for run in batch], np.uint32))
    hparams = [replace(settings.config, settings.hparams, **run["hparams"])[1] for run in batch]
    if job["side_by_side"]:
        keys, many = split((keys, stack(hparams)), jax.devices())
        looks, layers = programs.play(keys, many, chunks)
        for i, run in enumerate(batch):
            mine = jax.tree.map(lambda leaf, i=i: leaf[i], layers)
            yield run, [look.of(i) for look in looks], mine
        return
    for i, run in enumerate(batch):
        yield run, *programs.play(keys[i], hparams[i], chunks)


def _save_policy(
    folder: str, run: dict[str, Any], settings: RunSettings, env: Env, *, layers: Any
) -> None:
    """Write the trained policy of a run to a folder."""
    from experiments.engine.policy_file import save_policy
    from experiments.engine.run import saved_policy

    Path(folder).mkdir(parents=True, exist_ok=True)
    about = {"env": settings.env, "algorithm": settings.algorithm, "seed": run["seed"]}
    about["step"] = settings.config.total_steps
    save_policy(Path(folder) / run["policy"], saved_policy(env, layers), about)


def _rows(looks: list[Look], numbers: Any) -> Reply:
    """One run's rows: one per evaluation, and one per evaluation and scenario."""
    from experiments.engine.evaluate import rows_of

    rows, episodes = [], []
    for look in looks:
        counters = {name: getattr(look.counters, name).item() for name in _COUNTED}
        played = rows_of(look.episodes, numbers, look.step)
        means = {name: f"{np.mean([getattr(row, name) for row in played]):.6g}" for name in _SCORES}
        episodes += [row._asdict() for row in played]
        row = {
            "step": look.step,
            "status": "diverged" if look.diverged else "done",
            "human_data_usage": counters["human_data"],
            "human_cost_steps": counters["human_cost_steps"],
            "takeovers": counters["takeovers"],
            "training_cost": f"{counters['cost']:g}",
        }
        rows.append(row | means)
    return {"rows": rows, "episodes": episodes}


_COUNTED = ("human_data", "human_cost_steps", "takeovers", "cost")
_SCORES = ("success", "episodic_return", "progress", "episodic_cost", "length")


def serve() -> None:
    """Answer jobs, a line of JSON each, from standard input on what was standard output.

    The first line is the `Preparation`; its answer says that the worker is there. Until the last
    one a sign of life comes every few seconds. Whatever else prints goes to standard error.
    """
    from experiments.engine.runtime import start_jax

    replies = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    lock, parent = threading.Lock(), os.getppid()

    def say(reply: Reply) -> None:
        with lock:
            print(json.dumps(reply), file=replies, flush=True)

    def live() -> None:
        while True:
            time.sleep(BEAT_S)
            if os.getppid() != parent:  # it was killed: nobody waits for the run under way
                os._exit(1)
            say(ALIVE)

    threading.Thread(target=live, daemon=True).start()
    start_jax()
    worker = None
    for line in sys.stdin:
        if worker is None:
            worker = Worker(prepare(json.loads(line)))
            say(READY)
        else:
            say(worker.run(json.loads(line)))
