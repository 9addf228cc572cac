"""Settings of PPO-Lagrangian: `PPOHParams` are traced, `PPOConfig` is static.

Every field says its own help, range and group (see `ppl_jax.fields`); `validate` reads them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal

import flax.struct
import jax
import numpy as np

from ppl_jax.checks import check_number, did_you_mean
from ppl_jax.config import Setting, settings_of
from ppl_jax.fields import About, about, setting

POSITIVE = float(np.finfo(np.float32).tiny)  # least value of a field that must not be 0

OLD_NAMES = {
    "worlds": "num_envs",
    "minibatches": "num_minibatches",
    "smoothing": "gae_lambda",
    "max_divergence": "target_kl",
    "max_gradient": "max_grad_norm",
    "entropy_weight": "entropy_coef",
    "multiplier_rate": "lagrangian_lr",
    "cost_ends": "terminate_on_cost",
    "least_std": "min_std",
}
"""New names of settings, by the names in run folders and cards of earlier versions."""


@flax.struct.dataclass
class PPOHParams:
    """Traced settings; each field has its help."""

    learning_rate: jax.Array | float = setting(
        0.0003,
        "Learning rate of Adam; falls linearly to 0 over the run.",
        low=0.0,
        group="updates",
        common=True,
    )
    discount: jax.Array | float = setting(
        0.99, "gamma of the reward.", low=0.0, high=1.0, group="updates", common=True
    )
    cost_discount: jax.Array | float = setting(
        0.99,
        "gamma of the cost; a long horizon lets rare large costs hide small ones.",
        low=0.0,
        high=1.0,
        group="cost",
    )
    gae_lambda: jax.Array | float = setting(
        0.95,
        "lambda of the generalised advantages, of reward and cost.",
        low=0.0,
        high=1.0,
        group="updates",
    )
    clip: jax.Array | float = setting(
        0.2, "PPO's bound on the probability ratio, around 1.", low=POSITIVE, group="updates"
    )
    target_kl: jax.Array | float = setting(
        0.02,
        "Mean KL from the acting policy at which a batch's policy updates stop.",
        low=0.0,
        group="updates",
        common=True,
    )
    max_grad_norm: jax.Array | float = setting(
        0.5, "Norm to which gradients are clipped.", low=POSITIVE, group="updates"
    )
    entropy_coef: jax.Array | float = setting(
        0.0, "Weight of the policy's entropy.", low=0.0, group="updates"
    )
    cost_limit: jax.Array | float = setting(
        1.0, "Mean cost per episode that is allowed.", low=0.0, group="cost", common=True
    )
    terminate_on_cost: jax.Array | float = setting(
        0.0,
        "1: a step with cost ends the episode for the advantages, though not in the environment.",
        low=0.0,
        high=1.0,
        group="cost",
    )
    initial_multiplier: jax.Array | float = setting(
        1.0, "Multiplier of the cost at the start.", low=POSITIVE, group="cost", common=True
    )
    lagrangian_lr: jax.Array | float = setting(
        0.01, "Adam's learning rate for the multiplier.", low=0.0, group="cost", common=True
    )
    initial_std: jax.Array | float = setting(
        0.5,
        "Standard deviation of the actions at the start.",
        low=POSITIVE,
        group="policy",
        common=True,
    )
    min_std: jax.Array | float = setting(
        0.05, "Least standard deviation of the actions.", low=POSITIVE, group="policy"
    )
    final_std: jax.Array | float = setting(
        1.0,
        "Upper bound on the standard deviation of the actions at the end, reached geometrically.",
        low=POSITIVE,
        group="policy",
    )
    success_bonus: jax.Array | float = setting(
        0.0,
        "Reward added in the step that solves the task, while training.",
        low=0.0,
        group="updates",
        common=True,
    )
    demonstration_noise: jax.Array | float = setting(
        0.3,
        "Standard deviation of the noise under which demonstrations are made.",
        low=0.0,
        group="demonstrations",
    )
    guidance_weight: jax.Array | float = setting(
        1.0,
        "Weight of the log-likelihood of the expert's actions, where guided.",
        low=0.0,
        group="demonstrations",
    )


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings that shape arrays and programs; each field has its help."""

    total_steps: int = setting(
        20000000,
        "Environment steps, rounded up to whole batches; demonstrations not counted.",
        low=1,
        group="run",
        common=True,
    )
    num_envs: int = setting(
        64, "Environments stepped side by side.", low=1, group="updates", common=True
    )
    rollout_steps: int = setting(
        256, "Steps of each environment per batch.", low=1, group="updates", common=True
    )
    epochs: int = setting(5, "Passes over a batch.", low=1, group="updates", common=True)
    num_minibatches: int = setting(
        8, "Updates per pass over a batch.", low=1, group="updates", common=True
    )
    hidden: tuple[int, ...] = setting(
        (256, 256),
        "Widths of the hidden layers of policy and critics.",
        group="policy",
        common=True,
    )
    scaling: Literal["running", "world"] = setting(
        "running",
        "Inputs scaled by running statistics, or by the environment's constants.",
        choices=("running", "world"),
        group="policy",
    )
    demonstrations: int = setting(
        0,
        "Steps that a scripted expert labels under noise and that the policy clones first.",
        low=0,
        group="demonstrations",
        common=True,
    )
    demonstration_stride: int = setting(
        1,
        "One step in this many is kept: where the clone is furthest from the expert.",
        low=1,
        group="demonstrations",
    )
    demonstration_rounds: int = setting(
        1,
        "Rounds of demonstrations: the expert acts in the first, the clone in the others.",
        low=1,
        group="demonstrations",
    )
    cloning: Literal["laplace", "gaussian"] = setting(
        "laplace",
        "Likelihood that is cloned: for the median or the mean of the expert's actions.",
        choices=("laplace", "gaussian"),
        group="demonstrations",
    )
    cloning_updates: int = setting(
        20000, "Updates on the demonstrations, over all rounds.", low=0, group="demonstrations"
    )
    guided: bool = setting(
        False,
        "The expert labels every step of the training too.",
        group="demonstrations",
        common=True,
    )
    critic_batches: int = setting(
        0, "Batches at the start in which only the critics learn.", low=0, group="updates"
    )

    @property
    def batch_steps(self) -> int:
        """Environment steps per batch."""
        return self.num_envs * self.rollout_steps

    @property
    def batches(self) -> int:
        """Batches of the run."""
        return -(-self.total_steps // self.batch_steps)


def validate(config: PPOConfig, hparams: PPOHParams) -> None:
    """Check settings before anything compiles.

    Raises:
        ValueError: One line naming field, value and what is allowed.
    """
    for record in (config, hparams):
        for field in dataclasses.fields(record):
            if field.name != "hidden":
                _check_range(field.name, getattr(record, field.name), about(field))
    if not config.hidden or min(config.hidden) < 1:
        raise ValueError(f"hidden must name at least one width of 1 or more, got {config.hidden}")
    if config.batch_steps % config.num_minibatches:
        raise ValueError(
            f"num_minibatches must divide num_envs x rollout_steps ({config.batch_steps}), got "
            f"{config.num_minibatches}"
        )


def allowed(field: About, whole: bool) -> str:
    """The values that a number may have, as the end of "must ..."."""
    if field.high is not None:
        return f"lie between {field.low:g} and {field.high:g}"
    if field.low == POSITIVE:
        return "be positive"
    if not whole:
        return f"be a number of {field.low:g} or more"
    return f"be at least {field.low:g}" if field.low else "not be negative"


def _check_range(name: str, value: Any, field: About) -> None:
    if field.choices is not None:
        if value not in field.choices:
            raise ValueError(f"{name} must be one of {', '.join(field.choices)}, got {value!r}")
        return
    if field.low is None:
        return
    high = math.inf if field.high is None else field.high
    if not math.isfinite(value) or not field.low <= value <= high:
        raise ValueError(f"{name} must {allowed(field, isinstance(value, int))}, got {value}")
    check_number(name, value)


def catalogue(config: PPOConfig, hparams: PPOHParams) -> dict[str, Setting]:
    """Every setting of a run by its name, in the order of the classes."""
    return settings_of(config, traced=False) | settings_of(hparams, traced=True)


def replace(config: PPOConfig, hparams: PPOHParams, **changes: Any) -> tuple[PPOConfig, PPOHParams]:
    """The settings with some of them changed by name.

    Raises:
        ValueError: If a name is no setting of PPO-Lagrangian.
    """
    known = catalogue(config, hparams)
    if unknown := sorted(set(changes) - set(known)):
        raise ValueError(
            f"unknown settings of PPO-Lagrangian: {', '.join(unknown)}"
            + did_you_mean(unknown[0], known)
        )
    static = {name: value for name, value in changes.items() if not known[name].traced}
    traced = {name: value for name, value in changes.items() if known[name].traced}
    return dataclasses.replace(config, **static), dataclasses.replace(hparams, **traced)


def read(settings: Mapping[str, Any]) -> tuple[PPOConfig, PPOHParams]:
    """Settings by name from a run folder or a card, old names included; the rest are defaults.

    Raises:
        ValueError: One line naming what is unknown.
    """
    values = {OLD_NAMES.get(name, name): value for name, value in settings.items()}
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return replace(PPOConfig(), PPOHParams(), **values)
