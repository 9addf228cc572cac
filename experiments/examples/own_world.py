# ruff: noqa: D102 (what each method does stands in `ppl_jax.types.Env`)
"""An environment of your own, from outside the package: one class and one registration.

    python own_world.py train windy
    python own_world.py compare windy --algorithms ppl hg_dagger --seeds 3

A wind, another one in each scenario, blows a point away from 0. All functions are pure and for one
environment; automatic reset, batches, evaluation and prediction come with the base class.
"""

import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Environment
from experiments.cli import main
from ppl_jax.types import EnvSpec, Outcome


class Windy(Environment):
    """Stay within half a metre of 0. The parameters are the winds of the scenarios, [S] m/s."""

    name, max_episode_steps = "windy", 50
    spec = EnvSpec(
        observation_size=2,
        action_size=1,
        observation_mean=np.zeros(2, np.float32),
        observation_scale=np.ones(2, np.float32),
    )
    default_params = np.linspace(-0.7, 0.7, 20, dtype=np.float32)
    held_out_params = np.linspace(-0.6, 0.6, 10, dtype=np.float32)

    def scenario_count(self, params):
        return len(params)

    def reset_to(self, index, key, params):
        wind = jnp.asarray(params)[index]  # a state is any pytree
        return {"place": jnp.zeros(()), "wind": wind, "time": jnp.zeros((), jnp.int32)}

    def observe(self, state, params):
        return jnp.stack([state["place"], state["wind"]])

    def transition(self, key, state, action, params):
        speed, time = state["wind"] + action[0], state["time"] + 1
        place, over = state["place"] + 0.1 * speed, time >= self.max_episode_steps
        lost = jnp.abs(place) > 0.5
        return {**state, "place": place, "time": time}, Outcome(
            reward=1.0 - jnp.abs(place), terminated=lost, truncated=over, cost=1.0 * lost,
            success=over & ~lost, unsafe=lost, progress=time / 50, speed=jnp.abs(speed),
        )  # fmt: skip

    def scripted_expert(self, key, state, observation, params):
        return jnp.clip(-state["wind"] - 2.0 * state["place"], -1.0, 1.0)[None]


envs.register("windy", Windy, card=envs.EnvCard(title="Windy", settings={"gate": "low_return"}))

if __name__ == "__main__":
    main()
