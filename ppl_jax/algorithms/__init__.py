"""The learning methods, one file each, by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.algorithms.bc import make_bc
from ppl_jax.algorithms.eil import make_eil
from ppl_jax.algorithms.ensemble_dagger import make_ensemble_dagger
from ppl_jax.algorithms.gail import make_gail
from ppl_jax.algorithms.haco import make_haco, make_haco_port
from ppl_jax.algorithms.hg_dagger import make_hg_dagger
from ppl_jax.algorithms.iwr import make_iwr
from ppl_jax.algorithms.ppl import make_ppl
from ppl_jax.algorithms.pvp import make_pvp
from ppl_jax.algorithms.thrifty_dagger import make_thrifty_dagger
from ppl_jax.config import PRESETS, HParams, TrainConfig

Changes = Callable[[str], Mapping[str, Any]]
"""`changes(task)`: fields of `TrainConfig` and `HParams` that a method sets otherwise."""


class AlgorithmSpec(NamedTuple):
    """A registered method.

    Attributes:
        make: Builds it.
        changes: Settings that make it what it is.
        tuned: Settings that a search found, for the default preset alone.
        variant: It is another version of a method that is there already (a port that differs in
            substance): left out where all methods are compared.
    """

    make: MakeAlgorithm
    changes: Changes
    tuned: Mapping[str, Any]
    variant: bool = False


# what the paper gives the methods that learn from demonstrations alone
DEMONSTRATIONS = {"driving": 20_000, "table_wiping": 10_000, "nut_assembly": 100_000}
GAIL_STEPS = 1_000_000
WARM_UP = {"driving": 600, "table_wiping": 300, "nut_assembly": 300}  # about two episodes


def _bc(task: str) -> Mapping[str, Any]:
    steps = DEMONSTRATIONS.get(task, 10_000)
    return {
        "total_steps": steps,
        "demonstrations": steps,
        "human_capacity": steps,
        "offline_updates": 20_000,
    }


def _gail(task: str) -> Mapping[str, Any]:
    steps = DEMONSTRATIONS.get(task, 10_000)
    return {"total_steps": steps + GAIL_STEPS, "demonstrations": steps}


# several networks see every sample; the published sizes range from 50 (Thrifty-DAgger) and 128
# (PVP) to 1024 (HACO)
BATCH_OF_CRITICS = 128


def _warmed_up(task: str) -> Mapping[str, Any]:
    return {"demonstrations": WARM_UP.get(task, 300), "offline_updates": 1000}


def _thrifty(task: str) -> Mapping[str, Any]:
    return {**_warmed_up(task), "batch_size": BATCH_OF_CRITICS}


_METHODS: dict[str, AlgorithmSpec] = {}


def register(
    name: str,
    make: MakeAlgorithm,
    changes: Mapping[str, Any] | Changes | None = None,
    tuned: Mapping[str, Any] | None = None,
    variant: bool = False,
) -> None:
    """Make a method known by name, to `make_train`, the command line and every comparison.

    Args:
        name: As the user types it.
        make: `make(spec, config) -> Algorithm`.
        changes: Settings it has otherwise than the others: fields of `TrainConfig` and `HParams`,
            or a function from the task's name to them.
        tuned: The same, but left out by the presets that stand for somebody's published settings.
        variant: Leave it out where all methods are compared.

    Raises:
        ValueError: If the name is taken, or a field is unknown.
    """
    if name in _METHODS:
        raise ValueError(f"algorithm {name!r} is registered already")
    function = changes if callable(changes) else lambda task: changes or {}
    known = {f.name for cls in (TrainConfig, HParams) for f in dataclasses.fields(cls)}
    unknown = {*function("driving"), *(tuned or {})} - known
    if unknown:
        raise ValueError(f"algorithm {name!r} changes unknown fields: {', '.join(sorted(unknown))}")
    _METHODS[name] = AlgorithmSpec(make, function, tuned or {}, variant)


# `tuned` is the best of four settings each, found by `ppl tune driving --seeds 1` on training
# scenarios after 3,000 steps (experiments/results/driving_tuning.csv), and used in every world
_CRITICS = {"batch_size": BATCH_OF_CRITICS}
_VALUES_ALONE = {**_CRITICS, "bc_weight": 0.0}  # no cloning term in the published losses

register("ppl", make_ppl, tuned={"learning_rate": 1e-3})
register("bc", make_bc, _bc, {"likelihood": "laplace"})
register("gail", make_gail, _gail, {"survival_correction": 0.0})
register("hg_dagger", make_hg_dagger, tuned={"likelihood": "laplace"})
register("ensemble_dagger", make_ensemble_dagger, _warmed_up, {"max_discrepancy": 0.1})
register(
    "thrifty_dagger",
    make_thrifty_dagger,
    _thrifty,
    {"learning_rate": 1e-3, "switch_rate": 0.05},
)
register("iwr", make_iwr, _warmed_up, {"likelihood": "laplace"})
register("eil", make_eil, _VALUES_ALONE, {"margin": 1.0})
register("haco", make_haco, _CRITICS, {"conservative_weight": 10.0})
register("haco_port", make_haco_port, {**_CRITICS, "conservative_weight": 1.0}, variant=True)
register("pvp", make_pvp, _VALUES_ALONE, {"discount": 0.9})
register("pvp4real", make_pvp, _CRITICS, {"discount": 0.9}, variant=True)


def registered(variants: bool = True) -> list[str]:
    """Names of the methods, in order."""
    return [name for name, method in _METHODS.items() if variants or not method.variant]


def method(name: str) -> AlgorithmSpec:
    """A method by name.

    Raises:
        ValueError: If there is none.
    """
    if name not in _METHODS:
        raise ValueError(f"unknown algorithm {name!r}: choose one of {', '.join(_METHODS)}")
    return _METHODS[name]


def settings(name: str, task: str, preset: str = "default") -> tuple[TrainConfig, HParams]:
    """A method's settings for a task: the preset's, with the method's own changes.

    Raises:
        ValueError: If the method is unknown, or the preset is not for the task.
    """
    config, hparams = PRESETS[preset](task)
    changes = dict(method(name).changes(task))
    if preset == "default":
        changes |= method(name).tuned
    static = {f.name for f in dataclasses.fields(TrainConfig)}
    config = dataclasses.replace(config, **{k: v for k, v in changes.items() if k in static})
    hparams = dataclasses.replace(hparams, **{k: v for k, v in changes.items() if k not in static})
    return config, hparams


__all__ = [
    "Algorithm",
    "AlgorithmSpec",
    "MakeAlgorithm",
    "method",
    "register",
    "registered",
    "settings",
]
