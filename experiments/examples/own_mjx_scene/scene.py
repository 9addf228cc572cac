"""The MJCF: a seven-joint arm with a fork in the hand, a block on a table, and a goal."""

from envs.manipulation.scenes.panda import panda_arm

GRIP = 0.12  # m, from the hand's frame to the point of the fork that is controlled
BLOCK_HALF = (0.03, 0.03, 0.025)  # m

FORK = """
<geom type="capsule" fromto="0 0 0 0 0 .09" size=".012" mass=".1" contype="0" conaffinity="0"/>
<geom type="capsule" fromto="0 -.022 .1 0 .022 .1" size=".008" mass=".05" contype="0"
  conaffinity="0"/>
<geom name="left_tip" type="sphere" pos="0 .022 .11" size=".01" mass=".01"/>
<geom name="right_tip" type="sphere" pos="0 -.022 .11" size=".01" mass=".01"/>
"""


def xml() -> str:
    """MJCF. Geoms with contype and conaffinity 0 are drawn, and touch nothing."""
    return f"""
<mujoco model="push">
  <compiler angle="radian"/>
  <option timestep=".002" cone="elliptic" impratio="10" iterations="8">
    <flag eulerdamp="disable"/>
  </option>
  <visual><headlight ambient=".5 .5 .5" diffuse=".5 .5 .5" specular="0 0 0"/></visual>
  <default><geom friction=".3 .005 .0001"/></default>
  <worldbody>
    <geom name="table" type="plane" size=".6 .6 .05" pos=".4 0 0" rgba=".80 .74 .64 1"/>
    {panda_arm(FORK, grip=GRIP)}
    <body name="block" pos=".45 0 .025">
      <freejoint name="block"/>
      <geom name="block" type="box" size="{" ".join(map(str, BLOCK_HALF))}" mass=".2"
        rgba=".85 .35 .20 1"/>
    </body>
    <body name="goal" mocap="true" pos=".6 0 0">
      <geom type="cylinder" size=".03 .0005" rgba=".2 .65 .3 1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact>
    <exclude body1="hand" body2="world"/>
  </contact>
</mujoco>"""
