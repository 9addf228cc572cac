"""MJX scenes: bad input is one line; what MJCF of published robots has is loaded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.check import check_env
from envs.manipulation.control.on_mjx import OperationalSpace
from envs.manipulation.physics.mjx.scene import Scene
from envs.manipulation.scenes import panda
from envs.manipulation.tasks.scene_task import SceneTask, Start, Verdict

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


FINGERS = """
<inertial mass=".3" pos="0 0 .03" diaginertia="1e-3 1e-3 1e-3"/>
<body name="left" pos="0 .02 .1"><joint name="left" type="slide" axis="0 1 0"/>
  <geom name="left" size=".01" mass=".02"/></body>
<body name="right" pos="0 -.02 .1"><joint name="right" type="slide" axis="0 -1 0"/>
  <geom name="right" size=".01" mass=".02"/></body>"""


class Grasp(SceneTask):
    """A task with two servos in the hand."""

    name = "grasp"
    max_episode_steps = 10

    def __init__(self, limits=('ctrlrange="0 .04"', 'ctrlrange="0 .02"'), **options):
        motors = "".join(
            f'<position name="{side}" joint="{side}" kp="100" {limit}/>'
            for side, limit in zip(("left", "right"), limits, strict=True)
        )
        scene = Scene(
            '<mujoco><compiler angle="radian"/><option timestep=".002"/><worldbody>'
            f"{panda.panda_arm(FINGERS, grip=0.1)}</worldbody>"
            f"<actuator>{motors}</actuator></mujoco>"
        )
        arm = OperationalSpace(
            scene, joints=panda.JOINTS, site="grip", torque_limit=panda.TORQUE_LIMIT
        )
        super().__init__(scene, arm, training=range(3), held_out=range(2), **options)

    def draw(self, key):
        return Start(jnp.zeros(self.scene.model.nq).at[self.arm.qpos].set(panda.REST))

    def judge(self, before, after):
        high = after.site.position[2] > 0.5
        return Verdict(reward=high.astype(jnp.float32), success=high)

    def see(self, state):
        return state.bodies.qpos


def test_servos_in_the_hand_are_driven_by_the_end_of_the_action():
    env = Grasp()
    check_env(env, "grasp")
    assert env.spec.action_size == 8
    np.testing.assert_allclose(env.control_of(jnp.array([1.0, -1.0])), [0.04, 0.0], atol=1e-7)
    start = jax.eval_shape(
        lambda: env.reset_to(jnp.int32(0), jax.random.key(0), env.default_params)
    )
    assert start.bodies.ctrl.shape == (2,)
    one = Grasp(hand_actions=1)
    check_env(one, "grasp")
    assert one.spec.action_size == 7
    np.testing.assert_allclose(one.control_of(jnp.zeros(1)), [0.02, 0.01], atol=1e-7)


def test_servos_that_do_not_fit():
    told = message(lambda: Grasp(limits=('ctrlrange="0 .04"', "")))
    assert told == "actuator 'right' needs a ctrlrange: an action of 1 is its end"
    told = message(lambda: Grasp(hand_actions=3))
    assert told == "hand_actions must be 1 or 2 (actuators), got 3"
