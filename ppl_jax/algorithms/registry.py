"""Learning methods by name, and the settings that a run of one starts from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ppl_jax.algorithms.base import MakeAlgorithm
from ppl_jax.cards import DEFAULT, EnvCard, card
from ppl_jax.config import (
    HParams,
    NoConfig,
    NoHParams,
    TrainConfig,
    catalogue,
    check_range,
    check_unique,
    did_you_mean,
    preset_values,
    replace,
    settings_fields,
    world_ranges,
)
from ppl_jax.gates import gate
from ppl_jax.plugins import note_caller
from ppl_jax.predictors import predictor

Changes = Callable[[EnvCard], Mapping[str, Any]]
"""`changes(card)`: flat settings that a method sets otherwise in an environment."""

Derive = Callable[[TrainConfig, HParams, Mapping[str, Any]], tuple[TrainConfig, HParams]]
"""`derive(config, hparams, given)`: settings that follow from others, `given` being those that
somebody asked for by name."""


class AlgorithmSpec(NamedTuple):
    """A registered method.

    Attributes:
        make: Builds it.
        config, hparams: Classes of its own static and traced settings.
        changes: Settings that make it what it is.
        tuned: Settings that a search found, for the preset "default" alone.
        derive: Settings that follow from others.
        gated: A gate decides who acts; not so where the method's own rule does, or nobody.
        variant: It is another version of a method that is there already (a port that differs in
            substance): left out where all methods are compared.
        grid: Values of settings that `ppl tune` tries, by name.
        cost: Time of a training step as a multiple of PPL's, for estimates.
    """

    make: MakeAlgorithm
    config: type
    hparams: type
    changes: Changes
    tuned: Mapping[str, Any]
    derive: Derive
    gated: bool = True
    variant: bool = False
    grid: Mapping[str, tuple[Any, ...]] = {}
    cost: float = 1.0


_METHODS: dict[str, AlgorithmSpec] = {}


def _nothing_follows(
    config: TrainConfig, hparams: HParams, given: Mapping[str, Any]
) -> tuple[TrainConfig, HParams]:
    return config, hparams


def register(
    name: str,
    make: MakeAlgorithm,
    changes: Mapping[str, Any] | Changes | None = None,
    tuned: Mapping[str, Any] | None = None,
    *,
    config: type = NoConfig,
    hparams: type = NoHParams,
    derive: Derive = _nothing_follows,
    gated: bool = True,
    variant: bool = False,
    grid: Mapping[str, tuple[Any, ...]] | None = None,
    cost: float = 1.0,
) -> None:
    """Make a method known by name, to `make_train`, the command line and every comparison.

    Args:
        name: As the user types it.
        make: `make(spec, config) -> Algorithm`.
        changes: Settings it has otherwise than the others by their flat names, or a function from
            the environment's card to them.
        tuned: The same, but left out by the presets that stand for somebody's published settings.
        config: Class of its own static settings: a frozen dataclass whose fields are made by
            `ppl_jax.fields.setting`. The method reads them as `config.method`.
        hparams: Class of its own traced settings, a `flax.struct.dataclass` of such fields. The
            method reads them as `hparams.method`.
        derive: Settings that follow from others.
        gated: Whether a gate decides who acts.
        variant: Leave it out where all methods are compared.
        grid: Values of settings that `ppl tune` tries.
        cost: Time of a training step as a multiple of PPL's, for estimates.

    Raises:
        ValueError: If the name is taken, a setting's name is, or a changed setting is unknown.
    """
    if name in _METHODS:
        raise ValueError(f"algorithm {name!r} is registered already")
    check_unique(config, hparams)
    function = changes if callable(changes) else lambda card: changes or {}
    known = {
        field for cls in (TrainConfig, HParams, config, hparams) for field in settings_fields(cls)
    }
    unknown = {*function(DEFAULT), *(tuned or {}), *(grid or {})} - known
    if unknown:
        raise ValueError(f"algorithm {name!r} changes unknown fields: {', '.join(sorted(unknown))}")
    note_caller()
    _METHODS[name] = AlgorithmSpec(
        make=make,
        config=config,
        hparams=hparams,
        changes=function,
        tuned=tuned or {},
        derive=derive,
        gated=gated,
        variant=variant,
        grid=grid or {},
        cost=cost,
    )


def registered(variants: bool = True) -> list[str]:
    """Names of the methods, in order."""
    return [name for name, spec in _METHODS.items() if variants or not spec.variant]


def method(name: str) -> AlgorithmSpec:
    """A method by name.

    Raises:
        ValueError: If there is none.
    """
    if name not in _METHODS:
        raise ValueError(
            f"unknown algorithm {name!r}: choose one of {', '.join(_METHODS)}"
            + did_you_mean(name, _METHODS)
        )
    return _METHODS[name]


def settings(
    name: str, env: str, preset: str = "default", **given: Any
) -> tuple[TrainConfig, HParams]:
    """The settings of a run: the preset's for the environment, the method's own, those given.

    Args:
        name: The method's name.
        env: Name of the environment.
        preset: "default", "paper" or "reference".
        **given: Settings by their flat names; `gate`, `predictor` and `randomise` decide which
            further ones there are.

    Raises:
        ValueError: If a name is unknown, or the preset is not for the environment, or it cannot be
            randomised.
    """
    spec = method(name)
    assumed = {**preset_values(preset, env), **spec.changes(card(env))}
    if preset == "default":
        assumed |= spec.tuned
    chosen = {name: getattr(TrainConfig(), name) for name in ("gate", "predictor", "randomise")}
    chosen |= {k: v for k, v in (assumed | given).items() if k in chosen}
    config = TrainConfig(**chosen, method=spec.config())
    hparams = HParams(
        method=spec.hparams(),
        gate=gate(chosen["gate"]).hparams(),
        predictor=predictor(chosen["predictor"]).hparams(),
        world=world_ranges(env, chosen["randomise"]),
    )
    known = catalogue(config, hparams)
    owned = {key: value for key, value in assumed.items() if key in known}
    config, hparams = replace(config, hparams, **owned)
    for setting in given:
        if setting not in known:
            check_range(env, setting)
    config, hparams = replace(config, hparams, **given)
    return spec.derive(config, hparams, given)
