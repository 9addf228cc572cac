"""Values of JSON files against the kinds that their fields have."""

from __future__ import annotations

import json
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Union

from experiments.engine.runtime import UserError
from ppl_jax.config import did_you_mean

_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
_NAMES |= {dict: "an object", list: "a list", tuple: "a list", type(None): "null"}
SHOWN = 60  # letters of a value in a message


def shown(value: Any) -> str:
    """A value as messages show it, cut to one short line."""
    text = json.dumps(value) if isinstance(value, (dict, list)) else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def of_kind(value: Any, kind: Any) -> Any:
    """A value read from JSON as its kind has it: 2000.0 as a whole number, 1 as true, a list as a
    tuple.

    Args:
        value: From `json.loads`.
        kind: bool, int, float, str, dict, list, None, a `Literal`, a tuple of one of these, or a
            union of them; anything else takes every value.

    Raises:
        ValueError: "must be a whole number, got 'x'".
    """
    found, fits = _converted(value, kind)
    if not fits:
        raise ValueError(f"must be {_name(kind)}, got {shown(value)}")
    return found


def _converted(value: Any, kind: Any) -> tuple[Any, bool]:
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        tried = [_converted(value, part) for part in parts]
        return next((one for one in tried if one[1]), (value, False))
    if origin is Literal:
        return value, isinstance(value, str) and value in parts
    if tuple in (origin, kind):
        if not isinstance(value, (list, tuple)):
            return value, False
        if not parts:
            return tuple(value), True
        each = [_converted(one, parts[0]) for one in value]
        return tuple(one for one, _ in each), all(fits for _, fits in each)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind is bool:
        flag = isinstance(value, (bool, int, float)) and value in (0, 1)
        return (bool(value), True) if flag else (value, False)
    if kind is int:
        whole = number and (isinstance(value, int) or value.is_integer())
        return (int(value), True) if whole else (value, False)
    if kind is float:
        return value, number
    if kind in (None, type(None)):
        return value, value is None
    if kind in (str, dict, list):
        return value, isinstance(value, kind)
    return value, True


def _name(kind: Any) -> str:
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(_name(part) for part in parts)
    if origin is Literal:
        return "one of " + ", ".join(map(str, parts))
    if origin is tuple:
        return f"a list, each of it {_name(parts[0])}"
    return _NAMES.get(kind, "something else")


def read_fields(
    content: Any, kinds: Mapping[str, Any], where: str, *, needed: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The fields of a JSON object that are known, each of its kind.

    Args:
        content: What was read.
        kinds: Kind of each known field; others are left out.
        where: File (and place in it), for messages.
        needed: Fields that must be there.

    Raises:
        UserError: One line naming file, field, what was found and what is allowed.
    """
    if not isinstance(content, dict):
        raise UserError(f"{where} must hold an object, got {shown(content)}")
    for name in needed:
        if name not in content:
            near = did_you_mean(name, [other for other in content if other not in kinds])
            raise UserError(f"{where} lacks {name!r}{near}")
    found = {}
    for name, kind in kinds.items():
        if name in content:
            try:
                found[name] = of_kind(content[name], kind)
            except ValueError as error:
                raise UserError(f"{where}: {name} {error}") from error
    return found


def read_json(path: Path) -> Any:
    """What a JSON file holds, with or without a byte order mark.

    Raises:
        UserError: One line naming the file and what is wrong.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{str(path)!r} cannot be read: {reason}") from error
