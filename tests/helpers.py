"""Probe worlds with known answers, as small as they can be."""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Environment
from ppl_jax.types import EnvSpec, Outcome


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

    def scenario_numbers(self, params):
        return jnp.arange(params.signs.shape[0])

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
        return state, outcome.replace(reward=1.0 + outcome.reward)


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

    def scenario_numbers(self, params):
        return jnp.arange(params.signs.shape[0])

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
        return state.replace(time=state.time + 1), Outcome(
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
        return state, outcome.replace(cost=1.0 * (state.time == 1))


class Endless(TwoSteps):
    """Every step pays 1, time alone ends it, all looks the same: V = 1 / (1 - gamma)."""

    name = "endless"
    max_episode_steps = 3

    def observe(self, state, params):
        return jnp.ones(2)

    def transition(self, key, state, action, params):
        state, outcome = super().transition(key, state, action, params)
        no = jnp.zeros((), bool)
        outcome = outcome.replace(
            reward=jnp.ones(()), terminated=no, truncated=state.time >= self.max_episode_steps
        )
        return state, outcome
