"""The base of a task on any MJCF scene: pools, reset, physics steps and episode ends are here.

A task of one's own fills in four methods: `draw` (a start), `sense` (what it needs of the physics),
`judge` (reward and ends) and `see` (the observation). `tasks/lift.py` is one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.derivatives import length
from envs.manipulation.control.gripper_on_mjx import TwoFingerGripper
from envs.manipulation.control.on_mjx import Goal, OperationalSpace
from envs.manipulation.physics.lanes import one_after_another
from envs.manipulation.physics.mjx.places import with_values
from envs.manipulation.physics.mjx.scene import Bodies, Scene
from envs.manipulation.randomisation import Factors, Ranges
from envs.manipulation.tasks.base import HELD_OUT_SCENARIOS, TRAINING_SCENARIOS, ArmTask
from ppl_jax.types import EnvSpec, Expert, Outcome

MOTION = 6  # components of an action that move the arm's site; the rest drive the hand


class Start(NamedTuple):
    """What `draw` makes of a scenario's number.

    Attributes:
        qpos: [nq] of MuJoCo.
        ctrl: [nu] of the actuators, or None for their middle.
        mocap: [nmocap, 7] positions (m) and quaternions, or None for those of the MJCF.
        extra: What else the scenario fixes (a goal, say): a pytree, kept in the state.
    """

    qpos: jax.Array
    ctrl: jax.Array | None = None
    mocap: jax.Array | None = None
    extra: Any = None


@flax.struct.dataclass
class Site:
    """The arm's site at the start of the last physics step: what robosuite observes and rewards.

    Attributes:
        position, velocity: [3] m and m/s, world axes.
        rotation: [3, 3] columns are its axes.
    """

    position: jax.Array
    velocity: jax.Array
    rotation: jax.Array


@flax.struct.dataclass
class SceneState:
    """Everything that the next step depends on.

    Attributes:
        bodies: Of the physics.
        held: [3, 3] rotation of the controller's last goal (columns).
        fingers: `Fingers` of a two-finger gripper, or None.
        site: The arm's site.
        sensed: What `sense` returned for the last physics step.
        extra: See `Start`.
        scenario, time: Number and steps so far.
    """

    bodies: Bodies
    held: jax.Array
    fingers: Any
    site: Site
    sensed: Any
    extra: Any
    scenario: jax.Array
    time: jax.Array


@flax.struct.dataclass
class SceneParams:
    """A pool of starts, drawn by number, and what a study may change.

    Attributes:
        number: [S]. reward_scale: Factor on the task's reward.
        ranges: Of the domain randomisation, or None.
    """

    number: jax.Array
    reward_scale: jax.Array | float = 1.0
    ranges: Ranges | None = None


class Verdict(NamedTuple):
    """What `judge` makes of a step; scalars.

    Attributes:
        reward: Reward.
        success: The task is solved; the episode ends.
        unsafe: It failed for good; the episode ends and costs 1.
        progress: 0 to 1; `success` where None.
        cost: `unsafe` where None.
    """

    reward: jax.Array
    success: jax.Array
    unsafe: jax.Array | bool = False
    progress: jax.Array | None = None
    cost: jax.Array | None = None


class SceneTask(ArmTask):
    """Base of tasks on a `Scene` under operational-space control.

    A task has a `name` and `max_episode_steps`, and fills in `draw`, `sense`, `judge` and `see`.

    Attributes:
        scene, arm, gripper: Physics, controller, and a two-finger gripper or None.
        observation_mean, observation_scale: What a network sees is (observation - mean) / scale;
            [O], or one number for all.
    """

    observation_mean: Any = 0.0
    observation_scale: Any = 1.0

    def __init__(
        self,
        scene: Scene,
        arm: OperationalSpace,
        *,
        gripper: TwoFingerGripper | None = None,
        handled: Sequence[str] = (),
        hand_actions: int | None = None,
        training: Sequence[int] = TRAINING_SCENARIOS,
        held_out: Sequence[int] = HELD_OUT_SCENARIOS,
        experts: Mapping[str, Expert] | None = None,
    ):
        """Hold the scene and find the sizes of action and observation.

        Args:
            scene, arm: Scene and controller.
            gripper: Driven by the seventh component of the action. Without one, what follows the
                sixth drives the MJCF's actuators over their `ctrlrange`.
            handled: Names of the bodies whose mass domain randomisation changes.
            hand_actions: Components that drive actuators: 1 (all alike), or one for each, which is
                the default.
            training, held_out: Numbers of the scenarios to train and to evaluate on.
            experts: By name; "scripted" is the usual one.

        Raises:
            ValueError: If an actuator has no `ctrlrange`, or `hand_actions` fits no actuators.
        """
        pools = [
            SceneParams(number=jnp.asarray(numbers, jnp.int32), reward_scale=jnp.float32(1.0))
            for numbers in (training, held_out)
        ]
        super().__init__(*pools, experts=experts or {})
        self.scene, self.arm = scene, arm
        self.gripper: Any = gripper
        self._handled = [scene.body(name) for name in handled]
        hand = self._find_actuators(hand_actions)
        size = jax.eval_shape(lambda: self.see(self._first())).shape[0]
        self.spec = EnvSpec(
            observation_size=size,
            action_size=MOTION + hand,
            observation_mean=np.broadcast_to(np.float32(self.observation_mean), size),
            observation_scale=np.broadcast_to(np.float32(self.observation_scale), size),
        )

    def _find_actuators(self, wanted: int | None) -> int:
        """Number of components of the action that drive the hand."""
        model = self.scene.model
        if self.gripper is not None:
            return 1
        free = [
            model.actuator(i).name for i in range(model.nu) if not model.actuator_ctrllimited[i]
        ]
        if free:
            raise ValueError(f"actuator {free[0]!r} needs a ctrlrange: an action of 1 is its end")
        if wanted not in (None, model.nu) and not (wanted == 1 and model.nu):
            raise ValueError(f"hand_actions must be 1 or {model.nu} (actuators), got {wanted}")
        self._low, self._high = model.actuator_ctrlrange.T.astype(np.float32)
        return model.nu if wanted is None else wanted

    def _first(self) -> SceneState:
        return self.reset_to(jnp.int32(0), jax.random.key(0), self.default_params)

    # ---- the task's own

    def draw(self, key: jax.Array) -> Start:
        """The start that a scenario's key draws."""
        raise NotImplementedError(f"{type(self).__name__}.draw")

    def sense(self, data: Any) -> Any:
        """What the task needs of a physics step beside the arm's site: a pytree of arrays.

        As robosuite's sensors do, it sees frames, contacts and forces of the start of the last
        physics step. At the start of an episode forces are zero.
        """
        del data
        return ()

    def judge(self, before: SceneState, after: SceneState) -> Verdict:
        """Reward and ends of a step."""
        raise NotImplementedError(f"{type(self).__name__}.judge")

    def see(self, state: SceneState) -> jax.Array:
        """The observation of a state, [O], without noise."""
        raise NotImplementedError(f"{type(self).__name__}.see")

    # ---- the environment

    @property
    def physics(self) -> str:
        """Name of the engine."""
        return "mjx" if self.scene.impl == "jax" else f"mjx-{self.scene.impl}"

    def reset_to(self, index: jax.Array, key: jax.Array, params: SceneParams) -> SceneState:
        """The start of scenario `index` of the pool, at rest."""
        del key  # a scenario is deterministic
        scene, arm, gripper = self.scene, self.arm, self.gripper
        start = self.draw(jax.random.key(params.number[index]))
        joints = self.first_joints(start.qpos[arm.qpos], index, params)
        ctrl = start.ctrl
        if ctrl is None and gripper is None and scene.model.nu:
            ctrl = (self._low + self._high) / 2
        qpos = start.qpos.at[arm.qpos].set(joints)
        if gripper is not None:
            qpos = qpos.at[gripper.at].set(gripper.rest)
        bodies = scene.start(qpos, ctrl)
        if start.mocap is not None:
            bodies = dataclasses.replace(bodies, mocap=start.mocap)
        fingers = None if gripper is None else gripper.opened()
        put = scene.put if gripper is None else gripper.posed(scene.put, bodies, fingers)
        data = scene.at_rest(bodies, put)
        site = self._site(data)
        return SceneState(
            bodies=bodies,
            held=site.rotation,
            fingers=fingers,
            site=site,
            sensed=self.sense(data),
            extra=start.extra,
            scenario=jnp.asarray(index, jnp.int32),
            time=jnp.zeros((), jnp.int32),
        )

    def transition(
        self, key: jax.Array, state: SceneState, action: jax.Array, params: SceneParams
    ) -> tuple[SceneState, Outcome]:
        """One control step, without reset."""
        del key  # the world is deterministic
        action = jnp.clip(action, -1.0, 1.0)
        moved = one_after_another(self._moved, state, action, self.factors(state, params))
        diverged = ~jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in _floats(moved)]))
        new = jax.tree.map(lambda old, new: jnp.where(diverged, old, new), state, moved)
        new = dataclasses.replace(new, time=state.time + 1)
        verdict = self.judge(state, new)
        success, unsafe = verdict.success & ~diverged, jnp.asarray(verdict.unsafe)
        cost = unsafe if verdict.cost is None else verdict.cost
        progress = success if verdict.progress is None else verdict.progress
        return new, Outcome(
            reward=jnp.where(diverged, 0.0, params.reward_scale * verdict.reward),
            terminated=success | unsafe | diverged,
            truncated=new.time >= self.max_episode_steps,
            cost=jnp.asarray(cost, jnp.float32),
            success=success,
            unsafe=unsafe,
            progress=jnp.asarray(progress, jnp.float32),
            speed=length(new.site.velocity),
            physics_diverged=diverged,
        )

    def observe(self, state: SceneState, params: SceneParams) -> jax.Array:
        """The observation of a state, [O]."""
        return self.with_sensor_noise(self.see(state), state, params)

    def grip_position(self, state: SceneState) -> jax.Array:
        """Where the arm's site is, [3] m in world axes."""
        return state.site.position

    def grip_velocity(self, state: SceneState) -> jax.Array:
        """Velocity of the arm's site, [3] m/s."""
        return state.site.velocity

    # ---- physics

    def control_of(self, hand: jax.Array) -> jax.Array:
        """Control of each actuator, [nu], for the action's components after the sixth.

        An action of -1 and 1 are the ends of `ctrlrange`; a single one drives all alike.
        """
        share = (1 + jnp.broadcast_to(hand, self._low.shape)) / 2
        return self._low + (self._high - self._low) * share

    def _site(self, data: Any) -> Site:
        arm = self.arm
        speeds = data.qvel[arm.dofs]
        return Site(
            position=data.site_xpos[arm.site],
            velocity=speeds @ arm.jacobian(data)[:, :3],
            rotation=data.site_xmat[arm.site],
        )

    def _moved(self, state: SceneState, action: jax.Array, factors: Factors) -> SceneState:
        """The state after the physics steps of one control step; its time is the old one."""
        scene, arm, gripper = self.scene, self.arm, self.gripper
        put, bodies = scene.varied(factors, self._handled), state.bodies
        if gripper is None and scene.model.nu:
            bodies = dataclasses.replace(bodies, ctrl=self.control_of(action[MOTION:]))

        def aimed(data: Any, goal: Goal, first: jax.Array) -> Goal:
            """The goal of the control step, from the frames of its first physics step."""
            new = arm.goal(data, action, state.held)
            return jax.tree.map(lambda a, b: jnp.where(first, a, b), new, goal)

        def step(carry: Any, first: jax.Array) -> tuple[Any, None]:
            bodies, fingers, goal, _, _ = carry

            def torque(data: Any) -> jax.Array:
                own = arm.torque(data, aimed(data, goal, first), factors)
                return with_values(jnp.zeros_like(data.qvel), arm.dofs, own)

            if gripper is None:
                data = scene.step(
                    scene.data(bodies), lambda data: data.replace(qfrc_applied=torque(data)), put
                )
                bodies = scene.kept(bodies, data)
            else:
                bodies, fingers, data = gripper.step(
                    bodies, fingers, action=action[MOTION], torque=torque, put=put
                )
            goal = aimed(data, goal, first)
            return (bodies, fingers, goal, self._site(data), self.sense(data)), None

        begun = Goal(jnp.zeros(3, jnp.float32), state.held)
        carry = (bodies, state.fingers, begun, state.site, state.sensed)
        carry, _ = jax.lax.scan(step, carry, np.arange(scene.substeps) == 0)
        bodies, fingers, goal, site, sensed = carry
        return dataclasses.replace(
            state, bodies=bodies, held=goal.rotation, fingers=fingers, site=site, sensed=sensed
        )


def _floats(state: Any) -> list[jax.Array]:
    return [x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)]
