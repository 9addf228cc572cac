"""Many runs as one program: a run with its evaluations as one pure function, and a batch of them.

A core is as fast with one run as with many, so on a CPU a batch is one run after another; an
accelerator steps them side by side, split over all devices.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ppl_jax import experts
from ppl_jax.config import HParams, TrainConfig, env_params
from ppl_jax.evaluation import Episodes, make_evaluate
from ppl_jax.experts import SavedPolicy
from ppl_jax.interaction import Counters, Learner
from ppl_jax.training import TrainFunctions, phases
from ppl_jax.types import Env, PyTree


class RunHistory(NamedTuple):
    """Results of a run: one entry per evaluation, [P].

    Attributes:
        episodes: `Episodes` of every held-out scenario, [P, S].
        counters: `Counters` up to the evaluation, [P].
        diverged: A loss was not finite by then, [P].
    """

    episodes: Episodes
    counters: Counters
    diverged: jax.Array


RunFn = Callable[[jax.Array, HParams, PyTree], Any]
"""`run(key, hparams, held_out_params) -> RunHistory`."""


def evaluation_steps(config: TrainConfig, every: int) -> list[int]:
    """Environment steps at which a run is evaluated.

    After offline learning, then every `every` steps, and at its end.
    """
    begun, end = config.demonstrations, config.total_steps
    steps = [begun] if config.offline_updates else []
    steps += range(begun + every, end + 1, every)
    return steps if steps and steps[-1] == end else [*steps, end]


def make_run(
    env: Env,
    functions: TrainFunctions,
    config: TrainConfig,
    every: int,
    *,
    keep_policy: bool = False,
) -> RunFn:
    """One whole run as a function: `RunHistory` at `evaluation_steps(config, every)`.

    It trains what `ppl train` trains, number for number, but holds the evaluations in the
    program.

    Args:
        env: The environment; its held-out parameters are an argument of the run, not a constant,
            and the run evaluates in its own randomised worlds where it has ranges.
        functions: The method's functions (`ppl_jax.training.make_train`).
        config: Static settings.
        keep_policy: Return (RunHistory, the policy's layers at the end) instead.
        every: Steps between evaluations; a multiple of the decision interval and of the method's
            rounds.
    """
    interval = config.decision_interval

    def one(curve: RunHistory) -> RunHistory:
        return jax.tree.map(lambda leaf: leaf[None], curve)

    def look(learner: Learner, held_out: PyTree) -> RunHistory:
        layers = functions.algorithm.policy(learner.algorithm)
        mean, scale = env.spec.observation_mean, env.spec.observation_scale
        policy = SavedPolicy(
            weights=layers, activation="relu", output="tanh", obs_mean=mean, obs_scale=scale
        )

        def act(key: jax.Array, state: Any, observation: jax.Array, params: Any) -> jax.Array:
            return experts.act(policy, observation)

        episodes = make_evaluate(env, act)(held_out, jax.random.key(0))
        return RunHistory(episodes=episodes, counters=learner.counters, diverged=learner.diverged)

    def run(key: jax.Array, hparams: HParams, held_out: PyTree) -> Any:
        learner, curves = functions.init(key, hparams), []
        held_out = env_params(env, held_out, hparams)

        def part(learner: Learner, _: None, steps: int = every) -> tuple[Learner, RunHistory]:
            learner = functions.run_chunk(learner, steps // interval)[0]
            return learner, look(learner, held_out)

        for phase, length in phases(config):
            if phase != "interact":
                learner = functions.run_chunk(learner, length // interval, phase)[0]
                if phase == "fit":
                    curves.append(one(look(learner, held_out)))
                continue
            learner, curve = jax.lax.scan(part, learner, None, length=length // every)
            curves.append(curve)
            if length % every:
                learner, last = part(learner, None, length % every)
                curves.append(one(last))
        if not curves:  # demonstrations that nothing is learnt from
            curves.append(one(look(learner, held_out)))
        history = jax.tree.map(lambda *parts: jnp.concatenate(parts), *curves)
        if keep_policy:
            return history, functions.algorithm.policy(learner.algorithm)
        return history

    return run


def make_batch(
    run: RunFn, side_by_side: bool
) -> Callable[[jax.Array, HParams, PyTree], RunHistory]:
    """`batch(keys [B], hparams [B], held_out_params) -> RunHistory` with a leading [B].

    Args:
        run: One run.
        side_by_side: Step the runs together (`vmap`), or one after another (`lax.map`).
    """
    if side_by_side:
        return jax.vmap(run, in_axes=(0, 0, None))

    def one_after_another(keys: jax.Array, hparams: HParams, held_out: PyTree) -> RunHistory:
        return jax.lax.map(lambda one: run(one[0], one[1], held_out), (keys, hparams))

    return one_after_another


def stack(hparams: list[HParams]) -> HParams:
    """Runs' hyper-parameters as one pytree of float32 arrays [B]."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.array(leaves, np.float32)), *hparams)


def split(batch: PyTree, devices: list[Any]) -> PyTree:
    """A batch [B, ...] with its runs shared out over devices; B is a multiple of their number."""
    mesh = Mesh(np.array(devices), ("runs",))
    return jax.device_put(batch, NamedSharding(mesh, PartitionSpec("runs")))


def run_bytes(functions: TrainFunctions, hparams: HParams) -> int:
    """Memory that one run's state takes, bytes: its buffers, parameters and environment."""
    learner = jax.eval_shape(functions.init, jax.random.key(0), hparams)
    leaves = jax.tree.leaves(learner)
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in leaves)
