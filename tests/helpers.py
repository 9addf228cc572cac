"""Shared by tests: probe environments with known answers, tiny settings, programs from outside."""

import dataclasses
import functools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple, get_args

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from ppl_jax import algorithms, checkpoint, gates, predictors
from ppl_jax.config import HParams, TrainConfig, as_arrays, replace, values
from ppl_jax.evaluation import make_evaluate
from ppl_jax.experts import SavedPolicy, act
from ppl_jax.training import Phase, make_train, phases
from ppl_jax.types import EnvSpec, Outcome

ROOT = Path(__file__).parent.parent
TINY = {
    "total_steps": 800,
    "batch_size": 32,
    "hidden": (32,),
    "prediction_horizon": 6,
    "decision_interval": 5,
    "max_preference_horizon": 6,
    "human_capacity": 2000,
    "preference_capacity": 2000,
    "members": 3,
    "rollout_steps": 100,
}
OWN = {
    "bc": {"total_steps": 200, "demonstrations": 200, "offline_updates": 400},
    "gail": {"total_steps": 8200, "demonstrations": 200},
    "iwr": {"demonstrations": 40, "offline_updates": 50},
    "ensemble_dagger": {"demonstrations": 40, "offline_updates": 100},
    "thrifty_dagger": {"demonstrations": 40, "offline_updates": 100},
}

PROGRAM = """
import envs
from experiments.cli import main
from ppl_jax.algorithms import register
from tests.helpers import Probe

def broken(spec, config):
    raise ValueError("this method is broken")

envs.register("probe", Probe)
register("broken", broken)
if __name__ == "__main__":
    main()
"""


@flax.struct.dataclass
class ProbeState:
    sign: jax.Array  # +1 or -1: what the observation shows
    error: jax.Array  # how far the executed actions have led astray
    time: jax.Array


@flax.struct.dataclass
class ProbeParams:
    signs: jax.Array


class Probe(Environment):
    """The right action is `0.6 * sign`; others add up to an unsafe deviation.

    `dependent=False` shows the same observation always (sign +1): the answer is a constant.
    """

    name = "probe"
    max_episode_steps = 20
    tolerance = 0.15

    def __init__(self, dependent=True):
        signs = jnp.array([1.0, -1.0] if dependent else [1.0])
        self.spec = EnvSpec(3, 1, np.zeros(3, np.float32), np.ones(3, np.float32))
        self.default_params = self.held_out_params = ProbeParams(signs)

    def scenario_count(self, params):
        return params.signs.shape[0]

    def reset_to(self, index, key, params):
        return ProbeState(params.signs[index], jnp.zeros(()), jnp.zeros((), jnp.int32))

    def observe(self, state, params):
        return jnp.stack([state.sign, state.error, jnp.ones(())])

    def transition(self, key, state, action, params):
        miss = jnp.abs(action[0] - self.answer(state.sign))
        error = jnp.where(miss > self.tolerance, state.error + miss, 0.0)
        time = state.time + 1
        unsafe = error > 1.0
        outcome = Outcome(
            reward=-miss,
            terminated=unsafe,
            truncated=time >= self.max_episode_steps,
            cost=unsafe.astype(jnp.float32),
            success=(time >= self.max_episode_steps) & ~unsafe,
            unsafe=unsafe,
            progress=time / self.max_episode_steps,
            speed=jnp.float32(10.0),
        )
        return ProbeState(state.sign, error, time), outcome

    @staticmethod
    def answer(sign):
        return 0.6 * sign

    @staticmethod
    def scripted_expert(key, state, observation, params):
        return jnp.atleast_1d(Probe.answer(state.sign))


class Aim(Probe):
    """The same where a step pays 1 less the miss, so that failing at once does not pay."""

    name = "aim"

    def transition(self, key, state, action, params):
        state, outcome = super().transition(key, state, action, params)
        return state, dataclasses.replace(outcome, reward=1.0 + outcome.reward)


@flax.struct.dataclass
class GoalState:
    place: jax.Array
    time: jax.Array


class Goal(Environment):
    """Walk to +1, which ends the episode with success; below -1 it ends without."""

    name = "goal"
    max_episode_steps = 40
    spec = EnvSpec(2, 1, np.zeros(2, np.float32), np.ones(2, np.float32))

    def __init__(self):
        self.default_params = self.held_out_params = ProbeParams(jnp.zeros(2))

    def scenario_count(self, params):
        return params.signs.shape[0]

    def reset_to(self, index, key, params):
        return GoalState(params.signs[index], jnp.zeros((), jnp.int32))

    def observe(self, state, params):
        return jnp.stack([state.place, jnp.ones(())])

    def transition(self, key, state, action, params):
        place = state.place + 0.1 * jnp.clip(action[0], -1, 1)
        time = state.time + 1
        solved, lost = place >= 1.0, place <= -1.0
        outcome = Outcome(
            reward=0.1 * action[0],
            terminated=solved | lost,
            truncated=time >= self.max_episode_steps,
            cost=lost.astype(jnp.float32),
            success=solved,
            unsafe=lost,
            progress=jnp.clip(place, 0, 1),
            speed=jnp.float32(10.0),
        )
        return GoalState(place, time), outcome

    @staticmethod
    def scripted_expert(key, state, observation, params):
        return jnp.array([0.8])


class Balance(Goal):
    """Stay near 0, where nothing stays: x' = 1.3 x + 0.4 a. The expert never leaves it."""

    name = "balance"
    max_episode_steps = 60

    def __init__(self):
        self.default_params = self.held_out_params = ProbeParams(jnp.zeros(2))

    def transition(self, key, state, action, params):
        place = 1.3 * state.place + 0.4 * jnp.clip(action[0], -1, 1)
        time = state.time + 1
        lost, over = jnp.abs(place) > 1.0, time >= self.max_episode_steps
        outcome = Outcome(
            reward=-jnp.abs(place),
            terminated=lost,
            truncated=over,
            cost=lost.astype(jnp.float32),
            success=over & ~lost,
            unsafe=lost,
            progress=time / self.max_episode_steps,
            speed=jnp.float32(10.0),
        )
        return GoalState(place, time), outcome

    @staticmethod
    def scripted_expert(key, state, observation, params):
        return jnp.clip(jnp.atleast_1d(-1.3 / 0.4 * state.place), -1.0, 1.0)


class Spend(Goal):
    """One step: the reward is 2 a, the cost (1 + a)^2 / 2.

    With E[cost] <= 1/2 and a ~ N(m, s): (1 + m)^2 + s^2 = 1, and the multiplier is 2 / (1 + m).
    """

    name = "spend"
    max_episode_steps = 1

    def __init__(self):
        self.default_params = self.held_out_params = ProbeParams(jnp.zeros(2))

    def transition(self, key, state, action, params):
        a, yes = action[0], jnp.ones((), bool)
        return dataclasses.replace(state, time=state.time + 1), Outcome(
            reward=2.0 * a,
            terminated=yes,
            truncated=~yes,
            cost=(1.0 + a) ** 2 / 2,
            success=yes,
            unsafe=~yes,
            progress=jnp.ones(()),
            speed=jnp.ones(()),
        )


class TwoSteps(Goal):
    """Two steps whatever one does; the second pays 1 and costs 3: V(s0) = gamma, V(s1) = 1."""

    name = "two_steps"
    max_episode_steps = 2

    def __init__(self):
        self.default_params = self.held_out_params = ProbeParams(jnp.zeros(2))

    def observe(self, state, params):
        return jnp.stack([1.0 * state.time, jnp.ones(())])

    def transition(self, key, state, action, params):
        time = state.time + 1
        last = time >= 2
        return GoalState(state.place, time), Outcome(
            reward=1.0 * last,
            terminated=last,
            truncated=jnp.zeros((), bool),
            cost=3.0 * last,
            success=last,
            unsafe=last,
            progress=time / 2,
            speed=jnp.ones(()),
        )


class Toll(TwoSteps):
    """The same, but it is the first of the two steps that costs."""

    name = "toll"

    def transition(self, key, state, action, params):
        state, outcome = super().transition(key, state, action, params)
        return state, dataclasses.replace(outcome, cost=1.0 * (state.time == 1))


class Endless(TwoSteps):
    """Every step pays 1, time alone ends it, all looks the same: V = 1 / (1 - gamma)."""

    name = "endless"
    max_episode_steps = 3

    def observe(self, state, params):
        return jnp.ones(2)

    def transition(self, key, state, action, params):
        state, outcome = super().transition(key, state, action, params)
        no = jnp.zeros((), bool)
        outcome = dataclasses.replace(
            outcome,
            reward=jnp.ones(()),
            terminated=no,
            truncated=state.time >= self.max_episode_steps,
        )
        return state, outcome


def plain_settings(name, **changes):
    """(config, hparams) of a method with the classes' own defaults, and some changed by name."""
    chosen = {k: changes[k] for k in ("gate", "predictor") if k in changes}
    spec = algorithms.method(name)
    config = TrainConfig(**chosen, method=spec.config())
    hparams = HParams(
        method=spec.hparams(),
        gate=gates.gate(config.gate).hparams(),
        predictor=predictors.predictor(config.predictor).hparams(),
    )
    return replace(config, hparams, **changes)


def tiny_settings(name, tiny=TINY, **changes):
    """The same with what the method has of `tiny`."""
    config, hparams = plain_settings(name, **{k: changes[k] for k in changes if k == "gate"})
    known = values(config, hparams)
    return plain_settings(name, **({k: v for k, v in tiny.items() if k in known} | changes))


def probe_settings(name, **changes):
    """A method's settings, tiny, with some changed."""
    chosen = {k: changes[k] for k in ("gate", "predictor") if k in changes}
    config, _ = tiny_settings(name, **chosen, **OWN.get(name, {}))
    _, hparams = algorithms.settings(name, "probe", **chosen)
    known = values(config, hparams)
    faster = {
        "learning_rate": 3e-3,
        "discriminator_rate": 1e-3,
        "polyak_tau": 0.02,
        "survival_correction": 1.0,  # success ends the episode in these worlds
    }
    config, hparams = replace(config, hparams, **{k: v for k, v in faster.items() if k in known})
    others = {k for k in TINY if k not in known}  # what only other methods have
    return replace(config, hparams, **{k: v for k, v in changes.items() if k not in others})


def outcome(out):
    """What a run folder holds, less times."""
    newest = out / "checkpoints" / f"step_{checkpoint.steps(out / 'checkpoints')[-1]}"
    lines = (out / "metrics.jsonl").read_text().splitlines()
    return {
        "learner": json.loads((newest / "checksum.json").read_text())["crc32"],
        "evaluation": (out / "evaluation.csv").read_text(),
        "metrics": [
            {k: v for k, v in json.loads(line).items() if not k.startswith("time/")}
            for line in lines
        ],
    }


def program(tmp_path, *words, code=0):
    """Run the command line in a program that registers the probe and a broken method."""
    script = tmp_path / "own.py"
    script.write_text(PROGRAM)
    return call(script, *words, code=code)


def call(script, *words, code=0):
    """Run a script from outside the package; its exit code must be `code`."""
    done = subprocess.run(
        [sys.executable, str(script), *map(str, words)],
        capture_output=True,
        text=True,
        timeout=560,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


def pairwise(a, b):
    """The leaves of two trees in pairs."""
    return zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)


def functions(name, probe=None, **changes):
    """A method's training functions in a probe environment, and its settings."""
    probe = probe or Probe()
    config, hparams = probe_settings(name, **changes)
    return make_train(probe, probe.scripted_expert, algorithms.method(name).make, config), hparams


class Programs(NamedTuple):
    """A method's compiled functions, which runs of any length, seed and learning rate share.

    Attributes:
        functions, config, hparams: What they are of.
        init: `init(key, learning rate) -> learner`.
        chunk: `chunk(learner, blocks, phase) -> learner`.
    """

    functions: Any
    config: TrainConfig
    hparams: HParams
    init: Any
    chunk: Any

    def play(self, key, rate=None, total_steps=None):
        """The learner after a whole run."""
        config = self.config
        if total_steps is not None:
            config = dataclasses.replace(config, total_steps=total_steps)
        rate = self.hparams.learning_rate if rate is None else rate
        learner = self.init(key, jnp.broadcast_to(jnp.float32(rate), key.shape))
        for phase, length in phases(config):
            learner = self.chunk(learner, length // config.decision_interval, phase)
        return learner


@functools.cache
def programs(name, world=Probe, *, together=False, **changes):
    """Of one run, or of several `together` under `vmap`: keys and rates have an axis then."""
    made, hparams = functions(name, world(), **changes)
    arrays = as_arrays(hparams)

    def init(key, rate, arrays):
        return made.init(key, arrays.replace(learning_rate=rate))

    def chunk(learner, blocks, phase):
        return made.run_chunk(learner, blocks, phase)[0]

    def of(phase):
        run = functools.partial(chunk, phase=phase)
        return jax.jit(jax.vmap(run, in_axes=(0, None)) if together else run)

    phased = {phase: of(phase) for phase in get_args(Phase)}
    start = jax.jit(jax.vmap(init, in_axes=(0, 0, None)) if together else init)
    return Programs(
        functions=made,
        config=probe_settings(name, **changes)[0],
        hparams=hparams,
        init=lambda key, rate: start(key, rate, arrays),
        chunk=lambda learner, blocks, phase: phased[phase](learner, jnp.int32(blocks)),
    )


@functools.cache
def _evaluation(world):
    env = world()
    spec = env.spec

    def play(layers, key):
        policy = SavedPolicy(layers, "relu", "tanh", spec.observation_mean, spec.observation_scale)
        run = make_evaluate(env, lambda key, state, observation, params: act(policy, observation))
        return run(env.held_out_params, key)

    return jax.jit(play)


def success(world, made, learner):
    """Share of a probe's held-out scenarios that the learner's policy solves."""
    layers = made.algorithm.policy(learner.algorithm)
    return float(np.mean(_evaluation(world)(layers, jax.random.key(0)).success))


def numpy_action(policy, observation):
    """What a policy file does, in plain NumPy: [B, O] -> [B, A]."""
    x = (observation - policy.obs_mean) / policy.obs_scale
    between = {"relu": lambda x: np.maximum(x, 0), "tanh": np.tanh}[policy.activation]
    for i, (w, b) in enumerate(policy.weights):
        x = (between(x) if i else x) @ w + b
    return np.tanh(x) if policy.output == "tanh" else np.clip(x, -1, 1)
