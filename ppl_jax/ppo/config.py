"""Settings of PPO-Lagrangian: `PPOHParams` are traced, `PPOConfig` is static."""

from __future__ import annotations

import dataclasses
from typing import Literal

import flax.struct
import jax
import numpy as np


@flax.struct.dataclass
class PPOHParams:
    """Traced settings.

    Attributes:
        learning_rate: Of Adam; it falls linearly to 0 over the run.
        discount, cost_discount: gamma of the reward and of the cost. Where a rare episode costs
            hundreds, a long horizon drowns the small costs that could be avoided.
        gae_lambda: GAE's lambda, of both.
        clip: e.
        target_kl: Mean KL from the policy that played at which a batch's policy updates stop.
        max_grad_norm: Norm to which gradients are clipped.
        entropy_coef: Of the policy's entropy.
        cost_limit: d, mean cost per episode.
        terminate_on_cost: 1 where nothing is worth anything after a step that costs: for its advantages an
            episode ends there (the early-terminated problem of Sun et al. 2021, "Safe Exploration
            by Solving Early Terminated MDP"), though the world goes on. Then no kind of failure,
            such as leaving the road, is a way out of a longer one. 0 leaves it as it is.
        initial_multiplier, lagrangian_lr: lambda at the start, and Adam's rate for p.
        initial_std, min_std: Of the actions, at the start and at least.
        final_std: Bound on it at the end; from `initial_std` it moves there geometrically. Noise
            that is clipped at the action box changes what a policy does on average, so that one
            evaluated without noise had better have been trained with little of it.
        success_bonus: Added to the reward in the step that solves the task, while training. Where
            solving it ends the episode and a state shortly before pays every step, return alone
            would have the policy loiter there.
        demonstration_noise: Standard deviation of the noise under which the expert demonstrates.
        guidance_weight: Of the distance from the expert's action, where the policy is guided.
    """

    learning_rate: jax.Array | float = 3e-4
    discount: jax.Array | float = 0.99
    cost_discount: jax.Array | float = 0.99
    gae_lambda: jax.Array | float = 0.95
    clip: jax.Array | float = 0.2
    target_kl: jax.Array | float = 0.02
    max_grad_norm: jax.Array | float = 0.5
    entropy_coef: jax.Array | float = 0.0
    cost_limit: jax.Array | float = 1.0
    terminate_on_cost: jax.Array | float = 0.0
    initial_multiplier: jax.Array | float = 1.0
    lagrangian_lr: jax.Array | float = 0.01
    initial_std: jax.Array | float = 0.5
    min_std: jax.Array | float = 0.05
    final_std: jax.Array | float = 1.0
    success_bonus: jax.Array | float = 0.0
    demonstration_noise: jax.Array | float = 0.3
    guidance_weight: jax.Array | float = 1.0


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """What sets shapes and programs.

    Attributes:
        total_steps: Environment steps, rounded up to whole batches; demonstrations not counted.
        worlds: Stepped side by side.
        rollout_steps: Of each world per batch.
        epochs, num_minibatches: Passes over a batch, and updates per pass.
        hidden: Widths of the hidden layers of policy and critics.
        scaling: Inputs are centred and scaled by running statistics of what was seen, or by the
            world's constants.
        demonstrations: Steps that an expert labels with what it would do, under noise, and that
            the policy clones first.
        demonstration_stride: Of so many steps of a world the one is kept at which the clone is
            furthest from the expert: steps that follow each other look alike, and what a clone
            lacks is situations.
        demonstration_rounds: Into which these are split: the expert plays the first, the clone the
            others.
        cloning: Likelihood that is cloned (see `ppl_jax.distributions`): "laplace" goes for the
            median of what the expert does in states that look alike, "gaussian" for the mean.
        cloning_updates: Updates of that, over all rounds.
        guided: The expert also says at every step of the training what it would do.
        critic_batches: Batches at the start in which only the critics learn.
    """

    total_steps: int = 20_000_000
    num_envs: int = 64
    rollout_steps: int = 256
    epochs: int = 5
    num_minibatches: int = 8
    hidden: tuple[int, ...] = (256, 256)
    scaling: Literal["running", "world"] = "running"
    demonstrations: int = 0
    demonstration_stride: int = 1
    demonstration_rounds: int = 1
    cloning: Literal["laplace", "gaussian"] = "laplace"
    cloning_updates: int = 20_000
    guided: bool = False
    critic_batches: int = 0

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
    for field in (
        "total_steps",
        "num_envs",
        "rollout_steps",
        "epochs",
        "num_minibatches",
        "demonstration_rounds",
        "demonstration_stride",
    ):
        if getattr(config, field) < 1:
            raise ValueError(f"{field} must be at least 1, got {getattr(config, field)}")
    for field in ("demonstrations", "cloning_updates", "critic_batches"):
        if getattr(config, field) < 0:
            raise ValueError(f"{field} must not be negative, got {getattr(config, field)}")
    if not config.hidden or min(config.hidden) < 1:
        raise ValueError(f"hidden must name at least one width of 1 or more, got {config.hidden}")
    if config.batch_steps % config.num_minibatches:
        raise ValueError(
            f"num_minibatches must divide num_envs x rollout_steps ({config.batch_steps}), got "
            f"{config.num_minibatches}"
        )
    for name, value in dataclasses.asdict(hparams).items():
        above = name in (
            "initial_multiplier",
            "initial_std",
            "min_std",
            "final_std",
            "clip",
            "max_grad_norm",
        )
        if not (value > 0 if above else value >= 0) or not np.isfinite(value):
            what = "positive" if above else "a number of 0 or more"
            raise ValueError(f"{name} must be {what}, got {value}")
    for name in ("discount", "cost_discount", "gae_lambda", "terminate_on_cost"):
        if getattr(hparams, name) > 1:
            raise ValueError(f"{name} must lie between 0 and 1, got {getattr(hparams, name)}")
