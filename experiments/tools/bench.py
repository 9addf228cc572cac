"""`ppl bench`: speed, as ratios within one run; medians of several repeats."""

from __future__ import annotations

import dataclasses
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.driving.make import make_driving
from envs.registry import make
from experiments.engine.files import as_json, write_text_atomic
from experiments.engine.runtime import device, versions
from experiments.report.tables import print_table
from experiments.tools.bench_growth import bench_growth, no_update
from experiments.tools.bench_physics import arms, bench_physics
from ppl_jax import algorithms
from ppl_jax.algorithms.ppl import make_ppl
from ppl_jax.config import as_arrays
from ppl_jax.ppo.config import PPOConfig
from ppl_jax.ppo.loop import make_ppo_lagrangian
from ppl_jax.predictors import predict
from ppl_jax.training import make_train

STEPS = 200  # environment steps per timed call
SWEEP, SWEEP_STEPS = 64, 3000  # runs, and their length: a quarter of an hour in all
CONTACT_STEPS = 60  # after which an arm's tool is in contact


def _median_s(run: Callable[[], Any], repeats: int) -> float:
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def bench(repeats: int, parts: tuple[str, ...], out: Path | None) -> dict[str, Any]:
    """Measure and print; see the README for what the figures mean.

    Args:
        repeats: Repeats of each figure; medians are reported.
        parts: Some of "envs", "training", "experts", "methods", "seeds" (methods, and five seeds
            in one program), "sweep"; or "physics", "growth": tables of their own, see
            `bench_physics` and `bench_growth`.
        out: JSON file to write (beside it the tables, as NAME_physics.csv and NAME_growth.csv), or
            None.
    """

    def table(part: str) -> Path | None:
        return None if out is None else out.with_name(f"{out.stem}_{part}.csv")

    if "physics" in parts:
        bench_physics(arms(), repeats=repeats, out=table("physics"))
    if "growth" in parts:
        bench_growth(repeats=repeats, out=table("growth"))
    parts = tuple(part for part in parts if part not in ("physics", "growth"))
    if not parts:
        return {}
    began = time.perf_counter()
    env = make_driving()
    figures: dict[str, Any] = {"world_built_s": time.perf_counter() - began}
    if "envs" in parts:
        figures |= _environment(env, repeats) | _lookahead(env, repeats)
        for name in ("table_wiping", "nut_assembly"):
            figures |= arm_figures(name, repeats)
    if "training" in parts:
        figures |= _training(env, repeats)
        figures |= _gradient(env, repeats, figures["train_ms_per_step"])
    for name in ("driving", "table_wiping", "nut_assembly") if "experts" in parts else ():
        figures |= _expert(name, repeats)
    for name in algorithms.registered(variants=False):
        if "methods" in parts or "seeds" in parts:
            figures |= _method(env, name, repeats, "seeds" in parts)
    if "sweep" in parts:
        figures |= _sweep(repeats)
    unit = 1 if sys.platform == "darwin" else 1024
    figures["peak_memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
    print_table(["figure", "value"], [[k, f"{v:,.4g}"] for k, v in figures.items()])
    if out is not None:
        about = {"versions": versions(), "device": device()}
        write_text_atomic(out, as_json(figures | about, 2) + "\n")
    return figures


def _environment(env: Any, repeats: int) -> dict[str, float]:
    """Environment steps per second with the full observation and automatic reset."""
    params, figures = env.default_params, {}
    action = jnp.array([0.0, 0.4])
    for count in (1, 64, 1024):
        length = max(STEPS * 4 // count, 20)

        def run(states: Any, key: jax.Array, count: int = count, length: int = length) -> Any:
            def one(key: jax.Array, state: Any) -> Any:
                obs, state, reward, *_ = env.step(key, state, action, params)
                return state, jnp.sum(obs) + reward

            def step(carry: Any, key: jax.Array) -> Any:
                states, total = carry
                if count == 1:
                    states, seen = one(key, states)
                else:
                    states, seen = jax.vmap(one)(jax.random.split(key, count), states)
                return (states, total + jnp.sum(seen)), None

            return jax.lax.scan(step, (states, 0.0), jax.random.split(key, length))[0]

        key = jax.random.key(0)
        if count == 1:
            _, states = env.reset(key, params)
        else:
            _, states = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, count), params)
        program = jax.jit(run)
        seconds = _median_s(lambda p=program, s=states, k=key: p(s, k), repeats)
        figures[f"env_steps_per_s_{count}"] = count * length / seconds
    return figures


def _lookahead(env: Any, repeats: int) -> dict[str, float]:
    """Predicted steps per second of the gate's lookahead in one environment (no observations)."""
    params, horizon, calls = env.default_params, 10, 100
    _, state = env.reset(jax.random.key(0), params)

    @jax.jit
    def run(state: Any) -> jax.Array:
        def call(total: jax.Array, _: None) -> Any:
            action = jnp.stack([total * 1e-9, 0.5])
            ahead = predict(
                env,
                env.transition,
                jax.random.key(0),
                state,
                action=action,
                params=params,
                horizon=horizon,
            )
            return total + jnp.sum(ahead.reward), None

        return jax.lax.scan(call, jnp.zeros(()), None, length=calls)[0]

    return {"predicted_steps_per_s": horizon * calls / _median_s(lambda: run(state), repeats)}


def arm_figures(
    name: str, repeats: int, batches: tuple[int, ...] = (1, 16, 64, 256)
) -> dict[str, float]:
    """Control steps per second of an arm, its lookahead, and compile time.

    The expert is at the controls until the tool is in contact; its last action is held from there.
    """
    env = make(name)
    params, key, figures = env.default_params, jax.random.key(0), {}
    steps = 40

    def play(state: Any, action: jax.Array) -> Any:
        def step(state: Any, _: None) -> Any:
            return env.transition(key, state, action, params)[0], None

        return jax.lax.scan(step, state, None, length=steps)[0]

    def approach(state: Any) -> Any:
        def step(state: Any, _: None) -> Any:
            action = env.experts["scripted"](key, state, env.observe(state, params), params)
            return env.transition(key, state, action, params)[0], action

        return jax.lax.scan(step, state, None, length=CONTACT_STEPS)

    start = env.reset_to(jnp.int32(0), key, params)
    state, actions = jax.jit(approach)(start)
    for count in batches:
        many = jax.tree.map(lambda x, n=count: jnp.stack([x] * n), state)
        began = time.perf_counter()
        given = state if count == 1 else many
        program = jax.jit(play if count == 1 else jax.vmap(play, in_axes=(0, None)))
        compiled = program.lower(given, actions[-1]).compile()
        figures[f"{name}_compile_s_{count}"] = time.perf_counter() - began
        seconds = _median_s(lambda c=compiled, g=given: c(g, actions[-1]), repeats)
        figures[f"{name}_steps_per_s_{count}"] = count * steps / seconds
    ahead = jax.jit(
        lambda state: (
            predict(
                env, env.transition, key, state, action=actions[-1], params=params, horizon=10
            ).reward
        )
    )
    figures[f"{name}_lookahead_10_ms"] = 1e3 * _median_s(lambda: ahead(state), repeats)
    return figures


def _method(env: Any, name: str, repeats: int, together: bool) -> dict[str, float]:
    """A method's step: time, share of its updates, and five seeds in one program.

    GAIL's is a round of `rollout_steps` steps and its update. Five seeds are compared with five
    runs of 10,000 steps, once for the running alone and once with compiling from nothing.
    """
    config, hparams = algorithms.settings(name, "driving")
    # demonstrations in its buffers, and as many steps of its own
    config = dataclasses.replace(config, demonstrations=STEPS, total_steps=10_000 + STEPS)
    make, seeds = algorithms.method(name).make, 5

    def program(make: Any, lanes: int) -> tuple[float, float]:
        functions = make_train(env, env.experts["scripted"], make, config)
        steps = max(functions.algorithm.update_every, STEPS)
        blocks = steps // config.decision_interval
        phase = "fit" if name == "bc" else "interact"

        def start(key: jax.Array) -> Any:
            learner = functions.init(key, as_arrays(hparams))
            return functions.run_chunk(learner, STEPS // config.decision_interval, "demonstrate")[0]

        def chunk(learner: Any) -> Any:
            return functions.run_chunk(learner, blocks, phase)[0]

        keys = jax.random.split(jax.random.key(0), lanes)
        if lanes == 1:
            learner, chunk = jax.jit(start)(keys[0]), jax.jit(chunk, donate_argnums=0)
        else:
            learner = jax.jit(jax.vmap(start))(keys)
            chunk = jax.jit(jax.vmap(chunk), donate_argnums=0)
        began = time.perf_counter()
        compiled = chunk.lower(learner).compile()
        compile_s, times = time.perf_counter() - began, []
        for _ in range(repeats + 1):
            began = time.perf_counter()
            learner = jax.block_until_ready(compiled(learner))
            times.append((time.perf_counter() - began) / steps * 1e3)
        return float(np.median(times[1:])), compile_s

    cached = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        alone, compile_s = program(make, 1)
        idle, _ = program(lambda spec, config: make(spec, config)._replace(update=no_update), 1)
        batch, compile_batch_s = program(make, seeds) if together else (0.0, 0.0)
    finally:
        jax.config.update("jax_enable_compilation_cache", cached)
    figures = {
        f"{name}_ms_per_step": alone,
        f"{name}_share_update": 1.0 if name == "bc" else (alone - idle) / alone,
        f"{name}_compile_s": compile_s,
    }
    if together:
        run, whole = 10 * alone + compile_s, 10 * batch + compile_batch_s  # s, of 10,000 steps
        figures[f"{name}_five_seeds_over_five_runs"] = batch / (seeds * alone)
        figures[f"{name}_five_seeds_over_five_runs_with_compile"] = whole / (seeds * run)
    return figures


def _expert(name: str, repeats: int) -> dict[str, float]:
    """Environment steps per second of PPO-Lagrangian, updates included, and the updates' share.

    It is the trainer alone: no guidance by a teacher, no batch cut short. The share is what a batch
    with all its epochs takes longer than one with a single epoch, per epoch and times their number.
    """
    from experiments.engine.expert_settings import settings_for

    env = make(name)
    settings, hparams, _ = settings_for(name)
    config = PPOConfig(scaling=settings.scaling)
    hparams = dataclasses.replace(hparams, target_kl=1e9)
    seconds, compile_s = {}, 0.0
    for epochs in (1, config.epochs):
        functions = make_ppo_lagrangian(env, dataclasses.replace(config, epochs=epochs))
        learner = jax.jit(functions.init)(jax.random.key(0), hparams)
        began = time.perf_counter()
        program = jax.jit(lambda learner, run=functions.run: run(learner, 1)[0], donate_argnums=0)
        compiled = program.lower(learner).compile()
        compile_s, times = time.perf_counter() - began, []
        for _ in range(repeats + 1):
            began = time.perf_counter()
            learner = jax.block_until_ready(compiled(learner))
            times.append(time.perf_counter() - began)
        seconds[epochs] = float(np.median(times[1:]))
    whole = seconds[config.epochs]
    updates = (whole - seconds[1]) / (config.epochs - 1) * config.epochs
    return {
        f"expert_{name}_steps_per_s": config.batch_steps / whole,
        f"expert_{name}_hours_for_20m_steps": 20e6 / config.batch_steps * whole / 3600,
        f"expert_{name}_share_updates": updates / whole,
        f"expert_{name}_compile_s": compile_s,
    }


def _training(env: Any, repeats: int) -> dict[str, float]:
    """Milliseconds per training step, and how much of it each part takes.

    A part's share is what a run costs more than the same run without that part. It is the start of
    a run that is timed, where the expert is in control most and pairs cost most.
    """
    config, hparams = algorithms.settings("ppl", "driving")
    config = dataclasses.replace(config, total_steps=STEPS)
    blocks = STEPS // config.decision_interval

    def timed(make: Any) -> float:
        functions = make_train(env, env.experts["scripted"], make, config)
        program = jax.jit(lambda learner: functions.run_chunk(learner, blocks), donate_argnums=0)
        # a learner with data in its buffers
        learner, _ = program(jax.jit(functions.init)(jax.random.key(0), hparams))
        times = []
        for _ in range(repeats):
            began = time.perf_counter()
            learner, _ = jax.block_until_ready(program(learner))
            times.append((time.perf_counter() - began) / STEPS * 1e3)
        return float(np.median(times))

    def without(**parts: Any) -> Any:
        def make(spec: Any, config: Any) -> Any:
            return make_ppl(spec, config)._replace(**parts)

        return make

    whole = timed(make_ppl)
    no_gradient = timed(without(update=no_update))
    no_pairs = timed(
        without(update=no_update, store=lambda state, step, hparams: state, predicted_steps=0)
    )
    return {
        "train_ms_per_step": whole,
        "share_gradient": (whole - no_gradient) / whole,
        "share_pairs_lookahead_and_buffers": max(no_gradient - no_pairs, 0.0) / whole,
        "share_environment_and_gate": no_pairs / whole,
    }


def _gradient(env: Any, repeats: int, train_ms: float) -> dict[str, float]:
    """FLOP/s of the update against a plain matrix product of its largest shape."""
    config, hparams = algorithms.settings("ppl", "driving")
    algorithm = make_ppl(env.spec, config)
    state = algorithm.init(jax.random.key(0))
    ones = jax.tree.map(jnp.ones_like, state.human_buffer.added) * config.batch_size
    state = state.replace(
        human_buffer=state.human_buffer.replace(added=ones),
        preference_buffer=state.preference_buffer.replace(added=ones),
    )
    traced, updates = as_arrays(hparams), 50

    @jax.jit
    def run(state: Any) -> Any:
        def step(learned: Any, key: jax.Array) -> Any:
            return algorithm.update(state.replace(learned=learned), key, traced)[0].learned, None

        return jax.lax.scan(step, state.learned, jax.random.split(jax.random.key(1), updates))[0]

    seconds = _median_s(lambda: run(state), repeats) / updates
    widths = [env.spec.observation_size, *config.hidden, env.spec.action_size]
    products = [a * b for a, b in zip(widths[:-1], widths[1:], strict=True)]
    # forward and weight gradients of every layer, input gradients of all but the first
    flops = 2 * 2 * config.batch_size * (3 * sum(products) - products[0])

    rows, width = 2 * config.batch_size, config.hidden[0]
    left, right = jnp.ones((rows, width)), jnp.ones((width, width))

    @jax.jit
    def multiply(left: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda x, _: ((x @ right) * 1e-3, None), left, None, length=200)[0]

    plain = 200 * 2 * rows * width * width / _median_s(lambda: multiply(left), repeats)
    return {
        "update_ms": seconds * 1e3,
        "update_gflops": flops / seconds / 1e9,
        "plain_product_gflops": plain / 1e9,
        "update_over_plain_product": flops / seconds / plain,
        "update_share_of_step": seconds * 1e3 / train_ms,
    }


def _sweep(repeats: int) -> dict[str, float]:
    """Wall time per run of a sweep of short runs, against runs of `ppl train` one by one.

    Both from the command line, with the programs' caches as they are: Python's start, building the
    environment, compiling (or reading the cache) and evaluations are in both.
    """
    program = [sys.executable, "-m", "experiments.cli"]

    def seconds(command: str, *words: str) -> float:
        words = (command, "driving", "--total-steps", str(SWEEP_STEPS), *words)
        began = time.perf_counter()
        subprocess.run([*program, *words], check=True, capture_output=True)
        return time.perf_counter() - began

    with tempfile.TemporaryDirectory() as folder:
        alone = [
            seconds("train", "--seed", str(seed), "--out", f"{folder}/run-{seed}")
            for seed in range(repeats)
        ]
        whole = seconds("sweep", "--seeds", str(SWEEP), "--out", f"{folder}/sweep")
    single = float(np.median(alone))
    return {
        "sweep_runs": SWEEP,
        "sweep_steps_of_a_run": SWEEP_STEPS,
        "single_run_s": single,
        "sweep_s_per_run": whole / SWEEP,
        "sweep_over_single_runs": whole / SWEEP / single,
    }
