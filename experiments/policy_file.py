"""Policies as one `.npz` without pickles, that plain NumPy can run.

Arrays `w0, b0, w1, b1, ...` (row vectors: `x @ w + b`), `activation` ("relu" or "tanh", between
layers), `output` ("tanh": squash the last layer; "clip": clip it to [-1, 1]), optionally `obs_mean`
and `obs_scale` (`(obs - mean) / scale` first), and `meta`, a JSON string.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from ppl_jax.experts import SavedPolicy


def save_policy(path: str | Path, policy: SavedPolicy, meta: dict[str, Any]) -> None:
    """Write a policy file, whole or not at all."""
    arrays: dict[str, Any] = {}
    for i, (w, b) in enumerate(policy.weights):
        arrays[f"w{i}"], arrays[f"b{i}"] = np.asarray(w), np.asarray(b)
    part = Path(f"{path}.part")
    with open(part, "wb") as file:
        np.savez(
            file,
            **arrays,
            activation=np.array(policy.activation),
            output=np.array(policy.output),
            obs_mean=np.asarray(policy.obs_mean, np.float32),
            obs_scale=np.asarray(policy.obs_scale, np.float32),
            meta=np.array(json.dumps(meta)),
        )
    os.replace(part, path)


def load_policy(path: str | Path, observation_size: int, action_size: int) -> SavedPolicy:
    """Read a policy file and check it against a world.

    Raises:
        ValueError: If the file is missing or no policy, a number in it is not finite, or its
            sizes are not the world's.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            files = {name: archive[name] for name in archive.files}
        count = sum(name[0] == "w" and name[1:].isdigit() for name in files)
        weights = [(files[f"w{i}"], files[f"b{i}"]) for i in range(count)]
        activation, output = str(files["activation"]), str(files["output"])
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"policy file {str(path)!r} cannot be read: {error}") from error
    if not weights:
        raise ValueError(f"policy file {str(path)!r} holds no layer w0, b0")
    if activation not in ("relu", "tanh") or output not in ("tanh", "clip"):
        raise ValueError(
            f"policy file {str(path)!r}: activation must be relu or tanh and output tanh or clip, "
            f"got {activation!r} and {output!r}"
        )
    mean = files.get("obs_mean", np.zeros(observation_size, np.float32))
    scale = files.get("obs_scale", np.ones(observation_size, np.float32))
    for name, value in [
        *((f"w{i}", w) for i, (w, _) in enumerate(weights)),
        *((f"b{i}", b) for i, (_, b) in enumerate(weights)),
        ("obs_mean", mean),
        ("obs_scale", scale),
    ]:
        if not np.isfinite(value).all():
            raise ValueError(f"policy file {str(path)!r}: {name} holds a NaN or infinite number")
    takes, gives = weights[0][0].shape[0], weights[-1][0].shape[1]
    if takes != observation_size or gives != action_size:
        raise ValueError(
            f"policy file {str(path)!r} maps {takes} observations to {gives} actions; this world "
            f"has {observation_size} and {action_size}"
        )
    return SavedPolicy(weights, activation, output, mean, scale)
