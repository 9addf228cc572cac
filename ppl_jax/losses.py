"""Losses of Predictive Preference Learning. Each returns `(scalar, metrics)`.

    L(pi) = w_pref L_pref + w_bc L_bc                                        (paper, section 4)
    L_pref = -E_{D_pref}[ log sigmoid(beta log pi(a+|s) - beta log pi(a-|s)) ]
    L_bc   = -E_{D_h}[ log pi(a_h|s) ]

There is no reward, critic or reference policy in them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from ppl_jax.distributions import log_likelihood

Metrics = dict[str, jax.Array]


def bc_loss(
    mean: jax.Array,
    expert_action: jax.Array,
    likelihood: str = "gaussian",
    reduction: str = "sum",
) -> tuple[jax.Array, Metrics]:
    """Behaviour cloning: -E[log pi(a_h|s)].

    Args:
        mean: [B, A] policy actions.
        expert_action: [B, A].
        likelihood: See `ppl_jax.distributions`.
        reduction: "sum" over action dimensions (the log-likelihood), or "mean" (the released
            code's mean squared error).
    """
    loss = -jnp.mean(log_likelihood(mean, expert_action, likelihood))
    if reduction == "mean":
        loss = loss / mean.shape[-1]
    return loss, {"loss_bc": loss}


def cpo_loss(
    preferred_mean: jax.Array,
    preferred_action: jax.Array,
    rejected_mean: jax.Array,
    rejected_action: jax.Array,
    beta: jax.Array | float,
    bias: jax.Array | float = 1.0,
    likelihood: str = "gaussian",
) -> tuple[jax.Array, Metrics]:
    """Contrastive preference loss: -E[log sigmoid(beta (log pi(a+|s) - bias log pi(a-|s)))].

    Args:
        preferred_mean, rejected_mean: [B, A] policy actions at the states of either action (the
            same state in the paper).
        preferred_action, rejected_action: [B, A].
        beta: Temperature.
        bias: 1 in the paper; 0.5 in the released code, where -bias is the "contrastive bias" of
            contrastive preference learning.
        likelihood: See `ppl_jax.distributions`.
    """
    preferred = log_likelihood(preferred_mean, preferred_action, likelihood)
    rejected = log_likelihood(rejected_mean, rejected_action, likelihood)
    loss = -jnp.mean(jax.nn.log_sigmoid(beta * (preferred - bias * rejected)))
    return loss, {
        "loss_preference": loss,
        "log_likelihood_preferred": jnp.mean(preferred),
        "log_likelihood_rejected": jnp.mean(rejected),
        "preference_accuracy": jnp.mean(preferred > rejected),
    }
