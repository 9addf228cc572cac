"""Records and protocols that the rest of the package is written against."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.cards import EnvCard

PyTree = Any

Array = jax.Array | np.ndarray
"""JAX's or NumPy's: for what is packed in NumPy and goes to the device later."""


def in_single(tree: PyTree) -> PyTree:
    """A tree whose real numbers are in single precision, as methods keep them.

    An environment of one's own may give others under `jax_enable_x64`; the shipped ones do not.
    """

    def leaf(array: Any) -> jax.Array:
        array = jnp.asarray(array)
        real = jnp.issubdtype(array.dtype, jnp.floating)
        return array.astype(jnp.float32) if real else array

    return jax.tree.map(leaf, tree)


@flax.struct.dataclass
class StepInfo:
    """Step information beyond reward and termination; one struct for every environment.

    Attributes:
        cost: Safety cost of the step, >= 0.
        success: The task was solved in this step.
        unsafe: Something that must not happen happened (in driving: a crash, or off the road).
        progress: Share of the task done, in [0, 1].
        speed: Pace of the step (m/s in driving).
        final_observation: [O] observation before an automatic reset; the plain one otherwise.
    """

    cost: jax.Array
    success: jax.Array
    unsafe: jax.Array
    progress: jax.Array
    speed: jax.Array
    final_observation: jax.Array


@flax.struct.dataclass
class Outcome:
    """Result of a raw transition: no observation, no reset.

    Attributes:
        reward, cost, progress, speed: Scalars (see `StepInfo`).
        terminated, truncated, success, unsafe: Booleans.
        clearance: Distance to the nearest thing that would make it unsafe; inf where there is none
            or the environment does not say.
        physics_diverged: The physics gave a value that is not finite; the state is the one before,
            and the episode ends here.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    cost: jax.Array
    success: jax.Array
    unsafe: jax.Array
    progress: jax.Array
    speed: jax.Array
    clearance: jax.Array | np.float32 | float = np.float32(np.inf)
    physics_diverged: jax.Array | bool = False


@flax.struct.dataclass
class Trajectory:
    """A predicted trajectory of H steps, [H].

    Attributes:
        observation: [H, O] predicted observations, or [0, O] where none were asked for.
        reward, speed: Reward and speed of each predicted step.
        unsafe, success, terminated: Booleans.
        clearance: Distance to the nearest thing that would make each state unsafe.
        valid: The step was made: the prediction had not ended before it.
        expert_actions: [H, A] the expert's action at each predicted state, where it was asked, else
            None.
        position: [H, P] where each predicted state is, where that was asked, else None.
    """

    observation: jax.Array
    reward: jax.Array
    speed: jax.Array
    unsafe: jax.Array
    success: jax.Array
    terminated: jax.Array
    valid: jax.Array
    clearance: jax.Array | None = None
    expert_actions: jax.Array | None = None
    position: jax.Array | None = None


@flax.struct.dataclass
class Interaction:
    """One environment step, as passed to `Algorithm.store`.

    Attributes:
        observation, next_observation: [O]; the latter before any automatic reset.
        novice_action, expert_action, executed_action: [A].
        takeover: The expert was in control.
        takeover_start: It was not in the step before.
        reward, cost: Scalars.
        terminated, truncated, success: Booleans.
        predicted: First `max_preference_horizon` steps of the novice's held action, from here.
    """

    observation: jax.Array
    next_observation: jax.Array
    novice_action: jax.Array
    expert_action: jax.Array
    executed_action: jax.Array
    takeover: jax.Array
    takeover_start: jax.Array
    reward: jax.Array
    cost: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    success: jax.Array
    predicted: Trajectory


@flax.struct.dataclass
class DecisionPoint:
    """Inputs to the takeover decision.

    Attributes:
        observation: [O].
        novice_action, expert_action: [A] what either would do now.
        takeover: The expert has been in control until now.
        trajectory: Where the novice's action is predicted to lead.
        experts: Where the expert's are, if the method asks for it, else None.
        log_density: Log of the density that the expert gives to the novice's action; NaN where the
            expert has none (`ppl_jax.experts.log_density`).
    """

    observation: jax.Array
    novice_action: jax.Array
    expert_action: jax.Array
    takeover: jax.Array
    trajectory: Trajectory
    experts: Trajectory | None
    log_density: jax.Array


@flax.struct.dataclass
class PreferenceBatch:
    """Preference pairs, [B].

    Attributes:
        observation: [B, O] (predicted) state.
        preferred_action, rejected_action: [B, A]: the expert's and the novice's.
        rejected_observation: [B, O] state of the rejected action where it is another one (the
            released code's pairs), else None.
    """

    observation: jax.Array
    preferred_action: jax.Array
    rejected_action: jax.Array
    rejected_observation: jax.Array | None


class EnvSpec(NamedTuple):
    """Sizes of an environment, and how a network sees its observation.

    Attributes:
        observation_size, action_size: O and A.
        observation_mean, observation_scale: [O] constants of the environment; a network sees
            `(observation - mean) / scale`.
    """

    observation_size: int
    action_size: int
    observation_mean: np.ndarray
    observation_scale: np.ndarray

    def zeros(self) -> tuple[jax.Array, jax.Array]:
        """An observation [O] and an action [A] of zeros: what buffers and networks are made for."""
        return (
            jnp.zeros(self.observation_size, jnp.float32),
            jnp.zeros(self.action_size, jnp.float32),
        )


Expert = Callable[[jax.Array, PyTree, jax.Array, PyTree], jax.Array]
"""`expert(key, state, observation [O], params) -> action [A]`; pure."""

Transition = Callable[[jax.Array, PyTree, jax.Array, PyTree], tuple[PyTree, Outcome]]
"""`transition(key, state, action [A], params) -> (state, outcome)`; pure."""


class Env(Protocol):
    """An environment. All methods are pure; write them for one environment and `vmap` outside.

    Attributes:
        name: As in results and on the command line.
        spec: Sizes and scaling of observation and action.
        max_episode_steps: Time limit.
        default_params, held_out_params: Traced structs to train on and to evaluate on. Scenarios of
            either are numbered `0 .. scenario_count(params) - 1`.
    """

    name: str
    spec: EnvSpec
    max_episode_steps: int
    default_params: PyTree
    held_out_params: PyTree

    @property
    def experts(self) -> Mapping[str, Expert]:
        """Experts by name ("scripted", ...); empty where there is none."""
        ...

    @property
    def predictors(self) -> Mapping[str, Transition]:
        """Prediction steps by name: "simulator" (the true transition), "kinematic", ..."""
        ...

    @property
    def card(self) -> EnvCard:
        """Facts that are known without building it."""
        ...

    def reset(self, key: jax.Array, params: PyTree) -> tuple[jax.Array, PyTree]:
        """A random start: (observation [O], state)."""
        ...

    def reset_to(self, index: jax.Array, key: jax.Array, params: PyTree) -> PyTree:
        """The start of scenario `index`: a state."""
        ...

    def scenario_count(self, params: PyTree) -> int:
        """Number of scenarios in `params`."""
        ...

    def scenario_numbers(self, params: PyTree) -> jax.Array:
        """Number that results name each scenario by, [S]."""
        ...

    def readings(self, state: PyTree) -> list[tuple[str, str]]:
        """Figures of a concrete state to show a person, as (label, text)."""
        ...

    def transition(
        self, key: jax.Array, state: PyTree, action: jax.Array, params: PyTree
    ) -> tuple[PyTree, Outcome]:
        """One raw step: (state, outcome), without observation or reset."""
        ...

    def observe(self, state: PyTree, params: PyTree) -> jax.Array:
        """The observation of a state, [O]."""
        ...

    def step(
        self, key: jax.Array, state: PyTree, action: jax.Array, params: PyTree
    ) -> tuple[jax.Array, PyTree, jax.Array, jax.Array, jax.Array, StepInfo]:
        """One step with automatic reset: (obs, state, reward, terminated, truncated, info)."""
        ...
