"""MuJoCo Warp behind MJX (`impl="warp"`): its own collision and solver, on CUDA devices."""

from __future__ import annotations

import importlib.util
from typing import Any, NamedTuple

import jax
import numpy as np

from envs.manipulation.physics.mjx.repairs import mjx


class Room(NamedTuple):
    """What Warp sets aside before it runs; more than fits is dropped by it with a warning.

    Attributes:
        contacts: Of all worlds of a batch together.
        rows: Constraint rows of one world.
    """

    contacts: int = 65_536
    rows: int = 256


def put(model: Any, room: Room) -> tuple[Any, Any]:
    """Warp's model and data.

    Args:
        model: C MuJoCo's.
        room: For contacts and rows.

    Raises:
        ImportError: Without Warp.
    """
    if importlib.util.find_spec("warp") is None:
        raise ImportError("impl 'warp' needs MuJoCo Warp: pip install 'ppl-jax[warp]'")
    x = mjx()
    data = x.make_data(model, impl="warp", naconmax=room.contacts, njmax=room.rows)
    return x.put_model(model, impl="warp"), data


def mass_matrix(model: Any, data: Any) -> jax.Array:
    """Joint-space inertia, [nv, nv], of Warp's rows of its lower triangle.

    Args:
        model: C MuJoCo's.
        data: After `mjx.forward`.
    """
    row = np.repeat(np.arange(model.nv), model.M_rownnz)
    place = np.full((model.nv, model.nv), len(row))  # of a zero behind the last
    place[row, model.M_colind] = place[model.M_colind, row] = np.arange(len(row))
    return jax.numpy.append(data._impl.M, 0.0)[place]
