"""Options of `ppl train`: the settings of one run, with the values it would really use."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import OmitArgPrefixes, Positional

from experiments.engine.fields import shown as show
from experiments.engine.runtime import UserError
from experiments.engine.settings import (
    RunSettings,
    default_interval,
    flat,
    read_run_settings,
    run_settings,
)
from experiments.options.hints import shown
from experiments.options.settings import (
    GROUPS,
    HELP_ALL,
    environments,
    option_fields,
    settings_in,
    shows_everything,
    word_after,
)
from ppl_jax.config import PRESETS, Setting, TrainConfig

EVALUATE_ON = "Scenarios that are played: held_out, training, or a set that `ppl list` names."
_EXPERT = (
    "scripted, neural (shipped), a policy file or run folder; or recorded PATH, a session or "
    "demonstrations."
)
_OWN: dict[str, list[Any]] = {
    "run": [
        ("algorithm", str, "ppl", "Method; `ppl list` names them."),
        ("seed", int, 0, "Random seed."),
        (
            "preset",
            Literal[PRESETS],
            "default",
            "Ours, the paper's to the letter, or the released code's.",
        ),  # pyright: ignore[reportInvalidTypeForm]
    ],
    "expert": [
        ("expert", tuple[Literal["recorded"], str] | str, "scripted", _EXPERT),
        ("reference_policy", str | None, None, "Policy file: the reference of dpo and ipo."),
    ],
    "evaluation": [
        (
            "evaluate_every",
            int,
            0,
            "Steps between evaluations and checkpoints; a tenth of the run.",
        ),
        ("evaluate_on", str, "held_out", EVALUATE_ON),
        (
            "scenarios",
            str | None,
            None,
            "Folder of recorded scenarios to train on (default: generated ones).",
        ),
        (
            "held_out_scenarios",
            str | None,
            None,
            "Folder of recorded scenarios to evaluate on (default: those of --scenarios).",
        ),
    ],
    "output": [
        ("out", Path | None, None, "Run folder (default: runs/ENV-ALGORITHM-SEED-TIME)."),
        ("resume", bool, False, "Continue the run in --out; its settings come from there."),
    ],
}


def train_options(argv: Sequence[str]) -> tuple[type, dict[str, Any]]:
    """The options of `ppl train` for a command line: a class for tyro, and each option's default.

    Raises:
        UserError: If the command line names an unknown method, gate, predictor or preset.
    """
    everything = shows_everything(argv)
    own = {name: default for group in _OWN.values() for name, _, default, _ in group}
    settings = settings_in(argv)
    before = _before(argv)
    if before is not None:
        own |= {name: getattr(before, name) for name in own if hasattr(before, name)}
        held = flat(before.config, before.hparams)
        settings = settings_in([before.env, *argv, "--algorithm", before.algorithm, *_owners(held)])
        settings = {
            name: one._replace(value=_like(held[name], one.value)) if name in held else one
            for name, one in settings.items()
        }
        own["evaluate_every"] = before.evaluate_every
    else:
        own["evaluate_every"] = _tenth(settings)
    groups = option_fields(settings, everything=everything)
    defaults = {**own, **{name: one.value for name, one in settings.items()}}
    members: list[Any] = [
        (
            "env",
            Annotated[str, Positional, tyro.conf.arg(help=f"One of {environments()}.")],
            dataclasses.field(default="" if before is None else before.env),
        )
    ]
    for group in GROUPS:
        fields = [
            (name, shown(kind, own[name], text=text), dataclasses.field(default=own[name]))
            for name, kind, _, text in _OWN.get(group, [])
        ] + groups[group]
        if fields:
            part = dataclasses.make_dataclass(group, fields)
            members.append((group, OmitArgPrefixes[part], dataclasses.field(default_factory=part)))
    made = dataclasses.make_dataclass("Train", members)
    made.__doc__ = (
        "Train one policy: progress, then the evaluation table; a run folder. "
        f"{HELP_ALL} shows every option."
    )
    return made, defaults


def _owners(held: Mapping[str, Any]) -> list[str]:
    """The options that decide which further settings a run has."""
    worlds = "--randomise" if held["randomise"] else "--no-randomise"
    return ["--gate", held["gate"], "--predictor", held["predictor"], worlds]


def _tenth(settings: Mapping[str, Setting]) -> int:
    """The default of evaluate_every: a tenth of a run with these settings."""
    names = ("total_steps", "demonstrations", "decision_interval")
    return default_interval(TrainConfig(**{name: settings[name].value for name in names}))


def _like(value: Any, model: Any) -> Any:
    """A value read from JSON as the type that the option has."""
    if isinstance(model, tuple):
        return tuple(value)
    if isinstance(model, int) and not isinstance(model, bool) and float(value).is_integer():
        return int(value)
    return value


def _before(argv: Sequence[str]) -> RunSettings | None:
    """The settings of the run that is to be continued, or None."""
    out = word_after(argv, "--out")
    if "--resume" not in argv:
        return None
    if out is None:
        raise UserError("--resume needs --out, the run folder to continue")
    return read_run_settings(Path(out))


@dataclasses.dataclass(frozen=True)
class TrainRequest:
    """A parsed `ppl train`.

    Attributes:
        settings: Settings of the run.
        out: Run folder, or None for a new one.
        resume: Continue the run in it.
    """

    settings: RunSettings
    out: Path | None
    resume: bool


def train_request(parsed: Any, defaults: dict[str, Any], argv: Sequence[str]) -> TrainRequest:
    """The request of a parsed command line.

    Raises:
        UserError: If a setting cannot work, or contradicts the run that is to be continued.
    """
    flat_options: dict[str, Any] = {}
    for group in GROUPS:
        flat_options |= vars(getattr(parsed, group, dataclasses.make_dataclass("None_", [])()))
    given = {k: v for k, v in flat_options.items() if v != defaults[k]}
    out = flat_options["out"]
    before = _before(argv)
    if before is not None:
        contradicting = [
            f"{name} is {show(defaults[name])}, asked for {show(value)}"
            for name, value in given.items()
            if name not in ("out", "resume")
        ]
        if parsed.env != before.env:
            contradicting.insert(0, f"env is {before.env!r}, asked for {parsed.env!r}")
        if contradicting:
            raise UserError(f"cannot resume {str(out)!r}: its {'; its '.join(contradicting)}")
        return TrainRequest(settings=before, out=out, resume=True)
    if not parsed.env:
        raise UserError(f"env: name the environment, one of {environments()}")
    expert = flat_options["expert"]
    asked = {*given, *_DECIDING}
    settings = run_settings(
        parsed.env,
        flat_options["algorithm"],
        flat_options["seed"],
        preset=flat_options["preset"],
        expert=expert if isinstance(expert, str) else " ".join(expert),
        reference_policy=flat_options["reference_policy"],
        scenarios=flat_options["scenarios"],
        held_out_scenarios=flat_options["held_out_scenarios"],
        evaluate_on=flat_options["evaluate_on"],
        evaluate_every=given.get("evaluate_every"),
        given={k: flat_options[k] for k in flat_options if k in asked and k not in _NOT_SETTINGS},
    )
    return TrainRequest(settings=settings, out=out, resume=False)


_DECIDING = ("gate", "predictor", "randomise")  # the defaults of others depend on them, as shown
_NOT_SETTINGS = {name for group in _OWN.values() for name, _, _, _ in group}
