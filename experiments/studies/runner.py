"""`ppl sweep`: plans the runs of a grid, has an engine run them and keeps their results."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envs.registry import known, unknown
from experiments.engine import compile_log
from experiments.engine import schedulers as engines
from experiments.engine.fields import read_fields, read_json
from experiments.engine.files import as_json, unusable, write_text_atomic
from experiments.engine.ownership import LOCK, owned
from experiments.engine.preparation import stop_if_preparing
from experiments.engine.progress import Progress
from experiments.engine.runtime import UserError, revision, versions
from experiments.engine.settings import (
    RunSettings,
    check,
    default_interval,
    flat,
    one_level,
    program_key,
    run_settings,
    traced_values,
)
from experiments.engine.worker import Job, Reply
from experiments.studies.grid import (
    STUDIES,
    Group,
    Run,
    Study,
    groups,
    points,
    run_name,
    widen,
)
from experiments.studies.results import Results
from ppl_jax import algorithms
from ppl_jax.cards import card
from ppl_jax.config import check_range, did_you_mean, values

if TYPE_CHECKING:
    from experiments.options.commands import Sweep

SETTINGS = "sweep.json"
LOG = "workers.log"
POLICIES = "policies"  # folder of the trained policies, a file per run
COMPILE_S = 25.0  # of a program that was never compiled before


def _study(command: Sweep) -> Study | None:
    """The study that a command names.

    Raises:
        UserError: If there is none of that name.
    """
    if command.study is None:
        return None
    if command.study not in STUDIES:
        raise UserError(
            f"study must be one of {', '.join(STUDIES)}, got {command.study!r}"
            + did_you_mean(command.study, STUDIES)
        )
    return STUDIES[command.study]


def plan(command: Sweep) -> list[Run]:
    """The runs that a command asks for.

    Raises:
        UserError: If a setting cannot work, before anything is built.
    """
    runs = []
    for env in command.envs:
        if not known(env):
            raise UserError(unknown(env))
        for algorithm in _algorithms(command):
            for chosen in _points(command, env, algorithm):
                for seed in command.seeds:
                    settings = _settings(command, env, algorithm, chosen, seed=seed)
                    if settings is not None:
                        name = run_name(env, algorithm, chosen, seed)
                        runs.append(Run(name=name, values=tuple(chosen.items()), settings=settings))
    return widen(runs)


def _axes(command: Sweep, env: str) -> dict[str, Sequence[Any]]:
    given = dict(command.axes)
    study = dict(found.axes) if (found := _study(command)) else {}
    if env != "driving" and command.study == "predictor" and "predictor" not in given:
        raise UserError(f"study predictor is for driving, which alone has two, got {env}")
    return study | given


def _points(command: Sweep, env: str, algorithm: str) -> list[dict[str, Any]]:
    """Every combination of the axes that a method has, each once.

    Raises:
        UserError: If no method of the sweep has an axis.
    """
    known = _known(command, env, algorithm)
    everyone = set().union(*(_known(command, env, name) for name in _algorithms(command)))
    axes = _axes(command, env)
    for name in axes:
        if name not in everyone:
            try:
                check_range(env, name)
            except ValueError as error:
                raise UserError(str(error)) from error
            raise UserError(f"unknown setting {name!r}{did_you_mean(name, everyone)}")
    mine = {name: values for name, values in axes.items() if name in known}
    return points(mine)


def _algorithms(command: Sweep) -> tuple[str, ...]:
    study = _study(command)
    return command.algorithms or (study.algorithms if study else ("ppl",))


def _worlds(command: Sweep) -> dict[str, bool]:
    """The setting that randomises the worlds, where command or study do."""
    study = _study(command)
    return {"randomise": True} if command.randomise or (study and study.randomise) else {}


def _known(command: Sweep, env: str, algorithm: str) -> set[str]:
    """The settings that runs of a method have, under any of the gates and predictors swept over."""
    found: set[str] = set()
    axes = {k: v for k, v in _axes(command, env).items() if k in ("gate", "predictor")}
    for given in points(axes):
        try:
            given = given | _worlds(command)
            found |= set(values(*algorithms.settings(algorithm, env, command.preset, **given)))
        except ValueError as error:
            raise UserError(str(error)) from error
    return found


def _settings(
    command: Sweep, env: str, algorithm: str, chosen: dict[str, Any], *, seed: int
) -> RunSettings | None:
    """Settings of one run; None where a study's L exceeds the environment's H."""
    given = chosen | _worlds(command)
    if command.total_steps is not None:
        given["total_steps"] = command.total_steps
    common = {name: getattr(command, name) for name in COMMON}
    settings = run_settings(env, algorithm, seed, **common, given=given)
    config = settings.config
    study = _study(command)
    if study and command.total_steps is None and study.length != 1:
        config = dataclasses.replace(config, total_steps=int(config.total_steps * study.length))
    every = command.evaluate_every
    if every is None:
        every = default_interval(config)
        if study:
            left, interval = config.total_steps - config.demonstrations, config.decision_interval
            every = max(left // study.evaluations // interval, 1) * interval
    settings = dataclasses.replace(settings, config=config, evaluate_every=every)
    horizon = flat(config, settings.hparams).get("preference_horizon", 0)
    asked = "preference_horizon" in command.axes
    if study and not asked and horizon > config.prediction_horizon:
        return None
    check(settings)
    return settings


COMMON = ("preset", "expert", "scenarios", "held_out_scenarios", "evaluate_on")


@dataclasses.dataclass(frozen=True)
class Execution:
    """How runs are executed.

    Attributes:
        engine: "local" (processes of this machine) or "ray".
        address: Address of a running Ray cluster; one on this machine where None.
        processes: Runs at the same time, on a CPU.
        batch: Runs per program; None lets the machine decide.
        dry_run: Say how much work it is, and stop.
    """

    engine: str = "local"
    address: str | None = None
    processes: int = 2
    batch: int | None = None
    dry_run: bool = False


def sweep(command: Sweep) -> None:
    """Run a grid: what is not there yet; results are written as they come.

    Raises:
        UserError: If a setting is wrong, or a run failed (the others are run all the same).
    """
    if not command.envs:
        raise UserError("envs: name at least one environment")
    execution = Execution(
        engine=command.engine,
        address=command.address,
        processes=command.processes,
        batch=command.batch,
        dry_run=command.dry_run,
    )
    execute(plan(command), command.out, execution)


def execute(runs: Sequence[Run], out: Path, execution: Execution) -> None:
    """Make the runs that are not there yet, and write results as they come.

    Raises:
        UserError: If a setting is wrong, or a run failed (the others are run all the same).
    """
    stop_if_preparing()
    for name, least in (("processes", 1), ("batch", 1)):
        value = getattr(execution, name)
        if value is not None and value < least:
            raise UserError(f"{name} must be at least {least}, got {value}")
    results = Results(out, runs)
    if execution.dry_run:
        _tell_plan(runs, runs, execution)
        return
    with owned(out):
        _execute(runs, results, execution)


def _execute(runs: Sequence[Run], results: Results, execution: Execution) -> None:
    """`execute` in a folder that is this process's own."""
    out = results.out
    before = _open(out, {run.name: _json(run.settings) for run in runs})
    done = results.read(before)
    waiting = [run for run in runs if run.name not in done]
    batch = _tell_plan(runs, waiting, execution)
    policies = None if execution.engine == "ray" else str((out / POLICIES).resolve())
    jobs = list(_jobs(groups(waiting), runs, batch, policies))
    failed = {}
    with Progress(len(runs), "runs", len(done)) as progress:
        progress.start()
        if jobs:
            first = compile_log.phrase(*_program(jobs[0][1][0]))
            progress.say(f"{first}; the first run of each program compiles")
        for number, reply in _engine(execution, [job for job, _ in jobs], out / LOG):
            compiling = reply.get("compile_s", 0.0) / _workers(execution)
            if compiling:
                compile_log.remember(_program(jobs[number][1][0])[1], reply["compile_s"])
            progress.began += compiling  # says nothing of what is left
            for run, rows in _replies(reply, jobs[number], runs):
                if isinstance(rows, str):
                    failed[run.name] = rows
                    results.fail(run, rows)
                    print(f"{run.name}: {rows}", file=sys.stderr)
                else:
                    results.add(run, rows)
                progress.update(results.count + len(failed), results.note(run))
    results.write_sorted()
    if failed:
        name, why = next(iter(failed.items()))
        raise UserError(
            f"{len(failed)} of {len(runs)} runs failed (the same command tries them again); "
            f"{name}: {why}"
        )


def _program(run: Run) -> tuple[str, str]:
    """The name of a run's program, for people and in the log of compile times."""
    settings = run.settings
    name = f"{settings.algorithm} in {settings.where}"
    return name, f"sweep: {name}"


def policy_name(run: str) -> str:
    """The file name of a run's policy, in the folder `policies`."""
    return re.sub(r"[^A-Za-z0-9_.=,-]+", "_", run) + ".npz"


def _json(settings: RunSettings) -> dict[str, Any]:
    return json.loads(json.dumps(settings.as_json()))


def _open(out: Path, asked: dict[str, Any]) -> dict[str, Any]:
    """Take a folder for a sweep, or check that what is in it has the same settings.

    More runs (seeds, values, axes) may join; those that are there must be the same.

    Returns:
        The settings of the runs in it by name, as they were before.

    Raises:
        UserError: If they are not.
    """
    path = out / SETTINGS
    before: dict[str, Any] = {}
    if path.is_file():
        before = _read_settings(path)
        for name in asked.keys() & before.keys():
            held, wanted = one_level(before[name]), one_level(asked[name])
            for field, value in wanted.items():
                if field not in _MAY_DIFFER and held.get(field) != value:
                    raise UserError(
                        f"{str(out)!r} holds {name} with {field} {held.get(field)!r}, asked for "
                        f"{value!r}: give another --out"
                    )
    elif any(held.name != LOCK for held in out.iterdir()):
        raise UserError(f"{str(out)!r} holds something else: give another --out")
    content = {"versions": versions(), "revision": revision(), "runs": before | asked}
    try:
        write_text_atomic(path, as_json(content, indent=1) + "\n")
    except OSError as error:
        raise unusable(out, error) from error
    return before


def _read_settings(path: Path) -> dict[str, Any]:
    """The settings of the runs in a sweep.json by name.

    Raises:
        UserError: If it holds none.
    """
    where = repr(str(path))
    runs = read_fields(read_json(path), {"runs": dict}, where, needed=("runs",))["runs"]
    return read_fields(runs, dict.fromkeys(runs, dict), f"{where}, runs")


_MAY_DIFFER = ("schema", "max_preference_horizon")  # the second only bounds L


def _tell_plan(runs: Sequence[Run], waiting: Sequence[Run], execution: Execution) -> int:
    """Say how much work it is; returns the runs per batch."""
    from experiments.engine.run import algorithm_factory, make_env_and_expert
    from ppl_jax.sweep import run_bytes
    from ppl_jax.training import make_train

    wanted = groups(waiting)
    steps = sum(run.settings.config.total_steps for run in waiting)
    workers = _workers(execution)
    seconds = sum(
        card(run.settings.env).step_ms
        * algorithms.method(run.settings.algorithm).cost
        * run.settings.config.total_steps
        * run.settings.config.batch_size
        / 256e3
        for run in waiting
    )
    memory = 0
    for group in wanted if execution.engine == "local" else ():
        env, expert = make_env_and_expert(group.settings)
        try:
            made = make_train(
                env, expert, algorithm_factory(group.settings, env), group.settings.config
            )
        except ValueError:
            continue  # its runs will say so; the others go on
        memory = max(memory, run_bytes(made, group.settings.hparams))
    batch = execution.batch or _batch(memory, len(waiting))
    compiles = len({program_key(group.settings) for group in wanted})
    minutes = (seconds + COMPILE_S * compiles * min(workers, 2)) / workers / 60
    print(
        f"{len(runs)} runs, {len(runs) - len(waiting)} of them done; {steps:,} steps to go in "
        f"{len(wanted)} groups: {compiles} programs to compile, on {workers} workers with "
        f"{batch} run{'s' if batch > 1 else ''} at a time, {memory * batch / 2**20:.0f} MB each; "
        f"about {minutes:.0f} min",
        file=sys.stderr,
    )
    return batch


def _accelerated() -> bool:
    import jax

    return jax.default_backend() != "cpu"


def _workers(execution: Execution) -> int:
    return 1 if execution.engine == "local" and _accelerated() else execution.processes


def _batch(run_bytes: int, runs: int) -> int:
    """Runs stepped side by side: on a CPU one; on accelerators what memory holds, evenly split."""
    import jax

    if not _accelerated():
        return 1
    devices = jax.devices()
    stats = devices[0].memory_stats() or {}
    room = 0.5 * stats.get("bytes_limit", 2**33)  # the other half is for temporaries
    most = max(int(room // (2 * max(run_bytes, 1))), 1)
    return min(most, -(-runs // len(devices))) * len(devices)


def _jobs(
    wanted: Sequence[Group], runs: Sequence[Run], batch: int, policies: str | None
) -> Iterator[tuple[Job, list[Run]]]:
    """Batches of each group; the last is filled up with copies, so that one program serves all."""
    index = {run.name: number for number, run in enumerate(runs)}
    for group in wanted:
        size = min(batch, len(group.runs)) if not _accelerated() else batch
        for start in range(0, len(group.runs), size):
            mine = group.runs[start : start + size]
            filled = mine + [mine[-1]] * (size - len(mine))
            job = {
                "settings": _json(dataclasses.replace(group.settings, seed=0)),
                "side_by_side": _accelerated(),
                "policies": policies,
                "runs": [
                    {
                        "index": index[run.name],
                        "seed": run.settings.seed,
                        "policy": policy_name(run.name),
                        "hparams": traced_values(run.settings),
                    }
                    for run in filled
                ],
            }
            yield job, mine


def _engine(execution: Execution, jobs: Sequence[Job], log: Path) -> Iterator[tuple[int, Reply]]:
    if execution.engine == "ray":
        return engines.ray_cluster(jobs, execution.address)
    if _accelerated():
        return engines.here(jobs)
    return engines.local(jobs, execution.processes, log)


def _replies(
    reply: Reply, job: tuple[Job, list[Run]], runs: Sequence[Run]
) -> Iterator[tuple[Run, dict[str, Any] | str]]:
    """Each run of a job with its rows, or with what went wrong."""
    if "error" in reply:
        for run in job[1]:
            yield run, reply["error"]
        return
    found = {answer["index"]: answer for answer in reply["runs"]}  # copies fall together
    for number, answer in found.items():
        yield runs[number], answer
