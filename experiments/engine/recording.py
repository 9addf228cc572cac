"""Recordings of sessions: every step with its state, as plain arrays, without pickles.

A run folder holds one in pieces (recording/NUMBER.npz, up to that line of the session's log); an
exported session is one file of the same columns. All are [T] or [T, ...]:

    observation, next_observation     before and after the step
    novice_action, expert_action      of either (the person's: where is_intervention)
    executed_action, is_intervention  the action made, and whether the person made it
    takeover_start                    the person was not in control in the step before
    reward, cost, terminated, truncated, success
    predicted/...                     where the novice's held action would have led, [T, L, ...]
    episode                           a number for each, an unfinished one too
    ahead, fails                      the predicted path that was shown, [T, H, P], and its verdict
    state/...                         the environment's before the step, enough to draw it

Demonstrations from elsewhere need `observation`, `executed_action` (or `action`) and one of
`episode`, `terminated` and `truncated`; `experiments.engine.columns` says what each column may hold
and what follows from the others where it is missing. Columns of other names are left out. `meta` is
a JSON object, the session's config.json; its `env`, where it is there, has to be the run's.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine.columns import (
    AHEAD,
    EPISODE,
    FAILS,
    META,
    PREDICTED,
    STATE,
    Columns,
    checked,
    completed,
    joined,
)
from experiments.engine.config_file import checked_content, read_config
from experiments.engine.files import check_ending, write_atomic
from experiments.engine.runtime import UserError, need
from ppl_jax.interaction import no_prediction
from ppl_jax.npz import read_npz
from ppl_jax.types import Env, Interaction, Trajectory

FOLDER = "recording"
_RENAMED = {"takeover": "is_intervention"}
_STEP_FIELDS = (
    "observation",
    "next_observation",
    "expert_action",
    "executed_action",
    "takeover_start",
    "reward",
    "cost",
    "terminated",
    "truncated",
    "success",
)
_PREDICTED_FIELDS = ("observation", "reward", "speed", "unsafe", "success", "terminated", "valid")


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


def row_of(step: Interaction, state: Any) -> dict[str, Any]:
    """A step as a row of columns; `state` is the environment's before it."""
    row = {_RENAMED.get(name, name): np.asarray(leaf) for name, leaf in _flat(step).items()}
    return row | {STATE + name: np.array(leaf) for name, leaf in _flat(state).items()}


class Recorder:
    """Collects the steps of a session and writes them in pieces."""

    def __init__(self, run: Path):
        self.folder = run / FOLDER
        self.episode = 0
        self.rows: list[dict[str, Any]] = []

    def add(self, step: Interaction, state: Any, ahead: PredictedPath) -> None:
        """Take a step, the state before it and the predicted path that was shown."""
        row = row_of(step, state) | {AHEAD: ahead.path, FAILS: np.bool_(ahead.fails)}
        self.rows.append(row | {EPISODE: np.int32(self.episode)})
        self.episode += bool(row["terminated"] | row["truncated"])

    def restart(self) -> None:
        """The episode was left unfinished."""
        self.episode += 1

    def take(self) -> list[dict[str, Any]]:
        """Hand the steps so far over to the caller, which writes them."""
        rows, self.rows = self.rows, []
        return rows

    def write(self, rows: list[dict[str, Any]], events: int) -> None:
        """Write a piece: the steps up to line `events` of the log."""
        if not rows:
            return
        self.folder.mkdir(exist_ok=True)
        columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        _write(self.folder / f"{events:010d}.npz", columns | {"next_episode": self.episode})

    def rewind(self, events: int) -> tuple[int, PredictedPath | None]:
        """Drop the pieces beyond line `events` of the log: those steps are repeated.

        Returns:
            The number of steps in the episode under way, and the path that was shown last in it.
        """
        self.rows, self.episode = [], 0
        for path in _pieces(self.folder):
            if int(path.stem) > events:
                path.unlink()
        pieces = _pieces(self.folder)
        if not pieces:
            return 0, None
        with np.load(pieces[-1], allow_pickle=False) as piece:
            self.episode = int(piece["next_episode"])
        if restarts := events - int(pieces[-1].stem):  # lines of the log that are no steps
            self.episode += restarts
            return 0, None
        steps, shown = 0, None
        for path in reversed(pieces):
            with np.load(path, allow_pickle=False) as piece:
                mine = piece[EPISODE] == self.episode
                if mine.any() and shown is None and AHEAD in piece:
                    shown = PredictedPath(piece[AHEAD][-1], bool(piece[FAILS][-1]))
            steps += int(mine.sum())
            if not mine.all():
                break
        return (steps, shown) if shown is not None else (0, None)


def _pieces(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*.npz") if path.stem.isdigit())


def _write(path: Path, columns: dict[str, Any]) -> None:
    write_atomic(path, lambda file: np.savez_compressed(file, **columns))


def load(path: Path) -> tuple[Columns, dict[str, Any]]:
    """The columns of a run folder or an exported session, and the content of its config.json.

    Raises:
        UserError: If there is no recording, or one line of what in it cannot be.
    """
    where = f"recording {str(path)!r}"
    if path.is_dir():
        config = read_config(path)
        found = {}
        for piece in _pieces(path / FOLDER):
            name = f"recording {str(piece)!r}"
            found[name] = checked(_read(piece, name), name)
        if not found:
            raise UserError(f"{str(path)!r} has no recording: no step of a person was saved in it")
        return completed(joined(found), where), config
    columns = _read(path, where)
    config = _meta(columns.pop(META, np.array("{}")), f"{where}, {META}")
    return completed(checked(columns, where), where), config


def _read(path: Path, where: str) -> Columns:
    try:
        columns = read_npz(path)
    except ValueError as error:
        raise UserError(f"{where} cannot be read: {error}") from error
    columns.pop("next_episode", None)
    return columns


def _meta(array: np.ndarray, where: str) -> dict[str, Any]:
    try:
        content = json.loads(str(array))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where} must be a JSON object, got {str(array)[:40]!r}") from error
    return checked_content(content, where)


def export(run: Path, out: Path) -> int:
    """Write a session as one file; returns the number of its steps.

    Raises:
        UserError: If there is nothing to export, or `out` is no .npz.
    """
    check_ending(out, (".npz",))
    columns, config = load(run)
    _write(out, columns | {META: np.str_(json.dumps(config))})
    return len(columns[EPISODE])


def predicted_steps(columns: Columns) -> int:
    """Number of predicted states per step that can be learnt from, L; 0 where there are none.

    They belong to the novice's action.
    """
    needed = ["novice_action", *(PREDICTED + name for name in _PREDICTED_FIELDS)]
    return columns[needed[1]].shape[1] if all(name in columns for name in needed) else 0


def refuse_other_sizes(columns: Columns, env: Env, where: str = "recording") -> None:
    """Check that observations and actions have the sizes of an environment.

    Raises:
        UserError: One line naming the column and both sizes.
    """
    for name, size in (
        ("observation", env.spec.observation_size),
        ("executed_action", env.spec.action_size),
    ):
        shape = list(columns[name].shape)
        if shape[1] != size:
            raise UserError(f"{where}: column {name!r} is {shape}, {env.name} needs [T, {size}]")


def interactions(columns: Columns, env: Env, horizon: int, where: str = "recording") -> Interaction:
    """Recorded steps as passed to a method, [T].

    Args:
        columns: From `load`. Where they have no novice's action, it is the executed one.
        env: The environment they are learnt in.
        horizon: Predicted states per step.
        where: File, for messages.

    Raises:
        UserError: If they are of another environment, or hold fewer predicted states.
    """
    refuse_other_sizes(columns, env, where)
    have = predicted_steps(columns)
    if have < horizon:
        raise UserError(f"{where} has {have} predicted states of each step, not {horizon}")
    column = cast(dict[str, Any], columns)
    length, predicted = len(column[EPISODE]), no_prediction()
    if horizon:
        found = {name: column[PREDICTED + name][:, :horizon] for name in _PREDICTED_FIELDS}
        predicted = Trajectory(**found)
    else:
        predicted = jax.tree.map(
            lambda leaf: jnp.zeros((length, *leaf.shape), leaf.dtype), predicted
        )
    return Interaction(
        takeover=column["is_intervention"],
        novice_action=column.get("novice_action", column["executed_action"]),
        predicted=predicted,
        **{name: column[name] for name in _STEP_FIELDS},
    )


def states(columns: Columns, like: Any) -> Any:
    """The recorded states, [T], as a struct like `like`.

    Raises:
        UserError: With the column that is missing or of another environment, after "recording X: ".
    """
    leaves = _flat(like)
    for name, leaf in leaves.items():
        if STATE + name not in columns:
            raise UserError(f"it has no column {STATE + name!r}")
        column = columns[STATE + name]
        fits = np.can_cast(column.dtype, leaf.dtype, "same_kind")
        if column.shape[1:] != leaf.shape or not fits:
            raise UserError(
                f"its column {STATE + name!r} has rows of {list(column.shape[1:])} {column.dtype}, "
                f"not of {list(leaf.shape)} {leaf.dtype}"
            )
    found = [columns[STATE + name].astype(leaf.dtype) for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(like), found)


def export_minari(run: Path, name: str) -> int:
    """Write a session as a Minari data set; returns the number of its steps.

    Its actions are the executed ones; `is_intervention` and both sides' actions are in its infos.

    Raises:
        UserError: If Minari is not installed, has a data set of that name, or no step was recorded.
    """
    minari = need("minari", "minari", "a Minari data set")
    spaces = need("gymnasium.spaces", "minari", "a Minari data set")
    columns, config = load(run)
    size, actions = columns["observation"].shape[1], columns["executed_action"].shape[1]
    found = _episode_buffers(columns)
    try:
        # it warns that neither author nor link to code is named: both are the user's to add
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            minari.create_dataset_from_buffers(
                name,
                found,
                observation_space=spaces.Box(-np.inf, np.inf, (size,), np.float32),
                action_space=spaces.Box(-1.0, 1.0, (actions,), np.float32),
                algorithm_name=str(config.get("algorithm")),
                description=f"a person at the gate of {config.get('env')} (ppl_jax)",
            )
    except ValueError as error:
        raise UserError(f"minari: {error}") from error
    return len(columns[EPISODE])


def _episode_buffers(columns: Columns) -> list[Any]:
    """The recorded episodes as Minari takes them."""
    buffer = need("minari.data_collector", "minari", "a Minari data set").EpisodeBuffer
    found = []
    for number in np.unique(columns[EPISODE]):
        at = columns[EPISODE] == number
        ended = bool(columns["terminated"][at][-1] | columns["truncated"][at][-1])
        truncations = columns["truncated"][at].copy()
        truncations[-1] |= not ended  # left unfinished
        infos = {
            key: columns[key][at]
            for key in ("is_intervention", "novice_action", "expert_action", "cost", "success")
            if key in columns
        }
        last = columns["next_observation"][at][-1:]
        found.append(
            buffer(
                observations=np.concatenate([columns["observation"][at], last]),
                actions=columns["executed_action"][at],
                rewards=columns["reward"][at],
                terminations=columns["terminated"][at],
                truncations=truncations,
                infos={key: np.concatenate([v, v[-1:]]) for key, v in infos.items()},
            )
        )
    return found
