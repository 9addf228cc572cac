"""Contacts that MuJoCo would close and this package's scenes do not have.

The functions take MuJoCo's arrays or MJX's: `may_close(model, data, contact) -> [C]`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from envs.manipulation.scenes.model import HANDLE_HALF, WIPING_TABLE

DEEPEST = 0.005  # m: a point farther inside the handle came through another face


def over_wiping_table(model: Any, data: Any, contact: Any) -> Any:
    """The wiper's contacts on the table's top: a plane has no edge in MuJoCo."""
    del model, data
    (x, y), half, _ = WIPING_TABLE
    away = abs(contact.pos[:, :2] - np.array([x, y], np.float32))
    return (away[:, 0] < half[0]) & (away[:, 1] < half[1])


def on_long_sides(model: Any, data: Any, contact: Any) -> Any:
    """The pads' contacts on the handle's two long sides, and all contacts elsewhere."""
    handle = model.geom("handle").id
    local = (contact.pos - data.geom_xpos[handle]) @ data.geom_xmat[handle].reshape(3, 3)
    inside = (abs(local[:, 0]) < HANDLE_HALF[0]) & (abs(local[:, 2]) < HANDLE_HALF[2])
    elsewhere = (contact.geom[:, 0] != handle) & (contact.geom[:, 1] != handle)
    return elsewhere | (inside & (contact.dist > -DEEPEST))


def over_table(table: tuple[tuple[float, float], tuple[float, float], float]) -> Any:
    """A `may_close` for a scene of `scenes.model.arm_scene`: what meets the table meets its top.

    Args:
        table: Centre and half size of its top, m, and the height.
    """
    (x, y), half, _ = table

    def may_close(model: Any, data: Any, contact: Any) -> Any:
        del data
        plane = model.geom("table").id
        away = abs(contact.pos[:, :2] - np.array([x, y], np.float32))
        elsewhere = (contact.geom[:, 0] != plane) & (contact.geom[:, 1] != plane)
        return elsewhere | ((away[:, 0] < half[0]) & (away[:, 1] < half[1]))

    return may_close
