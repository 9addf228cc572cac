"""The run folder: config.json, metrics.jsonl, evaluation.csv, summary.json, checkpoints/."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

from experiments.engine.csv_file import Table, numbers, read_table
from experiments.engine.files import as_json, make_out_folder, unusable, write_text_atomic
from experiments.engine.runtime import UserError

CONFIG, METRICS, EVALUATION, SUMMARY, CHECKPOINTS, POLICY = (
    "config.json",
    "metrics.jsonl",
    "evaluation.csv",
    "summary.json",
    "checkpoints",
    "policy.npz",
)


class RunFolder:
    """A run's files. Text is written whole or appended line by line, never left half changed."""

    def __init__(self, path: str | Path):
        self.path = Path(path)

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / CHECKPOINTS

    def create(self, config: dict[str, Any]) -> None:
        """Make the folder and write config.json.

        Raises:
            UserError: If the folder already holds a run, or cannot be written.
        """
        if (self.path / CONFIG).exists():
            raise UserError(
                f"out folder {str(self.path)!r} already holds a run: give --resume to continue "
                "it, or another --out"
            )
        make_out_folder(self.path)
        try:
            self.write_json(CONFIG, config)
        except OSError as error:
            raise unusable(self.path, error) from error

    def config(self) -> dict[str, Any]:
        """Read config.json.

        Raises:
            ValueError: If the folder is not a run folder.
        """
        try:
            return json.loads((self.path / CONFIG).read_text())
        except (OSError, ValueError) as error:
            raise ValueError(
                f"{str(self.path)!r} is not a run folder: it has no readable {CONFIG}"
            ) from error

    def write_json(self, name: str, content: Any) -> None:
        """Replace a JSON file in one step."""
        write_text_atomic(self.path / name, as_json(content, indent=2) + "\n")

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Append one line to metrics.jsonl."""
        with open(self.path / METRICS, "a", newline="") as file:
            file.write(as_json(row) + "\n")

    def append_evaluation(self, rows: list[dict[str, Any]]) -> None:
        """Append rows to evaluation.csv (with a header when new)."""
        path, columns = self.path / EVALUATION, list(rows[0])
        if there := path.exists():
            with open(path, newline="") as file:
                columns = next(csv.reader(file))  # another program may have changed their order
        with open(path, "a", newline="") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            if not there:
                writer.writeheader()
            writer.writerows(rows)

    def has_gone_on(self) -> bool:
        """Whether a second evaluation was logged: a checkpoint was written after the first."""
        held = self._evaluated()
        return held is not None and len(set(held.column("step"))) > 1

    def _evaluated(self) -> Table | None:
        """The whole lines of evaluation.csv; None where there is not even a header.

        Raises:
            UserError: If it is no such file.
        """
        path = self.path / EVALUATION
        if not path.is_file() or b"\n" not in path.read_bytes():  # killed within its first line
            return None
        table = read_table(path, cut=True)
        if "step" not in table.columns:
            raise UserError(f"{str(path)!r} has no column 'step'")
        return table

    def rewind(self, done: int, step: int) -> None:
        """Drop what was logged later: a resumed run writes it again.

        Args:
            done: Steps and offline updates done: metrics up to there stay.
            step: Environment step of the last evaluation that stays.

        Raises:
            UserError: If a file holds something else; both stay as they are.
        """
        metrics, kept = self.path / METRICS, []
        for number, line in whole_lines(metrics):
            try:
                if json.loads(line)["done"] <= done:
                    kept.append(line + "\n")
            except (ValueError, TypeError, KeyError) as error:
                raise UserError(f"{str(metrics)!r}, line {number} is no line of a run") from error
        path, table, text = self.path / EVALUATION, self._evaluated(), io.StringIO()
        if table is None:
            path.unlink(missing_ok=True)
        else:
            steps = numbers(table.column("step"), table.lines, "step", path, low=0, whole=True)
            rows = [row for row, at in zip(table.rows, steps, strict=True) if at <= step]
            csv.writer(text, lineterminator="\n").writerows([table.columns, *rows])
            write_text_atomic(path, text.getvalue())
        if metrics.exists():
            write_text_atomic(metrics, "".join(kept))


def whole_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a log with their numbers, from 1; none where it is not there.

    A last line without its end was being written when the process was killed: it is left out.
    """
    if not path.exists():
        return []
    *whole, _ = path.read_text(encoding="utf-8-sig", errors="replace").split("\n")
    return [(number, line) for number, line in enumerate(whole, 1) if line.strip()]
