"""Checks that an environment keeps the contract of `ppl_jax.types.Env`; a misfit is one line.

Shapes are found by tracing (`jax.eval_shape`); nothing is compiled and no step is made.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.cards import EnvCard
from ppl_jax.types import Env, EnvSpec, Outcome

_METHODS = ("reset", "reset_to", "step", "transition", "observe", "scenario_count", "readings")
_FLAGS = ("terminated", "truncated", "success", "unsafe", "physics_diverged")


def check_env(env: Any, name: str) -> None:
    """Check an environment before anything is compiled.

    Args:
        env: The environment.
        name: As it is registered, for the message.

    Raises:
        ValueError: One line that says what does not fit.
    """
    try:
        _check_attributes(env)
        _check_spec(env.spec)
        for pool in ("default_params", "held_out_params"):
            _check_pool(env, pool)
        _check_functions(env)
    except _DoesNotFit as error:
        message = f"environment {name!r} ({type(env).__name__}) does not fit: {error}"
        raise ValueError(message) from error.__cause__


class _DoesNotFit(Exception):
    """The part that does not fit."""


def _require(fits: bool, message: str) -> None:
    if not fits:
        raise _DoesNotFit(message)


def _check_attributes(env: Env) -> None:
    _require(isinstance(getattr(env, "name", None), str), "it has no name (a string)")
    for method in (*_METHODS, "scenario_numbers"):
        _require(
            callable(getattr(env, method, None)),
            f"it has no method {method} (envs.base.Environment has defaults for most)",
        )
    _require(
        isinstance(getattr(env, "spec", None), EnvSpec), "spec must be a ppl_jax.types.EnvSpec"
    )
    steps = getattr(env, "max_episode_steps", None)
    _require(_is_count(steps), f"max_episode_steps must be an int of 1 or more, got {steps!r}")
    _require(isinstance(getattr(env, "card", None), EnvCard), "card must be an envs.cards.EnvCard")
    _require(
        env.card.ranges is None or callable(getattr(env, "with_ranges", None)),
        "it has no method with_ranges(params, ranges), but its card has ranges",
    )
    for field in ("experts", "predictors"):
        found = getattr(env, field, None)
        named = isinstance(found, Mapping) and all(callable(value) for value in found.values())
        _require(named, f"{field} must map names to functions, got {found!r}")
    _require("simulator" in env.predictors, "predictors must have 'simulator', the true transition")


def _is_count(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 1)


def _check_spec(spec: EnvSpec) -> None:
    for field in ("observation_size", "action_size"):
        value = getattr(spec, field)
        _require(_is_count(value), f"spec.{field} must be an int of 1 or more, got {value!r}")
    for field in ("observation_mean", "observation_scale"):
        value, size = np.asarray(getattr(spec, field)), spec.observation_size
        _require(
            value.shape == (size,), f"spec.{field} must have shape ({size},), got {value.shape}"
        )
        _require(
            np.issubdtype(value.dtype, np.number) and bool(np.isfinite(value).all()),
            f"spec.{field} must be finite",
        )
    scale = np.asarray(spec.observation_scale)
    worst = int(np.argmin(scale))
    _require(
        bool((scale > 0).all()),
        f"spec.observation_scale must be positive, got {scale[worst]:g} at index {worst}",
    )


def _check_pool(env: Env, pool: str) -> None:
    _require(hasattr(env, pool), f"it has no {pool}")
    params = getattr(env, pool)
    count = _call(f"scenario_count({pool})", lambda: env.scenario_count(params))
    _require(_is_count(count), f"scenario_count({pool}) must be 1 or more, got {count!r}")
    numbers = _trace(f"scenario_numbers({pool})", env.scenario_numbers, params)
    _require(
        _is_array(numbers)
        and numbers.shape == (count,)
        and jnp.issubdtype(numbers.dtype, jnp.integer),
        f"scenario_numbers({pool}) must be {count} integers, got {_show(numbers)}",
    )


def _check_functions(env: Env) -> None:
    params, size = env.default_params, env.spec.observation_size
    index = jax.ShapeDtypeStruct((), jnp.int32)
    key = jax.eval_shape(lambda: jax.random.key(0))
    action = jax.ShapeDtypeStruct((env.spec.action_size,), jnp.float32)
    state = _trace("reset_to", env.reset_to, index, key, params)
    observation = _trace("observe", env.observe, state, params)
    _check_observation("observe", observation, size)
    drawn = _trace("reset", env.reset, key, params)
    _require(
        isinstance(drawn, tuple) and len(drawn) == 2,
        f"reset must return (observation, state), got {_show(drawn)}",
    )
    _check_observation("reset", drawn[0], size)
    _check_same_state("reset", state, drawn[1])
    for name, predictor in env.predictors.items():
        label = "transition" if name == "simulator" else f"predictors[{name!r}]"
        made = _trace(label, predictor, key, state, action, params)
        _require(
            isinstance(made, tuple) and len(made) == 2 and isinstance(made[1], Outcome),
            f"{label} must return (state, ppl_jax.types.Outcome), got {_show(made)}",
        )
        _check_same_state(label, state, made[0])
        _check_outcome(label, made[1])
    for name, expert in env.experts.items():
        label = f"experts[{name!r}]"
        acted = _trace(label, expert, key, state, observation, params)
        _require(
            _is_array(acted)
            and acted.shape == action.shape
            and jnp.issubdtype(acted.dtype, jnp.floating),
            f"{label} must return a float array of shape {action.shape} "
            f"(spec.action_size), got {_show(acted)}",
        )


def _check_observation(label: str, observation: Any, size: int) -> None:
    _require(
        _is_array(observation)
        and observation.shape == (size,)
        and jnp.issubdtype(observation.dtype, jnp.floating),
        f"{label} must return one flat float array of shape ({size},) "
        f"(spec.observation_size), got {_show(observation)}",
    )


def _check_same_state(label: str, before: Any, after: Any) -> None:
    """A state must keep its structure, shapes and types, since it is carried through loops."""
    old, new = jax.tree.structure(before), jax.tree.structure(after)
    _require(old == new, f"{label} must keep the state's structure {old}, got {new}")
    paths = jax.tree_util.tree_leaves_with_path(before)
    for (path, leaf), other in zip(paths, jax.tree.leaves(after), strict=True):
        where = jax.tree_util.keystr(path)
        _require(
            leaf.shape == other.shape and leaf.dtype == other.dtype,
            f"{label} must keep the state's shapes and types: state{where} was {_show(leaf)}, "
            f"became {_show(other)}",
        )


def _check_outcome(label: str, outcome: Outcome) -> None:
    for field in dataclasses.fields(Outcome):
        value = getattr(outcome, field.name)
        _require(
            _is_array(value) and value.shape == (),
            f"{label}: Outcome.{field.name} must be a scalar, got {_show(value)}",
        )
        if field.name in _FLAGS:
            _require(
                value.dtype == jnp.bool_,
                f"{label}: Outcome.{field.name} must be a boolean, got {_show(value)}",
            )


def _trace(label: str, function: Callable[..., Any], *arguments: Any) -> Any:
    return _call(label, functools.partial(jax.eval_shape, function, *arguments))


def _call(label: str, function: Callable[[], Any]) -> Any:
    try:
        return function()
    except Exception as error:  # the user's own code: anything may come
        lines = str(error).strip().splitlines() or [""]
        raise _DoesNotFit(f"{label} failed: {type(error).__name__}: {lines[0]}") from error


def _is_array(value: Any) -> bool:
    return hasattr(value, "shape") and hasattr(value, "dtype")


def _show(value: Any) -> str:
    if _is_array(value):
        return f"{value.dtype}{list(value.shape)}"
    return type(value).__name__
