"""C MuJoCo under the same scenes: its model, its data and the contact parameters of this package.

MuJoCo's own kinematics, dynamics, collision detection and contact solver, in double precision:
what the hand-written physics is held against, and what draws the arm.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from envs.manipulation.physics.analytic import grasp_contact, gripper, wipe_contact
from envs.manipulation.scenes.model import nut_scene, wiping_scene


def wiping_xml(markers: int = 100) -> str:
    """MJCF of table wiping with this package's contact parameters."""
    low, high, width = wipe_contact.IMPEDANCE
    stiff = wipe_contact.DEPTH_SCALE / wipe_contact.TIME_CONSTANT**2
    soft = (
        f'solref="{-stiff:.9g} {-2 / wipe_contact.TIME_CONSTANT:.9g}" '
        f'solimp="{low} {high} {width / wipe_contact.DEPTH_SCALE}"'
    )
    return wiping_scene(wipe_contact.POINTS, soft, wipe_contact.FRICTION, markers)


def nut_xml() -> str:
    """MJCF of nut assembly with this package's contact parameters."""
    d = grasp_contact.IMPEDANCE
    stiff, damp = grasp_contact.STIFF * d * d, grasp_contact.DAMP * d
    soft = f'solref="{-stiff:.9g} {-damp:.9g}" solimp="{d} {d} 0.001"'
    return nut_scene(
        grasp_contact.BEADS,
        grasp_contact.FEET,
        pads=gripper.PADS,
        tips=gripper.TIPS,
        soft=soft,
        friction=grasp_contact.FRICTION,
        knuckle_inertia=gripper.SERVO_INERTIA,
        ring_damping=grasp_contact.RING_DAMPING,
    )


def import_mujoco() -> Any:
    """The module `mujoco`, whose names type checkers do not know.

    Raises:
        ImportError: Without MuJoCo.
    """
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            "the C MuJoCo twin needs mujoco: pip install ppl-jax[manipulation]"
        ) from error


class MujocoArm:
    """MuJoCo's model and data of a scene with the arm.

    Attributes:
        mujoco: The module.
        model, data: `MjModel` and `MjData`, double precision.
        site: Index of the grip site.
    """

    def __init__(self, xml: str):
        """Compile a scene.

        Args:
            xml: MJCF with the joints `joint_0` ... `joint_5` first and a site `grip`.

        Raises:
            ImportError: Without MuJoCo.
        """
        self.mujoco = mujoco = import_mujoco()
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site("grip").id

    def jacobian(self) -> np.ndarray:
        """Jacobian of the grip site in the arm's joints, [6, 6]: m over rad."""
        model, data = self.model, self.data
        jac = np.zeros((6, model.nv))
        self.mujoco.mj_jacSite(model, data, jac[:3], jac[3:], self.site)
        return jac[:, :6]

    def mass_matrix(self) -> np.ndarray:
        """Joint-space inertia of the arm, [6, 6]."""
        model, data = self.model, self.data
        full = np.zeros((model.nv, model.nv))
        self.mujoco.mj_fullM(model, full, data.qM) if hasattr(data, "qM") else (
            self.mujoco.mj_fullM(model, data, full)
        )
        return full[:6, :6]
