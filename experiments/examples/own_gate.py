"""A gate of your own, from outside the package: one function and one registration.

    python own_gate.py train driving --gate brakes_late --max-speed-near 6
    python own_gate.py sweep driving --gate brakes_late --max-speed-near 4 6 8

"brakes_late" hands over where the prediction fails or ends faster than `max_speed_near`. The gate
owns that setting: it is an option, an axis of sweeps and a column of results.
"""

import flax.struct
import jax
import jax.numpy as jnp

import ppl_jax


@flax.struct.dataclass
class BrakesLateHParams:
    """The gate's own traced settings."""

    max_speed_near: jax.Array | float = ppl_jax.setting(
        8.0, "Predicted speed at the horizon above which the expert takes over, m/s.", low=0,
        group="gate", common=True,
    )  # fmt: skip


def brakes_late(point, hparams, scale):
    """The novice's prediction fails, or is still fast where it ends."""
    path = point.trajectory  # a `ppl_jax.types.Trajectory` of H steps
    last = jnp.maximum(jnp.sum(path.valid) - 1, 0)
    return jnp.any(path.unsafe) | (path.speed[last] > hparams.max_speed_near)


ppl_jax.register_gate("brakes_late", brakes_late, hparams=BrakesLateHParams)

if __name__ == "__main__":
    ppl_jax.main()
