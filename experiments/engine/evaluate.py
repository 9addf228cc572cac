"""Evaluation of a policy: every held-out scenario once, and the numbers that sum it up."""

from __future__ import annotations

import functools
import math
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs import pretrained
from envs.registry import make
from experiments.engine.config_file import config_path, read_config
from experiments.engine.csv_file import numbers, read_table
from experiments.engine.fields import read_fields
from experiments.engine.policy_file import load_meta, load_policy
from experiments.engine.run_folder import EVALUATION, POLICY
from experiments.engine.runtime import UserError
from experiments.engine.settings import read_run_settings
from ppl_jax import experts
from ppl_jax.config import HParams, as_arrays, env_params
from ppl_jax.evaluation import Episodes, make_evaluate
from ppl_jax.experts import SavedPolicy, neural_expert
from ppl_jax.types import Env, EnvSpec, Expert


class EvaluationRow(NamedTuple):
    """One row of evaluation.csv."""

    step: int
    scenario: int
    success: int
    episodic_return: float
    progress: float
    episodic_cost: float
    length: int


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def episodes(
    env: Env, activation: str, output: str, arrays: Any, params: Any, key: jax.Array
) -> Episodes:
    """Every scenario of a pool once.

    Args:
        env: The environment.
        activation, output: Of the policy's network.
        arrays: Its weights, and mean and scale of its observations.
        params: The pool.
        key: For random worlds.
    """
    weights, mean, scale = arrays
    policy = SavedPolicy(
        weights=weights, activation=activation, output=output, obs_mean=mean, obs_scale=scale
    )

    def act(key: jax.Array, state: Any, observation: jax.Array, params: Any) -> jax.Array:
        return experts.act(policy, observation)

    return make_evaluate(env, act)(params, key)


def arrays_of(policy: SavedPolicy) -> SavedPolicy:
    """A policy's numbers as float32 arrays of JAX."""
    weights, mean, scale = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32),
        (list(policy.weights), policy.obs_mean, policy.obs_scale),
    )
    return policy._replace(weights=weights, obs_mean=mean, obs_scale=scale)


def evaluate_policy(
    env: Env,
    policy: SavedPolicy,
    step: int,
    on: str = "held_out",
    *,
    hparams: HParams | None = None,
) -> list[EvaluationRow]:
    """Play every scenario of a pool once, without the expert.

    Args:
        env: The environment.
        policy: The policy.
        step: For the rows.
        on: "held_out" or "training".
        hparams: Settings of the run whose worlds, if they are randomised, are played in.
    """
    policy = arrays_of(policy)
    arrays = (policy.weights, policy.obs_mean, policy.obs_scale)
    params = env.held_out_params if on == "held_out" else env.default_params
    if hparams is not None:
        params = env_params(env, params, as_arrays(hparams))
    played = episodes(env, policy.activation, policy.output, arrays, params, jax.random.key(0))
    return rows_of(played, env.scenario_numbers(params), step)


def rows_of(episodes: Episodes, numbers: Any, step: int) -> list[EvaluationRow]:
    """Episodes as rows."""
    played = jax.device_get(episodes)
    return [
        EvaluationRow(
            step=step,
            scenario=int(numbers[i]),
            success=int(played.success[i]),
            episodic_return=round(float(played.episodic_return[i]), 4),
            progress=round(float(played.progress[i]), 5),
            episodic_cost=round(float(played.episodic_cost[i]), 4),
            length=int(played.length[i]),
        )
        for i in range(len(played.success))
    ]


def summarise_episodes(rows: list[EvaluationRow]) -> dict[str, float]:
    """Means over episodes, under the names of summary.json."""
    return {
        "success_rate": float(np.mean([row.success for row in rows])),
        "episodic_return": float(np.mean([row.episodic_return for row in rows])),
        "route_completion": float(np.mean([row.progress for row in rows])),
        "episodic_cost": float(np.mean([row.episodic_cost for row in rows])),
        "episode_length": float(np.mean([row.length for row in rows])),
        "episodes": len(rows),
    }


def read_evaluation(run: Path) -> list[EvaluationRow]:
    """Rows of a run folder's evaluation.csv; one that is there twice counts once.

    Raises:
        UserError: If there is none, or one line naming row and column of what cannot be right.
    """
    path = run / EVALUATION
    table = read_table(path)
    columns = {}
    for name, kind in typing.get_type_hints(EvaluationRow).items():
        if name not in table.columns:
            raise UserError(f"{str(path)!r} has no column {name!r}")
        whole = kind is int
        high = 1 if name == "success" else math.inf
        low = 0 if whole else -math.inf
        found = numbers(
            table.column(name), table.lines, name, path, low=low, high=high, whole=whole
        )
        columns[name] = [int(value) for value in found] if whole else found
    rows = {}
    for line, values in zip(table.lines, zip(*columns.values(), strict=True), strict=True):
        row = EvaluationRow(**dict(zip(columns, values, strict=True)))
        before, first = rows.setdefault((row.step, row.scenario), (line, row))
        if first != row:
            raise UserError(
                f"{str(path)!r}, rows {before} and {line}: step {row.step}, scenario "
                f"{row.scenario} is there twice, with different results"
            )
    return [row for _, row in rows.values()]


def policy_path(run: Path) -> Path:
    """The policy file of a run folder, or the file itself.

    Raises:
        UserError: If there is none.
    """
    if run.is_file():
        return run
    path = run / POLICY
    if not path.is_file():
        raise UserError(f"{str(run)!r} is neither a run folder with a policy nor a policy file")
    return path


def run_options(run: Path) -> tuple[str, dict[str, Any]]:
    """The environment of a run folder (or of a policy file's meta) and how it was built."""
    if run.is_file():
        try:
            meta = load_meta(run)
        except ValueError as error:
            raise UserError(str(error)) from error
        if not isinstance(meta, dict) or not isinstance(meta.get("env"), str):
            raise UserError(f"policy file {str(run)!r} cannot be read: its meta names no env")
        return meta["env"], {}
    config = read_config(run)
    read_fields(config, {}, config_path(run), needed=("env",))
    names = ("scenarios", "held_out_scenarios")
    options = {name: value for name in names if (value := config.get(name)) is not None}
    return config["env"], {"physics": run_physics(config), **options}


def run_hparams(run: Path) -> HParams | None:
    """The traced settings of a run folder whose worlds are randomised; None of any other.

    Raises:
        UserError: If the folder's config.json cannot be read.
    """
    if run.is_file():
        return None
    randomised = read_config(run).get("settings", {}).get("randomise", False)
    return read_run_settings(run).hparams if randomised else None


def run_physics(config: Mapping[str, Any]) -> str:
    """The physics that a config.json of any kind of run names; "auto" where it is older."""
    return {**config, **config.get("settings", {})}.get("physics", "auto")


def run_spec(run: Path) -> EnvSpec:
    """Sizes of a run's environment."""
    env, _ = run_options(run)
    return make_env(env, {}).spec


def make_env(name: str, options: dict[str, Any]) -> Env:
    """Build an environment; a mistake, or a physics that is not installed, is a `UserError`."""
    try:
        return make(name, **options)
    except ValueError as error:
        raise UserError(str(error)) from error
    except ImportError as error:
        if options.get("physics", "auto") == "auto":
            raise
        raise UserError(f"physics {options['physics']!r} cannot be used here: {error}") from error


def physics_of(env: Env) -> dict[str, str]:
    """For a summary: the physics that runs the environment, where it has a choice."""
    name = getattr(env, "physics", None)
    return {} if name is None else {"physics": name}


def named_expert(name: str, env: Env) -> Expert:
    """The expert "scripted", the shipped one, "neural", or that of a policy file or run folder.

    Raises:
        UserError: If there is none, or the file cannot be used.
    """
    if name == "scripted":
        expert = env.experts.get("scripted")
        if expert is None:
            raise UserError(f"expert: {env.name} has no scripted expert, give a policy file")
        return expert
    return neural_expert(named_policy(name, env))


def named_policy(name: str, env: Env) -> SavedPolicy:
    """The shipped expert's policy, "neural", or that of a policy file or run folder.

    Raises:
        UserError: If there is none, or the file cannot be used.
    """
    if name != "neural":
        path = Path(name)
        return read_policy(policy_path(path) if path.is_dir() else path, env.spec)
    try:
        return read_policy(pretrained.policy_path(env.name), env.spec)
    except ValueError as error:
        raise UserError(str(error)) from error


def read_policy(path: str | Path, spec: EnvSpec) -> SavedPolicy:
    """Load a policy file for an environment; a mistake becomes a `UserError`."""
    try:
        return load_policy(path, spec.observation_size, spec.action_size)
    except ValueError as error:
        raise UserError(str(error)) from error


def evaluate_run(
    run: Path, scenarios: str | None, physics: str | None = None
) -> list[EvaluationRow]:
    """Play a run's held-out scenarios once.

    Args:
        run: Run folder or policy file.
        scenarios: Folder of recordings to play instead.
        physics: To play in; the run's own where None.

    Raises:
        UserError: If run, policy, folder or physics cannot be used.
    """
    source = policy_path(run)
    name, options = run_options(run)
    if scenarios is not None:
        options = {k: v for k, v in options.items() if k == "physics"}
        options["held_out_scenarios"] = scenarios
    if physics is not None:
        options["physics"] = physics
    env = make_env(name, options)
    policy = read_policy(source, env.spec)
    return evaluate_policy(env, policy, 0, hparams=run_hparams(run))
