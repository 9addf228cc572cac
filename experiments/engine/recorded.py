"""Learning from a recorded session instead of an expert: its steps are used as if made now."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp

from experiments.engine import recording
from experiments.engine.runtime import UserError
from ppl_jax.algorithms import MakeAlgorithm
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.interaction import Learner, summarise
from ppl_jax.live import make_live
from ppl_jax.losses import Metrics
from ppl_jax.training import Phase, TrainFunctions, phases
from ppl_jax.types import Env

WORD = "recorded "


def recording_of(expert: str) -> Path | None:
    """The path in "recorded PATH", or None for any other expert."""
    return Path(expert.removeprefix(WORD)) if expert.startswith(WORD) else None


def length_of(path: Path, env: str) -> int:
    """Number of steps of a recording.

    Args:
        path: A run folder or an exported session.
        env: Name of the environment that it has to be of.

    Raises:
        UserError: If it cannot be read, or is of another environment.
    """
    columns, config = recording.load(path)
    if config.get("env") != env:
        raise UserError(f"recording {str(path)!r} is of {config.get('env')}, not of {env}")
    return len(columns[recording.EPISODE])


def recorded_functions(
    env: Env, make_algorithm: MakeAlgorithm, config: TrainConfig, path: Path
) -> TrainFunctions:
    """The training functions of `make_train`, with a recording for environment and expert.

    `train` gives the metrics of its last phase as a whole, [1].

    The first `config.demonstrations` steps are stored, then there are `config.offline_updates`,
    then an update follows every step, as in the session itself.

    Raises:
        UserError: If the recording cannot be used, or is too short.
        ValueError: If the method plays by itself.
    """
    columns, _ = recording.load(path)
    have = len(columns[recording.EPISODE])
    if config.total_steps > have:
        raise UserError(
            f"total_steps must not exceed the recording's {have}, got {config.total_steps}"
        )
    live = make_live(env, make_algorithm, config)
    rows = recording.interactions(columns, env, live.algorithm.predicted_steps)
    rows = jax.tree.map(jnp.asarray, rows)
    algorithm = live.algorithm
    if algorithm.update_every > 1:
        raise ValueError(f"algorithm {algorithm.name} plays by itself: a recording cannot teach it")
    interval = config.decision_interval

    def run_chunk(
        learner: Learner, blocks: int | jax.Array, phase: Phase = "interact"
    ) -> tuple[Learner, Metrics]:
        length, counters = blocks * interval, learner.counters
        if phase == "fit":
            learner, metrics = live.fit(learner, length)
            return learner, summarise(metrics, counters, learner.counters)
        learning = phase == "interact"
        return live.ingest(learner, rows, learning, first=counters.steps, count=length)

    def train(key: jax.Array, hparams: HParams) -> tuple[Learner, Metrics]:
        learner, metrics = live.init(key, hparams), {}
        for phase, length in phases(config):
            learner, metrics = run_chunk(learner, length // interval, phase)
        return learner, jax.tree.map(lambda leaf: leaf[None], metrics)

    return TrainFunctions(init=live.init, run_chunk=run_chunk, train=train, algorithm=algorithm)
