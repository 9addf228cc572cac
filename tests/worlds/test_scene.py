"""MJX scenes: bad input is one line; what MJCF of published robots has is loaded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs.manipulation.control.on_mjx import OperationalSpace
from envs.manipulation.physics.mjx.scene import Scene

BALL = '<body name="ball" pos="0 0 1"><freejoint/><geom size=".1"/></body>'


def mjcf(bodies, extra="", option='timestep=".005"'):
    return f"<mujoco><option {option}/><worldbody>{bodies}</worldbody>{extra}</mujoco>"


def message(make):
    with pytest.raises(ValueError, match=r"\w") as caught:
        make()
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_mjcf_that_does_not_parse():
    assert "this MJCF does not parse" in message(lambda: Scene("<mujoco><worldbody>"))
    assert "no MJCF file 'nowhere.xml'" in message(lambda: Scene("nowhere.xml"))


def test_mjcf_that_does_not_compile():
    twice = mjcf(BALL + BALL)
    assert "repeated name 'ball'" in message(lambda: Scene(twice))


def test_the_timestep_divides_the_control_step():
    text = mjcf(BALL, option='timestep=".003"')
    told = message(lambda: Scene(text))
    assert told == "the MJCF's timestep must divide the control step of 0.05 s, got 0.003"


def test_shapes_that_mjx_cannot_collide():
    can = '<body pos="0 0 2"><freejoint/><geom type="cylinder" size=".1 .1"/></body>'
    box = '<body><geom type="box" size=".1 .1 .1"/></body>'
    told = message(lambda: Scene(mjcf(can + box)))
    assert told.startswith("MJX cannot simulate this scene: ")
    assert "mjGEOM_CYLINDER" in told or "CYLINDER" in told


def test_names_that_are_not_there():
    scene = Scene(mjcf(BALL))
    assert (
        message(lambda: scene.body("cube"))
        == "the scene has no body 'cube'; it has 'world', 'ball'"
    )
    assert "the scene has no site 'grip'; it has none with a name" in message(
        lambda: scene.site("grip")
    )
    assert "arm of six joints or more" in message(
        lambda: OperationalSpace(scene, joints=["a"], site="grip", torque_limit=[1.0])
    )


# as in published models of grippers: a mesh to look at, classes of defaults, position servos, a
# second finger that follows by an equality, and a tendon that drives both
GRIPPER = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep=".005" integrator="implicitfast"/>
  <default>
    <default class="hand">
      <joint type="slide" axis="0 1 0" range="0 .04" damping="5" armature=".1"/>
      <default class="looks"><geom type="mesh" contype="0" conaffinity="0" group="2"/></default>
      <default class="pad"><geom type="box" size=".01 .005 .01" mass=".02"/></default>
    </default>
  </default>
  <asset><mesh name="tetra" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody>
    <body name="palm" childclass="hand" pos="0 0 .5">
      <geom class="looks" mesh="tetra"/>
      <body name="left">
        <joint name="left"/><geom class="pad" pos="0 .01 0"/>
      </body>
      <body name="right" quat="0 0 0 1">
        <joint name="right"/><geom class="pad" pos="0 .01 0"/>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="left" body2="right"/></contact>
  <tendon><fixed name="both"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed>
  </tendon>
  <equality><joint joint1="left" joint2="right" solref=".01 1"/></equality>
  <actuator><position name="close" tendon="both" kp="200" ctrlrange="0 .04"/></actuator>
</mujoco>"""


def test_features_of_published_models():
    scene = Scene(GRIPPER)
    assert scene.full.ngeom == 3
    assert scene.model.ngeom == 2
    at, _ = scene.joints(["left", "right"])
    step = jax.jit(lambda bodies: scene.advance(bodies, lambda d: d, lambda d: d.qpos)[0])
    bodies = scene.start(np.array([0.0, 0.01]), ctrl=np.array([0.03]))
    for _ in range(30):
        bodies = step(bodies)
    np.testing.assert_allclose(bodies.qpos[at], 0.03, atol=2e-3)
    assert bool(jnp.all(jnp.isfinite(bodies.qvel)))
