"""A worker of a sweep: compiles each program once and runs what it is given."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

Job = dict[str, Any]
Reply = dict[str, Any]


class Worker:
    """Keeps the programs it has compiled.

    A job is `{"settings": ..., "runs": [{"index", "seed", "hparams"}, ...], "side_by_side"}`; the
    reply `{"compile_s", "seconds", "runs": [{"index", "rows", "episodes"}, ...]}` or `{"error"}`.
    """

    def __init__(self) -> None:
        self.programs: dict[str, Any] = {}

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
        import jax

        from experiments.engine.settings import RunSettings
        from ppl_jax.config import replace
        from ppl_jax.sweep import split, stack

        batch = job["runs"]
        seeds = [run["seed"] for run in batch]
        settings = RunSettings.from_json(job["settings"])
        hparams = [replace(settings.config, settings.hparams, **run["hparams"])[1] for run in batch]
        keys = jax.vmap(jax.random.key)(np.array(seeds, np.uint32))
        traced = (keys, stack(hparams))
        if job["side_by_side"]:
            traced = split(traced, jax.devices())
        program, env, compile_s = self._program(job, traced)
        began = time.perf_counter()
        params = env.held_out_params
        if settings.evaluate_on == "training":
            params = env.default_params
        curve, layers = jax.block_until_ready(program(*traced, params))
        seconds = time.perf_counter() - began
        numbers = env.scenario_numbers(params)
        layers = jax.tree.map(np.asarray, layers)
        curve = jax.tree.map(np.asarray, curve)
        runs = [
            {"index": run["index"]}
            | _rows(job, jax.tree.map(lambda leaf, i=i: leaf[i], curve), numbers)
            for i, run in enumerate(batch)
        ]
        if job.get("policies"):
            _save_policies(job, settings, env, layers)
        return {"compile_s": compile_s, "seconds": seconds, "runs": runs}

    def _program(self, job: Job, traced: Any) -> tuple[Any, Any, float]:
        """The compiled batch of these settings, its environment, and the seconds that took."""
        import jax

        from experiments.engine.run import algorithm_factory, make_env_and_expert
        from experiments.engine.settings import RunSettings
        from ppl_jax.sweep import make_batch, make_run
        from ppl_jax.training import make_train

        key = json.dumps([job["settings"], len(job["runs"]), job["side_by_side"]], sort_keys=True)
        if key in self.programs:
            return *self.programs[key], 0.0
        settings = RunSettings.from_json(job["settings"])
        env, expert = make_env_and_expert(settings)
        functions = make_train(env, expert, algorithm_factory(settings, env), settings.config)
        lane = make_run(env, functions, settings.config, settings.evaluate_every, keep_policy=True)
        batch = make_batch(lane, job["side_by_side"])
        params = env.held_out_params
        if settings.evaluate_on == "training":
            params = env.default_params
        began = time.perf_counter()
        program = jax.jit(batch).lower(*traced, params).compile()
        self.programs[key] = (program, env)
        return program, env, time.perf_counter() - began


def _save_policies(job: Job, settings: Any, env: Any, layers: Any) -> None:
    """Write the trained policy of each run to the job's folder."""
    import jax

    from experiments.engine.policy_file import save_policy
    from experiments.engine.run import saved_policy

    folder = Path(job["policies"])
    folder.mkdir(parents=True, exist_ok=True)
    for i, run in enumerate(job["runs"]):
        mine = jax.tree.map(lambda leaf, i=i: leaf[i], layers)
        about = {"env": settings.env, "algorithm": settings.algorithm, "seed": run["seed"]}
        about["step"] = settings.config.total_steps
        save_policy(folder / run["policy"], saved_policy(env, mine), about)


def _rows(job: Job, curve: Any, numbers: Any) -> Reply:
    """One run's rows: one per evaluation, and one per scenario of the last evaluation."""
    from experiments.engine.evaluate import rows_of
    from experiments.engine.settings import RunSettings
    from ppl_jax.evaluation import Episodes
    from ppl_jax.sweep import evaluation_steps

    settings = RunSettings.from_json(job["settings"])
    rows, last = [], []
    for at, step in enumerate(evaluation_steps(settings.config, settings.evaluate_every)):
        counters = {name: getattr(curve.counters, name)[at].item() for name in _COUNTED}
        last = rows_of(Episodes(*(column[at] for column in curve.episodes)), numbers, step)
        means = {name: f"{np.mean([getattr(row, name) for row in last]):.6g}" for name in _SCORES}
        row = {
            "step": step,
            "status": "diverged" if curve.diverged[at] else "done",
            "human_data_usage": counters["human_data"],
            "takeovers": counters["takeovers"],
            "training_cost": f"{counters['cost']:g}",
        }
        rows.append(row | means)
    return {"rows": rows, "episodes": [row._asdict() for row in last]}


_COUNTED = ("human_data", "takeovers", "cost")
_SCORES = ("success", "episodic_return", "progress", "episodic_cost", "length")


def serve() -> None:
    """Answer jobs, a line of JSON each, from standard input on what was standard output.

    Whatever else prints goes to standard error.
    """
    from experiments.engine.runtime import start_jax

    replies = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    start_jax()
    worker = Worker()
    for line in sys.stdin:
        print(json.dumps(worker.run(json.loads(line))), file=replies, flush=True)
