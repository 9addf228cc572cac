"""Table wiping on MJX: the twin's MJCF, with the table's edge."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from envs.manipulation.control.on_mjx import ur5e
from envs.manipulation.physics.lanes import one_after_another
from envs.manipulation.physics.may_close import over_wiping_table
from envs.manipulation.physics.mjx.scene import Scene
from envs.manipulation.physics.mujoco_c import import_mujoco, wiping_xml
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import (
    WIPER,
)
from envs.manipulation.tasks.wiping import Moved, WipingState

ITERATIONS = 20  # of the contact solver, at most


def without_air(text: str) -> Any:
    """The `MjSpec` of an arm's scene without drag: the controller adds the tool's alone."""
    spec = import_mujoco().MjSpec.from_string(text)
    spec.option.density = spec.option.viscosity = 0.0
    spec.option.iterations = ITERATIONS
    return spec


class WipingMjx:
    """25 steps of 2 ms with the exact set of 56 contact points."""

    name = "mjx"

    def __init__(self, solver: str | None = None):
        """Compile the scene.

        Args:
            solver: Of contacts; see `Scene`.
        """
        self.scene = Scene(
            without_air(wiping_xml(markers=0)), solver=solver, may_close=over_wiping_table
        )
        self.arm = ur5e(self.scene, WIPER)
        self.points = self.scene.contacts("table", "point_")
        self.wiper = self.scene.body("hand")

    def advance(self, state: WipingState, action: jax.Array, factors: Factors = NOMINAL) -> Moved:
        """The arm after one control step of 0.05 s; see `WipingAnalytic.advance`."""
        return one_after_another(self._advance, state, action, factors)

    def _advance(self, state: WipingState, action: jax.Array, factors: Factors) -> Moved:
        scene, arm = self.scene, self.arm
        put = scene.varied(factors, [self.wiper])
        bodies = dataclasses.replace(
            scene.start(state.joints), qvel=state.speeds, warm=state.acceleration
        )
        goal = arm.goal(scene.placed(bodies, put), action, state.goal_rotation.T)

        def control(data: Any) -> Any:
            return data.replace(qfrc_applied=arm.torque(data, goal, factors))

        def sense(data: Any) -> tuple[jax.Array, jax.Array]:
            return jnp.sum(scene.forces(data, self.points), 0), data.qacc

        moved, (push, acceleration) = scene.advance(bodies, control, sense, put)
        return Moved(
            joints=moved.qpos,
            speeds=moved.qvel,
            acceleration=acceleration,
            goal_rotation=goal.rotation.T,
            push=push,
        )
