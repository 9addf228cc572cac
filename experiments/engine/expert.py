"""Training a neural expert: the host loop around PPO-Lagrangian, and evaluating any expert."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.registry import known, unknown
from experiments.engine.evaluate import (
    EvaluationRow,
    evaluate_policy,
    make_world,
    named_policy,
    read_evaluation,
    rows_of,
    summarise_episodes,
)
from experiments.engine.policy_file import save_policy
from experiments.engine.progress import Progress
from experiments.engine.run import open_folder, restore_learner
from experiments.engine.run_folder import POLICY, SUMMARY, RunFolder
from experiments.engine.runtime import UserError
from ppl_jax import checkpoint
from ppl_jax.evaluation import evaluate
from ppl_jax.experts import SavedPolicy
from ppl_jax.ppo.config import PPOConfig, PPOHParams, validate
from ppl_jax.ppo.loop import PPOFunctions, PPOLearner, make_ppo_lagrangian
from ppl_jax.types import Env

FIRST_SCENARIO = 10_000  # of those an expert trains on: neither the novice's nor held out
EVALUATIONS = 40  # over a run, unless asked for otherwise


@dataclasses.dataclass(frozen=True)
class ExpertSettings:
    """Everything that defines a run; config.json holds it.

    Attributes:
        env, seed: What is trained.
        config, hparams: Static and traced settings.
        scenarios, held_out_scenarios: Folders of recorded scenarios, or None for generated ones.
        training_scenarios: Number of generated scenarios to train on; the world's own where 0.
        evaluate_every: Batches between evaluations and checkpoints.
    """

    env: str
    seed: int
    config: PPOConfig
    hparams: PPOHParams
    scenarios: str | None = None
    held_out_scenarios: str | None = None
    training_scenarios: int = 0
    evaluate_every: int = 1

    def as_json(self) -> dict[str, Any]:
        """For config.json."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        config = dataclasses.asdict(self.config)
        hparams = {k: float(v) for k, v in dataclasses.asdict(self.hparams).items()}
        return content | {"algorithm": "ppo_lagrangian", "config": config, "hparams": hparams}


def settings_for(env: str) -> tuple[PPOConfig, PPOHParams, int]:
    """What trained the shipped expert of a world, and on how many scenarios; or the defaults."""
    # each starts as a clone of the scripted expert, with little noise, and is improved gently
    config = PPOConfig(demonstrations=100_000, critic_batches=10)
    hparams = PPOHParams(
        learning_rate=1e-4,
        target_kl=0.01,
        cost_limit=0.1,
        initial_std=0.2,
        demonstration_noise=0.2,
    )
    if env == "driving":
        # What a clone lacks is situations, not steps: many maps, and of its demonstrations the one
        # of twelve that it was worst at. Slow and safe, it has hardly anything left to earn, so the
        # cost weighs five times the reward; left to itself it unlearns what it was shown, so it
        # stays guided.
        config = dataclasses.replace(
            config,
            total_steps=500_000,
            hidden=(288, 288, 288),
            demonstrations=14_400_000,
            demonstration_stride=12,
            demonstration_rounds=24,
            cloning_updates=72_000,
            guided=True,
        )
        hparams = hparams.replace(
            discount=0.99,
            cost_discount=0.98,
            cost_limit=0.2,
            initial_multiplier=5.0,
            lagrangian_lr=0.0,
            success_bonus=20.0,
            initial_std=0.08,
            final_std=0.05,
            demonstration_noise=0.1,
            guidance_weight=0.5,
        )
        return config, hparams, 8000
    config = dataclasses.replace(config, scaling="world")
    # where hovering over the last marker or the peg pays for ever, solving the task must pay more
    if env == "table_wiping":
        config = dataclasses.replace(config, total_steps=10_000_000)
        return config, hparams.replace(success_bonus=50.0), 0
    if env == "nut_assembly":
        config = dataclasses.replace(config, total_steps=1_000_000)
        return config, hparams.replace(success_bonus=100.0), 0
    return PPOConfig(), PPOHParams(), 0


def check(settings: ExpertSettings) -> None:
    """Refuse what cannot work, before anything is built.

    Raises:
        UserError: One line naming field, value and what is allowed.
    """
    if not known(settings.env):
        raise UserError(unknown(settings.env))
    for name, least in (("seed", 0), ("training_scenarios", 0), ("evaluate_every", 1)):
        value = getattr(settings, name)
        if value < least:
            raise UserError(f"{name} must be at least {least}, got {value}")
    if settings.training_scenarios and settings.scenarios is not None:
        raise UserError("training_scenarios is for generated scenarios: give it, or --scenarios")
    try:
        validate(settings.config, settings.hparams)
    except ValueError as error:
        raise UserError(str(error)) from error


def make_env_and_expert(settings: ExpertSettings) -> Env:
    """The world that an expert trains in.

    Raises:
        UserError: If a scenario folder cannot be used.
    """
    names = ("scenarios", "held_out_scenarios")
    options = {name: v for name in names if (v := getattr(settings, name)) is not None}
    if settings.training_scenarios:
        options["training"] = range(FIRST_SCENARIO, FIRST_SCENARIO + settings.training_scenarios)
    return make_world(settings.env, options)


def train_expert(settings: ExpertSettings, out: Path, resume: bool = False) -> dict[str, Any]:
    """Train, evaluating and saving on the way; returns the summary.

    Args:
        settings: Of the run.
        out: Run folder.
        resume: Go on from the folder's last checkpoint.

    Raises:
        UserError: If settings or folder cannot be used.
    """
    check(settings)
    began = time.perf_counter()
    config, folder = settings.config, RunFolder(out)
    env = make_env_and_expert(settings)
    try:
        teacher = env.experts.get(env.card.expert.teacher)
        functions = make_ppo_lagrangian(env, config, expert=teacher)
    except ValueError as error:
        raise UserError(str(error)) from error
    open_folder(folder, settings.as_json(), resume)
    learner = jax.jit(functions.init)(jax.random.key(settings.seed), settings.hparams)
    done = 0
    if resume:
        done, learner = restore_learner(folder, learner)
        folder.rewind(done, done)
        if done >= config.batches * config.batch_steps:
            print(f"{out} is complete already ({done} steps)", file=sys.stderr)
            return folder.read_json(SUMMARY)
    run = _Run(settings, folder, env, functions)
    first = done // config.batch_steps
    with Progress(config.batches * config.batch_steps, f"expert {settings.env}", done) as progress:
        learner = run.start(learner, first)
        progress.start()
        for batch in range(first + 1, config.batches + 1):
            learner, note = run.batch(learner, batch)
            if note is not None:
                progress.update(batch * config.batch_steps, note)
    return run.finish(learner, time.perf_counter() - began)


class _Run:
    """The compiled batch of a run and what happens around it."""

    def __init__(
        self, settings: ExpertSettings, folder: RunFolder, env: Env, functions: PPOFunctions
    ):
        self.settings, self.folder, self.env, self.functions = settings, folder, env, functions
        self.compile_s = self.train_s = 0.0
        self.trained = 0

    def start(self, learner: PPOLearner, first: int) -> PPOLearner:
        """Compile, and at the start of a run clone what it has demonstrated."""
        began = time.perf_counter()
        jitted = jax.jit(lambda learner: self.functions.run(learner, 1), donate_argnums=0)
        self.program = jitted.lower(learner).compile()
        self.compile_s = time.perf_counter() - began
        if first or not self.settings.config.demonstrations:
            return learner
        learner, metrics = jax.jit(self.functions.clone)(learner)
        row = {name: float(value) for name, value in metrics.items()}
        scores = self._evaluate(learner, 0)
        self.folder.append_metrics({"step": 0, "done": 0} | row | scores)
        checkpoint.save(self.folder.checkpoints, 0, learner)
        shown, success = row["clone/success_rate"], scores["eval/success_rate"]
        print(f"clone: success {success:.2f} (demonstrated: {shown:.2f})", file=sys.stderr)
        return learner

    def batch(self, learner: PPOLearner, batch: int) -> tuple[PPOLearner, str | None]:
        """One batch; every so many also evaluate and save, and say how it is going."""
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
        about = {"env": self.settings.env, "algorithm": "ppo_lagrangian"}
        about |= {"seed": self.settings.seed, "step": step}
        save_policy(self.folder.path / POLICY, self._policy(learner), about)
        checkpoint.save(self.folder.checkpoints, step, learner)

    def finish(self, learner: PPOLearner, wall_s: float) -> dict[str, Any]:
        """Write and return the summary."""
        settings, steps = (
            self.settings,
            self.settings.config.batches * self.settings.config.batch_steps,
        )
        rows = read_evaluation(self.folder.path)
        summary = {
            "env": settings.env,
            "algorithm": "ppo_lagrangian",
            "seed": settings.seed,
            "total_steps": steps,
            **summarise_episodes([row for row in rows if row.step == steps]),
            "multiplier": float(learner.learned.multiplier.value),
            "diverged": bool(learner.diverged),
            "wall_s": round(wall_s, 1),
            "compile_s": round(self.compile_s, 1),
            "steps_per_s": round(self.trained / max(self.train_s, 1e-9), 1),
        }
        self.folder.write_json(SUMMARY, summary)
        return summary


def evaluate_expert(env: Env, kind: str) -> list[EvaluationRow]:
    """Play every held-out scenario once with an expert.

    Args:
        env: The world.
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
