"""The two scenes as MJCF, built from the tabulated UR5e; and indices into them.

Kinematics, inertias, armature, limits and contact parameters are robosuite 1.4.1's; every shape is
a primitive. What MuJoCo collides is only what the named `<pair>`s list: the tool with what it
works on. Contacts of the arm itself end an episode and are found by distance (`links.py`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

CONTROL_STEP = 0.05  # s
TIMESTEP = (
    0.002  # s: robosuite's; at 5 ms the free arm strays 2 mm in a second, wiping 20 times more
)
SUBSTEPS = 25

INITIAL_JOINTS = np.array([-0.470, -1.735, 2.480, -2.275, -1.590, -1.991])
INITIAL_NOISE = 0.02  # rad, standard deviation per joint
JOINT_LIMIT = np.array([6.28319, 6.28319, 3.14159, 6.28319, 6.28319, 6.28319])
TORQUE_LIMIT = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])
FRICTION_LOSS = 0.01  # N m, every arm joint

WIPING_BASE = (-0.41, 0.0, 0.912)
NUT_BASE = (-0.56, 0.0, 0.912)
WIPING_TABLE = ((0.15, 0.0), (0.25, 0.40), 0.90)  # centre, half size, height of the top
NUT_TABLE = ((0.0, 0.0), (0.40, 0.40), 0.82)
PEG = (0.23, -0.10, 0.85)  # centre of the round peg
PEG_RADIUS, PEG_HALF = 0.02, 0.1
RING_RADIUS, RING_BEAD = 0.0412, 0.01  # of the circle of beads that stand for the ring; a bead's
HANDLE = (0.06, 0.0, 0.0)  # of the handle's centre in the ring's frame
HANDLE_HALF = (0.02525, 0.015875, 0.01)


class Link(NamedTuple):
    """A link of the arm, in its parent's frame; inertia in its own.

    Attributes:
        name: Of body; its joint is `joint_0` ... `joint_5`.
        position: Of the frame, m.
        turned: The frame is turned by 90 degrees about y.
        axis: Of the joint, "y" or "z".
        mass: kg.
        centre: Of mass, m.
        inertia: Principal ones about x, y, z, kg m^2.
    """

    name: str
    position: tuple[float, float, float]
    turned: bool
    axis: str
    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float]


LINKS = (
    Link("shoulder", (0.0, 0.0, 0.163), False, "z", 3.7, (0.0, 0.0, 0.0),
         (0.0102675, 0.0102675, 0.00666)),
    Link("upper_arm", (0.0, 0.138, 0.0), True, "y", 8.393, (0.0, 0.0, 0.2125),
         (0.133886, 0.133886, 0.0151074)),
    Link("forearm", (0.0, -0.131, 0.425), False, "y", 2.275, (0.0, 0.0, 0.196),
         (0.0311796, 0.0311796, 0.004095)),
    Link("wrist_1", (0.0, 0.0, 0.392), True, "y", 1.219, (0.0, 0.127, 0.0),
         (0.0025599, 0.0025599, 0.0021942)),
    Link("wrist_2", (0.0, 0.127, 0.0), False, "z", 1.219, (0.0, 0.0, 0.1),
         (0.0025599, 0.0025599, 0.0021942)),
    Link("wrist_3", (0.0, 0.0, 0.1), False, "y", 0.1889, (0.0, 0.0771683, 0.0),
         (9.90863e-5, 1.32134e-4, 9.90863e-5)),
)  # fmt: skip
HAND = (0.0, 0.098, 0.0)  # of the hand's frame in wrist 3's; turned by -90 degrees about x
ARMATURE = tuple(5.0 / (index + 1) for index in range(6))
DAMPING = 0.001  # N m s, every arm joint


class Tool(NamedTuple):
    """What the hand holds, rigid; along the hand's z axis.

    Attributes:
        mass: kg.
        centre: Distance of its centre of mass from the hand's frame, m.
        inertia: About the hand's axes through that centre, kg m^2.
        grip: Distance of the grip site, m. The site is turned by -90 degrees about z.
        box: Side of the box whose drag in air stands for the tool's, m (MuJoCo's inertia box).
    """

    mass: float
    centre: float
    inertia: tuple[float, float, float]
    grip: float
    box: float


WIPER = Tool(0.03, 0.015, (0.01, 0.01, 0.01), 0.03, 2**0.5)
GRIPPER = Tool(0.1579, 0.0886, (0.00137, 0.00137, 0.00105), 0.145, 0.775)
AIR_DENSITY, AIR_VISCOSITY = 1.2, 2e-5  # kg/m^3, Pa s

_ARM_COLOUR, _JOINT_COLOUR, _STEEL = ".93 .93 .95 1", ".35 .60 .85 1", ".30 .32 .36 1"
# drawn shape of each link: capsule ends and radius, in the link's frame
_SHAPES = {
    "shoulder": "0 0 -.03 0 .03 0",
    "upper_arm": "0 .01 0 0 .01 .425",
    "forearm": "0 0 0 0 0 .392",
    "wrist_1": "0 .06 0 0 .127 0",
    "wrist_2": "0 0 .05 0 0 .1",
    "wrist_3": "0 .05 0 0 .09 0",
}
_RADII = {
    "shoulder": 0.062,
    "upper_arm": 0.056,
    "forearm": 0.047,
    "wrist_1": 0.042,
    "wrist_2": 0.042,
    "wrist_3": 0.036,
}


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _arm(tool: str, mount: tuple[float, float, float]) -> str:
    """The arm's bodies, nested, with `tool` (MJCF) in the hand."""
    text = f"""
<body name="hand" pos="{_text(HAND)}" quat=".7071067811865476 -.7071067811865476 0 0">{tool}</body>"""
    for index, link in reversed(list(enumerate(LINKS))):
        quat = ".7071067811865476 0 .7071067811865476 0" if link.turned else "1 0 0 0"
        text = f"""
<body name="{link.name}" pos="{_text(link.position)}" quat="{quat}">
  <inertial mass="{link.mass}" pos="{_text(link.centre)}" diaginertia="{_text(link.inertia)}"/>
  <joint name="joint_{index}" axis="0 {"1 0" if link.axis == "y" else "0 1"}"
    damping="{DAMPING}" armature="{ARMATURE[index]:.12g}"/>
  <geom class="shown" type="capsule" fromto="{_SHAPES[link.name]}" size="{_RADII[link.name]}"
    rgba="{_ARM_COLOUR if index in (1, 2) else _JOINT_COLOUR}"/>
  {text}
</body>"""
    x, y, z = mount
    return f"""
<body name="mount" pos="{x} {y} {z}">
  <geom class="shown" type="cylinder" pos="-.02 0 -.30" size=".17 .31" rgba="{_STEEL}"/>
  <geom class="shown" type="cylinder" pos="0 0 .05" size=".075 .05" rgba="{_STEEL}"/>
  {text}
</body>"""


def _scene(bodies: str, pairs: str, extra: str = "") -> str:
    return f"""
<mujoco model="ppl_jax">
  <compiler angle="radian" autolimits="true" inertiafromgeom="auto"/>
  <option timestep="{TIMESTEP}" integrator="Euler" cone="pyramidal" solver="Newton"
    gravity="0 0 -9.81" density="1.2" viscosity="2e-5" iterations="4" ls_iterations="4">
    <flag eulerdamp="disable" filterparent="disable"/>
  </option>
  <visual><headlight ambient=".45 .45 .45" diffuse=".55 .55 .55" specular=".1 .1 .1"/>
    <global offwidth="1280" offheight="960"/></visual>
  <default>
    <default class="shown"><geom contype="0" conaffinity="0" group="1" mass="0"/></default>
    <default class="felt"><geom contype="0" conaffinity="0" group="3" mass="0"/></default>
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".86 .90 .95" rgb2=".98 .98 1"
      width="64" height="64"/>
    <texture name="wood" type="2d" builtin="flat" rgb1=".86 .78 .66" width="8" height="8"/>
    <material name="table" texture="wood" specular=".1" reflectance="0"/>
  </asset>
  <worldbody>
    <light pos="-.3 -.6 2.4" dir=".2 .3 -1" diffuse=".35 .35 .35" castshadow="false"/>
    <geom class="shown" type="plane" size="3 3 .1" rgba=".72 .75 .78 1"/>
    {bodies}
  </worldbody>
  <contact>{pairs}</contact>
  {extra}
</mujoco>"""


def _table(table: tuple[tuple[float, float], tuple[float, float], float]) -> str:
    (x, y), (half_x, half_y), top = table
    legs = "".join(
        f'<geom class="shown" type="cylinder" size=".022 {(top - 0.05) / 2}" rgba="{_STEEL}" '
        f'pos="{x + sx * (half_x - 0.04)} {y + sy * (half_y - 0.04)} {(top - 0.05) / 2}"/>'
        for sx in (-1, 1)
        for sy in (-1, 1)
    )
    return f"""
<geom class="shown" type="box" pos="{x} {y} {top - 0.025}" size="{half_x} {half_y} .025"
  material="table"/>{legs}
<geom name="table" class="felt" type="plane" pos="{x} {y} {top}" size="{half_x} {half_y} .05"/>"""
