"""The novices of the methods that clone: a network, how it acts, and the density behind its losses.

The paper's novice draws a_n from pi_n; the released code's is deterministic. `make_novice` makes
either. What is evaluated, saved and exported is deterministic in both: the mean before squashing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax

from ppl_jax.config import HParams, TrainConfig
from ppl_jax.distributions import (
    SQUASHED,
    Likelihood,
    mean_and_log_std,
    squashed_gaussian,
    surrogate,
)
from ppl_jax.fields import setting
from ppl_jax.networks import Layers, Params, layers, make_policy, make_raw
from ppl_jax.types import EnvSpec

POLICIES = ("deterministic", "gaussian")


@dataclasses.dataclass(frozen=True)
class ClonerConfig:
    """Static settings of methods that clone."""

    policy: Literal["deterministic", "gaussian"] = setting(
        "deterministic",
        "The novice acts as its network says, its log pi a surrogate (likelihood), or draws "
        "actions from a squashed Gaussian with a learned spread.",
        choices=POLICIES,
        common=True,
    )


class Novice(NamedTuple):
    """A policy as pure functions of its parameters.

    Attributes:
        init: `init(key) -> params`.
        output: `output(params, observation [..., O]) -> [..., D]`, what the likelihood reads.
        act: `act(params, key, observation [O]) -> action [A]` while training.
        likelihood: `likelihood(hparams) -> Likelihood` of outputs and actions.
        layers: `layers(params) -> Layers` of the deterministic policy that it is without sampling.
    """

    init: Callable[[jax.Array], Params]
    output: Callable[[Params, jax.Array], jax.Array]
    act: Callable[[Params, jax.Array, jax.Array], jax.Array]
    likelihood: Callable[[HParams], Likelihood]
    layers: Callable[[Params], Layers]


def make_novice(spec: EnvSpec, config: TrainConfig) -> Novice:
    """The novice that `config.method.policy` names.

        deterministic   a = mu(s);  log pi as `ppl_jax.distributions.log_likelihood` has it
        gaussian        a = tanh(u), u ~ N(m(s), std(s));  log pi exact

    Args:
        spec: The environment's sizes and scales.
        config: Static settings; `method` is a `ClonerConfig`.
    """
    if config.method.policy == "deterministic":
        return _deterministic(spec, config)
    return _gaussian(spec, config)


def _deterministic(spec: EnvSpec, config: TrainConfig) -> Novice:
    network = make_policy(spec, config.hidden)
    return Novice(
        init=network.init,
        output=network.apply,
        act=lambda params, key, observation: network.apply(params, observation),
        likelihood=lambda hparams: likelihood_of(config, hparams),
        layers=layers,
    )


def _gaussian(spec: EnvSpec, config: TrainConfig) -> Novice:
    size = spec.action_size
    network = make_raw(spec, config.hidden, 2 * size)

    def act(params: Params, key: jax.Array, observation: jax.Array) -> jax.Array:
        mean, log_std = mean_and_log_std(network.apply(params, observation))
        return squashed_gaussian(key, mean, log_std)[0]

    def layers_of_mean(params: Params) -> Layers:
        *inner, (w, b) = layers(params)
        return [*inner, (w[..., :size], b[..., :size])]

    return Novice(
        init=network.init,
        output=network.apply,
        act=act,
        likelihood=lambda hparams: SQUASHED,
        layers=layers_of_mean,
    )


def likelihood_of(config: TrainConfig, hparams: HParams) -> Likelihood:
    """The likelihood of a deterministic policy in a run with these settings."""
    return surrogate(config.likelihood, hparams.laplace_scale, hparams.laplace_core)
