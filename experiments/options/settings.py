"""Options of the command line generated from the settings classes."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Union

import tyro

from envs.registry import known, registered
from experiments.engine.runtime import UserError
from experiments.engine.settings import RENAMED, RENAMED_VALUES
from ppl_jax import algorithms
from ppl_jax.config import Setting, catalogue, check_range, range_names
from ppl_jax.gates import registered_gates
from ppl_jax.predictors import registered_predictors

GROUPS = ("run", "world", "method", "gate", "predictor", "expert", "evaluation", "output")
HELP_ALL = "--help-all"


def word_after(argv: Sequence[str], option: str) -> str | None:
    """The last value of `--option value` or `--option=value` in a command line."""
    found = None
    for word, following in zip(argv, [*argv[1:], "--"], strict=True):
        name, has_value, value = word.partition("=")
        if word.startswith("--") and name.replace("_", "-") == option:
            value = value if has_value else following
            found = found if value.startswith("--") else value
    return found


def words_after(argv: Sequence[str], option: str) -> list[str]:
    """All values of an option that may take several."""
    found: list[str] = []
    taking = False
    for word in argv:
        if word.startswith("--"):
            name, has_value, value = word.partition("=")
            taking = name.replace("_", "-") == option
            if taking and has_value:
                found.append(value)
        elif taking:
            found.append(word)
    return found


def is_given(argv: Sequence[str], option: str) -> bool:
    """Whether a command line names an option, `--option=value` and `--an_option` included."""
    names = (word.partition("=")[0] for word in argv if word.startswith("--"))
    return any(name.replace("_", "-") == option for name in names)


def switch(argv: Sequence[str], name: str) -> bool | None:
    """What a command line says last of a switch: `--name`, `--no-name`, or nothing (None)."""
    said = {f"--{name}": True, f"--no-{name}": False}
    return next((said[word] for word in reversed(argv) if word in said), None)


def environments_in(argv: Sequence[str]) -> list[str]:
    """The known environments that a command line names."""
    return [word for word in argv if not word.startswith("-") and known(word)]


def settings_in(argv: Sequence[str], *, sweeping: bool = False) -> dict[str, Setting]:
    """The settings of the runs that a command line asks for, with the values they would have.

    Args:
        argv: The words after the command.
        sweeping: Methods, gates and predictors may be several.

    Raises:
        UserError: If a method, gate, predictor or preset is unknown, or an old name is used, or a
            range is given for worlds that are not randomised.
    """
    refuse_old_names(argv)
    env = (environments_in(argv) or ["driving"])[0]
    preset = word_after(argv, "--preset") or "default"
    methods = words_after(argv, "--algorithms") or [word_after(argv, "--algorithm") or "ppl"]
    several: dict[str, Sequence[str | None]] = {}
    for name in ("gate", "predictor"):
        one = [word_after(argv, f"--{name}")]
        several[name] = (words_after(argv, f"--{name}") or [None]) if sweeping else one
    randomise = switch(argv, "randomise")
    found: dict[str, Setting] = {}
    try:
        for method in methods:
            for gate in several["gate"]:
                for predictor in several["predictor"]:
                    given = {"gate": gate, "predictor": predictor, "randomise": randomise}
                    given = {name: value for name, value in given.items() if value is not None}
                    made = algorithms.settings(method, env, preset, **given)
                    if not made[0].randomise:
                        for name in range_names(env):
                            if is_given(argv, f"--{name.replace('_', '-')}"):
                                check_range(env, name)
                    mine = catalogue(*made)
                    if not algorithms.method(method).gated:
                        mine = {k: s for k, s in mine.items() if s.about.group != "gate"}
                        mine["decision_interval"] = catalogue(*made)["decision_interval"]
                    found = mine | found
    except ValueError as error:
        raise UserError(str(error)) from error
    return found


def refuse_old_names(
    argv: Sequence[str],
    names: Mapping[str, str] = RENAMED,
    values: Mapping[str, Mapping[str, str]] = RENAMED_VALUES,
) -> None:
    """Refuse settings and values under the names they had before.

    Args:
        argv: A command line.
        names: New names of settings by their old ones.
        values: For a setting the new names of its values by their old ones.

    Raises:
        UserError: One line with the new name.
    """
    for old, new in names.items():
        if is_given(argv, f"--{old.replace('_', '-')}"):
            raise UserError(f"{old} is called {new} now: give --{new.replace('_', '-')}")
    for name, renamed in values.items():
        for value in words_after(argv, f"--{name.replace('_', '-')}"):
            if value in renamed:
                raise UserError(f"{name} {value!r} is called {renamed[value]!r} now")


def shows_everything(argv: Sequence[str]) -> bool:
    """Whether options that are not common are there too.

    Only `--help` leaves them out: what help hides could not be given either.
    """
    return HELP_ALL in argv or not {"-h", "--help"} & set(argv)


def choices_of(setting: Setting) -> tuple[str, ...] | None:
    """The names that a setting allows; a user's gates and predictors among them."""
    if setting.name == "gate":
        return registered_gates()
    if setting.name == "predictor":
        return registered_predictors()
    return setting.about.choices


def kind_of(setting: Setting) -> Any:
    """The type that an option of a setting parses to."""
    kind, choices = setting.kind, choices_of(setting)
    if choices is None:
        return kind
    names = Literal[choices]  # pyright: ignore[reportInvalidTypeForm]
    return Union[kind, names] if kind in (int, float) else names  # noqa: UP007


def option_fields(
    settings: Mapping[str, Setting], *, everything: bool, groups: Sequence[str] = GROUPS
) -> dict[str, list[Any]]:
    """For each group the fields of its dataclass: one option a setting, with its true value.

    Args:
        settings: By name.
        everything: Whether all of them are there, or the common ones alone.
        groups: Names of the groups.
    """
    fields: dict[str, list[Any]] = {group: [] for group in groups}
    for name, one in settings.items():
        told = tyro.conf.arg(help=one.about.help)
        kind: Any = Annotated[kind_of(one), told]
        if not (one.about.common or everything):
            kind = Annotated[kind_of(one), told, tyro.conf.Suppress]
        fields[one.about.group].append((name, kind, dataclasses.field(default=one.value)))
    return fields


_OF_THE_SWEEP = ("total_steps", "randomise")  # one value for all of its runs


def axis_fields(settings: Mapping[str, Setting], *, everything: bool) -> list[Any]:
    """Fields of a dataclass with several values of every setting that a sweep may vary."""
    fields = []
    for name, one in settings.items():
        if name in _OF_THE_SWEEP:
            continue
        listed = typing.get_origin(one.kind) is tuple
        kind: Any = str if listed else kind_of(one)
        text = one.about.help + (" Each value is W,W,...." if listed else "")
        shown = ",".join(map(str, one.value)) if listed else one.value
        told = tyro.conf.arg(help=text, help_behavior_hint=f"(a run's own: {shown})")
        whole: Any = Annotated[tuple[kind, ...], told]
        if not (one.about.common or everything):
            whole = Annotated[tuple[kind, ...], told, tyro.conf.Suppress]
        fields.append((name, whole, dataclasses.field(default=())))
    return fields


def axis_values(settings: Mapping[str, Setting], axes: Any) -> dict[str, tuple[Any, ...]]:
    """The axes that were given values, by name.

    Raises:
        UserError: If a value of widths is no list of whole numbers.
    """
    found = {}
    for name, values in vars(axes).items():
        if not values:
            continue
        if typing.get_origin(settings[name].kind) is tuple:
            values = tuple(_widths(name, value) for value in values)
        found[name] = values
    return found


def _widths(name: str, text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.replace("x", ",").split(","))
    except ValueError as error:
        raise UserError(
            f"{name} must be widths such as 64,64 for each value of a sweep, got {text!r}"
        ) from error


def environments() -> str:
    """The environments' names, for help."""
    return ", ".join(registered())
