"""The run folder: config.json, metrics.jsonl, evaluation.csv, summary.json, checkpoints/."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

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

    def read_json(self, name: str) -> Any:
        """Read a JSON file of the folder."""
        return json.loads((self.path / name).read_text())

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Append one line to metrics.jsonl."""
        with open(self.path / METRICS, "a", newline="") as file:
            file.write(as_json(row) + "\n")

    def append_evaluation(self, rows: list[dict[str, Any]]) -> None:
        """Append rows to evaluation.csv (with a header when new)."""
        path = self.path / EVALUATION
        new = not path.exists()
        with open(path, "a", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerows(rows)

    def has_gone_on(self) -> bool:
        """Whether a second evaluation was logged: a checkpoint was written after the first."""
        evaluation = self.path / EVALUATION
        if not evaluation.is_file():
            return False
        with open(evaluation, newline="") as file:
            return len({row["step"] for row in csv.DictReader(file)}) > 1

    def rewind(self, done: int, step: int) -> None:
        """Drop what was logged later: a resumed run writes it again.

        Args:
            done: Steps and offline updates done: metrics up to there stay.
            step: Environment step of the last evaluation that stays.
        """
        metrics = self.path / METRICS
        if metrics.exists():
            kept = []
            for line in metrics.read_text().splitlines():
                try:
                    row = json.loads(line)
                except ValueError:  # the line that was being written when the run was killed
                    continue
                if row["done"] <= done:
                    kept.append(line + "\n")
            write_text_atomic(metrics, "".join(kept))
        evaluation = self.path / EVALUATION
        if evaluation.exists():
            lines = evaluation.read_text().splitlines(keepends=True)
            header = lines[:1]
            columns = header[0].strip().split(",") if header else []
            kept = header
            for line in lines[1:]:
                cells = line.strip().split(",")
                if len(cells) == len(columns) and int(cells[columns.index("step")]) <= step:
                    kept.append(line)
            write_text_atomic(evaluation, "".join(kept))
