"""Gates: would the predicted trajectory fail, so that the expert takes over?

A gate is a function `decide(point, hparams, scale) -> bool` of what is known at a decision, of the
traced settings that it owns, and of the environment's `observation_scale`. `register_gate` makes
one of your own known to every method and to the command line.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.config import HParams, NoHParams, check_unique, did_you_mean
from ppl_jax.fields import setting
from ppl_jax.plugins import note_caller
from ppl_jax.types import DecisionPoint

Scale = np.ndarray | jax.Array
Decide = Callable[[DecisionPoint, Any, Scale], jax.Array]
"""`decide(point, hparams, scale) -> bool`."""


class Gate(NamedTuple):
    """A registered gate.

    Attributes:
        decide: `decide(point, hparams, scale) -> bool`: whether the expert takes over.
        hparams: Class of its traced settings; `decide` gets one.
        needs_expert_rollout: It reads `point.experts`, the expert's own predicted trajectory.
        needs_density: It reads `point.log_density`, which only a neural expert has.
    """

    decide: Decide
    hparams: type = NoHParams
    needs_expert_rollout: bool = False
    needs_density: bool = False


@flax.struct.dataclass
class UnsafeOrSlowHParams:
    """Settings of `unsafe_or_slow`."""

    min_speed: jax.Array | float = setting(
        5.0,
        "Predicted mean speed below which the expert takes over, m/s.",
        low=0,
        group="gate",
        common=True,
    )
    min_clearance: jax.Array | float = setting(
        0.0,
        "Predicted distance to the road's edge or to a thing below which the expert takes over, m.",
        low=0,
        group="gate",
    )
    min_gain: jax.Array | float = setting(
        100.0,
        "Predicted gain in speed from which on a slow start is not slow, m/s.",
        low=0,
        group="gate",
    )


def unsafe_or_slow(point: DecisionPoint, hparams: UnsafeOrSlowHParams, scale: Scale) -> jax.Array:
    """The paper's driving rule: any predicted crash or leaving the road, or mean speed too low.

    A prediction that ends in success is not slow, nor one that gains `min_gain`.
    """
    del scale
    trajectory = point.trajectory
    steps = jnp.maximum(jnp.sum(trajectory.valid, dtype=jnp.int32), 1)
    total = jnp.sum(jnp.where(trajectory.valid, trajectory.speed, 0.0))
    mean_speed = total / steps.astype(jnp.float32)
    gain = trajectory.speed[steps - 1] - trajectory.speed[0]
    slow = (mean_speed < hparams.min_speed) & (gain < hparams.min_gain)
    clearance = trajectory.clearance
    near = clearance is not None and jnp.any(clearance < hparams.min_clearance)
    return jnp.any(trajectory.unsafe) | near | (slow & ~jnp.any(trajectory.success))


@flax.struct.dataclass
class LowReturnHParams:
    """Settings of `low_return`."""

    min_return: jax.Array | float = setting(
        10.0,
        "epsilon: predicted return at or below which the expert takes over.",
        group="gate",
        common=True,
    )


def low_return(point: DecisionPoint, hparams: LowReturnHParams, scale: Scale) -> jax.Array:
    """The released code's rule: the prediction ends with a negative reward, or returns too little.

    An arrival in the first predicted step (return 10) counts as a failure there, and here.
    """
    del scale
    trajectory = point.trajectory
    failed = jnp.any(trajectory.terminated & (trajectory.reward < 0))
    return failed | (jnp.sum(trajectory.reward) <= hparams.min_return)


@flax.struct.dataclass
class DeviatesFromExpertHParams:
    """Settings of `deviates_from_expert`."""

    max_departure: jax.Array | float = setting(
        1.0,
        "Distance allowed between the ends of the novice's and the expert's predictions, in "
        "units of the observation's scale.",
        low=0,
        group="gate",
        common=True,
    )


def deviates_from_expert(
    point: DecisionPoint, hparams: DeviatesFromExpertHParams, scale: Scale
) -> jax.Array:
    """The prediction fails, or ends elsewhere than the expert would from here.

        max_i |s_i - s*_i| / scale_i > max_departure

    with s, s* the two last predicted observations. A threshold on the return also fires where
    nobody can earn it yet (on the expert's own way to the ring), and does not fire where standing
    still earns enough (holding it). A prediction that succeeds does not deviate.
    """
    trajectory, experts = point.trajectory, point.experts
    if experts is None:
        raise ValueError("gate 'deviates_from_expert' needs the expert's own prediction")
    apart = jnp.max(jnp.abs(trajectory.observation[-1] - experts.observation[-1]) / scale)
    elsewhere = (apart > hparams.max_departure) & ~jnp.any(trajectory.success)
    return jnp.any(trajectory.unsafe) | elsewhere


@flax.struct.dataclass
class ActionProbabilityHParams:
    """Settings of `action_probability`."""

    min_log_density: jax.Array | float = setting(
        -3.0,
        "Log-density under the expert below which the novice's action hands over control.",
        group="gate",
        common=True,
    )


def action_probability(
    point: DecisionPoint, hparams: ActionProbabilityHParams, scale: Scale
) -> jax.Array:
    """The expert gives the novice's action a log-density below `min_log_density`.

    It looks at no prediction (EGPO, Peng et al. 2021; PVP's "free level" 0.95 is a density of
    0.05).
    """
    del scale
    return point.log_density < hparams.min_log_density


_GATES: dict[str, Gate] = {}


def register_gate(
    name: str,
    decide: Decide,
    *,
    hparams: type = NoHParams,
    needs_expert_rollout: bool = False,
    needs_density: bool = False,
) -> None:
    """Make a gate known by name, to every method with a gate and to the command line.

    Args:
        name: As in `--gate NAME`.
        decide: `decide(point, hparams, scale) -> bool`, pure.
        hparams: Class of its own traced settings: a `flax.struct.dataclass` whose fields are made
            by `ppl_jax.fields.setting`.
        needs_expert_rollout: It reads `point.experts` (one more lookahead per decision; both then
            ask the policy again at every predicted state).
        needs_density: It reads `point.log_density`.

    Raises:
        ValueError: If the name is taken, or a setting's is.
    """
    if name in _GATES:
        raise ValueError(f"gate {name!r} is registered already")
    check_unique(hparams)
    note_caller()
    _GATES[name] = Gate(
        decide=decide,
        hparams=hparams,
        needs_expert_rollout=needs_expert_rollout,
        needs_density=needs_density,
    )


register_gate("unsafe_or_slow", unsafe_or_slow, hparams=UnsafeOrSlowHParams)
register_gate("low_return", low_return, hparams=LowReturnHParams)
register_gate(
    "deviates_from_expert",
    deviates_from_expert,
    hparams=DeviatesFromExpertHParams,
    needs_expert_rollout=True,
)
register_gate(
    "action_probability",
    action_probability,
    hparams=ActionProbabilityHParams,
    needs_density=True,
)


def registered_gates() -> tuple[str, ...]:
    """Names of the gates, in order."""
    return tuple(_GATES)


def gate(name: str) -> Gate:
    """A gate by name.

    Raises:
        ValueError: If there is none.
    """
    if name not in _GATES:
        raise ValueError(
            f"gate must be one of {', '.join(_GATES)}, got {name!r}{did_you_mean(name, _GATES)}"
        )
    return _GATES[name]


def shared_gate(name: str, scale: Scale) -> Callable[[Any, DecisionPoint, HParams], jax.Array]:
    """The decision that methods without a rule of their own share: that of the gate `name`.

    Args:
        name: A registered gate.
        scale: [O] the environment's `observation_scale`.
    """
    decide = gate(name).decide
    return lambda state, point, hparams: decide(point, hparams.gate, scale)


def never(state: Any, point: DecisionPoint, hparams: HParams) -> jax.Array:
    """The decision of a method that nobody watches (`Algorithm.decide`)."""
    del state, point, hparams
    return jnp.zeros((), bool)
