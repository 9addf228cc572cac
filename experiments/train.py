"""One training run: the host loop around the scanned chunks, and its run folder."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs import registered
from experiments.evaluate import (
    evaluate_policy,
    make_world,
    read_evaluation,
    read_policy,
    summarise_episodes,
)
from experiments.policy_file import save_policy
from experiments.progress import Progress
from experiments.runtime import UserError, device, revision, versions
from ppl_jax import checkpoint
from ppl_jax.algorithms import ALGORITHMS
from ppl_jax.config import HParams, TrainConfig, validate
from ppl_jax.experts import SavedPolicy, neural_expert
from ppl_jax.networks import layers
from ppl_jax.runlog import POLICY, SUMMARY, RunFolder
from ppl_jax.training import Learner, TrainFunctions, make_train
from ppl_jax.types import Env, Expert

EVALUATE_EVERY = 1000  # steps


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """Everything that defines a run; config.json holds it.

    Attributes:
        env, algorithm, seed: What is trained.
        config, hparams: Static and traced settings.
        expert: "scripted", or a policy file.
        scenarios, held_out_scenarios: Folders of recorded scenarios, or None for generated ones.
        evaluate_every: Steps between evaluations (and checkpoints).
    """

    env: str
    algorithm: str
    seed: int
    config: TrainConfig
    hparams: HParams
    expert: str = "scripted"
    scenarios: str | None = None
    held_out_scenarios: str | None = None
    evaluate_every: int = EVALUATE_EVERY

    def as_json(self) -> dict[str, Any]:
        """For config.json."""
        return {
            "env": self.env,
            "algorithm": self.algorithm,
            "seed": self.seed,
            "expert": self.expert,
            "scenarios": self.scenarios,
            "held_out_scenarios": self.held_out_scenarios,
            "evaluate_every": self.evaluate_every,
            "config": dataclasses.asdict(self.config),
            "hparams": {k: float(v) for k, v in dataclasses.asdict(self.hparams).items()},
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> RunSettings:
        """The inverse of `as_json`; ignores what else config.json holds."""
        config = dict(content["config"])
        config["hidden"] = tuple(config["hidden"])
        return RunSettings(
            env=content["env"],
            algorithm=content["algorithm"],
            seed=content["seed"],
            config=TrainConfig(**config),
            hparams=HParams(**content["hparams"]),
            expert=content["expert"],
            scenarios=content["scenarios"],
            held_out_scenarios=content["held_out_scenarios"],
            evaluate_every=content["evaluate_every"],
        )


def check(settings: RunSettings) -> None:
    """Refuse what cannot work, before anything is built.

    Raises:
        UserError: One line naming field, value and what is allowed.
    """
    if settings.env not in registered():
        raise UserError(
            f"unknown environment {settings.env!r}: choose one of {', '.join(registered())}"
        )
    if settings.algorithm not in ALGORITHMS:
        raise UserError(
            f"unknown algorithm {settings.algorithm!r}: choose one of {', '.join(ALGORITHMS)}"
        )
    if settings.seed < 0:
        raise UserError(f"seed must not be negative, got {settings.seed}")
    interval = settings.config.decision_interval
    try:
        validate(settings.config, settings.hparams)
    except ValueError as error:
        raise UserError(str(error)) from error
    if settings.evaluate_every < 1 or settings.evaluate_every % interval:
        raise UserError(
            f"evaluate_every must be a positive multiple of decision_interval ({interval}), got "
            f"{settings.evaluate_every}"
        )


def build(settings: RunSettings) -> tuple[Env, Expert]:
    """The world and the expert of a run.

    Raises:
        UserError: If a scenario folder or the expert's file cannot be used.
    """
    options = {
        name: value
        for name in ("scenarios", "held_out_scenarios")
        if (value := getattr(settings, name)) is not None
    }
    env = make_world(settings.env, options)
    if settings.expert == "scripted":
        return env, env.scripted_expert
    return env, neural_expert(read_policy(settings.expert, env.spec))


def saved_policy(env: Env, params: Any) -> SavedPolicy:
    """A trained policy as plain arrays on the world's raw observation."""
    weights = [(np.asarray(w), np.asarray(b)) for w, b in layers(params)]
    return SavedPolicy(
        weights, "relu", "tanh", env.spec.observation_mean, env.spec.observation_scale
    )


def train(settings: RunSettings, out: Path, resume: bool = False) -> dict[str, Any]:
    """Train, evaluating and saving on the way; returns the summary.

    Args:
        settings: Of the run.
        out: Run folder.
        resume: Go on from the folder's last checkpoint.

    Raises:
        UserError: If settings or folder cannot be used.
    """
    check(settings)
    folder = RunFolder(out)
    _open(folder, settings, resume)
    began = time.perf_counter()
    env, expert = build(settings)
    functions = make_train(env, expert, ALGORITHMS[settings.algorithm], settings.config)
    learner = jax.jit(functions.init)(jax.random.key(settings.seed), settings.hparams)
    start = 0
    if resume:
        start, learner = _restore(folder, learner)
        folder.rewind(start)
        if start >= settings.config.total_steps:
            print(f"{out} is complete already ({start} steps)", file=sys.stderr)
            return folder.read_json(SUMMARY)
    runner = _Runner(settings, folder, env, functions)
    with Progress(settings.config.total_steps, f"train {settings.env}", start) as progress:
        runner.compile(learner, start)
        progress.start()
        while start < settings.config.total_steps:
            learner, start, note = runner.chunk(learner, start)
            progress.update(start, note)
    return runner.finish(learner, time.perf_counter() - began)


def _open(folder: RunFolder, settings: RunSettings, resume: bool) -> None:
    content = settings.as_json()
    if resume:
        try:
            before = folder.config()
        except ValueError as error:
            raise UserError(str(error)) from error
        for name, value in content.items():
            if before.get(name) != json.loads(json.dumps(value)):
                raise UserError(
                    f"cannot resume {str(folder.path)!r}: its {name} is {before.get(name)!r}, "
                    f"asked for {value!r}"
                )
        return
    try:
        folder.create(
            content
            | {
                "versions": versions(),
                "device": device(),
                "revision": revision(),
            }
        )
    except ValueError as error:
        raise UserError(str(error)) from error


def _restore(folder: RunFolder, learner: Learner) -> tuple[int, Learner]:
    def warn(line: str) -> None:
        print(f"warning: {line}", file=sys.stderr)

    found = checkpoint.restore(folder.checkpoints, learner, warn)
    if found is None:
        return 0, learner  # killed before its first checkpoint: from the start
    return found


class _Runner:
    """Compiled functions of a run and what happens between its chunks."""

    def __init__(
        self, settings: RunSettings, folder: RunFolder, env: Env, functions: TrainFunctions
    ):
        self.settings, self.folder, self.env, self.functions = settings, folder, env, functions
        self.compile_s = self.train_s = 0.0
        self.trained_steps = 0
        self.programs: dict[int, Callable[[Learner], Any]] = {}

    def _length(self, start: int) -> int:
        return min(self.settings.evaluate_every, self.settings.config.total_steps - start)

    def _program(self, learner: Learner, length: int) -> Callable[[Learner], Any]:
        if length not in self.programs:
            blocks = length // self.settings.config.decision_interval

            def run(learner: Learner) -> Any:
                return self.functions.run_chunk(learner, blocks)

            began = time.perf_counter()
            jitted = jax.jit(run, donate_argnums=0)
            self.programs[length] = jitted.lower(learner).compile()
            self.compile_s += time.perf_counter() - began
        return self.programs[length]

    def compile(self, learner: Learner, start: int) -> None:
        """Compile the training program ahead of time."""
        self._program(learner, self._length(start))

    def chunk(self, learner: Learner, start: int) -> tuple[Learner, int, str]:
        """Train to the next evaluation, evaluate, log, save."""
        length = self._length(start)
        program = self._program(learner, length)
        began = time.perf_counter()
        learner, metrics = jax.block_until_ready(program(learner))
        seconds = time.perf_counter() - began
        self.train_s += seconds
        self.trained_steps += length
        step = start + length
        params = self.functions.algorithm.policy_params(learner.algorithm)
        rows = evaluate_policy(self.env, saved_policy(self.env, params), step)
        scores = summarise_episodes(rows)
        human = int(learner.counters.human_data)
        self.folder.append_evaluation([row._asdict() | {"human_data_usage": human} for row in rows])
        values = {name: float(value) for name, value in metrics.items()}
        self.folder.append_metrics(
            {"step": step}
            | values
            | {f"eval/{name}": value for name, value in scores.items()}
            | {"time/chunk_s": round(seconds, 3), "train/diverged": bool(learner.diverged)}
        )
        self._save(step, learner, params)
        note = f"success {scores['success_rate']:.2f}, human data {human}"
        if bool(learner.diverged):
            note += ", DIVERGED: the policy stays as it was"
        return learner, step, note

    def _save(self, step: int, learner: Learner, params: Any) -> None:
        save_policy(
            self.folder.path / POLICY,
            saved_policy(self.env, params),
            {
                "env": self.settings.env,
                "algorithm": self.settings.algorithm,
                "seed": self.settings.seed,
                "step": step,
            },
        )
        checkpoint.save(self.folder.checkpoints, step, learner)

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
            "intervention_rate": human / settings.config.total_steps,
            **scores,
            "training_episodes": int(learner.counters.episodes),
            "training_cost": float(learner.counters.cost),
            "broken_episodes": int(learner.counters.broken),
            "diverged": bool(learner.diverged),
            "wall_s": round(wall_s, 1),
            "compile_s": round(self.compile_s, 1),
            "steps_per_s": round(self.trained_steps / max(self.train_s, 1e-9), 1),
        }
        self.folder.write_json(SUMMARY, summary)
        return summary
