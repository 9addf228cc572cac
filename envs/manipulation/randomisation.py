"""Domain randomisation of the arm environments: factors on the dynamics, noise on starts and sight.

A scenario's factors are drawn from its number, so that a state carries none and the same scenario
is the same world in training, in the lookahead and in the evaluation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from ppl_jax.fields import setting

Scalar = Any  # a float, or a traced scalar
_STREAM = 0x5EED  # apart from the streams that draw the starts


class Factors(NamedTuple):
    """Factors of one scenario on the nominal world; plain ones change no program.

    Attributes:
        friction: Of all contacts.
        mass: Mass and inertia of what is handled: the wiper, the ring, the cube.
        damping: Of the arm's joints, dry friction included.
        gain: Stiffness of the operational-space controller.
    """

    friction: Scalar = 1.0
    mass: Scalar = 1.0
    damping: Scalar = 1.0
    gain: Scalar = 1.0


NOMINAL = Factors()


@flax.struct.dataclass
class Ranges:
    """Widths of the ranges that a scenario's world is drawn from; all traced, all 0 by default.

    A factor is drawn log-uniformly from [1 / (1 + r), 1 + r], so that half and double are alike.

    Attributes:
        friction_range, mass_range, damping_range, gain_range, start_noise, sensor_noise: See the
            fields' own text.
    """

    friction_range: jax.Array | float = setting(
        0.0,
        "r: friction of contacts within [1/(1+r), 1+r] of its own.",
        low=0,
        group="world",
        common=True,
    )
    mass_range: jax.Array | float = setting(
        0.0, "r: mass of what is handled within [1/(1+r), 1+r].", low=0, group="world", common=True
    )
    damping_range: jax.Array | float = setting(
        0.0,
        "r: damping of the arm's joints within [1/(1+r), 1+r].",
        low=0,
        group="world",
        common=True,
    )
    gain_range: jax.Array | float = setting(
        0.0,
        "r: stiffness of the controller within [1/(1+r), 1+r].",
        low=0,
        group="world",
        common=True,
    )
    start_noise: jax.Array | float = setting(
        0.0,
        "Extra noise on the joints at a start: standard deviation, rad.",
        low=0,
        group="world",
        common=True,
    )
    sensor_noise: jax.Array | float = setting(
        0.0,
        "Noise on observations: standard deviation as a share of their scale.",
        low=0,
        group="world",
        common=True,
    )


def _key(number: jax.Array) -> jax.Array:
    return jax.random.fold_in(jax.random.key(number), _STREAM)


def draw_factors(ranges: Ranges | None, number: jax.Array) -> Factors:
    """The factors of scenario `number`; `NOMINAL` without ranges."""
    if ranges is None:
        return NOMINAL
    widths = jnp.stack(
        [
            jnp.asarray(r, jnp.float32)
            for r in (
                ranges.friction_range,
                ranges.mass_range,
                ranges.damping_range,
                ranges.gain_range,
            )
        ]
    )
    share = jax.random.uniform(_key(number), (len(Factors._fields),), jnp.float32, minval=-1.0)
    friction, mass, damping, gain = jnp.exp(share * jnp.log1p(widths))
    return Factors(friction=friction, mass=mass, damping=damping, gain=gain)


def start_offset(ranges: Ranges | None, number: jax.Array, size: int) -> jax.Array | float:
    """What scenario `number` adds to the joints at its start, [size] rad; 0 without ranges."""
    if ranges is None:
        return 0.0
    noise = jax.random.normal(jax.random.fold_in(_key(number), 1), (size,), jnp.float32)
    return jnp.asarray(ranges.start_noise, jnp.float32) * noise


def sensed(
    ranges: Ranges | None,
    observation: jax.Array,
    *,
    number: jax.Array,
    time: jax.Array,
    scale: Any,
) -> jax.Array:
    """The observation [O] with its sensor noise; as it is without ranges.

    Args:
        ranges: Ranges.
        observation: [O].
        number: Of the scenario. time: Steps so far: the noise is white over them.
        scale: [O] what the noise is a share of.
    """
    if ranges is None:
        return observation
    key = jax.random.fold_in(jax.random.fold_in(_key(number), 2), time)
    noise = jax.random.normal(key, observation.shape, jnp.float32) * jnp.asarray(scale, jnp.float32)
    return observation + jnp.asarray(ranges.sensor_noise, jnp.float32) * noise
