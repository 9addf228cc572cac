"""The two-finger gripper on MJX: its law turns the knuckles and moves the pads' spheres.

The MJCF has the joints `left_knuckle` and `right_knuckle`, and on their bodies the spheres of
`gripper.PADS` and `gripper.TIPS` (`scenes.model.fingers`).
"""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.analytic import gripper
from envs.manipulation.physics.mjx.places import with_values
from envs.manipulation.physics.mjx.scene import Bodies, Scene

KNUCKLES = tuple(f"{side}_knuckle" for side in gripper.SIDES)


@flax.struct.dataclass
class Fingers:
    """What the law carries between physics steps.

    Attributes:
        inner, outer: [2] inner fingers and inner knuckles, left and right, rad.
        inner_speed, outer_speed: [2] rad/s.
        command: -1 open to 1 closed.
        touching: [2] whether each pad touches what it is to hold.
    """

    inner: jax.Array
    outer: jax.Array
    inner_speed: jax.Array
    outer_speed: jax.Array
    command: jax.Array
    touching: jax.Array


class TwoFingerGripper:
    """robosuite's Robotiq 85 as its recordings show it; see `physics.analytic.gripper`.

    Attributes:
        at, dofs: [2] places of the knuckles in `qpos` and `qvel`.
        rest: [2] rad, the knuckles after a reset.
        contacts: Rows of the contacts of each pad with what it is to hold.
    """

    rest = gripper.INITIAL[::3].astype(np.float32)

    def __init__(self, scene: Scene, holds: str):
        """Find the gripper in a scene.

        Args:
            scene: Scene.
            holds: Beginning of the names of the geoms that the pads may hold.

        Raises:
            ValueError: If the scene lacks a name.
        """
        self.scene = scene
        self.at, self.dofs = scene.joints(KNUCKLES)
        self.spheres = np.array(
            [[scene.geom(n) for n in (*gripper.PADS[s], *gripper.TIPS[s])] for s in gripper.SIDES]
        )
        self.contacts = [scene.contacts(f"{side}_", holds) for side in gripper.SIDES]

    def opened(self) -> Fingers:
        """The law's state after a reset: open, the command in its middle, as robosuite has it."""
        return Fingers(
            inner=jnp.asarray(gripper.INITIAL[1::3], jnp.float32),
            outer=jnp.asarray(gripper.INITIAL[2::3], jnp.float32),
            inner_speed=jnp.zeros(2, jnp.float32),
            outer_speed=jnp.zeros(2, jnp.float32),
            command=jnp.zeros((), jnp.float32),
            touching=jnp.zeros(2, bool),
        )

    def posed(self, put: Any, bodies: Bodies, fingers: Fingers) -> Any:
        """MJX's model with the spheres where the fingers have them."""
        place = gripper.pad_spheres(bodies.qpos[self.at], fingers.inner)
        return put.replace(geom_pos=with_values(put.geom_pos, self.spheres, place))

    def torque(self, data: Any, command: jax.Array) -> jax.Array:
        """Torque of the knuckles' servos, [2] N m."""
        return gripper.servo(command, data.qpos[self.at], data.qvel[self.dofs])

    def follow(self, data: Any, fingers: Fingers, command: jax.Array) -> Fingers:
        """The law's state after the physics step that `data` has made."""
        scene = self.scene
        squeeze = jnp.stack([jnp.sum(scene.normal(data, rows)) for rows in self.contacts])
        inner_speed, outer_speed = gripper.follow(
            data.qpos[self.at], fingers.inner, fingers.outer, squeeze
        )
        return Fingers(
            inner=fingers.inner + scene.timestep * inner_speed,
            outer=fingers.outer + scene.timestep * outer_speed,
            inner_speed=inner_speed,
            outer_speed=outer_speed,
            command=command,
            touching=jnp.stack([scene.touching(data, rows) for rows in self.contacts]),
        )

    def step(
        self, bodies: Bodies, fingers: Fingers, *, action: jax.Array, torque: Any, put: Any
    ) -> tuple[Bodies, Fingers, Any]:
        """One physics step of a scene with this gripper.

        Args:
            bodies, fingers: States.
            action: Of the gripper: its sign closes (1) or opens (-1) it.
            torque: `torque(data) -> [nv]`, what else is applied.
            put: MJX's model.

        Returns:
            The new states, and MJX's data of the step.
        """
        command = jnp.clip(fingers.command + gripper.RAMP * jnp.sign(action), -1.0, 1.0)

        def control(data: Any) -> Any:
            applied = with_values(torque(data), self.dofs, self.torque(data, command))
            return data.replace(qfrc_applied=applied)

        data = self.scene.step(self.scene.data(bodies), control, self.posed(put, bodies, fingers))
        return self.scene.kept(bodies, data), self.follow(data, fingers, command), data

    def joints(self, bodies: Bodies, fingers: Fingers) -> tuple[jax.Array, jax.Array]:
        """The six joints as robosuite names them, and their speeds: [6] rad, rad/s."""
        knuckles, speeds = bodies.qpos[self.at], bodies.qvel[self.dofs]
        return (
            jnp.stack([knuckles, fingers.inner, fingers.outer], -1).reshape(6),
            jnp.stack([speeds, fingers.inner_speed, fingers.outer_speed], -1).reshape(6),
        )
