"""Evaluation of a policy: every held-out scenario once, and the numbers that sum it up."""

from __future__ import annotations

import csv
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax import experts
from ppl_jax.evaluation import Episodes, make_evaluate
from ppl_jax.experts import SavedPolicy
from ppl_jax.runlog import EVALUATION
from ppl_jax.types import Env


class EvaluationRow(NamedTuple):
    """One row of evaluation.csv."""

    step: int
    scenario: int
    success: int
    episodic_return: float
    progress: float
    episodic_cost: float
    length: int


@functools.partial(jax.jit, static_argnums=(0, 2, 3))
def _episodes(env: Env, arrays: Any, activation: str, output: str, params: Any, key: jax.Array):
    weights, mean, scale = arrays
    policy = SavedPolicy(weights, activation, output, mean, scale)

    def act(key: jax.Array, state: Any, observation: jax.Array, params: Any) -> jax.Array:
        return experts.act(policy, observation)

    return make_evaluate(env, act)(params, key)


def evaluate_policy(env: Env, policy: SavedPolicy, step: int) -> list[EvaluationRow]:
    """Play every held-out scenario of `env` once, without the expert."""
    arrays = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float32),
        (list(policy.weights), policy.obs_mean, policy.obs_scale),
    )
    params = env.held_out_params
    episodes = _episodes(
        env, arrays, policy.activation, policy.output, params, jax.random.key(0)
    )
    return rows_of(episodes, env.scenario_numbers(params), step)


def rows_of(episodes: Episodes, numbers: Any, step: int) -> list[EvaluationRow]:
    """Episodes as rows."""
    columns = [np.asarray(column) for column in episodes]
    return [
        EvaluationRow(
            step, int(numbers[i]), int(columns[0][i]), round(float(columns[1][i]), 4),
            round(float(columns[3][i]), 5), round(float(columns[2][i]), 4), int(columns[4][i]),
        )
        for i in range(len(columns[0]))
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
    """Rows of a run folder's evaluation.csv."""
    with open(run / EVALUATION, newline="") as file:
        return [
            EvaluationRow(
                int(row["step"]), int(row["scenario"]), int(row["success"]),
                float(row["episodic_return"]), float(row["progress"]),
                float(row["episodic_cost"]), int(row["length"]),
            )
            for row in csv.DictReader(file)
        ]
