"""From an MJCF to the model that MJX runs: parsed, checked, and without what is only drawn."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import numpy as np

from envs.manipulation.physics.mujoco_c import import_mujoco

Source = Any
"""MJCF as text, the path of an MJCF file, a `mujoco.MjSpec`, or a compiled `mujoco.MjModel`."""


def one_line(error: Exception) -> str:
    """The message of MuJoCo's or MJX's error in one line."""
    parts = error.args if len(error.args) > 1 else (str(error),)
    return " ".join(" ".join(str(part) for part in parts).split())


def read(source: Source) -> Any:
    """The `mujoco.MjSpec` of a source.

    Args:
        source: MJCF as text (it begins with "<"), a path, or an `MjSpec`, which is copied.

    Raises:
        ValueError: If there is no such file, or the MJCF does not parse: one line.
    """
    mujoco = import_mujoco()
    if isinstance(source, mujoco.MjSpec):
        return source.copy()
    text = os.fspath(source)
    try:
        if text.lstrip().startswith("<"):
            return mujoco.MjSpec.from_string(text)
        if not os.path.isfile(text):
            raise ValueError(f"no MJCF file {text!r}")
        return mujoco.MjSpec.from_file(text)
    except ValueError as error:
        raise ValueError(f"this MJCF does not parse: {one_line(error)}") from error


def compiled(spec: Any) -> Any:
    """The compiled model of an `MjSpec`.

    Raises:
        ValueError: If it does not compile: one line.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(f"this MJCF does not compile: {one_line(error)}") from error


def without_looks(spec: Any, model: Any, keep: Iterable[str] = ()) -> Any:
    """The same physics without geoms that can touch nothing, compiled.

    Each of them costs a frame in every physics step. The bodies keep the masses that those geoms
    gave them.

    Args:
        spec: `MjSpec` that `model` was compiled from; it is changed.
        model: Compiled with all geoms.
        keep: Names of geoms whose places are asked for.
    """
    mujoco = import_mujoco()
    paired = set(model.pair_geom1.tolist()) | set(model.pair_geom2.tolist())
    names = [model.geom(index).name for index in range(model.ngeom)]
    idle = [
        not (model.geom_contype[index] or model.geom_conaffinity[index])
        and index not in paired
        and names[index] not in set(keep)
        for index in range(model.ngeom)
    ]
    for index, body in enumerate(spec.bodies):
        if index == 0:
            continue
        body.explicitinertial, body.mass = True, float(model.body_mass[index])
        body.ipos, body.iquat = model.body_ipos[index], model.body_iquat[index]
        body.inertia = model.body_inertia[index]
        body.fullinertia = np.full(6, np.nan)
    for geom, drop in zip(list(spec.geoms), idle, strict=True):
        if drop:
            spec.delete(geom)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    return compiled(spec)
