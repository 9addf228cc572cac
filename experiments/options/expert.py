"""Options of `ppl expert train`: the settings of one expert's run, with their true values."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import OmitArgPrefixes, Positional

from envs.registry import known, unknown
from experiments.engine.expert_settings import (
    PLAIN,
    ExpertSettings,
    check,
    default_interval,
    read_settings,
    settings_for,
)
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError
from experiments.engine.settings import refuse_contradictions
from experiments.options.commands import ExpertTrain
from experiments.options.hints import shown
from experiments.options.settings import (
    HELP_ALL,
    environments,
    environments_in,
    is_given,
    option_fields,
    refuse_old_names,
    shows_everything,
    word_after,
)
from ppl_jax.ppo.config import OLD_NAMES, PPOConfig, PPOHParams, catalogue, replace

GROUPS = ("run", "updates", "cost", "policy", "demonstrations", "evaluation", "output")
_OWN: dict[str, list[tuple[str, Any, str]]] = {
    "run": [
        ("seed", int, "Random seed."),
        (
            "training_scenarios",
            int,
            "Generated scenarios to train on, numbered from 10,000; 0 for the novice's.",
        ),
        ("scenarios", str | None, "Folder of recorded scenarios to train on instead."),
        ("physics", str, "Physics engine of the environment; `ppl list` names them."),
    ],
    "evaluation": [
        (
            "evaluate_every",
            int,
            "Batches between evaluations and checkpoints; a fortieth of the run.",
        ),
        (
            "held_out_scenarios",
            str | None,
            "Folder of recorded scenarios to evaluate on (default: those of --scenarios).",
        ),
    ],
    "output": [
        ("out", Path | None, "Run folder (default: runs/ENV-expert-SEED-TIME)."),
        ("resume", bool, "Continue the run in --out; its settings come from there."),
    ],
}


@dataclasses.dataclass(frozen=True)
class ExpertTrainRequest:
    """A parsed `ppl expert train`.

    Attributes:
        settings: All that defines the run.
        out: Run folder, or None for a new one.
        resume: Continue the run in it.
    """

    settings: ExpertSettings
    out: Path | None
    resume: bool


@dataclasses.dataclass(frozen=True)
class ExpertOptions:
    """The options of one command line.

    Attributes:
        cls: Class for tyro.
        env: The environment whose defaults they show; "" where none is named.
        before: Settings of the run that is to be continued, or None.
    """

    cls: type
    env: str
    before: ExpertSettings | None


def new_settings(env: str) -> ExpertSettings:
    """The settings of a run for which nothing but the environment is given."""
    config, hparams, scenarios = settings_for(env)
    return ExpertSettings(
        env=env,
        seed=0,
        config=config,
        hparams=hparams,
        training_scenarios=scenarios,
        evaluate_every=default_interval(config),
    )


def values_of(settings: ExpertSettings) -> dict[str, Any]:
    """Everything that defines a run as one level of names, the settings of PPO-Lagrangian first."""
    found = {k: one.value for k, one in catalogue(settings.config, settings.hparams).items()}
    return found | {name: getattr(settings, name) for name in PLAIN}


def expert_options(argv: Sequence[str]) -> ExpertOptions:
    """The options of `ppl expert train` for a command line.

    Args:
        argv: The words after the command.

    Raises:
        UserError: If an old name is used, or the run to be continued cannot be read.
    """
    refuse_old_names(argv, OLD_NAMES, {})
    before = _before(argv)
    env = before.env if before is not None else next(iter(environments_in(argv)), "")
    start = before or new_settings(env)
    defaults = {"out": None, "resume": False, **values_of(start)}
    settings = catalogue(start.config, start.hparams)
    groups = option_fields(settings, everything=shows_everything(argv), groups=GROUPS)
    hint = f"(default: {env})" if before is not None else "(required)"
    told = tyro.conf.arg(
        metavar="ENV",
        help=f"One of {environments()}, brax:NAME.",
        help_behavior_hint=hint,
    )
    members: list[Any] = [
        (
            "env",
            Annotated[str, Positional, told],
            dataclasses.field(default=env if before is not None else ""),
        )
    ]
    for group in GROUPS:
        fields = [
            (
                name,
                shown(kind, defaults[name], text=text),
                dataclasses.field(default=defaults[name]),
            )
            for name, kind, text in _OWN.get(group, [])
        ]
        part = dataclasses.make_dataclass(group, fields + groups[group])
        members.append((group, OmitArgPrefixes[part], dataclasses.field(default_factory=part)))
    cls = dataclasses.make_dataclass("ExpertTrain", members)
    cls.__doc__ = f"{ExpertTrain.__doc__} {HELP_ALL} shows every option."
    return ExpertOptions(cls=cls, env=env, before=before)


def command_of(settings: ExpertSettings) -> str:
    """The command line that makes a run again, given the defaults of this version."""
    usual = new_settings(settings.env)
    usual = dataclasses.replace(
        usual,
        training_scenarios=0 if settings.scenarios is not None else usual.training_scenarios,
        evaluate_every=default_interval(settings.config),
    )
    defaults, words = values_of(usual), ["ppl", "expert", "train", settings.env]
    for name, value in values_of(settings).items():
        if value == defaults[name]:
            continue
        option = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            listed = value if isinstance(value, tuple) else (value,)
            words += [f"--{option}", *map(str, listed)]
    return shlex.join(words)


def _before(argv: Sequence[str]) -> ExpertSettings | None:
    """The settings of the run that is to be continued, or None."""
    if not is_given(argv, "--resume"):
        return None
    out = word_after(argv, "--out")
    if out is None:
        raise UserError("--resume needs --out, the run folder to continue")
    return read_settings(RunFolder(out))


def expert_request(parsed: Any, options: ExpertOptions, argv: Sequence[str]) -> ExpertTrainRequest:
    """The run that a parsed command line asks for.

    Raises:
        UserError: If a setting cannot work, or contradicts the run that is to be continued.
    """
    asked: dict[str, Any] = {"env": parsed.env}
    for group in GROUPS:
        asked |= vars(getattr(parsed, group))
    out, resume = asked.pop("out"), asked.pop("resume")
    if options.before is not None:
        refuse_contradictions(out, values_of(options.before), asked)
        return ExpertTrainRequest(settings=options.before, out=out, resume=resume)
    if not parsed.env:
        raise UserError(f"env: name the environment, one of {environments()} or brax:NAME")
    if not known(parsed.env):
        raise UserError(unknown(parsed.env))
    if parsed.env != options.env:  # a value of an option is an environment's name too
        raise UserError(f"env: name {parsed.env!r} before the options")
    if is_given(argv, "--scenarios") and not is_given(argv, "--training-scenarios"):
        asked["training_scenarios"] = 0
    plain = {name: asked.pop(name) for name in PLAIN}
    config, hparams = replace(PPOConfig(), PPOHParams(), **asked)
    settings = ExpertSettings(**plain, config=config, hparams=hparams)
    check(settings)
    if not is_given(argv, "--evaluate-every"):
        every = default_interval(settings.config)
        settings = dataclasses.replace(settings, evaluate_every=every)
    return ExpertTrainRequest(settings=settings, out=out, resume=False)
