"""Reading CSV files, of ours or through other programs: encodings, separators and line ends of any
kind, and one line for what cannot be right.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.engine.runtime import UserError

LARGEST = 2**53  # up to which a float is exact
SEPARATORS = ",;\t"
_INDEX_NAMES = ("index", "level_0")  # that pandas gives, beside "" and "Unnamed: 0"


class Table(NamedTuple):
    """The cells of a CSV file, as text without space around them.

    Attributes:
        columns: Names of the columns.
        rows: Cells of each row, as many as there are columns.
        lines: Line of the file that each row ends in, from 1.
    """

    columns: list[str]
    rows: list[list[str]]
    lines: list[int]

    def column(self, name: str) -> list[str]:
        """The cells of a column."""
        at = self.columns.index(name)
        return [row[at] for row in self.rows]


def read_table(path: Path, *, cut: bool = False) -> Table:
    """A CSV file, or one that gzip has packed (.gz).

    UTF-8, UTF-16 (with its mark) and Latin-1 are read; commas, semicolons and tabs; any line ends.
    Rows without content, headers that are repeated and the index that pandas writes are left out.

    Args:
        path: The file.
        cut: Leave out a last line without its end: it was being written when a run was killed.

    Raises:
        UserError: One line naming the file, and the row where there is one.
    """
    where, text = repr(str(path)), _text(path)
    if cut:
        text = text[: max(text.rfind("\n"), text.rfind("\r")) + 1]
    header = text.lstrip("\r\n").splitlines()[:1]
    if not header or not header[0].strip():
        raise UserError(f"{where} is empty: it has no header")
    separator = max(SEPARATORS, key=header[0].count)
    reader = csv.reader(io.StringIO(text, newline=None), delimiter=separator, strict=True)
    columns: list[str] = []
    rows, lines = [], []
    try:
        for cells in reader:
            row = [cell.strip() for cell in cells]
            if not any(row) or row == columns:
                continue
            if not columns:
                columns = row
                continue
            rows.append(_fitting(row, columns, f"{where}, row {reader.line_num}"))
            lines.append(reader.line_num)
    except csv.Error as error:
        raise UserError(f"{where}, row {reader.line_num}: {error}") from error
    table = _without_index(Table(columns, rows, lines))
    for name in table.columns:
        if table.columns.count(name) > 1:
            raise UserError(f"{where} has the column {name!r} twice")
    return table


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
        if path.suffix == ".gz":
            content = gzip.decompress(content)
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError(f"{str(path)!r} cannot be read: {reason}") from error
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = content.decode("utf-16", "replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    if "\0" in text:
        raise UserError(f"{str(path)!r} cannot be read: it is no text")
    return text


def _fitting(row: list[str], columns: list[str], where: str) -> list[str]:
    """A row with as many cells as there are columns."""
    if "success" in row:
        raise UserError(
            f"{where} is a header of other columns: files whose columns differ cannot be put one "
            "behind the other"
        )
    if len(row) > len(columns) and not any(row[len(columns) :]):
        row = row[: len(columns)]
    if len(row) != len(columns):
        raise UserError(f"{where} has {len(row)} cells, the header has {len(columns)}")
    return row


def _without_index(table: Table) -> Table:
    """Without the columns that pandas writes for its index."""
    kept = [i for i, name in enumerate(table.columns) if not _is_index(table, i, name)]
    rows = [[row[i] for i in kept] for row in table.rows]
    return table._replace(columns=[table.columns[i] for i in kept], rows=rows)


def _is_index(table: Table, at: int, name: str) -> bool:
    if not name or name.startswith("Unnamed:"):
        return True
    cells = [row[at] for row in table.rows]
    whole = all(cell.isdigit() for cell in cells)
    return name in _INDEX_NAMES and whole and len(set(cells)) == len(cells)


def numbers(
    cells: Sequence[str],
    lines: Sequence[int],
    name: str,
    path: Path,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    whole: bool = False,
    empty: bool = False,
) -> list[float]:
    """A column as numbers; "2000.0" is a whole number.

    Args:
        cells: Its cells.
        lines: Line of each.
        name: Its name.
        path: The file, for messages.
        low, high: What is allowed.
        whole: Whether only whole numbers are.
        empty: Whether a cell may be empty, which is NaN.

    Raises:
        UserError: One line naming file, row and column, what was found and what is allowed.
    """
    found = []
    high = min(high, LARGEST) if whole else high
    for cell, line in zip(cells, lines, strict=True):
        if empty and not cell:
            found.append(math.nan)
            continue
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and low <= value <= high) or (whole and value % 1):
            raise UserError(
                f"{str(path)!r}, row {line}: {name} must be {_allowed(low, high, whole)}, got "
                f"{cell!r}"
            )
        found.append(value)
    return found


def _allowed(low: float, high: float, whole: bool) -> str:
    kind = "a whole number" if whole else "a finite number"
    if high < LARGEST:
        return f"{kind} from {low:g} to {high:g}"
    if low > -math.inf:
        return f"{kind} of {low:g} or more" + (f" and at most {LARGEST}" if whole else "")
    return kind
