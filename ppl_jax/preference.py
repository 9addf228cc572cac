"""Preference pairs over the first L predicted states.

For an intervention at s_t with novice action a_n and expert action a_h, the predictor holds a_n
and reaches s~_1 .. s~_H; each of the first L gives the pair (s~_i, a+ = a_h, a- = a_n) (Algorithm 1
of the paper). L is traced: pairs past it are masked, so sweeping it compiles nothing.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp

from ppl_jax.checks import check_name
from ppl_jax.types import Interaction, PreferenceBatch

PAIR_STATES = ("predicted", "shifted")


def preference_pairs(
    step: Interaction, preference_horizon: jax.Array | float, pair_states: str = "predicted"
) -> tuple[PreferenceBatch, jax.Array]:
    """All candidate pairs of one step and which of them count.

    Args:
        step: With `predicted` of M >= L steps.
        preference_horizon: L, traced.
        pair_states: "predicted" (the paper), or "shifted" (the released code: the preferred
            action at state k, the rejected one at state k + 1, for k = 0..L-1).

    Returns:
        [M] pairs and their [M] mask.

    Raises:
        ValueError: If `pair_states` is unknown.
        AssertionError: If shapes do not fit.
    """
    check_name("pair_states", pair_states, PAIR_STATES)
    predicted = step.predicted
    count = predicted.valid.shape[0]
    chex.assert_shape(predicted.observation, (count, *step.observation.shape))
    chex.assert_equal_shape(
        [step.expert_action, step.novice_action], custom_message="expert_action and novice_action"
    )
    mask = step.takeover & predicted.valid & (jnp.arange(count) < preference_horizon)

    def repeat(action: jax.Array) -> jax.Array:
        return jnp.broadcast_to(action, (count, *action.shape))

    observation, rejected = predicted.observation, None
    if pair_states == "shifted":
        rejected = predicted.observation
        observation = jnp.concatenate([step.observation[None], rejected[:-1]])
    pairs = PreferenceBatch(
        observation=observation,
        preferred_action=repeat(step.expert_action),
        rejected_action=repeat(step.novice_action),
        rejected_observation=rejected,
    )
    return pairs, mask
