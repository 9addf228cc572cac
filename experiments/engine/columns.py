"""The columns of recordings: what each is, the check of those that somebody else wrote, and what
follows from the others where one is missing.

All are [T] or [T, ...], a row per step. Sizes: O observation, A action, L predicted states, H and P
steps and coordinates of the path that was shown.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from experiments.engine.runtime import UserError
from ppl_jax.config import did_you_mean

Columns = dict[str, np.ndarray]
STATE, PREDICTED, EPISODE, META = "state/", "predicted/", "episode", "meta"
AHEAD, FAILS = "ahead", "fails"
TOLERANCE = 1e-5  # of the bounds of an action, for rounding


class Column(NamedTuple):
    """What a column holds.

    Attributes:
        kind: "flag": true or false, or 0 or 1. "number": finite. "cost": a number of 0 or more.
            "action": numbers in [-1, 1]. "whole": whole numbers of 0 or more.
        shape: Sizes of a row.
    """

    kind: Literal["flag", "number", "cost", "action", "whole"]
    shape: tuple[str, ...] = ()


COLUMNS = {
    "observation": Column("number", ("O",)),
    "executed_action": Column("action", ("A",)),
    "next_observation": Column("number", ("O",)),
    "novice_action": Column("number", ("A",)),  # as proposed: it is clipped when executed
    "expert_action": Column("action", ("A",)),
    "takeover_start": Column("flag"),
    "is_intervention": Column("flag"),
    "reward": Column("number"),
    "cost": Column("cost"),
    "terminated": Column("flag"),
    "truncated": Column("flag"),
    "success": Column("flag"),
    EPISODE: Column("whole"),
    PREDICTED + "observation": Column("number", ("L", "O")),
    PREDICTED + "reward": Column("number", ("L",)),
    PREDICTED + "speed": Column("number", ("L",)),
    PREDICTED + "unsafe": Column("flag", ("L",)),
    PREDICTED + "success": Column("flag", ("L",)),
    PREDICTED + "terminated": Column("flag", ("L",)),
    PREDICTED + "valid": Column("flag", ("L",)),
    AHEAD: Column("number", ("H", "P")),
    FAILS: Column("flag"),
}
"""Every column but those of states, which are the environment's own, and `meta`."""
OTHER_NAMES = {"action": "executed_action"}
ENDS = (EPISODE, "terminated", "truncated")  # one of them is needed, beside observation and action


def checked(columns: Columns, where: str) -> Columns:
    """The columns that are known, each of its kind and shape; those of other names are left out.

    Args:
        columns: As they were read.
        where: File, for messages.

    Raises:
        UserError: One line naming file, column, row and index, what was found and what is allowed.
    """
    columns = _under_our_names(columns, where)
    for name in columns.keys() - COLUMNS.keys():
        near = did_you_mean(name, [one for one in COLUMNS if one not in columns])
        if near and not name.startswith(STATE):  # else it would be taken to be missing
            raise UserError(f"{where} has an unknown column {name!r}{near}")
    for name in ("observation", "executed_action"):
        if name not in columns:
            raise UserError(f"{where} has no column {name!r}")
    if not any(name in columns for name in ENDS):
        raise UserError(f"{where} does not say where episodes end: it has no {', '.join(ENDS)}")
    length, sizes = _length(columns["observation"]), {}
    if not length:
        raise UserError(f"{where}: column 'observation' has no rows")
    found = {}
    for name, about in COLUMNS.items():
        if name in columns and not _is_empty(name, columns[name]):
            line = f"{where}: column {name!r}"
            array = _shaped(columns[name], about, length=length, sizes=sizes, line=line)
            found[name] = _of_kind(array, about.kind, line)
    for name, array in columns.items():
        if name.startswith(STATE):
            _rows(array, length, f"{where}: column {name!r}")
            if array.dtype.kind not in "biuf":
                raise UserError(f"{where}: column {name!r} must hold numbers, got {array.dtype}")
            found[name] = array
    return found


def _is_empty(name: str, array: np.ndarray) -> bool:
    """Predictions of no steps, in sessions of a method that needs none."""
    return name.startswith(PREDICTED) and array.ndim > 1 and array.shape[1] == 0


def _under_our_names(columns: Columns, where: str) -> Columns:
    for other, ours in OTHER_NAMES.items():
        if other in columns and ours in columns:
            raise UserError(f"{where} has both columns {other!r} and {ours!r}: leave one out")
    return {OTHER_NAMES.get(name, name): array for name, array in columns.items()}


def _length(array: np.ndarray) -> int:
    return len(array) if array.ndim else 0


def _rows(array: np.ndarray, length: int, line: str) -> None:
    if not array.ndim:
        raise UserError(f"{line} must have a row per step ({length}), got a single value")
    if len(array) != length:
        raise UserError(f"{line} has {len(array)} rows, 'observation' has {length}")


def _shaped(
    array: np.ndarray, about: Column, *, length: int, sizes: dict[str, int], line: str
) -> np.ndarray:
    """A column of the right shape; a last axis of one is added or left out where that fits."""
    _rows(array, length, line)
    wanted = 1 + len(about.shape)
    if about.shape and array.ndim == wanted - 1:
        array = array[..., None]
    elif array.ndim == wanted + 1 and array.shape[-1] == 1:
        array = array[..., 0]
    if array.ndim != wanted:
        raise UserError(f"{line} must be {_text('T', *about.shape)}, got {list(array.shape)}")
    for axis, size in zip(about.shape, array.shape[1:], strict=True):
        if sizes.setdefault(axis, size) != size:
            raise UserError(
                f"{line} must be {_text('T', *about.shape)} with {axis} = {sizes[axis]} as in the "
                f"columns before, got {list(array.shape)}"
            )
    return array


def _text(*axes: str) -> str:
    return f"[{', '.join(axes)}]"


_ALLOWED = {
    "flag": "true or false, or 0 or 1",
    "number": "a finite number",
    "cost": "a finite number of 0 or more",
    "action": "in [-1, 1]",
    "whole": "a whole number of 0 or more",
}


def _of_kind(array: np.ndarray, kind: str, line: str) -> np.ndarray:
    """A column as its kind has it.

    Raises:
        UserError: At the first value that is not.
    """
    if array.dtype.kind not in "biuf":
        raise UserError(f"{line} must hold {_ALLOWED[kind]}, got {array.dtype}")
    with np.errstate(over="ignore", invalid="ignore"):
        numbers = array.astype(np.float32) if array.dtype.kind != "f" else array
        good = np.isfinite(numbers.astype(np.float32))
        if kind == "flag":
            good = (numbers == 0) | (numbers == 1)
        elif kind == "action":
            good = np.abs(numbers) <= 1 + TOLERANCE
        elif kind == "cost":
            good &= numbers >= 0
        elif kind == "whole":
            good &= (array >= 0) & (array <= np.iinfo(np.int32).max) & (array % 1 == 0)
    if not good.all():
        row, *index = (int(i) for i in np.argwhere(~good)[0])
        at = f", index {', '.join(map(str, index))}" if index else ""
        found = array[(row, *index)].item()
        raise UserError(f"{line}, row {row}{at}: must be {_ALLOWED[kind]}, got {found}")
    if kind == "flag":
        return array.astype(bool)
    return array.astype(np.int32) if kind == "whole" else numbers


def joined(pieces: dict[str, Columns]) -> Columns:
    """Pieces of one recording one after another.

    Args:
        pieces: Checked columns by file.

    Raises:
        UserError: One line naming the piece that differs from the first, and its column.
    """
    (first, model), *others = pieces.items()
    for where, piece in others:
        for name in model.keys() ^ piece.keys():
            lacks, has = (where, first) if name in model else (first, where)
            raise UserError(f"{lacks} has no column {name!r}, which {has} has")
        for name, array in piece.items():
            if array.shape[1:] != model[name].shape[1:]:
                sizes = list(array.shape[1:]), list(model[name].shape[1:])
                raise UserError(
                    f"{where}: column {name!r} has rows of {sizes[0]}, those of {first} are "
                    f"{sizes[1]}"
                )
    return {name: np.concatenate([piece[name] for piece in pieces.values()]) for name in model}


def completed(columns: Columns, where: str) -> Columns:
    """The columns, and those that follow from them where they are missing.

    Plain demonstrations are the expert's (`is_intervention`). An episode ends where `terminated` or
    `truncated` says so, or else where `episode` changes. `next_observation` is the following row's;
    an episode's last row has its own, and counts as `terminated` where nothing says otherwise: no
    value is taken from a state that nobody recorded. Reward, cost and success are 0 where missing.

    Missing predictions and novice's actions stay so: they are not known here.

    Raises:
        UserError: If an episode's rows do not stand together, or one goes on after its end.
    """
    found, length = dict(columns), len(columns["observation"])
    no, zero = np.zeros(length, bool), np.zeros(length, np.float32)
    if EPISODE not in found:
        ends = found.get("terminated", no) | found.get("truncated", no)
        found[EPISODE] = np.concatenate([[0], np.cumsum(ends)[:-1]]).astype(np.int32)
    last = _last_rows(found[EPISODE], where)
    for name in ("terminated", "truncated"):
        if (wrong := found.get(name, no) & ~last).any():
            row = int(np.argmax(wrong))
            raise UserError(
                f"{where}: column {name!r}, row {row}: must be 0 where episode "
                f"{found[EPISODE][row]} goes on in the next row, got 1"
            )
    if "terminated" not in found:
        found["terminated"] = last & ~found.get("truncated", no)
    found.setdefault("truncated", last & ~found["terminated"])
    if "next_observation" not in found:
        observation = found["observation"]
        following = np.concatenate([observation[1:], observation[-1:]])
        found["next_observation"] = np.where(last[:, None], observation, following)
    person = found.setdefault("is_intervention", ~no)
    first = np.concatenate([[True], last[:-1]])
    before = np.concatenate([[False], person[:-1]])
    found.setdefault("takeover_start", person & (first | ~before))
    found.setdefault("expert_action", found["executed_action"])
    found.setdefault("success", no)
    for name in ("reward", "cost"):
        found.setdefault(name, zero)
    return found


def _last_rows(episode: np.ndarray, where: str) -> np.ndarray:
    """Which rows end the run of rows with their episode's number, [T]."""
    last = np.concatenate([episode[1:] != episode[:-1], [True]])
    starts = np.flatnonzero(np.concatenate([[True], last[:-1]]))
    _, counts = np.unique(episode[starts], return_index=True)
    again = np.setdiff1d(np.arange(len(starts)), counts)
    if again.size:
        row = int(starts[again[0]])
        raise UserError(
            f"{where}: column {EPISODE!r}, row {row}: must be a number of its own, got "
            f"{episode[row]} again, an episode that had ended before"
        )
    return last
