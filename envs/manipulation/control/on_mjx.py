"""Operational-space control of any arm of an MJX scene: the same law on MJX's quantities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.control.operational_space import (
    applied_torque,
    arm_torque,
    axes_of,
    shifted,
    vector_of,
)
from envs.manipulation.physics.analytic.arm import drag
from envs.manipulation.physics.mjx.scene import Scene
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import ARM_JOINTS, FRICTION_LOSS, TORQUE_LIMIT, Tool


class Goal(NamedTuple):
    """Where the site is to be: [3] m, and [3, 3] whose columns are its axes."""

    position: jax.Array
    rotation: jax.Array


class OperationalSpace:
    """Torques that make a site of an arm of six joints or more follow Cartesian commands."""

    def __init__(
        self,
        scene: Scene,
        *,
        joints: Sequence[str],
        site: str,
        torque_limit: Any,
        damping: float = 0.0,
        friction: float = 0.0,
        rest: Any = None,
        tool: Tool | None = None,
    ):
        """Find the arm in a scene.

        Args:
            scene: Scene.
            joints: Names of the arm's joints, from the base to the site.
            site: Name of the site.
            torque_limit: [J] N m.
            damping, friction: In the joints, N m s/rad and N m, where the MJCF leaves them to the
                controller.
            rest: [J] rad, the pose to which an arm of more than six joints is drawn; its first
                pose in the MJCF where None.
            tool: Its drag in air is added (the drag of a whole model costs much more).

        Raises:
            ValueError: If the scene lacks a name, or the arm has fewer than six joints.
        """
        if len(joints) < 6:
            raise ValueError(
                f"operational-space control needs an arm of six joints or more, got {len(joints)}"
            )
        self.scene, self.damping, self.friction, self.tool = scene, damping, friction, tool
        self.limit = np.asarray(torque_limit, np.float32)
        self.qpos, self.dofs = scene.joints(joints)
        self.site = scene.site(site)
        self.root = int(scene.model.body_rootid[scene.model.site_bodyid[self.site]])
        self.rest = np.asarray(scene.model.qpos0[self.qpos] if rest is None else rest, np.float32)

    def goal(self, data: Any, action: jax.Array, held: jax.Array) -> Goal:
        """Goal of a control step; see `operational_space.new_goal`.

        Args:
            data: MJX's data with the frames of now.
            action: [6] or more, in [-1, 1].
            held: [3, 3] rotation of the last goal (columns).
        """
        place, turn = shifted(data.site_xpos[self.site], data.site_xmat[self.site], action, held)
        return Goal(place, turn)

    def jacobian(self, data: Any) -> jax.Array:
        """What unit speed of each joint does to the site, [J, 6] m and rad, world axes."""
        cdof = data.cdof[self.dofs]
        spin = cdof[:, :3]
        arm = data.site_xpos[self.site] - data.subtree_com[self.root]
        return jnp.concatenate([cdof[:, 3:] + jnp.cross(spin, arm), spin], -1)

    def torque(self, data: Any, goal: Goal, factors: Factors = NOMINAL) -> jax.Array:
        """Torque on each joint in a physics step, [J] N m: control, air, and the joints' brake.

        Args:
            data: MJX's data with frames, inertia and bias forces of the step's start.
            goal: Goal of the control step.
            factors: On gains and on the joints' damping and friction.
        """
        dofs = self.dofs
        jacobian, speed = self.jacobian(data), data.qvel[dofs]
        total = arm_torque(
            jacobian,
            self.scene.mass_matrix(data)[np.ix_(dofs, dofs)],
            position=data.site_xpos[self.site],
            rotation=data.site_xmat[self.site],
            speeds=speed,
            goal=goal,
            posture=self.rest - data.qpos[self.qpos],
            gain=factors.gain,
        )
        total = applied_torque(
            total,
            data.qfrc_bias[dofs],
            limit=self.limit,
            speeds=speed,
            damping=self.damping,
            friction=self.friction,
            factor=factors.damping,
        )
        if self.tool is not None:
            twist = speed @ jacobian
            axes = axes_of(data.site_xmat[self.site])
            force, torque = drag(self.tool, axes, (vector_of(twist[:3]), vector_of(twist[3:])))
            total = total + jacobian @ jnp.stack([*force, *torque])
        return total


def ur5e(scene: Scene, tool: Tool) -> OperationalSpace:
    """The UR5e of `scenes.model` with a tool in its hand."""
    return OperationalSpace(
        scene,
        joints=ARM_JOINTS,
        site="grip",
        torque_limit=TORQUE_LIMIT,
        friction=FRICTION_LOSS,
        tool=tool,
    )
