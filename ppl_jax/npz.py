"""Reading .npz archives of others: arrays of numbers and text alone, and a reason where not."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """Every array of an archive by its name.

    Nothing in it is executed: arrays of Python objects, which NumPy stores as pickles, are refused.

    Raises:
        ValueError: With the reason in a few words.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError("it is a folder")
    try:
        if not path.stat().st_size:
            raise ValueError("it is empty")
        with open(path, "rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError(f"it is no .npz archive{_what_else(path)}")
    except OSError as error:
        raise ValueError(error.strerror or type(error).__name__) from error
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: _array(archive, name) for name in archive.files}
    except (OSError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"it is damaged ({error or type(error).__name__})") from error


def _array(archive: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    try:
        found = archive[name]
    except ValueError as error:
        if "pickle" in str(error) or "Object array" in str(error):
            raise ValueError(
                f"array {name!r} holds Python objects, only numbers and text are read"
            ) from error
        raise ValueError(f"array {name!r} is damaged ({error})") from error
    if not isinstance(found, np.ndarray):
        raise ValueError(f"{name!r} is no array")
    return found


def _what_else(path: Path) -> str:
    """What it is instead, where that can be told, or that it was cut off."""
    with open(path, "rb") as file:
        start = file.read(6)
    if start == b"\x93NUMPY":
        return ", but a single .npy array"
    return " or was cut off" if start[:2] == b"PK" else ""
