"""`ppl bench --parts physics`: control steps per CPU-second by environment, engine and batch.

CPU-seconds of the process, not seconds of the clock, so that a second core or a busy machine
changes little. On an accelerator only the clock's figures mean anything.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.registry import make, registered
from experiments.report.points import write_rows
from experiments.report.tables import print_table
from ppl_jax.cards import card
from ppl_jax.predictors import predict

BATCHES = (1, 16, 64, 256)
STEPS, CONTACT_STEPS, HORIZON = 10, 60, 10
COLUMNS = (
    "env",
    "physics",
    "batch",
    "steps_per_cpu_s",
    "steps_per_s",
    "lookahead_cpu_ms",
    "compile_cpu_s",
)


def arms() -> tuple[str, ...]:
    """Names of the environments with a choice of physics, or drawn by MuJoCo."""
    return tuple(name for name in registered() if card(name).physics)


def bench_physics(
    names: Sequence[str],
    *,
    repeats: int,
    batches: Sequence[int] = BATCHES,
    out: Path | None = None,
) -> list[dict[str, Any]]:
    """Measure, print and save.

    Args:
        names: Environments.
        repeats: Timed calls of each program; the fastest counts.
        batches: Numbers of worlds side by side, of `vmap` but for 1; the first alone for C MuJoCo.
        out: CSV file, written row by row, or None.
    """
    rows: list[dict[str, Any]] = []
    for name in names:
        state = _in_contact(name)
        for physics in card(name).physics:
            env = make(name, physics=physics)
            # C MuJoCo is called one world after another: a batch is the same figure, and minutes
            for batch in batches[:1] if physics == "mujoco_c" else batches:
                rows.append(
                    {"env": name, "physics": physics, "batch": batch}
                    | _figures(env, state, batch, repeats)
                )
                if out is not None:
                    write_rows(out, rows)
    text = [[f"{row[c]:,.4g}" if c != "batch" and not isinstance(row[c], str) else str(row[c])
             for c in COLUMNS] for row in rows]  # fmt: skip
    print_table(list(COLUMNS), text)
    return rows


def _in_contact(name: str) -> tuple[Any, jax.Array]:
    """A state of the environment's first start with the tool in contact, and the expert's action.

    The expert plays on the environment's default physics: every engine starts from the same state.
    """
    env = make(name)
    params, key = env.default_params, jax.random.key(0)

    def step(state: Any, _: None) -> Any:
        action = env.experts["scripted"](key, state, env.observe(state, params), params)
        return env.transition(key, state, action, params)[0], action

    play = jax.jit(lambda state: jax.lax.scan(step, state, None, length=CONTACT_STEPS))
    state, actions = play(env.reset_to(jnp.int32(0), key, params))
    return state, actions[-1]


def _figures(env: Any, start: tuple[Any, jax.Array], batch: int, repeats: int) -> dict[str, float]:
    state, action = start
    params, key = env.default_params, jax.random.key(0)

    def play(state: Any) -> Any:
        def step(state: Any, _: None) -> Any:
            return env.transition(key, state, action, params)[0], None

        return jax.lax.scan(step, state, None, length=STEPS)[0]

    def ahead(state: Any) -> jax.Array:
        return predict(
            env, env.transition, key, state, action=action, params=params, horizon=HORIZON
        ).reward

    many = state if batch == 1 else jax.tree.map(lambda x: jnp.stack([x] * batch), state)
    program, compile_s = compiled(play if batch == 1 else jax.vmap(play), many)
    cpu, wall = fastest(lambda: program(many), repeats)
    ahead_program, _ = compiled(ahead if batch == 1 else jax.vmap(ahead), many)
    ahead_cpu, _ = fastest(lambda: ahead_program(many), repeats)
    return {
        "steps_per_cpu_s": round(batch * STEPS / cpu, 1),
        "steps_per_s": round(batch * STEPS / wall, 1),
        "lookahead_cpu_ms": round(1e3 * ahead_cpu / batch, 3),
        "compile_cpu_s": round(compile_s, 1),
    }


def compiled(function: Callable[..., Any], *given: Any) -> tuple[Any, float]:
    """The program, and the CPU-seconds that compiling took, with the cache off."""
    cached = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        began = time.process_time()
        program = jax.jit(function).lower(*given).compile()
        return program, time.process_time() - began
    finally:
        jax.config.update("jax_enable_compilation_cache", cached)


def fastest(run: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Least CPU-seconds and least seconds of a call."""
    jax.block_until_ready(run())
    cpu, wall = [], []
    for _ in range(repeats):
        began, clock = time.process_time(), time.perf_counter()
        jax.block_until_ready(run())
        cpu.append(time.process_time() - began)
        wall.append(time.perf_counter() - clock)
    return float(np.min(cpu)), float(np.min(wall))
