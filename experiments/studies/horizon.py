"""`ppl horizon`: what a longer preference horizon buys and costs, along runs of PPL."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax

from experiments.engine.programs import Programs
from experiments.engine.progress import Progress
from experiments.engine.run import algorithm_factory, make_env_and_expert
from experiments.engine.runtime import UserError
from experiments.engine.settings import check
from experiments.report.tables import write_rows
from ppl_jax import experts
from ppl_jax.experts import SavedPolicy
from ppl_jax.horizon import errors, make_profile
from ppl_jax.interaction import Learner
from ppl_jax.training import make_train

if TYPE_CHECKING:
    from experiments.options.commands import Horizon

MEASUREMENTS = 5  # over a run, unless asked for otherwise


def measure_horizon(command: Horizon) -> None:
    """Train, stop now and then to measure, and write a row per stop and predicted step.

    Raises:
        UserError: If a setting cannot work.
    """
    from experiments.engine.settings import run_settings

    asked = {name: getattr(command, name) for name in ("total_steps", "batch_size", "physics")}
    given = {name: value for name, value in asked.items() if value is not None}
    settings = run_settings(command.env, expert=command.expert, given=given)
    config = settings.config
    interval = config.decision_interval
    every = command.measure_every
    if every is None:
        every = max(config.total_steps // MEASUREMENTS // interval, 1) * interval
    if every < 1 or every % interval or every > config.total_steps:
        raise UserError(
            f"measure_every must be a multiple of decision_interval ({interval}) up to "
            f"total_steps ({config.total_steps}), got {every}"
        )
    check(settings)
    env, expert = make_env_and_expert(settings)
    functions = make_train(env, expert, algorithm_factory(settings, env), config)
    try:
        profile = make_profile(env, expert, config)
    except ValueError as error:
        raise UserError(str(error)) from error
    programs = Programs(env, functions, interval)

    @jax.jit
    def look(key: jax.Array, learner: Learner) -> Any:
        layers = functions.algorithm.policy(learner.algorithm)
        mean, scale = env.spec.observation_mean, env.spec.observation_scale
        policy = SavedPolicy(
            weights=layers, activation="relu", output="tanh", obs_mean=mean, obs_scale=scale
        )
        return profile(key, lambda observation: experts.act(policy, observation), learner.hparams)

    rows, stops = [], config.total_steps // every
    with Progress(len(command.seeds) * stops, f"measure {command.env}") as progress:
        progress.start()
        for number, seed in enumerate(command.seeds):
            learner = programs.init(jax.random.key(seed), settings.hparams)
            for stop in range(1, stops + 1):
                learner, _ = programs.chunk(learner, every, "interact")
                found = look(jax.random.fold_in(jax.random.key(seed), stop), learner)
                rows += _rows(command.env, seed, stop * every, found)
                write_rows(command.out, rows)
                note = f"seed {seed} step {stop * every}: {rows[-1]['interventions']} takeovers"
                progress.update(number * stops + stop, note)


def _rows(env: str, seed: int, step: int, found: Any) -> list[dict[str, Any]]:
    gap, error = errors(found.drift, found.reach, found.apart)
    columns = {
        "wrong": found.wrong,
        "drift": found.drift,
        "reach": found.reach,
        "coverage": found.coverage,
        "gap": gap,
        "error": error,
    }
    where = {"env": env, "seed": seed, "step": step, "interventions": int(found.interventions)}
    return [
        where | {"predicted_step": i + 1} | {k: f"{float(v[i]):.5g}" for k, v in columns.items()}
        for i in range(found.wrong.shape[0])
    ]
