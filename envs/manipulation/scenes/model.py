"""The scenes as MJCF, built from the tabulated UR5e.

Kinematics, inertias, armature, limits and contact parameters are robosuite 1.4.1's; every shape is
a primitive. What MuJoCo collides is only what the named `<pair>`s list: the tool with what it
works on. Contacts of the arm itself end an episode and are found by distance (`collision.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

# robosuite's, s; at 5 ms the free arm strays 2 mm in a second, wiping 20 times more
TIMESTEP = 0.002
SUBSTEPS = 25  # per control step of 0.05 s

INITIAL_JOINTS = np.array([-0.470, -1.735, 2.480, -2.275, -1.590, -1.991])
INITIAL_NOISE = 0.02  # rad, standard deviation per joint
JOINT_LIMIT = np.array([6.28319, 6.28319, 3.14159, 6.28319, 6.28319, 6.28319], np.float32)
TORQUE_LIMIT = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])
FRICTION_LOSS = 0.01  # N m, every arm joint
PAD_SPHERE = 0.001  # m, radius of the spheres that stand for points of a gripper's pad

WIPING_BASE = (-0.41, 0.0, 0.912)
NUT_BASE = (-0.56, 0.0, 0.912)
WIPING_TABLE = ((0.15, 0.0), (0.25, 0.40), 0.90)  # centre, half size, height of the top
NUT_TABLE = ((0.0, 0.0), (0.40, 0.40), 0.82)
PEG = (0.23, -0.10, 0.85)  # centre of the round peg
PEG_RADIUS, PEG_HALF = 0.02, 0.1
RING_RADIUS, RING_BEAD = 0.0412, 0.01  # of the circle of beads that stand for the ring; a bead's
# Where MuJoCo takes the inverse weight of a finger's contacts, in its knuckle's frame, m: 5.7 1/kg,
# as in `grasp_contact`. The finger's mass (1 mg) means nothing there.
_FELT_AT = (0.0, 0.0328, 0.2009)
HANDLE = (0.06, 0.0, 0.0)  # of the handle's centre in the ring's frame
HANDLE_HALF = (0.02525, 0.015875, 0.01)
# Pads touch the handle's long sides alone (`physics.may_close`), and so deep (4 mm) that a sphere
# near its edge would leave through another face: what is felt is wider.
_FELT_HALF = (0.05, HANDLE_HALF[1], 0.03)
RING_MASS = 0.0194067  # kg
RING_CENTRE = 0.00991  # m from the ring's origin towards the handle
RING_INERTIA = np.array([1.7213e-5, 2.72618e-5, 4.3181e-5])  # about its own axes, kg m^2


class Link(NamedTuple):
    """A link of the arm, in its parent's frame; inertia in its own.

    Attributes:
        name: Name of the body; its joint is `joint_0` ... `joint_5`.
        position: Origin of the frame, m.
        turned: The frame is turned by 90 degrees about y.
        axis: Axis of the joint, "y" or "z".
        mass: kg.
        centre: Centre of mass, m.
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
    Link(
        name="shoulder",
        position=(0.0, 0.0, 0.163),
        turned=False,
        axis="z",
        mass=3.7,
        centre=(0.0, 0.0, 0.0),
        inertia=(0.0102675, 0.0102675, 0.00666),
    ),
    Link(
        name="upper_arm",
        position=(0.0, 0.138, 0.0),
        turned=True,
        axis="y",
        mass=8.393,
        centre=(0.0, 0.0, 0.2125),
        inertia=(0.133886, 0.133886, 0.0151074),
    ),
    Link(
        name="forearm",
        position=(0.0, -0.131, 0.425),
        turned=False,
        axis="y",
        mass=2.275,
        centre=(0.0, 0.0, 0.196),
        inertia=(0.0311796, 0.0311796, 0.004095),
    ),
    Link(
        name="wrist_1",
        position=(0.0, 0.0, 0.392),
        turned=True,
        axis="y",
        mass=1.219,
        centre=(0.0, 0.127, 0.0),
        inertia=(0.0025599, 0.0025599, 0.0021942),
    ),
    Link(
        name="wrist_2",
        position=(0.0, 0.127, 0.0),
        turned=False,
        axis="z",
        mass=1.219,
        centre=(0.0, 0.0, 0.1),
        inertia=(0.0025599, 0.0025599, 0.0021942),
    ),
    Link(
        name="wrist_3",
        position=(0.0, 0.0, 0.1),
        turned=False,
        axis="y",
        mass=0.1889,
        centre=(0.0, 0.0771683, 0.0),
        inertia=(9.90863e-5, 1.32134e-4, 9.90863e-5),
    ),
)
ARM_JOINTS = tuple(f"joint_{index}" for index in range(len(LINKS)))
HAND = (0.0, 0.098, 0.0)  # of the hand's frame in wrist 3's; turned by -90 degrees about x
ARMATURE = tuple(5.0 / (index + 1) for index in range(6))
DAMPING = 0.001  # N m s, every arm joint


class Tool(NamedTuple):
    """The rigid tool in the hand; along the hand's z axis.

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

    def heavier(self, factor: Any) -> Tool:
        """The tool with mass and inertia times `factor` (a plain 1 changes nothing)."""
        if isinstance(factor, float):
            return self
        across, along = factor * self.inertia[0], factor * self.inertia[2]
        return self._replace(mass=factor * self.mass, inertia=(across, across, along))


WIPER = Tool(mass=0.03, centre=0.015, inertia=(0.01, 0.01, 0.01), grip=0.03, box=2**0.5)
GRIPPER = Tool(
    mass=0.1579, centre=0.0886, inertia=(0.00137, 0.00137, 0.00105), grip=0.145, box=0.775
)
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
    quat = ".7071067811865476 -.7071067811865476 0 0"
    text = f"""<body name="hand" pos="{_text(HAND)}" quat="{quat}">{tool}</body>"""
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


def _scene(
    bodies: str, pairs: str, extra: str = "", *, air: bool = True, iterations: int = 50
) -> str:
    density, viscosity = (AIR_DENSITY, AIR_VISCOSITY) if air else (0, 0)
    return f"""
<mujoco model="ppl_jax">
  <compiler angle="radian" autolimits="true" inertiafromgeom="auto"/>
  <option timestep="{TIMESTEP}" integrator="Euler" cone="elliptic" impratio="20" solver="Newton"
    gravity="0 0 -9.81" density="{density}" viscosity="{viscosity}" iterations="{iterations}">
    <flag eulerdamp="disable"/>
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


def _inertial(tool: Tool) -> str:
    return (
        f'<inertial mass="{tool.mass}" pos="0 0 {tool.centre}" '
        f'diaginertia="{_text(tool.inertia)}"/>'
        f'<site name="grip" pos="0 0 {tool.grip}" quat=".7071067811865476 0 0 -.7071067811865476" '
        'size=".004" rgba="0 0 0 0"/>'
    )


def contact_pair(name: str, first: str, second: str, *, friction: float, soft: str) -> str:
    """MJCF of two geoms that collide, as points with friction.

    Args:
        name: Of the pair.
        first, second: Names of the geoms.
        friction: Friction.
        soft: solref and solimp, as MJCF attributes.
    """
    return (
        f'<pair name="{name}" geom1="{first}" geom2="{second}" condim="3" '
        f'friction="{friction} {friction} 0 0 0" {soft}/>'
    )


def arm_scene(
    *,
    tool: Tool,
    base: tuple[float, float, float],
    table: tuple[tuple[float, float], tuple[float, float], float],
    held: str = "",
    bodies: str = "",
    pairs: str = "",
    air: bool = True,
    iterations: int = 50,
) -> str:
    """MJCF of a scene of one's own: the arm behind a table.

    Args:
        tool: In the hand: mass, inertia and grip site.
        base: Base of the arm in world axes, m.
        table: Centre and half size of its top, m, and the height, m.
        held: MJCF of the tool's shapes, in the hand's frame. Class "shown" is drawn only.
        bodies: MJCF of what else is there.
        pairs: MJCF of the contact pairs that are to collide; see `contact_pair`.
        air: Drag in air on every body. Without it, a controller that knows the tool adds the
            tool's, which is nearly all of it.
        iterations: Of the contact solver, at most.
    """
    return _scene(
        _arm(_inertial(tool) + held, base) + _table(table) + bodies,
        pairs,
        air=air,
        iterations=iterations,
    )


def wiping_scene(points: np.ndarray, *, soft: str, friction: float, markers: int) -> str:
    """MJCF of table wiping.

    Args:
        points: [P, 2] contact points of the wiper's face, in the grip site's frame, m.
        soft: solref and solimp of a point, as MJCF attributes.
        friction: Friction of the wiper on the table.
        markers: Number of spots of dirt (mocap bodies `marker_0` ...; drawn only).
    """
    radius = 0.001
    spheres = "".join(
        # the site's x is the hand's -y, its y the hand's x
        f'<geom name="point_{i}" class="felt" type="sphere" size="{radius}" '
        f'pos="{y:.6g} {-x:.6g} {WIPER.grip - radius}"/>'
        for i, (x, y) in enumerate(points)
    )
    tool = f"""{_inertial(WIPER)}{spheres}
<geom class="shown" type="box" pos="0 0 .004" size=".03 .03 .012" rgba="{_STEEL}"/>
<geom class="shown" type="box" pos="0 0 .0225" size=".03 .06 .0075" rgba=".95 .75 .25 1"/>"""
    pairs = "".join(
        contact_pair(f"press_{i}", "table", f"point_{i}", friction=friction, soft=soft)
        for i in range(len(points))
    )
    spots = "".join(
        f'<body name="marker_{i}" mocap="true"><geom class="shown" type="cylinder" '
        'size=".02 .0006" rgba=".35 .22 .12 1"/></body>'
        for i in range(markers)
    )
    return _scene(_arm(tool, WIPING_BASE) + _table(WIPING_TABLE) + spots, pairs)


def two_finger_gripper(
    pads: Mapping[str, Sequence[str]], tips: Mapping[str, Sequence[str]], knuckle_inertia: float
) -> str:
    """MJCF of the shapes of `GRIPPER` in the hand: its body, and two fingers on knuckles.

    The inner fingers are fixed to the knuckles here; back ends move the pads' spheres, and drawing
    turns the fingers, as the gripper's state says.

    Args:
        pads, tips: Names of the contact spheres of each finger, "left" and "right": of its pad,
            and of the pad's lower edge.
        knuckle_inertia: Added to a knuckle's, kg m^2.
    """
    sphere = '<geom name="{}" class="felt" type="sphere" size="{}" pos="{}"/>'
    fingers = ""
    for side, sign in (("left", -1), ("right", 1)):
        points = "".join(
            sphere.format(name, PAD_SPHERE, "0 0 0") for name in (*pads[side], *tips[side])
        )
        quat = "1 0 0 0" if sign > 0 else "0 0 0 1"
        fingers += f"""
<body name="{side}_knuckle" pos="0 {sign * 0.0306011} .054904" quat="{quat}">
  <inertial mass="1e-6" pos="{_text(_FELT_AT)}" diaginertia="1e-9 1e-9 1e-9"/>
  <joint name="{side}_knuckle" axis="1 0 0" armature="{knuckle_inertia:.12g}"/>
  <geom class="shown" type="capsule" fromto="0 0 0 0 .0376 .043" size=".009" rgba="{_STEEL}"/>
  <body name="{side}_finger" pos="0 .0376 .043">
    <geom class="shown" type="capsule" fromto="0 0 0 0 -.018 .022" size=".008" rgba="{_STEEL}"/>
    <geom class="shown" type="box" pos="0 -.0220203 .03242" size=".011 .003175 .01875"
      rgba=".15 .15 .17 1"/>
  </body>
  {points}
</body>"""
    return f"""
<geom class="shown" type="box" pos="0 0 .045" size=".03 .038 .042" rgba="{_STEEL}"/>{fingers}"""


def nut_scene(
    beads: np.ndarray,
    feet: np.ndarray,
    *,
    pads: Mapping[str, Sequence[str]],
    tips: Mapping[str, Sequence[str]],
    soft: str,
    friction: float,
    knuckle_inertia: float,
    ring_damping: float,
) -> str:
    """MJCF of nut assembly, with `two_finger_gripper` in the hand.

    Args:
        beads, feet: [B, 3], [F, 3] contact points of the ring in its frame, m.
        pads, tips: Names of the contact spheres of each finger, "left" and "right": of its pad,
            which meets the handle, and of the pad's lower edge, which meets the table.
        soft: solref and solimp, as MJCF attributes.
        friction: Friction of all contacts.
        knuckle_inertia: Added to a knuckle's, kg m^2.
        ring_damping: Of the ring's six speeds, N s/m and N m s.
    """
    sphere = '<geom name="{}" class="felt" type="sphere" size="{}" pos="{}"/>'
    tool = _inertial(GRIPPER) + two_finger_gripper(pads, tips, knuckle_inertia)
    plates = "".join(
        f'<geom class="shown" type="box" size=".01125 .0225 .01" rgba=".95 .60 .15 1" '
        f'pos="{0.04245 * np.cos(a):.6g} {0.04245 * np.sin(a):.6g} 0" euler="0 0 {a:.6g}"/>'
        for a in np.pi / 4 * np.arange(8)
    )
    spheres = "".join(
        sphere.format(f"bead_{i}", RING_BEAD, _text(place)) for i, place in enumerate(beads)
    ) + "".join(
        sphere.format(f"foot_{i}", 0.001, _text(np.add(place, [0, 0, 0.001])))
        for i, place in enumerate(feet)
    )
    ring = f"""
<body name="ring" pos="-.1125 -.16 .89"><joint name="ring" type="free"
  damping="{ring_damping}"/>
  <inertial mass="{RING_MASS}" pos="{RING_CENTRE} 0 0" diaginertia="{_text(RING_INERTIA)}"/>
  {plates}{spheres}
  <geom class="shown" type="box" pos="{_text(HANDLE)}" size="{_text(HANDLE_HALF)}"
    rgba=".95 .60 .15 1"/>
  <geom name="handle" class="felt" type="box" pos="{_text(HANDLE)}" size="{_text(_FELT_HALF)}"/>
</body>"""
    pegs = f"""
<geom name="peg" class="shown" type="cylinder" pos="{_text(PEG)}" size="{PEG_RADIUS} {PEG_HALF}"
  rgba=".25 .65 .35 1"/>
<geom class="shown" type="box" pos="{PEG[0]} {-PEG[1]} {PEG[2]}" size=".016 .016 .1"
  rgba=".6 .62 .65 1"/>"""
    pairs = "".join(
        contact_pair(name, name, "handle", friction=friction, soft=soft)
        for side in ("left", "right")
        for name in pads[side]
    )
    pairs += "".join(
        contact_pair(name, "table", name, friction=friction, soft=soft)
        for side in ("left", "right")
        for name in tips[side]
    )
    pairs += "".join(
        contact_pair(f"foot_{i}", "table", f"foot_{i}", friction=friction, soft=soft)
        for i in range(len(feet))
    )
    pairs += "".join(
        contact_pair(f"bead_{i}", f"bead_{i}", "peg", friction=friction, soft=soft)
        for i in range(len(beads))
    )
    return _scene(_arm(tool, NUT_BASE) + _table(NUT_TABLE) + pegs + ring, pairs)
