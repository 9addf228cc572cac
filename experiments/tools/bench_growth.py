"""`ppl bench --parts growth`: how the cost of training grows with each size of a run.

CPU-seconds of the process, PPL in driving, with the expert always in control: every block looks
ahead from the gate and every step from its pairs, the most that a run of these settings can cost.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from envs.driving.make import make_driving
from experiments.report.points import write_rows
from experiments.report.tables import print_table
from experiments.tools.bench_physics import compiled, fastest
from ppl_jax import algorithms
from ppl_jax.algorithms.ppl import make_ppl
from ppl_jax.config import HParams, TrainConfig, as_arrays, replace
from ppl_jax.training import make_train

STEPS = 200  # of a timed call, where steps are not what grows
SIZES: dict[str, tuple[int, ...]] = {
    "steps": (100, 200, 400, 800, 1600),
    "preference_horizon": (1, 2, 4, 7, 10),
    "prediction_horizon": (10, 20, 40),
    "human_capacity": (10_000, 40_000, 160_000),
    "lanes": (1, 2, 4),
    "batch_size": (64, 128, 256, 512),
}
"""Values of each axis; `human_capacity` is given to the buffer of pairs as well."""
WITHOUT_UPDATES = ("preference_horizon", "prediction_horizon")
"""Axes that do not touch the update, which would drown them."""


def no_update(state: Any, key: jax.Array, hparams: Any) -> Any:
    """In place of an algorithm's `update`: learns nothing."""
    return state, {"none": jnp.zeros(())}


def bench_growth(
    *,
    repeats: int,
    out: Path | None = None,
    sizes: dict[str, tuple[int, ...]] = SIZES,
    env: Any = None,
) -> list[dict[str, Any]]:
    """Measure, print and save.

    Args:
        repeats: Timed calls of each program; the fastest counts.
        out: CSV file, written row by row, or None.
        sizes: Values of each axis.
        env: The environment; None: driving.

    Returns:
        A row per axis and value: CPU-milliseconds of the whole call and of one of its steps (for
        lanes, a step of all of them).
    """
    env = make_driving() if env is None else env
    rows: list[dict[str, Any]] = []
    for axis, values in sizes.items():
        run = _programs(env, axis, values)
        for value in values:
            steps = value if axis == "steps" else STEPS
            cpu, _ = fastest(run(value), repeats)
            rows.append(
                {
                    "axis": axis,
                    "value": value,
                    "updates": axis not in WITHOUT_UPDATES,
                    "cpu_ms": round(1e3 * cpu, 2),
                    "cpu_ms_per_step": round(1e3 * cpu / steps, 4),
                }
            )
            if out is not None:
                write_rows(out, rows)
    print_table(list(rows[0]), [[str(cell) for cell in row.values()] for row in rows])
    return rows


def _programs(env: Any, axis: str, values: tuple[int, ...]) -> Callable[[int], Callable[[], Any]]:
    """`call(value)`: what to time; values that are traced share a program."""
    config, hparams = algorithms.settings("ppl", env.name)
    config = dataclasses.replace(config, total_steps=max(10_000, *values))
    longest = max(config.prediction_horizon, *(values if "horizon" in axis else (0,)))
    most = min(10, longest)
    config, hparams = replace(config, hparams, max_preference_horizon=most, min_speed=1e9)
    shared: dict[Any, Callable[..., Any]] = {}

    def call(value: int) -> Callable[[], Any]:
        static, traced, lanes, blocks = config, hparams, 1, STEPS // config.decision_interval
        if axis == "steps":
            blocks = value // config.decision_interval
        elif axis == "lanes":
            lanes = value
        elif axis == "human_capacity":
            rows = {"human_capacity": value, "preference_capacity": value, "total_steps": value}
            static, traced = replace(config, hparams, **rows)
        else:
            static, traced = replace(config, hparams, **{axis: value})
        learner = _learner(env, axis, static, traced, lanes, shared)
        program = shared[static, lanes]
        return lambda: program(learner, jnp.int32(blocks))

    return call


def _learner(
    env: Any, axis: str, config: TrainConfig, hparams: HParams, lanes: int, shared: dict[Any, Any]
) -> Any:
    """A learner with data, after `STEPS` steps; its program is put into `shared`."""

    def make(spec: Any, config: TrainConfig) -> Any:
        method = make_ppl(spec, config)
        return method._replace(update=no_update) if axis in WITHOUT_UPDATES else method

    functions = make_train(env, env.experts["scripted"], make, config)

    def chunk(learner: Any, blocks: jax.Array) -> Any:
        return functions.run_chunk(learner, blocks)[0]

    keys = jax.random.split(jax.random.key(0), lanes)
    if lanes == 1:
        learner = jax.jit(functions.init)(keys[0], as_arrays(hparams))
    else:
        chunk = jax.vmap(chunk, in_axes=(0, None))
        learner = jax.jit(jax.vmap(functions.init, in_axes=(0, None)))(keys, as_arrays(hparams))
    blocks = jnp.int32(STEPS // config.decision_interval)
    if (config, lanes) not in shared:
        shared[config, lanes], _ = compiled(chunk, learner, blocks)
    return shared[config, lanes](learner, blocks)
