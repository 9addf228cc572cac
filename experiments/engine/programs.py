"""The compiled functions of a run, and a run played with them.

A run's length, its evaluations, seed and traced settings are arguments: runs that differ in these
alone are one set of programs, in `ppl train`, in a sweep and in `ppl_jax.train`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine.evaluate import episodes
from experiments.engine.plan import Chunk
from ppl_jax.config import HParams, as_arrays, env_params
from ppl_jax.evaluation import Episodes
from ppl_jax.interaction import Counters, Learner
from ppl_jax.losses import Metrics
from ppl_jax.networks import Layers
from ppl_jax.training import Phase, TrainFunctions
from ppl_jax.types import Env, PyTree

NETWORK = ("relu", "tanh")
"""Activation and output of the policies that are trained here."""

Announce = Callable[[str], AbstractContextManager]
"""`announce(what)`: a context in which the program `what` is compiled."""


class Look(NamedTuple):
    """A run as it is when it is evaluated; a leading axis of runs where they are side by side.

    Attributes:
        step: Environment steps by then.
        episodes: `Episodes` of every scenario, [S].
        counters: `Counters` by then.
        diverged: A loss was not finite by then.
    """

    step: int
    episodes: Episodes
    counters: Counters
    diverged: jax.Array

    def of(self, i: int) -> Look:
        """That of run `i` where runs are side by side."""
        return Look(self.step, *jax.tree.map(lambda leaf: leaf[i], self[1:]))


class Programs:
    """Compiles each function when it is first needed.

    Attributes:
        env, functions: What they are made of.
        compile_s: Seconds that compiling took so far.
    """

    def __init__(
        self,
        env: Env,
        functions: TrainFunctions,
        interval: int,
        *,
        on: str = "held_out",
        side_by_side: bool = False,
        announce: Announce = lambda what: nullcontext(),
    ):
        """Nothing is compiled yet.

        Args:
            env: The environment.
            functions: The method's functions (`ppl_jax.training.make_train`).
            interval: Steps of a block, K.
            on: The scenarios that evaluations play: "training", or those that the environment was
                made with as its held-out ones.
            side_by_side: Everything has a leading axis of runs, which are stepped together.
            announce: Called around each compilation.
        """
        self.env, self.functions, self.interval = env, functions, interval
        self.pool = env.default_params if on == "training" else env.held_out_params
        self.side_by_side, self.announce = side_by_side, announce
        self.compile_s = 0.0
        self._compiled: dict[str, Callable[..., Any]] = {}

    def init(self, key: jax.Array, hparams: HParams) -> Learner:
        """A learner before its first step."""
        jitted = jax.jit(self.functions.init)
        if self.side_by_side:  # every leaf has the runs first, shared out as the keys are
            jitted = jax.jit(jax.vmap(self.functions.init), out_shardings=key.sharding)
        return self._call("init", jitted, key, as_arrays(hparams))

    def chunk(self, learner: Learner, length: int, phase: Phase) -> tuple[Learner, Metrics]:
        """The learner after so many steps (updates in phase "fit"), and their mean metrics.

        `learner` is used up.
        """
        blocks = jnp.int32(length // self.interval)

        def run(learner: Learner, blocks: jax.Array) -> tuple[Learner, Metrics]:
            return self.functions.run_chunk(learner, blocks, phase)

        jitted = jax.jit(run, donate_argnums=0)
        if self.side_by_side:
            many = jax.vmap(run, in_axes=(0, None))
            jitted = jax.jit(many, donate_argnums=0, out_shardings=learner.key.sharding)
        return self._call(phase, jitted, learner, blocks)

    def evaluate(self, learner: Learner) -> Episodes:
        """Every scenario once, played by the policy in the run's own worlds."""
        layers, key = self.functions.algorithm.policy(learner.algorithm), jax.random.key(0)
        spec = self.env.spec
        arrays = (layers, jnp.asarray(spec.observation_mean), jnp.asarray(spec.observation_scale))
        network = (self.env, *NETWORK)
        if not self.side_by_side:
            params = env_params(self.env, self.pool, learner.hparams)
            return self._call("evaluation", episodes, arrays, params, key, static=network)

        def play(layers: Layers, hparams: HParams, pool: PyTree) -> Episodes:
            params = env_params(self.env, pool, hparams)
            return episodes(*network, (layers, *arrays[1:]), params, key)

        jitted = jax.jit(jax.vmap(play, in_axes=(0, 0, None)))
        return self._call("evaluation", jitted, layers, learner.hparams, self.pool)

    def play(
        self, key: jax.Array, hparams: HParams, chunks: Sequence[Chunk]
    ) -> tuple[list[Look], Layers]:
        """A whole run: what its evaluations found, and its policy at the end."""
        learner, looks = self.init(key, hparams), []
        for chunk in chunks:
            learner, _ = self.chunk(learner, chunk.length, chunk.phase)
            if chunk.evaluate:
                # the next chunk uses the learner up
                counters, diverged = jax.tree.map(np.asarray, (learner.counters, learner.diverged))
                played = jax.tree.map(np.asarray, self.evaluate(learner))
                looks.append(Look(chunk.step, played, counters, diverged))
        return looks, self.functions.algorithm.policy(learner.algorithm)

    def _call(self, what: str, jitted: Any, *arguments: Any, static: tuple[Any, ...] = ()) -> Any:
        if what not in self._compiled:
            began = time.perf_counter()
            with self.announce(what):
                self._compiled[what] = jitted.lower(*static, *arguments).compile()
            self.compile_s += time.perf_counter() - began
        return self._compiled[what](*arguments)
