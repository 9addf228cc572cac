"""The predictor f(s, a, H): what would happen if an action were held for H steps.

It rolls any transition function forward by value, so the state it started from is untouched.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from ppl_jax.config import NoHParams, check_unique, did_you_mean
from ppl_jax.plugins import note_caller
from ppl_jax.types import Env, Expert, Outcome, Trajectory, Transition

Act = Callable[[jax.Array, jax.Array], jax.Array]
"""`act(key, observation [O]) -> action [A]`."""


def predict(
    env: Env,
    transition: Transition,
    key: jax.Array,
    state: Any,
    *,
    action: jax.Array,
    params: Any,
    horizon: int,
    observe: bool = False,
    act: Act | None = None,
    expert: Expert | None = None,
    labelling_expert: Expert | None = None,
    place: Callable[[Any], jax.Array] | None = None,
) -> Trajectory:
    """Roll `horizon` steps from `state`.

    After the prediction has ended, its state stays as it was and its steps are not `valid`.

    Args:
        env: For observations.
        transition: The environment's own, or another (see `ppl_jax.types.Transition`).
        key: For a random transition.
        state: Start.
        action: [A] held through the prediction, or only its first action where `act` is given.
        params: Parameters of the environment.
        horizon: H, static.
        observe: Also return the observation of every predicted state.
        act: Policy asked again at every predicted state (the released code's gate).
        expert: Expert asked at every predicted state, the first included; `action` is ignored.
        labelling_expert: Expert that only says what it would do at every predicted state.
        place: `place(state) -> position [P]`, to see where it goes.
    """

    def step(carry: Any, key: jax.Array) -> tuple[Any, Trajectory]:
        state, action, alive = carry
        if expert is not None:
            key, key_expert = jax.random.split(key)
            action = expert(key_expert, state, env.observe(state, params), params)
        after, outcome = transition(key, state, action, params)
        after = jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, state)
        empty = jnp.zeros((0,), jnp.float32)
        observation = env.observe(after, params) if observe or act is not None else empty
        if act is not None:
            action = act(jax.random.fold_in(key, 1), observation)
        expert_actions = None
        if labelling_expert is not None:
            expert_actions = labelling_expert(key, after, env.observe(after, params), params)
        predicted = Trajectory(
            observation=observation if observe else empty,
            reward=jnp.where(alive, outcome.reward, 0.0),
            speed=jnp.where(alive, outcome.speed, 0.0),
            unsafe=alive & outcome.unsafe,
            success=alive & outcome.success,
            terminated=alive & outcome.terminated,
            valid=alive,
            clearance=jnp.where(alive, outcome.clearance, jnp.inf),
            expert_actions=expert_actions,
            position=None if place is None else place(after),
        )
        alive = alive & ~(outcome.terminated | outcome.truncated)
        return (after, action, alive), predicted

    keys = jax.random.split(key, horizon)
    return jax.lax.scan(step, (state, action, jnp.ones((), bool)), keys)[1]


def add_noise(key: jax.Array, observation: jax.Array, epsilon: jax.Array | float) -> jax.Array:
    """Disturb predicted observations [..., O] by Gaussian noise e scaled to |e| = epsilon |s|.

    The paper's robustness study ("imperfect predictors").
    """
    noise = jax.random.normal(key, observation.shape, jnp.float32)
    norm = jnp.linalg.norm(observation, axis=-1, keepdims=True)
    length = jnp.linalg.norm(noise, axis=-1, keepdims=True)
    return observation + epsilon * norm / jnp.maximum(length, 1e-12) * noise


def imperfect(transition: Transition, epsilon: jax.Array | float) -> Transition:
    """The transition of a predictor whose every step is off by epsilon.

        s'~ = s' + e,   |e| = epsilon |s' - s|

    for each array of real numbers in the state, in a random direction; errors add up along a
    prediction. Other arrays (counters, flags) stay as they are, and so does the outcome, which is
    that of the step from the disturbed state before.

    Args:
        transition: See `ppl_jax.types.Transition`.
        epsilon: Relative error, traced.
    """

    def disturbed(key: jax.Array, state: Any, action: jax.Array, params: Any) -> Any:
        key, key_noise = jax.random.split(key)
        after, outcome = transition(key, state, action, params)
        before, new = jax.tree.leaves(state), jax.tree.leaves(after)
        keys = jax.random.split(key_noise, len(new))
        off = [_off(*each, epsilon) for each in zip(keys, before, new, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(after), off), outcome

    return disturbed


def _off(key: jax.Array, before: Any, after: Any, epsilon: jax.Array | float) -> Any:
    """One array of a state, disturbed by epsilon times the length of its change."""
    if not jnp.issubdtype(after.dtype, jnp.floating) or after.size == 0:
        return after
    noise = jax.random.normal(key, after.shape, after.dtype)
    length = jnp.linalg.norm(jnp.ravel(after - before)) / jnp.linalg.norm(jnp.ravel(noise))
    return after + epsilon * length * noise


class Predictor(NamedTuple):
    """A registered predictor.

    Attributes:
        make: `make(env) -> transition(key, state, action, params, *, hparams)`, the transition
            that predictions use; `hparams` are the predictor's own. It raises `ValueError` where
            the environment has none.
        hparams: Class of its traced settings.
    """

    make: Callable[[Env], Callable[..., tuple[Any, Outcome]]]
    hparams: type = NoHParams


def _environments_own(name: str, about: str) -> Callable[[Env], Callable[..., tuple[Any, Outcome]]]:
    """A predictor that the environment brings: `env.predictors[name]`."""

    def make(env: Env) -> Callable[..., tuple[Any, Outcome]]:
        if name not in env.predictors:
            raise ValueError(
                f"environment {env.name!r} has no predictor {name!r}: choose one of "
                f"{', '.join(env.predictors)}"
            )
        transition = env.predictors[name]

        def predicted(
            key: jax.Array, state: Any, action: jax.Array, params: Any, *, hparams: Any
        ) -> tuple[Any, Outcome]:
            del hparams
            return transition(key, state, action, params)

        return predicted

    make.__doc__ = about
    return make


_PREDICTORS: dict[str, Predictor] = {}


def register_predictor(
    name: str,
    make: Callable[[Env], Callable[..., tuple[Any, Outcome]]],
    *,
    hparams: type = NoHParams,
) -> None:
    """Make a predictor known by name, to every environment and to the command line.

    Args:
        name: As in `--predictor NAME`.
        make: `make(env) -> transition(key, state, action, params, *, hparams) -> (state, outcome)`;
            it raises `ValueError` for an environment that it cannot predict.
        hparams: Class of its own traced settings: a `flax.struct.dataclass` whose fields are made
            by `ppl_jax.fields.setting(..., group="predictor")`.

    Raises:
        ValueError: If the name is taken, or a setting's is.
    """
    if name in _PREDICTORS:
        raise ValueError(f"predictor {name!r} is registered already")
    check_unique(hparams)
    note_caller()
    _PREDICTORS[name] = Predictor(make, hparams)


register_predictor("simulator", _environments_own("simulator", "The environment's own transition."))
register_predictor(
    "kinematic", _environments_own("kinematic", "Driving: the car alone, without traffic.")
)


def registered_predictors() -> tuple[str, ...]:
    """Names of the predictors, in order."""
    return tuple(_PREDICTORS)


def predictor(name: str) -> Predictor:
    """A predictor by name.

    Raises:
        ValueError: If there is none.
    """
    if name not in _PREDICTORS:
        raise ValueError(
            f"predictor must be one of {', '.join(_PREDICTORS)}, got {name!r}"
            f"{did_you_mean(name, _PREDICTORS)}"
        )
    return _PREDICTORS[name]
