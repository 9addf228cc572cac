"""Table wiping on C MuJoCo: slow, and the oracle of the other two."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from envs.manipulation.control.on_mujoco_c import goal_of, torque
from envs.manipulation.physics.may_close import over_wiping_table
from envs.manipulation.physics.mujoco_c import MujocoC, MujocoState, wiping_xml
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import ARM_JOINTS, SUBSTEPS
from envs.manipulation.tasks.wiping import Moved, WipingState


class WipingMujocoC:
    """25 steps of 2 ms of the MJCF, one environment after another."""

    name = "mujoco_c"

    def __init__(self) -> None:
        """Compile the scene."""
        self.scene = MujocoC(
            wiping_xml(markers=0),
            joints=ARM_JOINTS,
            handled=["hand"],
            groups=[("table", "point_")],
            may_close=over_wiping_table,
        )

    def advance(self, state: WipingState, action: jax.Array, factors: Factors = NOMINAL) -> Moved:
        """The arm after one control step of 0.05 s; see `WipingAnalytic.advance`."""
        scene = self.scene
        start = MujocoState(state.joints, state.speeds, state.acceleration)
        goal = goal_of(scene.measure(start, factors), action, state.goal_rotation.T)

        def step(carry: tuple[MujocoState, jax.Array], _: None) -> tuple:
            applied = torque(scene, carry[0], goal, factors)
            moved, touched = scene.step(carry[0], applied, factors=factors)
            return (moved, touched.force[0]), None

        (moved, push), _ = jax.lax.scan(
            step, (start, jnp.zeros(3, jnp.float32)), None, length=SUBSTEPS
        )
        return Moved(
            joints=moved.qpos,
            speeds=moved.qvel,
            acceleration=moved.warm,
            goal_rotation=goal[1].T,
            push=push,
        )
