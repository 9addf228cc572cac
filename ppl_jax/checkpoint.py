"""Saving and restoring the whole learner, through Orbax. The one file that knows Orbax.

A checkpoint is written beside its final name and renamed, so a killed process leaves the one before
whole. A checksum of every array is kept with it: a damaged checkpoint is recognised, named, and the
one before it is used.
"""

from __future__ import annotations

import json
import logging
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

PyTree = Any

SCHEMA = 1
KEPT = 2
_PREFIX = "step_"
_CHECKSUM = "checksum.json"


def _orbax() -> Any:
    from orbax.checkpoint import v1  # slow to import

    logging.getLogger("absl").setLevel(logging.CRITICAL)  # it prints a failure ten times over
    return v1


def _checksum(tree: PyTree) -> int:
    total = 0
    for leaf in jax.tree.leaves(tree):
        if jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        total = zlib.crc32(np.ascontiguousarray(leaf).view(np.uint8).ravel().data, total)
    return total


def steps(folder: Path) -> list[int]:
    """Steps of the finished checkpoints in a folder, oldest first."""
    if not folder.is_dir():
        return []
    names = [path.name for path in folder.iterdir() if (path / _CHECKSUM).is_file()]
    return sorted(
        int(name.removeprefix(_PREFIX))
        for name in names
        if name.startswith(_PREFIX) and name.removeprefix(_PREFIX).isdigit()
    )


def save(folder: Path, step: int, tree: PyTree) -> None:
    """Write checkpoint `step` and remove those beyond the last `KEPT`.

    Raises:
        OSError: If the disk is full or the folder cannot be written; older checkpoints stay.
    """
    folder.mkdir(parents=True, exist_ok=True)
    final = folder / f"{_PREFIX}{step}"
    part = folder / f"{_PREFIX}{step}.part"
    for path in (final, part):
        shutil.rmtree(path, ignore_errors=True)
    try:
        _orbax().save((part / "learner").absolute(), tree)
        record = {"schema": SCHEMA, "step": step, "crc32": _checksum(tree)}
        (part / _CHECKSUM).write_text(json.dumps(record))
        part.rename(final)
    except (OSError, ValueError) as error:  # Orbax tells of a full disk by a ValueError
        shutil.rmtree(part, ignore_errors=True)
        full = "No space left on device" in str(error)
        reason = "no space left on device" if full else str(error).splitlines()[0]
        rest = "it was to be the first, --resume begins again"
        if kept := steps(folder):
            rest = f"checkpoint {kept[-1]} is whole, continue from it with --resume"
        raise OSError(f"cannot write checkpoint {step} in {folder}: {reason}; {rest}") from error
    for old in steps(folder)[:-KEPT]:
        shutil.rmtree(folder / f"{_PREFIX}{old}", ignore_errors=True)


def restore(folder: Path, like: PyTree, warn: Callable[[str], None]) -> tuple[int, PyTree] | None:
    """The newest whole checkpoint as (step, tree), or None if there is none.

    Args:
        folder: Holds the checkpoints.
        like: A tree of the same structure, shapes and types.
        warn: Called with one line for each damaged checkpoint that is passed over.
    """
    for step in reversed(steps(folder)):
        path = folder / f"{_PREFIX}{step}"
        try:
            record = json.loads((path / _CHECKSUM).read_text())
            tree = _orbax().load((path / "learner").absolute(), _abstract(like))
            if record["crc32"] != _checksum(tree):
                raise ValueError("its contents do not match its checksum")
        except Exception as error:  # a damaged file makes Orbax raise anything
            reason = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
            warn(f"checkpoint {path} is damaged ({reason[:120]}); trying the one before it")
            continue
        return step, tree
    return None


def _abstract(tree: PyTree) -> PyTree:
    def shape(leaf: jax.Array) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)

    return jax.tree.map(shape, tree)
