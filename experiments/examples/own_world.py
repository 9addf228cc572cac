"""An environment of your own, from outside the package: one class and one registration.

    python own_world.py train windy
    python own_world.py compare windy --algorithms ppl hg_dagger --seeds 3

"windy" keeps a point near 0 on a line while a wind, another one in each scenario, blows it away.
All functions are pure and for one environment; reset, batches and evaluation come with the base.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs.base import Environment
from envs.cards import EnvCard
from experiments.cli import main
from ppl_jax.types import EnvSpec, Outcome


@flax.struct.dataclass
class State:
    """Place, m; wind, m/s; and steps so far."""

    place: jax.Array
    wind: jax.Array
    time: jax.Array


class Windy(Environment):
    """`params` are the winds of the scenarios, [S] m/s."""

    name = "windy"
    max_episode_steps = 50
    spec = EnvSpec(2, 1, np.zeros(2, np.float32), np.ones(2, np.float32))
    default_params = np.linspace(-0.7, 0.7, 20, dtype=np.float32)
    held_out_params = np.linspace(-0.6, 0.6, 10, dtype=np.float32)

    def scenario_count(self, params):
        return params.shape[0]

    def reset_to(self, index, key, params):
        wind = jnp.asarray(params)[index]
        return State(place=jnp.zeros(()), wind=wind, time=jnp.zeros((), jnp.int32))

    def observe(self, state, params):
        return jnp.stack([state.place, state.wind])

    def transition(self, key, state, action, params):
        place, time = state.place + 0.1 * (state.wind + action[0]), state.time + 1
        lost, over = jnp.abs(place) > 0.5, time >= self.max_episode_steps
        return State(place=place, wind=state.wind, time=time), Outcome(
            reward=1.0 - jnp.abs(place), terminated=lost, truncated=over, cost=1.0 * lost,
            success=over & ~lost, unsafe=lost, progress=time / self.max_episode_steps,
            speed=jnp.abs(state.wind + action[0]),
        )  # fmt: skip

    @staticmethod
    def scripted_expert(key, state, observation, params):
        return jnp.clip(-state.wind - 2.0 * state.place, -1.0, 1.0)[None]


CARD = EnvCard(  # not needed: the command line, the presets and the plots read it
    title="Windy", control_rate=10.0, settings={"total_steps": 2000, "gate": "low_return"},
    preset_settings={"default": {"min_return": 5.0}},
)  # fmt: skip
envs.register("windy", Windy, card=CARD)

if __name__ == "__main__":
    main()
