"""A seven-joint arm with the Franka Emika Panda's kinematics, built from primitives.

Kinematics, joint and torque limits: Franka Control Interface documentation, "Robot and interface
specifications" (modified Denavit-Hartenberg parameters). Masses and centres of mass: Gaz, Cognetti,
Oliva, Robuffo Giordano, De Luca, "Dynamic Identification of the Franka Emika Panda Robot With
Retrieval of Feasible Parameters Using Penalty-Based Optimization", RA-L 4(4), 2019. Inertias are
those of solid cylinders in place of the drawn capsules; armature and damping are round values.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

JOINTS = tuple(f"panda_{index}" for index in range(1, 8))
TORQUE_LIMIT = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # N m
LIMITS = np.array(
    [[-2.8973, 2.8973], [-1.7628, 1.7628], [-2.8973, 2.8973], [-3.0718, -0.0698],
     [-2.8973, 2.8973], [-0.0175, 3.7525], [-2.8973, 2.8973]]
)  # rad  # fmt: skip
# over a table, the hand straight down: robosuite 1.4.1's pose, but for its tilt of 0.13 rad
REST = np.array([0.0, np.pi / 16, 0.0, -5 * np.pi / 6, 0.0, np.pi / 16 + 5 * np.pi / 6, np.pi / 4])
FLANGE = 0.107  # m, from the seventh frame to the hand's
_HAND_TURN = (np.cos(np.pi / 8), 0.0, 0.0, -np.sin(np.pi / 8))  # the hand is mounted at -45 degrees
ARMATURE, DAMPING = 0.1, 0.5  # kg m^2, N m s/rad, every joint


class _Link(NamedTuple):
    """A link in modified Denavit-Hartenberg form: its frame in the one before, and its mass.

    Attributes:
        a, d: Along the old x axis and along the new z axis, m.
        alpha: Quarter turns about the old x axis.
        mass: kg. centre: Of mass, m.
        ends: [2, 3] axis of the capsule that is drawn and gives the inertia, m.
        radius: Of the capsule, m.
    """

    a: float
    d: float
    alpha: int
    mass: float
    centre: tuple[float, float, float]
    ends: tuple[tuple[float, float, float], tuple[float, float, float]]
    radius: float


_LINKS = (
    _Link(0.0, 0.333, 0, 4.970684, (0.003875, 0.002081, -0.04762),
          ((0, 0, -0.19), (0, 0, 0.0)), 0.065),
    _Link(0.0, 0.0, -1, 0.646926, (-0.003141, -0.02872, 0.003495),
          ((0, 0, -0.05), (0, 0, 0.05)), 0.065),
    _Link(0.0, 0.316, 1, 3.228604, (0.027518, 0.039252, -0.066502),
          ((0, 0, -0.22), (0.04, 0, 0.0)), 0.06),
    _Link(0.0825, 0.0, 1, 3.587895, (-0.05317, 0.104419, 0.027454),
          ((0, 0, 0), (-0.06, 0.10, 0)), 0.06),
    _Link(-0.0825, 0.384, -1, 1.225946, (-0.011953, 0.041065, -0.038437),
          ((0, 0.02, -0.24), (0, 0.05, -0.02)), 0.05),
    _Link(0.0, 0.0, 1, 1.666555, (0.060149, -0.014117, -0.010517),
          ((0, 0, 0), (0.07, 0, 0)), 0.05),
    _Link(0.088, 0.0, 1, 0.735522, (0.010517, -0.004252, 0.061597),
          ((0, 0, 0.03), (0, 0, 0.09)), 0.045),
)  # fmt: skip
_QUATS = {0: "1 0 0 0", 1: ".7071067811865476 .7071067811865476 0 0",
          -1: ".7071067811865476 -.7071067811865476 0 0"}  # fmt: skip
_WHITE, _GREY = ".94 .94 .95 1", ".35 .37 .41 1"


def _inertia(link: _Link) -> np.ndarray:
    """Inertia of a solid cylinder with the capsule's axis and radius, [3, 3] kg m^2.

    m r^2 / 2 about its axis, m (3 r^2 + l^2) / 12 across it, l over both caps.
    """
    axis = np.subtract(link.ends[1], link.ends[0])
    length = float(np.linalg.norm(axis))
    along, whole = np.outer(axis, axis) / length**2, length + 2 * link.radius
    about = link.mass * link.radius**2 / 2
    across = link.mass * (3 * link.radius**2 + whole**2) / 12
    return across * np.eye(3) + (about - across) * along


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def panda_arm(tool: str, *, base: Sequence[float] = (0.0, 0.0, 0.0), grip: float) -> str:
    """MJCF of the arm's bodies, from `panda_mount` to `hand`, with joints `JOINTS`.

    Its shapes are drawn only: what is to collide is the tool.

    Args:
        tool: MJCF of what is in the hand, in its frame: z points away from the arm, and x ahead
            at `REST`. It has an `<inertial>` or a geom with mass.
        base: Base of the arm in world axes, m.
        grip: Distance of the site "grip" from the hand's frame along z, m.
    """
    shown = 'contype="0" conaffinity="0" group="1" mass="0"'
    text = (
        f'<body name="hand" pos="0 0 {FLANGE}" quat="{_text(_HAND_TURN)}">'
        f'<site name="grip" pos="0 0 {grip}" size=".004" rgba="0 0 0 0"/>{tool}</body>'
    )
    for index, link in reversed(list(enumerate(_LINKS))):
        inertia = _inertia(link)
        full = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        # the new frame: a along x, turned by alpha about it, d along the turned z
        place = (link.a, -np.sin(np.pi / 2 * link.alpha) * link.d,
                 np.cos(np.pi / 2 * link.alpha) * link.d)  # fmt: skip
        text = f"""
<body name="panda_link_{index + 1}" pos="{_text(place)}" quat="{_QUATS[link.alpha]}">
  <inertial mass="{link.mass}" pos="{_text(link.centre)}" fullinertia="{_text(full)}"/>
  <joint name="{JOINTS[index]}" axis="0 0 1" range="{_text(LIMITS[index])}" limited="true"
    damping="{DAMPING}" armature="{ARMATURE}"/>
  <geom type="capsule" fromto="{_text(np.ravel(link.ends))}" size="{link.radius}" {shown}
    rgba="{_WHITE if index % 2 == 0 else _GREY}"/>
  {text}
</body>"""
    return f"""
<body name="panda_mount" pos="{_text(base)}">
  <geom type="cylinder" pos="0 0 .07" size=".08 .07" {shown} rgba="{_GREY}"/>
  {text}
</body>"""
