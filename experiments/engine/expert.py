"""Training a neural expert: the host loop around PPO-Lagrangian, and evaluating any expert."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.engine.evaluate import (
    EvaluationRow,
    evaluate_policy,
    make_env,
    named_policy,
    physics_of,
    read_evaluation,
    rows_of,
    summarise_episodes,
)
from experiments.engine.expert_settings import (
    ALGORITHM,
    FIRST_SCENARIO,
    ExpertSettings,
    check,
    read_settings,
)
from experiments.engine.fields import read_json
from experiments.engine.ownership import owned
from experiments.engine.policy_file import save_policy
from experiments.engine.progress import Progress
from experiments.engine.run import open_folder, record_of, restore_learner
from experiments.engine.run_folder import POLICY, SUMMARY, RunFolder
from experiments.engine.runtime import UserError
from experiments.engine.settings import one_level, refuse_contradictions
from ppl_jax import checkpoint
from ppl_jax.evaluation import evaluate
from ppl_jax.experts import SavedPolicy
from ppl_jax.ppo.loop import PPOFunctions, PPOLearner, make_ppo_lagrangian
from ppl_jax.types import Env


def build_env(settings: ExpertSettings) -> Env:
    """The environment that an expert trains in.

    Raises:
        UserError: If a scenario folder or the physics cannot be used.
    """
    names = ("scenarios", "held_out_scenarios")
    options: dict[str, Any] = {"physics": settings.physics}
    options |= {name: v for name in names if (v := getattr(settings, name)) is not None}
    if settings.training_scenarios:
        options["training"] = range(FIRST_SCENARIO, FIRST_SCENARIO + settings.training_scenarios)
    return make_env(settings.env, options)


def train_expert(settings: ExpertSettings, out: Path, resume: bool = False) -> dict[str, Any]:
    """Train, evaluating and saving on the way; returns the summary.

    Args:
        settings: All that defines the run.
        out: Run folder.
        resume: Continue from the folder's last checkpoint.

    Raises:
        UserError: If settings or folder cannot be used.
    """
    check(settings)
    with owned(out):
        return _train(settings, RunFolder(out), resume)


def _train(settings: ExpertSettings, folder: RunFolder, resume: bool) -> dict[str, Any]:
    """`train_expert` in a folder that is this process's own."""
    began, config = time.perf_counter(), settings.config
    env = build_env(settings)
    try:
        teacher = env.experts.get(env.card.expert.teacher)
        functions = make_ppo_lagrangian(env, config, expert=teacher)
    except ValueError as error:
        raise UserError(str(error)) from error
    if resume:
        before = one_level(read_settings(folder).as_json())
        refuse_contradictions(folder.path, before, one_level(settings.as_json()))
    else:
        open_folder(folder, settings.as_json(), resume=False)
    learner = jax.jit(functions.init)(jax.random.key(settings.seed), settings.hparams)
    done = 0
    if resume:
        done, learner = _restore(folder, learner)
        folder.rewind(done, done)
        if done >= config.batches * config.batch_steps and (folder.path / SUMMARY).is_file():
            print(f"{folder.path} is complete already ({done} steps)", file=sys.stderr)
            return read_json(folder.path / SUMMARY)
    first = done // config.batch_steps
    with Progress(config.batches * config.batch_steps, f"expert {settings.env}", done) as progress:
        run = _Run(settings, folder, env=env, functions=functions, progress=progress)
        learner = run.start(learner, first)
        progress.start()
        for batch in range(first + 1, config.batches + 1):
            learner, note = run.batch(learner, batch)
            if note is not None:
                progress.update(batch * config.batch_steps, note)
    return run.finish(learner, time.perf_counter() - began)


def _restore(folder: RunFolder, learner: PPOLearner) -> tuple[int, PPOLearner]:
    """The newest whole checkpoint as (done, learner); (0, `learner`) if there is none.

    A checkpoint from before config.json had a schema holds the settings that its version had, under
    the names they had then.
    """
    content = folder.config()
    if "schema" in content:
        return restore_learner(folder, learner)
    zero = jax.numpy.zeros((), jax.numpy.float32)
    hparams = record_of(dict.fromkeys(content["hparams"], zero))  # in the order of the checkpoint
    like = dataclasses.replace(learner, hparams=hparams)
    done, found = restore_learner(folder, like)
    return done, dataclasses.replace(found, hparams=learner.hparams)


class _Run:
    """The compiled batch of a run and what happens around it."""

    def __init__(
        self,
        settings: ExpertSettings,
        folder: RunFolder,
        *,
        env: Env,
        functions: PPOFunctions,
        progress: Progress,
    ):
        self.settings, self.folder, self.env, self.functions = settings, folder, env, functions
        self.progress = progress
        self.compile_s = self.train_s = 0.0
        self.trained = 0

    def start(self, learner: PPOLearner, first: int) -> PPOLearner:
        """Compile, and at the start of a run clone what it has demonstrated."""
        jitted = jax.jit(lambda learner: self.functions.run(learner, 1), donate_argnums=0)
        self.program = self._compiled(jitted, "a batch", learner)
        config = self.settings.config
        if first or not config.demonstrations:
            return learner
        clone = self._compiled(jax.jit(self.functions.clone), "cloning", learner)
        steps, updates = config.demonstrations, config.cloning_updates
        self.progress.say(f"clones its teacher: {steps:,} steps shown, {updates:,} updates")
        learner, metrics = clone(learner)
        row = {name: float(value) for name, value in metrics.items()}
        scores = self._evaluate(learner, 0)
        self.folder.append_metrics({"step": 0, "done": 0} | row | scores)
        checkpoint.save(self.folder.checkpoints, 0, learner)
        shown, success = row["clone/success_rate"], scores["eval/success_rate"]
        self.progress.say(f"the clone's success is {success:.2f} (its teacher's: {shown:.2f})")
        return learner

    def _compiled(self, jitted: Any, part: str, learner: PPOLearner) -> Any:
        """The program of a part of the run, compiled ahead of time and announced."""
        config, began = self.settings.config, time.perf_counter()
        what = f"PPO-Lagrangian in {self.settings.env}, {part}"
        with self.progress.compiling(what, f"{what}, {config.num_envs} x {config.rollout_steps}"):
            program = jitted.lower(learner).compile()
        self.compile_s += time.perf_counter() - began
        return program

    def batch(self, learner: PPOLearner, batch: int) -> tuple[PPOLearner, str | None]:
        """One batch; at every interval also an evaluation, a checkpoint and a note."""
        config = self.settings.config
        began = time.perf_counter()
        learner, metrics = jax.block_until_ready(self.program(learner))
        seconds = time.perf_counter() - began
        self.train_s, self.trained = self.train_s + seconds, self.trained + config.batch_steps
        step = batch * config.batch_steps
        row = {"step": step, "done": step} | {k: float(v[0]) for k, v in metrics.items()}
        row |= {"time/batch_s": round(seconds, 3), "train/diverged": bool(learner.diverged)}
        note = None
        if batch % self.settings.evaluate_every == 0 or batch == config.batches:
            scores = self._evaluate(learner, step)
            row |= scores
            note = (
                f"return {row['train/episodic_return']:.1f}, cost {row['train/episodic_cost']:.2f}"
                f", multiplier {row['train/multiplier']:.2f}, success "
                f"{row['train/success_rate']:.2f}, held out {scores['eval/success_rate']:.2f}"
            )
            if bool(learner.diverged):
                note += ", DIVERGED: the policy stays as it was"
        self.folder.append_metrics(row)
        if note is not None:
            self._save(learner, step)
        return learner, note

    def _policy(self, learner: PPOLearner) -> SavedPolicy:
        return jax.tree.map(
            lambda leaf: leaf if isinstance(leaf, str) else np.asarray(leaf),
            self.functions.policy(learner),
        )

    def _evaluate(self, learner: PPOLearner, step: int) -> dict[str, float]:
        rows = evaluate_policy(self.env, self._policy(learner), step)
        self.folder.append_evaluation([row._asdict() for row in rows])
        return {f"eval/{name}": value for name, value in summarise_episodes(rows).items()}

    def _save(self, learner: PPOLearner, step: int) -> None:
        about = {"env": self.settings.env, "algorithm": ALGORITHM}
        about |= {"seed": self.settings.seed, "step": step}
        save_policy(self.folder.path / POLICY, self._policy(learner), about)
        checkpoint.save(self.folder.checkpoints, step, learner)

    def finish(self, learner: PPOLearner, wall_s: float) -> dict[str, Any]:
        """Write and return the summary."""
        settings, config = self.settings, self.settings.config
        steps = config.batches * config.batch_steps
        rows = read_evaluation(self.folder.path)
        summary = {
            "env": settings.env,
            "algorithm": ALGORITHM,
            "seed": settings.seed,
            "total_steps": steps,
            **summarise_episodes([row for row in rows if row.step == steps]),
            "multiplier": float(learner.learned.multiplier.value),
            "diverged": bool(learner.diverged),
            **physics_of(self.env),
            "wall_s": round(wall_s, 1),
            "compile_s": round(self.compile_s, 1),
            "steps_per_s": round(self.trained / max(self.train_s, 1e-9), 1),
        }
        self.folder.write_json(SUMMARY, summary)
        return summary


def evaluate_expert(env: Env, kind: str) -> list[EvaluationRow]:
    """Play every held-out scenario once with an expert.

    Args:
        env: The environment.
        kind: "scripted", "neural", a policy file or a run folder.

    Raises:
        UserError: If there is no such expert.
    """
    if kind != "scripted":
        return evaluate_policy(env, named_policy(kind, env), 0)
    scripted = env.experts.get("scripted")
    if scripted is None:
        raise UserError(f"kind: {env.name} has no scripted expert, give neural or a policy file")
    episodes = evaluate(env, scripted, env.held_out_params, jax.random.key(0))
    return rows_of(episodes, env.scenario_numbers(env.held_out_params), 0)
