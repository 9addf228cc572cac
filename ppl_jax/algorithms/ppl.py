"""Predictive Preference Learning (the paper's Algorithm 1)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax import buffers, horizon
from ppl_jax.algorithms.base import Algorithm
from ppl_jax.buffers import RingBuffer
from ppl_jax.checks import check_limit
from ppl_jax.config import HParams, TrainConfig
from ppl_jax.fields import setting
from ppl_jax.learned import Learned, adam_step, init_learned
from ppl_jax.losses import (
    NEEDS_REFERENCE,
    Metrics,
    bc_loss,
    pair_likelihoods,
    preference_loss,
)
from ppl_jax.policies import ClonerConfig, Novice, make_novice
from ppl_jax.preference import preference_pairs
from ppl_jax.types import EnvSpec, Interaction, PreferenceBatch

Reference = Callable[[jax.Array], jax.Array]
"""A frozen policy, `reference(observation [B, O]) -> action [B, A]`."""


@dataclasses.dataclass(frozen=True)
class PPLConfig(ClonerConfig):
    """Static settings of PPL."""

    max_preference_horizon: int = setting(10, "Largest L a run may use; L itself is traced.", low=1)
    adaptive_horizon: bool = setting(
        False, "Choose L while training, from the expert's answers at predicted states."
    )
    preference_capacity: int = setting(
        50_000, "Rows of the buffer of preference pairs; the oldest go first.", low=1
    )
    pair_states: Literal["predicted", "future", "shifted"] = setting(
        "predicted",
        "Pairs at s_t and predicted states 1..L (the paper), at the predicted ones alone, or one "
        "state apart as in the released code.",
        choices=("predicted", "future", "shifted"),
    )
    objective: Literal["cpo", "dpo", "ipo", "slic_hf", "imitation"] = setting(
        "cpo",
        "Loss on preference pairs.",
        choices=("cpo", "dpo", "ipo", "slic_hf", "imitation"),
        common=True,
    )
    objective_target: Literal["pair", "library"] = setting(
        "pair",
        "Margin of ipo and slic_hf: one that bounded actions reach, or the libraries' constant.",
        choices=("pair", "library"),
    )
    preferred: Literal["expert", "random"] = setting(
        "expert", "Preferred actions of the pairs.", choices=("expert", "random")
    )
    rejected: Literal["novice", "random"] = setting(
        "novice", "Rejected actions of the pairs.", choices=("novice", "random")
    )

    def check(self, config: TrainConfig, hparams: HParams) -> None:
        """Check L against the horizons, and the policy against the objective.

        Raises:
            ValueError: One line naming field, value and what is allowed.
        """
        for limit, most in (
            ("prediction_horizon", config.prediction_horizon),
            ("max_preference_horizon", self.max_preference_horizon),
        ):
            check_limit("preference_horizon", hparams.method.preference_horizon, limit, most)
        if self.objective in NEEDS_REFERENCE and self.policy != "deterministic":
            raise ValueError(
                f"policy must be deterministic with objective {self.objective}, whose reference "
                f"policy has no density of its own, got {self.policy!r}"
            )


@flax.struct.dataclass
class PPLHParams:
    """Traced settings of PPL.

    An L beyond `PPLConfig.max_preference_horizon` is refused; within `jax.jit` or `jax.vmap`, where
    its value is not known, it counts as that, and the metric `train/horizon_cut` is 1.
    """

    preference_horizon: jax.Array | float = setting(
        4,
        "L: predicted states that get a preference pair, besides the present one; auto chooses it "
        "while training.",
        low=1,
        choices=("auto",),
        common=True,
    )
    beta: jax.Array | float = setting(
        0.1, "Temperature of the preference loss.", low=0, common=True
    )
    bc_weight: jax.Array | float = setting(
        1.0, "Weight of the behaviour-cloning loss.", low=0, common=True
    )
    preference_weight: jax.Array | float = setting(
        1.0, "Weight of the preference loss; 0 leaves cloning alone.", low=0, common=True
    )
    preference_bias: jax.Array | float = setting(
        1.0,
        "Factor on the rejected action's likelihood: 1 in the paper, 0.5 in the released code.",
        low=0,
        common=True,
    )


MOST_PAIRS = 10  # that preference_horizon "auto" may choose


def fit_horizons(
    config: TrainConfig, hparams: HParams, given: Mapping[str, Any]
) -> tuple[TrainConfig, HParams]:
    """Fit `max_preference_horizon` to L and H, and turn L = "auto" into `adaptive_horizon`.

    Args:
        config: Static settings.
        hparams: Traced settings.
        given: The settings that somebody asked for, by name.
    """
    method, horizon = config.method, hparams.method.preference_horizon
    if horizon == "auto":
        horizon = max(1, min(MOST_PAIRS, config.prediction_horizon))
        method = dataclasses.replace(method, adaptive_horizon=True)
        hparams = dataclasses.replace(
            hparams, method=dataclasses.replace(hparams.method, preference_horizon=horizon)
        )
    most = method.max_preference_horizon
    if "prediction_horizon" in given and "max_preference_horizon" not in given:
        most = max(1, min(most, config.prediction_horizon))
    longest = float(np.max(horizon))
    if longest <= config.prediction_horizon and "max_preference_horizon" not in given:
        most = max(most, int(longest))
    method = dataclasses.replace(method, max_preference_horizon=most)
    return dataclasses.replace(config, method=method), hparams


@flax.struct.dataclass
class PPLState:
    """The policy and the two data sets.

    Attributes:
        learned: Parameters of the policy, its optimiser and its average.
        human_buffer: D_h of (observation [O], expert action [A]).
        preference_buffer: D_pref of `PreferenceBatch`.
        random_actions: [2, C, A] that stand in for preferred and rejected actions of the rows of
            `preference_buffer` in ablations; None otherwise.
        horizon: The measurements from which L is chosen while training; None otherwise.
    """

    learned: Learned
    human_buffer: RingBuffer
    preference_buffer: RingBuffer
    random_actions: jax.Array | None
    horizon: horizon.Horizon | None


def init_state(key: jax.Array, policy: Novice, spec: EnvSpec, config: TrainConfig) -> PPLState:
    """Before the first step."""
    method, actions = config.method, None
    observation, action = spec.zeros()
    pair = PreferenceBatch(
        observation=observation,
        preferred_action=action,
        rejected_action=action,
        rejected_observation=observation if method.pair_states == "shifted" else None,
    )
    if "random" in (method.preferred, method.rejected):
        shape = (2, method.preference_capacity, spec.action_size)
        actions = jax.random.uniform(
            jax.random.fold_in(key, 1), shape, jnp.float32, minval=-1.0, maxval=1.0
        )
    measured = horizon.init_horizon(method.max_preference_horizon)
    return PPLState(
        learned=init_learned(policy.init(key)),
        human_buffer=buffers.init_buffer((observation, action), config.human_rows),
        preference_buffer=buffers.init_buffer(pair, method.preference_capacity),
        random_actions=actions,
        horizon=measured if method.adaptive_horizon else None,
    )


def measure_horizon(state: PPLState, step: Interaction, scale: jax.Array) -> PPLState:
    """Take in the expert's answers at predicted states, where it was asked.

    Args:
        state: Before.
        step: An interaction.
        scale: [O] units of the observation.
    """
    predicted = step.predicted
    if state.horizon is None or predicted.expert_actions is None:
        return state
    found = horizon.measure(
        step.observation,
        predicted.observation,
        predicted.expert_actions,
        expert_action=step.expert_action,
        novice_action=step.novice_action,
        scale=scale,
    )
    seen = step.takeover & predicted.valid
    return dataclasses.replace(state, horizon=horizon.add(state.horizon, found, seen))


def pairs_per_step(state: PPLState, hparams: HParams) -> jax.Array | float:
    """L."""
    if state.horizon is None:
        return hparams.method.preference_horizon
    return horizon.choose(state.horizon, hparams.method.preference_horizon)


def store(
    state: PPLState, step: Interaction, hparams: HParams, *, scale: jax.Array, method: PPLConfig
) -> PPLState:
    """Keep a step under the expert's control, and its preference pairs.

    Args:
        state: Before.
        step: An interaction.
        hparams: L.
        scale: [O] units of the observation.
        method: Static settings.
    """
    human = buffers.add(
        state.human_buffer,
        (step.observation[None], step.expert_action[None]),
        step.takeover[None],
    )
    state = measure_horizon(state, step, scale)
    pairs, mask = preference_pairs(step, pairs_per_step(state, hparams), method.pair_states)
    if state.random_actions is not None:
        rank = jnp.cumsum(mask, dtype=jnp.int32) - 1
        rows = (state.preference_buffer.next + rank) % method.preference_capacity
        preferred, rejected = state.random_actions[:, rows]
        if method.preferred == "random":
            pairs = dataclasses.replace(pairs, preferred_action=preferred)
        if method.rejected == "random":
            pairs = dataclasses.replace(pairs, rejected_action=rejected)
    return dataclasses.replace(
        state,
        human_buffer=human,
        preference_buffer=buffers.add(state.preference_buffer, pairs, mask),
    )


def pair_outputs(
    pairs: PreferenceBatch, output: Callable[[jax.Array], jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """A policy's outputs where the preferred and where the rejected action belong, [B, D] each."""
    at_preferred = output(pairs.observation)
    if pairs.rejected_observation is None:
        return at_preferred, at_preferred
    return at_preferred, output(pairs.rejected_observation)


def ppl_loss(
    params: Any,
    cloned: tuple[jax.Array, jax.Array],
    pairs: PreferenceBatch,
    has_pairs: jax.Array,
    *,
    hparams: HParams,
    policy: Novice,
    config: TrainConfig,
    reference: Reference | None = None,
) -> tuple[jax.Array, Metrics]:
    """bc_weight L_bc + preference_weight L_pref of one batch from either data set.

    Args:
        params: The policy's.
        cloned: Observations [B, O] and expert actions [B, A].
        pairs: [B].
        has_pairs: 0 while there are none, else 1.
        hparams: Weights, beta and bias.
        policy: The network.
        config: Likelihood, reduction and objective.
        reference: See `make_ppl`.
    """
    observation, action = cloned
    weights, method = hparams.method, config.method
    # two separate forward passes: XLA runs them side by side on a CPU
    likelihood = policy.likelihood(hparams)
    output = policy.output(params, observation)
    bc, metrics = bc_loss(output, action, likelihood, config.bc_reduction)
    preferred, rejected = pair_outputs(pairs, functools.partial(policy.output, params))
    compared = pair_likelihoods(
        preferred,
        pairs.preferred_action,
        rejected,
        pairs.rejected_action,
        bias=weights.preference_bias,
        likelihood=likelihood,
        reference=pair_outputs(pairs, reference) if reference is not None else None,
    )
    preference, more = preference_loss(
        compared,
        weights.beta,
        weights.preference_bias,
        objective=method.objective,
        target=method.objective_target,
    )
    total = weights.bc_weight * bc + weights.preference_weight * has_pairs * preference
    return total, metrics | more


def update(
    state: PPLState,
    key: jax.Array,
    hparams: HParams,
    *,
    policy: Novice,
    config: TrainConfig,
    reference: Reference | None = None,
) -> tuple[PPLState, Metrics]:
    """One step of Adam on a batch from either data set.

    The metric `horizon_cut` is 1 where L exceeds `max_preference_horizon`: a traced L cannot be
    refused, and no more pairs than that are kept.
    """
    key_human, key_pairs = jax.random.split(key)
    size, recency = config.batch_size, hparams.recency
    cloned = buffers.sample(state.human_buffer, key_human, size, recency)
    pairs = buffers.sample(state.preference_buffer, key_pairs, size, recency)
    has_data = buffers.size(state.human_buffer) > 0
    has_pairs = buffers.size(state.preference_buffer) > 0
    loss = functools.partial(
        ppl_loss, hparams=hparams, policy=policy, config=config, reference=reference
    )
    grads, metrics = jax.grad(loss, has_aux=True)(
        state.learned.params, cloned, pairs, has_pairs.astype(jnp.float32)
    )
    learned = adam_step(state.learned, grads, hparams.learning_rate, has_data)
    asked, most = hparams.method.preference_horizon, config.method.max_preference_horizon
    metrics = metrics | {"horizon_cut": jnp.asarray(asked > most, jnp.float32)}
    if state.horizon is not None:
        metrics = metrics | {"preference_horizon": pairs_per_step(state, hparams)}
    return dataclasses.replace(state, learned=learned), metrics


def make_ppl(spec: EnvSpec, config: TrainConfig, reference: Reference | None = None) -> Algorithm:
    """PPL: clone the expert, and prefer its action on the states the novice would have come to.

        L = preference_weight L_pref + bc_weight L_bc                    (see `ppl_jax.losses`)

    Args:
        spec: The environment's sizes and scales.
        config: Static settings; `objective`, `preferred`, `rejected` and `pair_states` make the
            ablations.
        reference: Reference policy of the objectives that have one.

    Raises:
        ValueError: If the objective needs a reference and none is given.
    """
    method = config.method
    if method.objective in NEEDS_REFERENCE and reference is None:
        raise ValueError(f"objective {method.objective!r} needs a reference policy")
    policy = make_novice(spec, config)
    return Algorithm(
        name="ppl",
        init=functools.partial(init_state, policy=policy, spec=spec, config=config),
        act=lambda state, key, observation: policy.act(state.learned.params, key, observation),
        store=functools.partial(
            store, scale=jnp.asarray(spec.observation_scale, jnp.float32), method=method
        ),
        update=functools.partial(update, policy=policy, config=config, reference=reference),
        policy=lambda state: policy.layers(state.learned.average),
        predicted_steps=method.max_preference_horizon,
        labels_predictions=method.adaptive_horizon,
    )
