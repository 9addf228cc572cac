"""Records and protocols that the rest of the package is written against."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import flax.struct
import jax

PyTree = Any


@flax.struct.dataclass
class StepInfo:
    """What a transition tells beside reward and ends; a fixed struct for every world.

    Attributes:
        cost: Safety cost of the step, >= 0.
        success: The task was solved in this step.
        unsafe: A predicted step like this one makes the expert take over (crash, off the road).
        progress: Share of the task done, in [0, 1].
        speed: Pace of the step (m/s in driving), for gates on slowness.
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
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    cost: jax.Array
    success: jax.Array
    unsafe: jax.Array
    progress: jax.Array
    speed: jax.Array


@runtime_checkable
class Env(Protocol):
    """A world. All methods are pure; write for one world and `vmap` outside.

    `params` is a traced struct; `default_params` gives the training one. Scenarios are numbered
    `0 .. params_count - 1`; `reset` draws one, `reset_to` takes one by its index.
    """

    name: str
    observation_size: int
    action_size: int
    max_episode_steps: int

    def reset(self, key: jax.Array, params: PyTree) -> tuple[jax.Array, PyTree]:
        """A random start: (observation [O], state)."""
        ...

    def reset_to(self, index: jax.Array, key: jax.Array, params: PyTree) -> PyTree:
        """The start of scenario `index`: a state."""
        ...

    def scenario_count(self, params: PyTree) -> int:
        """Number of scenarios in `params`."""
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


# An expert proposes an action from the state or the observation; both are pure.
Expert = Callable[[jax.Array, PyTree, jax.Array, PyTree], jax.Array]
"""`expert(key, state, observation [O], params) -> action [A]`."""

Policy = Callable[[PyTree, jax.Array], jax.Array]
"""`policy(parameters, observation [O]) -> action [A]`, deterministic."""
