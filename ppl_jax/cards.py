"""Facts about an environment that need no building of it.

A card is plain data: rates, units, budgets, and what the presets change for this environment. It
imports no JAX, so that a command line can read it before anything heavy starts.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Mapping
from typing import Any, Literal

from ppl_jax.packages import own_packages

Changes = Mapping[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExpertCard:
    """How an environment's shipped neural expert was trained, beside the defaults of PPO.

    Attributes:
        config, hparams: Fields of `ppl_jax.ppo.config.PPOConfig` and `PPOHParams`.
        scenarios: Number of generated scenarios it trained on; the environment's own where 0.
        teacher: The expert (a key of `Env.experts`) that it is cloned from.
    """

    config: Changes = dataclasses.field(default_factory=dict)
    hparams: Changes = dataclasses.field(default_factory=dict)
    scenarios: int = 0
    teacher: str = "scripted"


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvCard:
    """Facts of an environment; the defaults serve an environment of one's own.

    Attributes:
        title: For headings.
        summary: One sentence, for lists.
        control_rate: Steps per second, Hz.
        speed_unit, place_unit: Units of `Outcome.speed` and of the place on a predicted path.
        actions: Names of the action's components; () where they have none.
        view: How it is drawn: "road" from above, "arm" through MuJoCo; None where it cannot be.
        camera: Camera of an arm's view: lookat (m), distance (m), azimuth and elevation (degrees).
        physics: Names of the physics engines that can run it; () where there is no choice.
        ranges: Makes the settings class that its worlds are drawn within where `randomise` is on (a
            function, so that the card needs no JAX; the environment then has
            `with_ranges(params, ranges)`); None where it cannot be randomised.
        predictors: Names of its prediction steps.
        experts: Names of its experts.
        neural_expert: A neural expert is shipped.
        demonstrations: Steps given to methods that learn from demonstrations alone.
        warm_up: Steps demonstrated before methods that start from a few (about two episodes).
        settings: Settings that every preset changes for this environment.
        preset_settings: Settings that one preset changes besides, by the preset's name.
        missing_presets: Presets that are not for this environment.
        sets: Further sets of generated scenarios that evaluations may play, by name: their numbers,
            which the maker takes as `held_out`.
        step_ms: Time of a training step on one core at batch 256, ms, for estimates.
        compile_s: Time to compile its training program for the first time, s, for estimates.
        expert: How its neural expert is trained.
    """

    title: str = ""
    summary: str = ""
    control_rate: float = 10.0
    speed_unit: str = "m/s"
    place_unit: str = "m"
    actions: tuple[str, ...] = ()
    view: Literal["road", "arm"] | None = None
    camera: Changes = dataclasses.field(default_factory=dict)
    physics: tuple[str, ...] = ()
    ranges: Callable[[], Any] | None = None
    predictors: tuple[str, ...] = ("simulator",)
    experts: tuple[str, ...] = ("scripted",)
    neural_expert: bool = False
    demonstrations: int = 10_000
    warm_up: int = 300
    settings: Changes = dataclasses.field(default_factory=dict)
    preset_settings: Mapping[str, Changes] = dataclasses.field(default_factory=dict)
    missing_presets: tuple[str, ...] = ()
    sets: Mapping[str, tuple[int, ...]] = dataclasses.field(default_factory=dict)
    step_ms: float = 5.0
    compile_s: float = 25.0
    expert: ExpertCard = dataclasses.field(default_factory=ExpertCard)

    def changes(self, preset: str) -> dict[str, Any]:
        """Settings that `preset` changes for this environment.

        Raises:
            ValueError: If the preset is not for it.
        """
        if preset in self.missing_presets:
            raise ValueError(f"preset {preset!r} is not for this environment")
        return {**self.settings, **self.preset_settings.get(preset, {})}


DEFAULT = EnvCard()
_SHIPPED = "envs.registry"  # the package that registers the shipped environments
_CARDS: dict[str, EnvCard] = {}


def register_card(name: str, card: EnvCard) -> None:
    """Keep the card of an environment; `envs.register` calls this."""
    _CARDS[name] = card


def card(name: str) -> EnvCard:
    """The card of an environment; the default one where it has none of its own."""
    if name not in _CARDS:
        own_packages()
        importlib.import_module(_SHIPPED)  # registers the shipped ones; imports no JAX
    return _CARDS.get(name, DEFAULT)
