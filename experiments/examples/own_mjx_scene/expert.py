"""The expert, and the registration: what makes the scene an environment by name.

python -m own_mjx_scene.expert train push    (in the folder that holds own_mjx_scene)
"""

import jax.numpy as jnp

import envs
from envs.cards import EnvCard
from experiments.cli import main

from .scene import BLOCK_HALF
from .task import Push

BEHIND, CLEAR, LOW, HIGH = 0.075, 0.045, 0.025, 0.10  # m


def scripted_expert(key, state, observation, params):
    """Action [6]: over the block to behind it, down, and push it along the line to the goal."""
    off, way = observation[:3], observation[3:5]
    ahead = way / (jnp.linalg.norm(way) + 1e-6)
    across = jnp.stack([-ahead[1], ahead[0]])
    along, aside = off[:2] @ ahead, off[:2] @ across
    height = off[2] + BLOCK_HALF[2]
    # to be down behind the block and in line with it; the further off, the higher
    wrong = jnp.maximum((along + CLEAR) / 0.02, (jnp.abs(aside) - 0.01) / 0.02)
    level = LOW + (HIGH - LOW) * jnp.clip(wrong, 0.0, 1.0)
    down = (height < LOW + 0.01) & (jnp.abs(aside) < 0.03)
    forward = jnp.where(down, 0.06, -BEHIND - along)
    move = jnp.append(forward * ahead - aside * across, jnp.where(down, LOW, level) - height)
    fork = observation[7:9]
    turn = jnp.arctan2(fork[0] * ahead[1] - fork[1] * ahead[0], fork @ ahead)
    return jnp.clip(jnp.concatenate([12.0 * move, jnp.array([0.0, 0.0, 1.0]) * turn]), -1.0, 1.0)


def make_push(training: range = range(200), held_out: range = range(1000, 1020)) -> Push:
    """Build the environment."""
    return Push(training, held_out, {"scripted": scripted_expert})


CARD = EnvCard(
    title="Push", summary="An arm pushes a block to a goal.", control_rate=20.0, view="arm",
    settings={"total_steps": 2000, "gate": "deviates_from_expert"},
    camera={"lookat": (0.45, 0.0, 0.1), "distance": 1.2, "azimuth": 140, "elevation": -30},
)  # fmt: skip
envs.register("push", make_push, card=CARD)

if __name__ == "__main__":
    main()
