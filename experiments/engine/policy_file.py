"""Policies as one `.npz` without pickles, that plain NumPy can run.

Arrays `w0, b0, w1, b1, ...` (row vectors: `x @ w + b`), `activation` ("relu" or "tanh", between
layers), `output` ("tanh": squash the last layer; "clip": clip it to [-1, 1]), optionally `obs_mean`
and `obs_scale` (`(obs - mean) / scale` first) and `log_std` (of the Gaussian around the action, of
a policy that has one), `version` of this format, and `meta`, a JSON string.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.engine.files import write_atomic
from ppl_jax.experts import SavedPolicy
from ppl_jax.npz import read_npz

VERSION = 1


def save_policy(path: str | Path, policy: SavedPolicy, meta: dict[str, Any]) -> None:
    """Write a policy file, whole or not at all."""
    arrays: dict[str, Any] = {}
    for i, (w, b) in enumerate(policy.weights):
        arrays[f"w{i}"], arrays[f"b{i}"] = np.asarray(w), np.asarray(b)
    if policy.log_std is not None:
        arrays["log_std"] = np.asarray(policy.log_std, np.float32)
    arrays |= {
        "activation": np.array(policy.activation),
        "output": np.array(policy.output),
        "obs_mean": np.asarray(policy.obs_mean, np.float32),
        "obs_scale": np.asarray(policy.obs_scale, np.float32),
        "version": np.array(VERSION),
        "meta": np.array(json.dumps(meta)),
    }
    write_atomic(path, lambda file: np.savez(file, **arrays))


def load_policy(path: str | Path, observation_size: int, action_size: int) -> SavedPolicy:
    """Read a policy file and check it against an environment.

    Raises:
        ValueError: If the file is missing, no policy or of a newer version, a number in it is not
            finite, its layers do not fit together, or its sizes are not the environment's.
    """
    name = f"policy file {str(path)!r}"
    files = _read(path)
    if (version := _version(files, name)) > VERSION:
        raise ValueError(f"{name} has version {version}; this program reads up to {VERSION}")
    count = sum(field[0] == "w" and field[1:].isdigit() for field in files)
    if not count:
        raise ValueError(f"{name} holds no layer w0, b0")
    layers = [(f"w{i}", f"b{i}") for i in range(count)]
    for field in (*(field for layer in layers for field in layer), "activation", "output"):
        if field not in files:
            raise ValueError(f"{name} holds no array {field!r}")
    weights = [(files[w], files[b]) for w, b in layers]
    activation, output = str(files["activation"]), str(files["output"])
    if activation not in ("relu", "tanh") or output not in ("tanh", "clip"):
        raise ValueError(
            f"{name}: activation must be relu or tanh and output tanh or clip, got "
            f"{activation!r} and {output!r}"
        )
    mean = files.get("obs_mean", np.zeros(observation_size, np.float32))
    scale = files.get("obs_scale", np.ones(observation_size, np.float32))
    log_std = files.get("log_std")
    for i, (w, b) in enumerate(weights):
        fits = w.ndim == 2 and b.shape == w.shape[1:] and w.size
        if not fits or (i and weights[i - 1][0].shape[1] != w.shape[0]):
            raise ValueError(
                f"{name}: w{i} {w.shape} and b{i} {b.shape} do not fit the layer before"
            )
    takes, gives = weights[0][0].shape[0], weights[-1][0].shape[1]
    if takes != observation_size or gives != action_size:
        raise ValueError(
            f"{name} maps {takes} observations to {gives} actions; this environment has "
            f"{observation_size} and {action_size}"
        )
    arrays = {
        f"{kind}{i}": x
        for i, layer in enumerate(weights)
        for kind, x in zip("wb", layer, strict=True)
    }
    arrays |= {"obs_mean": mean, "obs_scale": scale}
    if log_std is not None:
        arrays["log_std"] = log_std
    shapes = {"obs_mean": (takes,), "obs_scale": (takes,), "log_std": (gives,)}
    for field, value in arrays.items():
        if value.shape != shapes.get(field, value.shape):
            raise ValueError(f"{name}: {field} has shape {value.shape}, expected {shapes[field]}")
        if value.dtype.kind not in "iuf":
            raise ValueError(f"{name}: {field} holds {value.dtype}, expected real numbers")
        with np.errstate(over="ignore"):
            bad = ~np.isfinite(value.astype(np.float32))
        if bad.any():
            at = [int(i) for i in np.argwhere(bad)[0]]
            raise ValueError(f"{name}: {field} holds a NaN or infinite number at {at}")
    if not (scale > 0).all():
        raise ValueError(f"{name}: obs_scale must be positive")
    return SavedPolicy(
        weights=weights,
        activation=activation,
        output=output,
        obs_mean=mean,
        obs_scale=scale,
        log_std=log_std,
    )


def load_meta(path: str | Path) -> dict[str, Any]:
    """Facts that a policy file holds about itself.

    Raises:
        ValueError: If it cannot be read, or they are no JSON object.
    """
    files = _read(path)
    if "meta" not in files:
        raise ValueError(f"policy file {str(path)!r} holds no array 'meta'")
    text = str(files["meta"])
    try:
        meta = json.loads(text)
    except (ValueError, RecursionError):
        meta = None
    if not isinstance(meta, dict):
        raise ValueError(
            f"policy file {str(path)!r}: meta must be a JSON object, got {text[:40]!r}"
        )
    return meta


def _read(path: str | Path) -> dict[str, np.ndarray]:
    try:
        return read_npz(path)
    except ValueError as error:
        raise ValueError(f"policy file {str(path)!r} cannot be read: {error}") from error


def _version(files: dict[str, np.ndarray], name: str) -> int:
    """The version of the format; the first wrote none."""
    version = files.get("version", np.array(VERSION))
    if version.shape != () or version.dtype.kind not in "iu":
        raise ValueError(f"{name}: version must be a whole number, got {str(version)[:40]!r}")
    return int(version)
