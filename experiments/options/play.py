"""Options of `ppl play`: those of the session, and the settings that its method would use."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from tyro.conf import OmitArgPrefixes

from experiments.options.commands import Play
from experiments.options.settings import is_given, option_fields, settings_in, shows_everything

_GROUPS = ("run", "world", "method", "predictor")  # a person is the gate and the expert


def play_options(argv: Sequence[str]) -> tuple[type, Callable[[Any], Any]]:
    """The options for a command line: a class for tyro, and what finishes its record.

    The finished record's `settings` are those that the command line names, by flat name.

    Raises:
        UserError: If the command line names an unknown method or predictor.
    """
    own = {field.name for field in dataclasses.fields(Play)}
    settings = {
        name: one
        for name, one in settings_in(argv).items()
        if one.about.group in _GROUPS and name not in own
    }
    groups = option_fields(settings, everything=shows_everything(argv), groups=_GROUPS)
    members = []
    for group in _GROUPS:
        part = dataclasses.make_dataclass(group, groups[group])
        members.append((group, OmitArgPrefixes[part], dataclasses.field(default_factory=part)))
    made = dataclasses.make_dataclass("Play", members, bases=(Play,))
    made.__doc__ = Play.__doc__

    def finish(parsed: Any) -> Play:
        chosen = {k: v for group in _GROUPS for k, v in vars(getattr(parsed, group)).items()}
        given = {k: v for k, v in chosen.items() if is_given(argv, f"--{k.replace('_', '-')}")}
        of_session = {name: getattr(parsed, name) for name in own}
        return Play(**of_session | {"settings": given, "words": tuple(argv)})

    return made, finish
