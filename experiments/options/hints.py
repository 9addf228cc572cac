"""Help of options that are unset unless given: its text says what happens then, not "None"."""

from __future__ import annotations

import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from tyro.conf import arg

Command = TypeVar("Command", bound=type)
_NAMES = {str: "STR", int: "INT", float: "FLOAT", Path: "PATH"}
UNSET = (None, ())


def shown(kind: Any, default: Any, *, text: str | None = None) -> Any:
    """An option's annotation with its help.

    Args:
        kind: Its type.
        default: Its default; None and () are not shown.
        text: Its help; that of the field's docstring where None.
    """
    if not (default is None or default == ()):
        return kind if text is None else Annotated[kind, arg(help=text)]
    return Annotated[kind, arg(help=text, help_behavior_hint="", metavar=metavar(kind))]


def hide_unset(command: Command) -> Command:
    """Class decorator: options whose default is None or () do not show it."""
    kinds = typing.get_type_hints(command, include_extras=True)
    for name in command.__annotations__:
        field = getattr(command, "__dataclass_fields__")[name]  # noqa: B009
        if field.default is None or field.default == ():
            command.__annotations__[name] = shown(kinds[name], field.default)
    return command


def metavar(kind: Any) -> str | None:
    """What help shows for a value of a type: "PATH", "{gif,png}", "INT|{auto}"; None if unknown."""
    origin = typing.get_origin(kind)
    if origin is Annotated:
        return metavar(typing.get_args(kind)[0])
    if origin in (typing.Union, types.UnionType):
        parts = [metavar(part) for part in typing.get_args(kind) if part is not type(None)]
        return None if None in parts else "|".join(part for part in parts if part)
    if origin is Literal:
        return "{" + ",".join(map(str, typing.get_args(kind))) + "}"
    if origin is tuple:
        part = metavar(typing.get_args(kind)[0])
        return None if part is None else f"[{part} ...]"
    return _NAMES.get(kind)
