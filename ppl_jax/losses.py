"""Losses of Predictive Preference Learning. Each returns `(scalar, metrics)`.

    L(pi) = w_pref L_pref + w_bc L_bc                                        (paper, section 4)
    L_pref = -E_{D_pref}[ log sigmoid(beta log pi(a+|s) - beta log pi(a-|s)) ]
    L_bc   = -E_{D_h}[ log pi(a_h|s) ]

There is no reward and no critic in them. Other objectives can stand in L_pref's place; with
Delta = log pi(a+|s) - bias log pi(a-|s), h = Delta - Delta of a frozen reference policy:

    cpo         -log sigmoid(beta Delta)             the paper's (Xu et al. 2024, no NLL term)
    dpo         -log sigmoid(beta h)                 Rafailov et al. 2023
    ipo         (h - target)^2                       Azar et al. 2024
    slic_hf     max(0, target - Delta)               Zhao et al. 2023; L_bc is its regulariser
    imitation   -log pi(a+|s)                        the paper's ablation: cloning of a+, a- unused

Libraries aim IPO at 1 / (2 beta) and SLiC-HF at 1. A policy with bounded actions cannot open such a
gap between near actions: it is driven to a corner of the action box. The target "pair" is the
Delta of a policy that acts as the expert did, mu(s) = a+; for IPO the h of that policy, or 0
where the reference has a wider gap already.
"""

from __future__ import annotations

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from ppl_jax.checks import check_name
from ppl_jax.distributions import Likelihood, surrogate
from ppl_jax.types import Array

Metrics = dict[str, jax.Array]

REDUCTIONS = ("sum", "mean")
OBJECTIVES = ("cpo", "dpo", "ipo", "slic_hf", "imitation")
TARGETS = ("pair", "library")
NEEDS_REFERENCE = ("dpo", "ipo")


def bc_loss(
    output: Array,
    expert_action: Array,
    likelihood: str | Likelihood = "gaussian",
    reduction: str = "sum",
    *,
    weight: jax.Array | float = 1.0,
) -> tuple[jax.Array, Metrics]:
    """Behaviour cloning: -E[weight log pi(a_h|s)].

    Args:
        output: [..., A] policy actions, or what else the likelihood reads of a policy.
        expert_action: [..., A].
        likelihood: A name, or a `ppl_jax.distributions.Likelihood`.
        reduction: "sum" over action dimensions (the log-likelihood), or "mean" (the released
            code's mean squared error).
        weight: [...] of mean 1, or a number.

    Raises:
        ValueError: If a name is unknown.
        AssertionError: If shapes do not fit.
    """
    check_name("reduction", reduction, REDUCTIONS)
    chex.assert_is_broadcastable(jnp.shape(weight), jnp.shape(expert_action)[:-1])
    log_pi = _named(likelihood).log_prob(output, expert_action)
    loss = -jnp.mean(weight * log_pi)
    if reduction == "mean":
        loss = loss / expert_action.shape[-1]
    return loss, {"loss_bc": loss}


def _named(likelihood: str | Likelihood) -> Likelihood:
    return surrogate(likelihood) if isinstance(likelihood, str) else likelihood


class PairLikelihoods(NamedTuple):
    """Log-likelihoods of a batch of preference pairs, [B] each.

    Attributes:
        preferred, rejected: log pi(a+|s), log pi(a-|s) of the policy.
        reference: Delta of the frozen reference policy (0 without one).
        attained: Delta of a policy that acts as preferred.
    """

    preferred: jax.Array
    rejected: jax.Array
    reference: jax.Array | float
    attained: jax.Array


def pair_likelihoods(
    preferred_output: Array,
    preferred_action: Array,
    rejected_output: Array,
    rejected_action: Array,
    *,
    bias: jax.Array | float = 1.0,
    likelihood: str | Likelihood = "gaussian",
    reference: tuple[jax.Array, jax.Array] | None = None,
) -> PairLikelihoods:
    """The log-likelihoods that every objective reads of a batch of pairs.

    Args:
        preferred_output, rejected_output: [B, A] policy actions at the states of either action
            (the same state in the paper), or what else the likelihood reads of a policy.
        preferred_action, rejected_action: [B, A].
        bias: Factor on the rejected action's likelihood; 1 in the paper.
        likelihood: A name, or a `ppl_jax.distributions.Likelihood`.
        reference: The reference policy's two outputs, like `preferred_output` and
            `rejected_output`.

    Raises:
        ValueError: If the likelihood is unknown.
        AssertionError: If shapes do not fit.
    """
    outputs = [preferred_output, rejected_output, *(reference or ())]
    chex.assert_equal_shape(outputs, custom_message="outputs")
    chex.assert_equal_shape([preferred_action, rejected_action], custom_message="actions")
    chex.assert_rank(preferred_action, 2)
    log_pi, attaining = _named(likelihood)
    attained = attaining(preferred_output, preferred_action)

    frozen: jax.Array | float = 0.0
    if reference is not None:
        first, second = reference
        frozen = log_pi(first, preferred_action) - bias * log_pi(second, rejected_action)
    return PairLikelihoods(
        preferred=log_pi(preferred_output, preferred_action),
        rejected=log_pi(rejected_output, rejected_action),
        reference=frozen,
        attained=log_pi(attained, preferred_action) - bias * log_pi(attained, rejected_action),
    )


def preference_loss(
    pairs: PairLikelihoods,
    beta: jax.Array | float,
    bias: jax.Array | float = 1.0,
    *,
    objective: str = "cpo",
    target: str = "pair",
) -> tuple[jax.Array, Metrics]:
    """A preference objective; see the top of this file.

    Args:
        pairs: Log-likelihoods of a batch.
        beta: Temperature (of cpo and dpo; of ipo's library target).
        bias: 1 in the paper; 0.5 in the released code, where -bias is the "contrastive bias" of
            contrastive preference learning. The same as given to `pair_likelihoods`.
        objective: "cpo", "dpo", "ipo", "slic_hf" or "imitation".
        target: "pair" or "library".

    Raises:
        ValueError: If a name is unknown.
        AssertionError: If shapes do not fit.
    """
    check_name("objective", objective, OBJECTIVES)
    check_name("target", target, TARGETS)
    chex.assert_equal_shape(
        [pairs.preferred, pairs.rejected, pairs.attained],
        custom_message="preferred, rejected and attained",
    )
    chex.assert_is_broadcastable(jnp.shape(pairs.reference), pairs.preferred.shape)
    delta = pairs.preferred - bias * pairs.rejected
    gained = delta - pairs.reference
    if objective == "cpo":
        each = -jax.nn.log_sigmoid(beta * delta)
    elif objective == "dpo":
        each = -jax.nn.log_sigmoid(beta * gained)
    elif objective == "ipo":
        reachable = jnp.maximum(pairs.attained - pairs.reference, 0.0)
        each = (gained - (0.5 / beta if target == "library" else reachable)) ** 2
    elif objective == "slic_hf":
        each = jax.nn.relu((1.0 if target == "library" else pairs.attained) - delta)
    else:  # imitation
        each = -pairs.preferred
    loss = jnp.mean(each)
    return loss, {
        "loss_preference": loss,
        "log_likelihood_preferred": jnp.mean(pairs.preferred),
        "log_likelihood_rejected": jnp.mean(pairs.rejected),
        "preference_accuracy": jnp.mean(pairs.preferred > pairs.rejected),
    }
