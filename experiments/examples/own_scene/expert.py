"""The expert, and the registration: what makes the scene an environment by name.

python -m own_scene.expert train hover    (in the folder that holds own_scene)
"""

import jax
import jax.numpy as jnp

import envs
from envs.cards import EnvCard
from envs.manipulation.twins import DrawnScene, register_twin
from experiments.cli import main

from . import scene
from .task import Hover, HoverParams


def scripted_expert(key, state, observation, params):
    """Action [6]: straight to the goal, slower as it comes near; the hand is not turned."""
    return jnp.append(jnp.clip(8.0 * observation[:3], -1.0, 1.0), jnp.zeros(3))


def make_hover(training: range = range(200), held_out: range = range(1000, 1020)) -> Hover:
    """Build the environment."""
    pools = [HoverParams(jnp.arange(r.start, r.stop)) for r in (training, held_out)]
    return Hover(pools[0], pools[1], {"scripted": scripted_expert})


def place_goal(data, state) -> None:
    """Put the goal where the state has it, for drawing; `data` is MuJoCo's."""
    data.mocap_pos[0] = jax.device_get(state.goal)


CARD = EnvCard(
    title="Hover", control_rate=20.0, view="arm", settings={"total_steps": 2000},
    camera={"lookat": (0.05, 0.0, 1.0), "distance": 1.6, "azimuth": 215, "elevation": -25},
)  # fmt: skip
envs.register("hover", make_hover, card=CARD)
register_twin("hover", lambda env: DrawnScene(env, scene.xml(), place_goal))

if __name__ == "__main__":
    main()
