"""The scene of lift: a cube on a table, and the two-finger gripper over it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from envs.manipulation.scenes.model import (
    GRIPPER,
    NUT_BASE,
    arm_scene,
    contact_pair,
    two_finger_gripper,
)

# robosuite 1.4.1, environments/manipulation/lift.py: table, cube (it draws 0.020 to 0.022 m)
TABLE = ((0.0, 0.0), (0.40, 0.40), 0.80)  # centre, half size, height of the top, m
BASE = NUT_BASE
CUBE_HALF = 0.021  # m
CUBE_DENSITY = 1000.0  # kg/m^3
CUBE_MASS = CUBE_DENSITY * (2 * CUBE_HALF) ** 3  # kg


def lift_scene(
    *,
    pads: Mapping[str, Sequence[str]],
    tips: Mapping[str, Sequence[str]],
    soft: str,
    friction: float,
    knuckle_inertia: float,
) -> str:
    """MJCF of lift.

    The cube meets the table as a box meets a plane, in four contacts; the pads meet the cube in
    spheres of 1 mm.

    Args:
        pads, tips: Names of the contact spheres of each finger; see `two_finger_gripper`.
        soft: solref and solimp, as MJCF attributes.
        friction: Friction of all contacts.
        knuckle_inertia: Added to a knuckle's, kg m^2.
    """
    cube = f"""
<body name="cube" pos="0 0 {TABLE[2] + CUBE_HALF}"><freejoint name="cube"/>
  <geom name="cube" type="box" size="{CUBE_HALF} {CUBE_HALF} {CUBE_HALF}" mass="{CUBE_MASS:.9g}"
    contype="0" conaffinity="0" group="1" rgba=".80 .18 .16 1"/>
</body>"""
    touching = [("cube", name) for side in pads for name in pads[side]]
    touching += [("table", name) for side in tips for name in tips[side]]
    touching += [("table", "cube")]
    pairs = "".join(
        contact_pair(f"{a}_{b}", a, b, friction=friction, soft=soft) for a, b in touching
    )
    return arm_scene(
        tool=GRIPPER,
        base=BASE,
        table=TABLE,
        held=two_finger_gripper(pads, tips, knuckle_inertia),
        bodies=cube,
        pairs=pairs,
        air=False,
        iterations=8,
    )
