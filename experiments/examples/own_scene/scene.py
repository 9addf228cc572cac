"""The scene: what the arm holds, where it stands, and the MJCF that draws it."""

from envs.manipulation.scenes.model import Tool, arm_scene

PROBE = Tool(mass=0.05, centre=0.03, inertia=(1e-4, 1e-4, 1e-4), grip=0.08, box=0.1)
BASE = (-0.41, 0.0, 0.912)  # m, of the arm in world axes
TABLE = ((0.15, 0.0), (0.25, 0.40), 0.90)  # m: centre, half size, height of the top


def xml() -> str:
    """MJCF: arm, table, a pointer in the hand, and the goal as a body that is moved (mocap)."""
    pointer = '<geom class="shown" type="capsule" fromto="0 0 0 0 0 .08" size=".008"/>'
    goal = (
        '<body name="goal" mocap="true">'
        '<geom class="shown" type="sphere" size=".02" rgba=".2 .7 .3 1"/></body>'
    )
    return arm_scene(tool=PROBE, base=BASE, table=TABLE, held=pointer, bodies=goal)
