"""Learning from a recorded session or demonstrations: their steps are used as if made now."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine import recording
from experiments.engine.runtime import UserError
from ppl_jax.algorithms import Algorithm, MakeAlgorithm, method, registered, settings
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.interaction import Learner, summarise
from ppl_jax.live import make_live
from ppl_jax.losses import Metrics
from ppl_jax.training import Phase, TrainFunctions, make_train, phases
from ppl_jax.types import Env, EnvSpec, Expert

WORD = "recorded "
COMPARED = 64  # rows of which recorded states are compared with recorded observations
CLOSE = 1e-3  # relative difference of the two that counts as rounding


def recording_of(expert: str) -> Path | None:
    """The path in "recorded PATH", or None for any other expert."""
    return Path(expert.removeprefix(WORD)) if expert.startswith(WORD) else None


def length_of(path: Path, env: str) -> int:
    """Number of steps of a recording.

    Args:
        path: A run folder, an exported session or demonstrations.
        env: Name of the environment that it has to be of, where it names one.

    Raises:
        UserError: If it cannot be read, or is of another environment.
    """
    columns, config = recording.load(path)
    if config.get("env", env) != env:
        raise UserError(f"recording {str(path)!r} is of {config['env']}, not of {env}")
    return len(columns[recording.EPISODE])


def default_lengths(
    path: Path, env: str, algorithm: str, config: TrainConfig, given: Mapping[str, Any]
) -> dict[str, int]:
    """How long a run on a recording is, where nobody says.

    It has all of the recording's steps, in whole decisions. Those of a method that learns from
    demonstrations alone are all demonstrations. One that plays by itself takes its demonstrations
    from the recording and has its own number of further steps.

    Args:
        path, env: As in `length_of`.
        algorithm: Name of the method.
        config: Its default settings in the environment.
        given: What somebody asked for, by flat names.

    Raises:
        UserError: If the recording cannot be read, or is shorter than a decision.
    """
    have, interval = length_of(path, env), int(given.get("decision_interval", 0))
    interval = interval if interval > 0 else config.decision_interval
    whole = have // interval * interval
    if not whole:
        raise UserError(
            f"recording {str(path)!r} must have at least decision_interval ({interval}) steps, got "
            f"{have}"
        )
    if plays_by_itself(algorithm, config):
        shown = min(config.demonstrations, whole, int(given.get("total_steps", whole)))
        shown = int(given.get("demonstrations", shown))
        rest = config.total_steps - config.demonstrations
        return {"demonstrations": shown, "total_steps": shown + rest}
    total = int(given.get("total_steps", whole))
    if config.demonstrations < config.total_steps:
        return {"total_steps": total}
    rows = max(config.human_capacity, total)
    return {"total_steps": total, "demonstrations": total, "human_capacity": rows}


def plays_by_itself(algorithm: str, config: TrainConfig) -> bool:
    """Whether a method learns in rounds of steps that it makes alone, such as gail."""
    one = np.ones(1, np.float32)
    spec = EnvSpec(observation_size=1, action_size=1, observation_mean=one, observation_scale=one)
    return method(algorithm).make(spec, config).update_every > 1


def recorded_functions(
    env: Env, make_algorithm: MakeAlgorithm, config: TrainConfig, path: Path
) -> TrainFunctions:
    """The training functions of `make_train`, with a recording for environment and expert.

    `train` gives the metrics of its last phase as a whole, [1].

    The first `config.demonstrations` steps are stored, then there are `config.offline_updates`,
    then an update follows every step, as in the session itself. A method that plays by itself has
    its demonstrations from the recording, and the rest of its run in the environment.

    A recording without the novice's actions has those of the novice that learns; one without
    predicted states has those of the run's own predictor, from the recorded states.

    Raises:
        UserError: If the recording cannot be used, or is too short.
    """
    columns, _ = recording.load(path)
    have, where = len(columns[recording.EPISODE]), f"recording {str(path)!r}"
    recording.refuse_other_sizes(columns, env, where)
    live = make_live(env, make_algorithm, config)
    algorithm, interval = live.algorithm, config.decision_interval
    alone = None
    if algorithm.update_every > 1:
        alone = make_train(env, _nobody(env), make_algorithm, config)
    name = "total_steps" if alone is None else "demonstrations"
    if getattr(config, name) > have:
        raise UserError(
            f"{name} must not exceed the recording's {have}, got {getattr(config, name)}"
        )
    states, horizon = None, algorithm.predicted_steps
    if horizon > recording.predicted_steps(columns):
        states, horizon = _restored(columns, env, algorithm, config, where), 0
    rows = recording.interactions(columns, env, horizon, where)
    rows, states = jax.tree.map(jnp.asarray, (rows, states))
    missing = {"states": states, "ask_novice": "novice_action" not in columns}

    def run_chunk(
        learner: Learner, blocks: int | jax.Array, phase: Phase = "interact"
    ) -> tuple[Learner, Metrics]:
        length, counters = blocks * interval, learner.counters
        if phase == "fit":
            learner, metrics = live.fit(learner, length)
            return learner, summarise(metrics, counters, learner.counters)
        if phase == "interact" and alone is not None:
            return alone.run_chunk(learner, blocks)
        learning = phase == "interact"
        return live.ingest(learner, rows, learning, first=counters.steps, count=length, **missing)

    def train(key: jax.Array, hparams: HParams) -> tuple[Learner, Metrics]:
        learner, metrics = live.init(key, hparams), {}
        for phase, length in phases(config):
            learner, metrics = run_chunk(learner, length // interval, phase)
        return learner, jax.tree.map(lambda leaf: leaf[None], metrics)

    return TrainFunctions(init=live.init, run_chunk=run_chunk, train=train, algorithm=algorithm)


def _nobody(env: Env) -> Expert:
    """An expert for the place of one who never acts."""

    def stay(key: jax.Array, state: Any, observation: jax.Array, params: Any) -> jax.Array:
        return jnp.zeros(env.spec.action_size)

    return stay


def _restored(
    columns: recording.Columns, env: Env, algorithm: Algorithm, config: TrainConfig, where: str
) -> Any:
    """The recorded states, [T], from which a method's predictions can be made.

    Raises:
        UserError: One line of what the recording lacks and what can be done.
    """
    have = recording.predicted_steps(columns)
    like = jax.eval_shape(lambda key: env.reset(key, env.default_params)[1], jax.random.key(0))
    try:
        states = recording.states(columns, like)
    except UserError as error:
        shorter = f"--max-preference-horizon {have}, or " if have and _has_horizon(config) else ""
        raise UserError(
            f"{where}: {algorithm.name} needs {algorithm.predicted_steps} predicted states of each "
            f"step, there are {have or 'none'}, nor can they be predicted here ({error}): give "
            f"{shorter}a method that needs none ({', '.join(_without_predictions(env))})"
        ) from error
    if not config.randomise:
        _refuse_other_states(columns, states, env, where)
    return states


def _has_horizon(config: TrainConfig) -> bool:
    return hasattr(config.method, "max_preference_horizon")


def _without_predictions(env: Env) -> list[str]:
    """The methods that read no predicted states."""
    found = []
    for name in registered(variants=False):
        config, _ = settings(name, env.name)
        if not method(name).make(env.spec, config).predicted_steps:
            found.append(name)
    return found


def _refuse_other_states(columns: recording.Columns, states: Any, env: Env, where: str) -> None:
    """Check that recorded states look as recorded, in some of the rows.

    Raises:
        UserError: One line naming the first row and index that differs.
    """
    seen = columns["observation"]
    rows = np.unique(np.linspace(0, len(seen) - 1, COMPARED).astype(int))
    some = jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), states)
    look = jax.jit(lambda states: jax.lax.map(lambda s: env.observe(s, env.default_params), states))
    found, scale = np.asarray(look(some)), np.abs(env.spec.observation_scale)
    wrong = ~(np.abs(found - seen[rows]) <= CLOSE * np.maximum(scale, np.abs(found)))
    if wrong.any():
        row, index = np.argwhere(wrong)[0]
        raise UserError(
            f"{where}, row {rows[row]}: its state is observed as {found[row, index]:g} at index "
            f"{index}, recorded is {seen[rows[row], index]:g}: it is of other scenarios or "
            f"settings of {env.name}"
        )
