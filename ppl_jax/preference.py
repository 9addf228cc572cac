"""Preference pairs over the present and the first L predicted states.

For an intervention at s_t with novice action a_n and expert action a_h, the predictor holds a_n
and reaches s~_{t+1} .. s~_{t+H}. Algorithm 1 of the paper adds the L + 1 pairs

    (s~, a+ = a_h, a- = a_n)   for s~ in (s_t, s~_{t+1}, ..., s~_{t+L})

L is traced: pairs past it are masked, so sweeping it compiles nothing.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp

from ppl_jax.checks import check_limit, check_name
from ppl_jax.types import Interaction, PreferenceBatch

PAIR_STATES = ("predicted", "future", "shifted")


def preference_pairs(
    step: Interaction, preference_horizon: jax.Array | float, pair_states: str = "predicted"
) -> tuple[PreferenceBatch, jax.Array]:
    """All candidate pairs of one step and which of them count.

    Args:
        step: With `predicted` of M >= L steps.
        preference_horizon: L; a traced one beyond M counts as M.
        pair_states: "predicted" (the paper: s_t and s~_{t+1} .. s~_{t+L}), "future" (the same
            without s_t), or "shifted" (the released code: the preferred action at state k, the
            rejected one at state k + 1, for k = 0..L-1).

    Returns:
        Pairs and their mask; M of them, with s_t M + 1.

    Raises:
        ValueError: If `pair_states` is unknown, or L, where it is not traced, exceeds M.
        AssertionError: If shapes do not fit.
    """
    check_name("pair_states", pair_states, PAIR_STATES)
    predicted = step.predicted
    count = predicted.valid.shape[0]
    chex.assert_shape(predicted.observation, (count, *step.observation.shape))
    chex.assert_equal_shape(
        [step.expert_action, step.novice_action], custom_message="expert_action and novice_action"
    )
    check_limit("preference_horizon", preference_horizon, "the predicted states", count)
    first = jnp.arange(count, dtype=jnp.float32) < preference_horizon
    mask = step.takeover & predicted.valid & first
    observation, rejected = predicted.observation, None
    if pair_states != "future":
        observation = jnp.concatenate([step.observation[None], observation])
    if pair_states == "predicted":
        mask = jnp.concatenate([jnp.asarray(step.takeover)[None], mask])
    elif pair_states == "shifted":
        observation, rejected = observation[:-1], predicted.observation

    def repeat(action: jax.Array) -> jax.Array:
        return jnp.broadcast_to(action, (mask.shape[0], *action.shape))

    pairs = PreferenceBatch(
        observation=observation,
        preferred_action=repeat(step.expert_action),
        rejected_action=repeat(step.novice_action),
        rejected_observation=rejected,
    )
    return pairs, mask
