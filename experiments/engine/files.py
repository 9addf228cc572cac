"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


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
