"""Files that are written whole or not at all, and JSON that any program reads."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from experiments.engine.runtime import UserError


def write_atomic(path: str | Path, write: Callable[[BinaryIO], object]) -> None:
    """Replace a file in one step: a reader sees the old content or the new, never a part.

    Args:
        path: The file; its folder must exist.
        write: Writes the content to the open file that it is given.

    Raises:
        OSError: If it cannot be written; the old file stays.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())  # a power cut after the renaming finds the content there
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    os.replace(part, path)


def write_text_atomic(path: str | Path, text: str) -> None:
    """Replace a text file (UTF-8, line ends as given) in one step.

    Raises:
        OSError: If it cannot be written; the old file stays.
    """
    write_atomic(path, lambda file: file.write(text.encode()))


def as_json(content: Any, indent: int | None = None) -> str:
    """Strict JSON (RFC 8259), which has no NaN: a number that is not finite is written as null.

    Args:
        content: Of plain Python values.
        indent: Spaces per level; None writes one line.
    """
    return json.dumps(_finite(content), indent=indent, allow_nan=False)


def _finite(content: Any) -> Any:
    if isinstance(content, float) and not math.isfinite(content):
        return None
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return content


def make_out_folder(path: Path) -> None:
    """Make the folder that a command writes to.

    Raises:
        UserError: If the path cannot be a folder.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unusable(path, error) from error


def check_out_file(path: Path) -> None:
    """Make sure that a command can write the file it is asked for, before its work.

    Raises:
        UserError: If it cannot.
    """
    if path.is_dir():
        raise UserError(f"out {str(path)!r} is a folder: name a file")
    make_out_folder(path.parent)
    probe = path.with_name(path.name + ".part")
    try:
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise unusable(path, error) from error


def check_ending(out: Path, endings: Sequence[str]) -> None:
    """Refuse a file of a kind that is not written.

    Raises:
        UserError: One line.
    """
    if out.suffix not in endings:
        listed = (" or " if len(endings) == 2 else ", ").join(endings)
        raise UserError(f"out must end in {listed}, got {str(out)!r}")


def unusable(path: Path, error: OSError) -> UserError:
    """The one line for a path that cannot be written."""
    return UserError(f"out {str(path)!r} cannot be written: {error.strerror or error}")
