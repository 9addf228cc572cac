"""What a session was: every step with its state, as plain arrays, without pickles.

A run folder holds it in pieces (recording/NUMBER.npz, up to that line of the session's log); an
exported session is one file of the same columns. All are [T] or [T, ...]:

    observation, next_observation     before and after the step
    novice_action, expert_action      what either would do (the person: where is_intervention)
    executed_action, is_intervention  what was done, and whether the person did it
    takeover_start                    the person was not in control in the step before
    reward, cost, terminated, truncated, success
    predicted/...                     where the novice's held action would have led, [T, L, ...]
    episode                           a number for each, an unfinished one too
    ahead, fails                      the predicted path that was shown, [T, H, P], and its verdict
    state/...                         the world before the step, enough to draw it
"""

from __future__ import annotations

import json
import warnings
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.engine.files import write_atomic
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError, need
from ppl_jax.types import Env, Interaction, Trajectory

FOLDER = "recording"
STATE, PREDICTED, EPISODE, META = "state/", "predicted/", "episode", "meta"
AHEAD, FAILS = "ahead", "fails"
_RENAMED = {"takeover": "is_intervention"}

Columns = dict[str, np.ndarray]


class PredictedPath(NamedTuple):
    """A predicted path.

    Attributes:
        path: [H, P] positions.
        fails: Something unsafe, or an end without success, is predicted.
    """

    path: np.ndarray
    fails: bool


def _flat(tree: Any) -> dict[str, Any]:
    """Leaves of a struct by their path, "ego/pose"."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {"/".join(key.name for key in path): leaf for path, leaf in leaves}


def row_of(step: Interaction, state: Any) -> dict[str, np.ndarray]:
    """A step as a row of columns; `state` is the world before it."""
    row = {_RENAMED.get(name, name): np.asarray(leaf) for name, leaf in _flat(step).items()}
    return row | {STATE + name: np.array(leaf) for name, leaf in _flat(state).items()}


class Recorder:
    """Collects the steps of a session and writes them in pieces."""

    def __init__(self, run: Path):
        self.folder = run / FOLDER
        self.episode = 0
        self.rows: list[dict[str, np.ndarray]] = []

    def add(self, step: Interaction, state: Any, ahead: PredictedPath) -> None:
        """Take a step, the world before it and what was shown."""
        row = row_of(step, state) | {AHEAD: ahead.path, FAILS: np.bool_(ahead.fails)}
        self.rows.append(row | {EPISODE: np.int32(self.episode)})
        self.episode += bool(row["terminated"] | row["truncated"])

    def restart(self) -> None:
        """The episode was left unfinished."""
        self.episode += 1

    def take(self) -> list[dict[str, np.ndarray]]:
        """The steps so far, which are then the caller's to write."""
        rows, self.rows = self.rows, []
        return rows

    def write(self, rows: list[dict[str, np.ndarray]], events: int) -> None:
        """Write a piece: the steps up to so many lines of the log."""
        if not rows:
            return
        self.folder.mkdir(exist_ok=True)
        columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        _write(self.folder / f"{events:010d}.npz", columns | {"next_episode": self.episode})

    def rewind(self, events: int) -> None:
        """Drop the pieces beyond so many lines of the log: those steps are made again."""
        self.rows, self.episode = [], 0
        for path in _pieces(self.folder):
            if int(path.stem) > events:
                path.unlink()
        for path in _pieces(self.folder)[-1:]:
            with np.load(path, allow_pickle=False) as piece:
                self.episode = int(piece["next_episode"])


def _pieces(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*.npz") if path.stem.isdigit())


def _write(path: Path, columns: dict[str, Any]) -> None:
    write_atomic(path, lambda file: np.savez_compressed(file, **columns))


def load(path: Path) -> tuple[Columns, dict[str, Any]]:
    """The columns of a run folder or an exported session, and what its config.json says.

    Raises:
        UserError: If there is no recording, or it cannot be read.
    """
    if path.is_dir():
        try:
            config = RunFolder(path).config()
        except ValueError as error:
            raise UserError(str(error)) from error
        found = [_columns(piece) for piece in _pieces(path / FOLDER)]
        if not found:
            raise UserError(f"{str(path)!r} has no recording: no step of a person was saved in it")
        columns = {name: np.concatenate([piece[name] for piece in found]) for name in found[0]}
        return columns, config
    columns = _columns(path)
    try:
        config = json.loads(str(columns.pop(META)))
    except (KeyError, ValueError) as error:
        raise UserError(f"recording {str(path)!r} has no readable {META}") from error
    return columns, config


def _columns(path: Path) -> Columns:
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"recording {str(path)!r} cannot be read: {reason}") from error
    columns.pop("next_episode", None)
    return columns


def export(run: Path, out: Path) -> int:
    """Write a session as one file; returns the number of its steps.

    Raises:
        UserError: If there is nothing to export, or `out` is no .npz.
    """
    if out.suffix != ".npz":
        raise UserError(f"out must end in .npz, got {str(out)!r}")
    columns, config = load(run)
    _write(out, columns | {META: np.str_(json.dumps(config))})
    return len(columns[EPISODE])


def interactions(columns: Columns, env: Env, horizon: int) -> Interaction:
    """Recorded steps as a method takes them, [T].

    Args:
        columns: Of `load`.
        env: The world they are learnt in.
        horizon: Predicted states a method needs of each step (`max_preference_horizon`).

    Raises:
        UserError: If they are of another world, or hold fewer predicted states.
    """
    for name, size in (
        ("observation", env.spec.observation_size),
        ("executed_action", env.spec.action_size),
    ):
        if name not in columns:
            raise UserError(f"the recording has no column {name!r}")
        shape = columns[name].shape
        if len(shape) != 2 or shape[1] != size:
            raise UserError(f"the recording's {name} is {shape}, {env.name} needs [T, {size}]")
    for name, column in columns.items():
        if np.issubdtype(column.dtype, np.floating) and not name.startswith(STATE):
            bad = ~np.isfinite(column)
            if bad.any():
                raise UserError(f"the recording's {name} is not finite in {bad.sum()} places")
    kept = columns.get(PREDICTED + "observation")
    have = 0 if kept is None else kept.shape[1]
    if have < horizon:
        raise UserError(
            f"max_preference_horizon must not exceed the recording's predicted states ({have}), "
            f"got {horizon}"
        )

    def column(name: str) -> np.ndarray:
        if name not in columns:
            raise UserError(f"the recording has no column {name!r}")
        return columns[name]

    fields = (
        "observation",
        "next_observation",
        "novice_action",
        "expert_action",
        "executed_action",
        "takeover_start",
        "reward",
        "cost",
        "terminated",
        "truncated",
        "success",
    )
    seen = ("observation", "reward", "speed", "unsafe", "success", "terminated", "valid")
    predicted = Trajectory(**{name: column(PREDICTED + name)[:, :horizon] for name in seen})
    steps = {name: column(name) for name in fields}
    return Interaction(takeover=column("is_intervention"), predicted=predicted, **steps)


def states(columns: Columns, like: Any) -> Any:
    """The recorded worlds, [T], as a struct like `like`.

    Raises:
        UserError: If they are of another world.
    """
    names = list(_flat(like))
    missing = [name for name in names if STATE + name not in columns]
    if missing:
        raise UserError(f"the recording's states are of another world: they lack {missing[0]!r}")
    return jax.tree.unflatten(jax.tree.structure(like), [columns[STATE + name] for name in names])


def export_minari(run: Path, name: str) -> int:
    """Write a session as a Minari data set; returns the number of its steps.

    What was executed are its actions; `is_intervention` and both sides' actions are in its infos.

    Raises:
        UserError: If Minari is not installed, has a data set of that name, or there is nothing.
    """
    minari = need("minari", "minari", "a Minari data set")
    import gymnasium
    from minari.data_collector import EpisodeBuffer

    columns, config = load(run)
    size, actions = columns["observation"].shape[1], columns["executed_action"].shape[1]
    found = []
    for number in np.unique(columns[EPISODE]):
        at = columns[EPISODE] == number
        ended = bool(columns["terminated"][at][-1] | columns["truncated"][at][-1])
        truncations = columns["truncated"][at].copy()
        truncations[-1] |= not ended  # left unfinished
        infos = {
            key: columns[key][at]
            for key in ("is_intervention", "novice_action", "expert_action", "cost", "success")
        }
        last = columns["next_observation"][at][-1:]
        found.append(
            EpisodeBuffer(
                observations=np.concatenate([columns["observation"][at], last]),
                actions=columns["executed_action"][at],
                rewards=columns["reward"][at],
                terminations=columns["terminated"][at],
                truncations=truncations,
                infos={key: np.concatenate([v, v[-1:]]) for key, v in infos.items()},
            )
        )
    try:
        # it warns that neither author nor link to code is named: both are the user's to add
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            minari.create_dataset_from_buffers(
                name,
                found,
                observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32),
                action_space=gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32),
                algorithm_name=str(config.get("algorithm")),
                description=f"a person at the gate of {config.get('env')} (ppl_jax)",
            )
    except ValueError as error:
        raise UserError(f"minari: {error}") from error
    return len(columns[EPISODE])
