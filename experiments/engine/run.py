"""One training run: the host loop around the scanned chunks, and its run folder."""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import flax.struct
import jax
import numpy as np

from experiments.engine.config_file import config_path, read_config
from experiments.engine.evaluate import (
    arrays_of,
    make_env,
    named_expert,
    physics_of,
    read_evaluation,
    read_policy,
    rows_of,
    summarise_episodes,
)
from experiments.engine.fields import read_fields, read_json
from experiments.engine.ownership import owned
from experiments.engine.plan import Chunk, plan
from experiments.engine.policy_file import save_policy
from experiments.engine.programs import NETWORK, Programs
from experiments.engine.progress import Progress
from experiments.engine.recorded import recorded_functions, recording_of
from experiments.engine.run_folder import CONFIG, POLICY, SUMMARY, RunFolder
from experiments.engine.runtime import UserError, device, revision, versions
from experiments.engine.settings import (
    RunSettings,
    check,
    one_level,
    refuse_contradictions,
    schema_of,
)
from ppl_jax import algorithms, checkpoint, experts
from ppl_jax.cards import card
from ppl_jax.experts import SavedPolicy
from ppl_jax.interaction import Counters, Learner
from ppl_jax.networks import Layers
from ppl_jax.training import TrainFunctions, make_train
from ppl_jax.types import Env, Expert


def make_env_and_expert(settings: RunSettings) -> tuple[Env, Expert]:
    """The environment and the expert of a run.

    Raises:
        UserError: If a scenario folder or the expert's file cannot be used.
    """
    env = build_env(settings)
    return env, named_expert(settings.expert, env)


def build_env(settings: RunSettings) -> Env:
    """The environment of a run.

    Raises:
        UserError: If a scenario folder or the physics cannot be used.
    """
    options: dict[str, Any] = {
        name: value
        for name in ("scenarios", "held_out_scenarios")
        if (value := getattr(settings, name)) is not None
    }
    numbers = card(settings.env).sets.get(settings.evaluate_on)
    if numbers is not None:
        options["held_out"] = numbers
    return make_env(settings.env, {"physics": settings.config.physics, **options})


def algorithm_factory(settings: RunSettings, env: Env) -> algorithms.MakeAlgorithm:
    """The method of a run, with its reference policy where it has one.

    Raises:
        UserError: If the reference policy's file cannot be used.
    """
    make = algorithms.method(settings.algorithm).make
    if settings.reference_policy is None:
        return make
    # a method whose objective has a reference takes it by keyword
    takes_reference = cast(Callable[..., algorithms.Algorithm], make)
    policy = arrays_of(read_policy(settings.reference_policy, env.spec))
    return functools.partial(takes_reference, reference=functools.partial(experts.act, policy))


def saved_policy(env: Env, layers: Layers) -> SavedPolicy:
    """A trained policy as plain arrays on the environment's raw observation."""
    weights = [(np.asarray(w), np.asarray(b)) for w, b in layers]
    return SavedPolicy(
        weights=weights,
        activation=NETWORK[0],
        output=NETWORK[1],
        obs_mean=env.spec.observation_mean,
        obs_scale=env.spec.observation_scale,
    )


def train(settings: RunSettings, out: Path, resume: bool = False) -> dict[str, Any]:
    """Train, evaluating and saving on the way; returns the summary.

    Args:
        settings: Settings of the run.
        out: Run folder.
        resume: Go on from the folder's last checkpoint.

    Raises:
        UserError: If settings or folder cannot be used.
    """
    check(settings)
    with owned(out):
        return _train(settings, RunFolder(out), resume)


def _train(settings: RunSettings, folder: RunFolder, resume: bool) -> dict[str, Any]:
    """`train` in a folder that is this process's own."""
    began = time.perf_counter()
    try:
        env, functions = _functions(settings)
    except ValueError as error:
        raise UserError(str(error)) from error
    every = functions.algorithm.update_every
    if settings.evaluate_every % every:
        raise UserError(
            f"evaluate_every must be a multiple of rollout_steps ({every}) for "
            f"{settings.algorithm}, got {settings.evaluate_every}"
        )
    open_folder(folder, settings.as_json(), resume)
    interval = settings.config.decision_interval
    programs = Programs(env, functions, interval, on=settings.evaluate_on)
    learner = programs.init(jax.random.key(settings.seed), settings.hparams)
    chunks = plan(settings.config, settings.evaluate_every)
    runner, done = _Runner(settings, folder, programs), 0
    if resume:
        done, learner = restore_learner(folder, learner)
        evaluated = [chunk.step for chunk in chunks if chunk.evaluate and chunk.end <= done]
        folder.rewind(done, max(evaluated, default=-1))
        if done >= chunks[-1].end and (folder.path / SUMMARY).is_file():
            print(f"{folder.path} is complete already ({done} steps)", file=sys.stderr)
            return read_json(folder.path / SUMMARY)
    with Progress(chunks[-1].end, f"train {settings.env}", done) as progress:
        name = f"{settings.algorithm} in {settings.where}"
        programs.announce = lambda what: progress.compiling(f"{name}, {what}")
        progress.start()
        for chunk in (chunk for chunk in chunks if chunk.end > done):
            learner, note = runner.run(learner, chunk)
            progress.update(chunk.end, note)
    return runner.finish(learner, time.perf_counter() - began)


def _functions(settings: RunSettings) -> tuple[Env, TrainFunctions]:
    recording = recording_of(settings.expert)
    if recording is None:
        env, expert = make_env_and_expert(settings)
        return env, make_train(env, expert, algorithm_factory(settings, env), settings.config)
    env = build_env(settings)
    return env, recorded_functions(
        env, algorithm_factory(settings, env), settings.config, recording
    )


def open_folder(folder: RunFolder, content: dict[str, Any], resume: bool) -> None:
    """Make a run folder, or check that the one to continue was made with the same settings.

    Args:
        folder: Folder of the run.
        content: Content of config.json; versions, device and revision are added.
        resume: Continue the run in the folder.

    Raises:
        UserError: If it cannot be made, or differs.
    """
    if resume:
        before = read_config(folder.path)
        read_fields(before, {}, config_path(folder.path), needed=("env", "algorithm", "seed"))
        held = one_level(before)
        asked = one_level(json.loads(json.dumps(content)))
        refuse_contradictions(folder.path, held, asked)
        return
    about = {"versions": versions(), "device": device(), "revision": revision()}
    folder.create(content | about)


_OLD_HPARAMS = (  # of a learner's checkpoint before config.json had a schema
    "preference_horizon",
    "beta",
    "bc_weight",
    "preference_weight",
    "preference_bias",
    "prediction_noise",
    "expert_noise",
    "learning_rate",
    "min_speed",
    "min_return",
    "max_departure",
    "min_log_density",
    "discount",
    "target_rate",
    "margin",
    "conservative_weight",
    "max_doubt",
    "max_discrepancy",
    "switch_rate",
    "discriminator_rate",
    "survival_correction",
)
_OLD_COUNTERS = {"physics_diverged": "broken"}
# settings, counters and further parts of a learner since schema 5
_LATER = (
    "laplace_scale",
    "laplace_core",
    "give_up_after",
    "recency",
    "min_clearance",
    "min_gain",
    "human_cost_steps",
    "costly",
)


def restore_learner(folder: RunFolder, learner: Any, *, repeats: bool = False) -> tuple[int, Any]:
    """The newest whole checkpoint of a run folder as (done, learner); (0, `learner`) if none.

    A checkpoint of before schema 5 lacks the settings and counters of since, and from before
    config.json had a schema it holds them under other names.

    Args:
        folder: The run folder.
        learner: At the start of the run.
        repeats: Where no checkpoint can be read, what was done is repeated from another log. Else
            a run that had one does not go back to its start.

    Raises:
        UserError: If it had one.
    """
    if hasattr(learner, "counters") and (schema := schema_of(folder.config())) < 5:
        names = {f.name: f.name for f in dataclasses.fields(Counters) if f.name not in _LATER}
        hparams = _without_later(learner.hparams)
        if schema == 1:
            names |= _OLD_COUNTERS
            zero = jax.numpy.zeros((), jax.numpy.float32)
            hparams = record_of({name: zero for name in _OLD_HPARAMS})
        parts = {f.name: getattr(learner, f.name) for f in dataclasses.fields(learner)}
        counted = {then: getattr(learner.counters, name) for name, then in names.items()}
        parts |= {"hparams": hparams, "counters": record_of(counted)}
        old = record_of({name: part for name, part in parts.items() if name not in _LATER})
        done, found = _restore(folder, old, repeats)
        if found is old:
            return 0, learner
        held = {name: getattr(found.counters, then) for name, then in names.items()}
        counters = dataclasses.replace(learner.counters, **held)
        found = {name: getattr(found, name) for name in parts if name not in _LATER}
        found |= {"hparams": learner.hparams, "counters": counters}
        return done, dataclasses.replace(learner, **found)
    return _restore(folder, learner, repeats)


def _without_later(settings: Any) -> Any:
    """A record of traced settings as it was before schema 5, its owners' within it too."""
    fields = {f.name: getattr(settings, f.name) for f in dataclasses.fields(settings)}
    kept = {
        name: _without_later(value) if dataclasses.is_dataclass(value) else value
        for name, value in fields.items()
        if name not in _LATER
    }
    return record_of(kept) if kept else settings


def record_of(values: Mapping[str, Any]) -> Any:
    """A pytree with these fields, in this order.

    A checkpoint's checksum depends on the order, and a dict would be sorted.
    """
    kind = type("Then", (), {"__annotations__": dict.fromkeys(values, jax.Array)})
    return flax.struct.dataclass(kind)(**values)


def _restore(folder: RunFolder, learner: Any, repeats: bool) -> tuple[int, Any]:
    def warn(line: str) -> None:
        print(f"warning: {line}", file=sys.stderr)

    found = checkpoint.restore(folder.checkpoints, learner, warn)
    if found is not None:
        return found
    if not repeats and (checkpoint.steps(folder.checkpoints) or folder.has_gone_on()):
        run, new = shlex.quote(str(folder.path)), shlex.quote(f"{folder.path}-again")
        raise UserError(
            f"cannot resume {str(folder.path)!r}: it has no checkpoint that can be read, and is "
            f"left as it is; start afresh with: mkdir {new} && cp {run}/{CONFIG} {new} && "
            f"ppl train --resume --out {new}"
        )
    return 0, learner  # killed before its first checkpoint: from the start


class _Runner:
    """What happens between the chunks of a run."""

    def __init__(self, settings: RunSettings, folder: RunFolder, programs: Programs):
        self.settings, self.folder, self.programs = settings, folder, programs
        self.env = programs.env
        self.train_s = 0.0
        self.trained_steps = 0

    def run(self, learner: Learner, chunk: Chunk) -> tuple[Learner, str]:
        """Train to the end of a chunk, evaluate, log, save; returns learner and a note."""
        began, compiled = time.perf_counter(), self.programs.compile_s
        learner, metrics = jax.block_until_ready(
            self.programs.chunk(learner, chunk.length, chunk.phase)
        )
        seconds = time.perf_counter() - began - (self.programs.compile_s - compiled)
        if chunk.phase == "interact":
            self.train_s += seconds
            self.trained_steps += chunk.length
        layers = self.programs.functions.algorithm.policy(learner.algorithm)
        human = int(learner.counters.human_data)
        row = {"step": chunk.step, "done": chunk.end, "phase": chunk.phase}
        row |= {name: float(value) for name, value in metrics.items()}
        note = f"human data {human}"
        if chunk.evaluate:
            numbers = self.env.scenario_numbers(self.programs.pool)
            rows = rows_of(self.programs.evaluate(learner), numbers, chunk.step)
            scores = summarise_episodes(rows)
            self.folder.append_evaluation([r._asdict() | {"human_data_usage": human} for r in rows])
            row |= {f"eval/{name}": value for name, value in scores.items()}
            note = f"success {scores['success_rate']:.2f}, {note}"
        row |= {"time/chunk_s": round(seconds, 3), "train/diverged": bool(learner.diverged)}
        self.folder.append_metrics(row)
        self._save(chunk, learner, layers)
        if bool(learner.diverged):
            note += ", DIVERGED: the policy stays as it was"
        return learner, note

    def _save(self, chunk: Chunk, learner: Learner, layers: Layers) -> None:
        save_policy(
            self.folder.path / POLICY,
            saved_policy(self.env, layers),
            {
                "env": self.settings.env,
                "algorithm": self.settings.algorithm,
                "seed": self.settings.seed,
                "step": chunk.step,
            },
        )
        checkpoint.save(self.folder.checkpoints, chunk.end, learner)

    def finish(self, learner: Learner, wall_s: float) -> dict[str, Any]:
        """Write and return the summary."""
        settings = self.settings
        rows = read_evaluation(self.folder.path)
        scores = summarise_episodes([r for r in rows if r.step == settings.config.total_steps])
        human = int(learner.counters.human_data)
        summary = {
            "env": settings.env,
            "algorithm": settings.algorithm,
            "seed": settings.seed,
            "total_steps": settings.config.total_steps,
            "human_data_usage": human,
            "human_cost_steps": int(learner.counters.human_cost_steps),
            "intervention_rate": human / settings.config.total_steps,
            **scores,
            "training_episodes": int(learner.counters.episodes),
            "training_cost": float(learner.counters.cost),
            "physics_diverged_episodes": int(learner.counters.physics_diverged),
            "diverged": bool(learner.diverged),
            **physics_of(self.env),
            "wall_s": round(wall_s, 1),
            "compile_s": round(self.programs.compile_s, 1),
            "steps_per_s": round(self.trained_steps / max(self.train_s, 1e-9), 1),
        }
        self.folder.write_json(SUMMARY, summary)
        return summary
