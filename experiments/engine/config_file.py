"""config.json of any kind of run and version: read, and each of its fields of its kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.engine.fields import read_fields
from experiments.engine.run_folder import CONFIG, RunFolder
from experiments.engine.runtime import UserError

KINDS = {
    "schema": int,
    "env": str,
    "algorithm": str,
    "seed": int,
    "expert": str,
    "reference_policy": str | None,
    "scenarios": str | None,
    "held_out_scenarios": str | None,
    "training_scenarios": int,
    "evaluate_every": int,
    "evaluate_on": str,
    "physics": str,
    "settings": dict,
    "config": dict,
    "hparams": dict,
    "session": dict,
}
"""Kinds of the fields that some kind of run has at the top."""
SWITCHES = {"physics": str, "randomise": bool}  # settings that decide which others there are


def config_path(run: Path) -> str:
    """A run folder's config.json as messages name it."""
    return repr(str(run / CONFIG))


def checked_content(content: Any, where: str) -> dict[str, Any]:
    """The content of a config.json as it is.

    Args:
        content: What was read.
        where: File, for messages.

    Raises:
        UserError: One line naming file and field, if it is no object or a field is of another kind.
    """
    read_fields(content, KINDS, where)
    read_fields(content.get("settings", {}), SWITCHES, where)
    return content


def read_config(run: Path) -> dict[str, Any]:
    """The content of config.json of a run folder.

    Raises:
        UserError: One line, if it is no run folder or a field is of another kind.
    """
    try:
        content = RunFolder(run).config()
    except (ValueError, RecursionError) as error:
        raise UserError(str(error)) from error
    return checked_content(content, config_path(run))
