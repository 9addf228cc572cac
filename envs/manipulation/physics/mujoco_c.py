"""C MuJoCo in double precision under the same scenes: oracle, third back end, and what draws.

Kinematics, dynamics, collision detection and contact solver are MuJoCo's own. A program reaches it
by `jax.pure_callback`, one environment after another.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.analytic import grasp_contact, gripper, wipe_contact
from envs.manipulation.randomisation import NOMINAL, Factors
from envs.manipulation.scenes.model import nut_scene, wiping_scene


def wiping_xml(markers: int = 100) -> str:
    """MJCF of table wiping with this package's contact parameters."""
    low, high, width = wipe_contact.IMPEDANCE
    stiff = wipe_contact.DEPTH_SCALE / wipe_contact.TIME_CONSTANT**2
    soft = (
        f'solref="{-stiff:.9g} {-2 / wipe_contact.TIME_CONSTANT:.9g}" '
        f'solimp="{low} {high} {width / wipe_contact.DEPTH_SCALE}"'
    )
    return wiping_scene(
        wipe_contact.POINTS,
        soft=soft,
        friction=wipe_contact.FRICTION,
        markers=markers,
    )


def grasp_softness() -> str:
    """MJCF attributes solref and solimp of nut assembly's contacts."""
    d = grasp_contact.IMPEDANCE
    stiff, damp = grasp_contact.STIFF * d * d, grasp_contact.DAMP * d
    return f'solref="{-stiff:.9g} {-damp:.9g}" solimp="{d} {d} 0.001"'


def nut_xml() -> str:
    """MJCF of nut assembly with this package's contact parameters."""
    return nut_scene(
        grasp_contact.BEADS,
        grasp_contact.FEET,
        pads=gripper.PADS,
        tips=gripper.TIPS,
        soft=grasp_softness(),
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
        raise ImportError("this needs MuJoCo: pip install mujoco") from error


MayClose = Callable[[Any, Any, Any], Any]
"""`may_close(model, data, contact) -> [C]` of truth values, for MuJoCo's and for MJX's alike."""


Leaf = Any  # an array of a program or of the host, or its shape


class MujocoState(NamedTuple):
    """What the next physics step depends on: [nq], [nv], [nv] (the last acceleration)."""

    qpos: Leaf
    qvel: Leaf
    warm: Leaf


class Measured(NamedTuple):
    """What a controller needs of an arm.

    Attributes:
        jacobian: [J, 6] of the site, m and rad per rad. mass: [J, J]. bias: [J] N m.
        position, rotation: [3] m and [3, 3] (columns) of the site.
    """

    jacobian: Leaf
    mass: Leaf
    bias: Leaf
    position: Leaf
    rotation: Leaf


class Touched(NamedTuple):
    """Contacts of the wanted pairs in a physics step: [G] groups of pairs.

    Attributes:
        force: [G, 3] on the second geoms, N, world axes. normal: [G] N.
        closed: [G] whether any is closed.
    """

    force: Leaf
    normal: Leaf
    closed: Leaf


class MujocoC:
    """A scene in C MuJoCo that a JAX program can step.

    Attributes:
        mujoco: The module.
        model, data: `MjModel` and `MjData`.
        site: Index of the site that is controlled.
        qpos, dofs: Places of the arm's joints.
    """

    def __init__(
        self,
        xml: str,
        *,
        joints: Sequence[str],
        site: str = "grip",
        handled: Sequence[str] = (),
        moved: Sequence[str] = (),
        groups: Sequence[tuple[str, str]] = (),
        may_close: MayClose | None = None,
    ):
        """Compile a scene.

        Args:
            xml: MJCF.
            joints: Names of the arm's joints.
            site: Name of the site.
            handled: Bodies whose mass a scenario changes.
            moved: Geoms whose places in their bodies are given at every step.
            groups: Beginnings of the names of the geoms of the contacts that are sensed.
            may_close: Which contacts a step may close; all where None.

        Raises:
            ImportError: Without MuJoCo.
        """
        self.mujoco = mujoco = import_mujoco()
        model = self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(model)
        self.site = model.site(site).id
        self.qpos = np.array([int(model.joint(name).qposadr[0]) for name in joints])
        self.dofs = np.array([int(model.joint(name).dofadr[0]) for name in joints])
        self._handled = np.array([model.body(name).id for name in handled], int)
        self._moved = np.array([model.geom(name).id for name in moved], int)
        model.geom_sameframe[self._moved] = 0  # MuJoCo: "lies in its body's frame", found once
        self._nominal = {
            name: np.array(getattr(model, name))
            for name in ("geom_friction", "pair_friction", "dof_damping", "body_mass",
                         "body_inertia")
        }  # fmt: skip
        self._groups = self._table(groups)
        self._may_close = may_close
        self._lock = threading.Lock()

    def _table(self, groups: Sequence[tuple[str, str]]) -> dict[tuple[int, int], tuple[int, int]]:
        """Group of each pair of geoms, and 1 where the second geom is the group's second."""
        names = [self.model.geom(index).name for index in range(self.model.ngeom)]
        found = {}
        for group, (first, second) in enumerate(groups):
            for a, one in enumerate(names):
                for b, two in enumerate(names):
                    if one.startswith(first) and two.startswith(second):
                        found[a, b], found[b, a] = (group, 1), (group, -1)
        return found

    def _place(self, state: Sequence[np.ndarray], factors: np.ndarray, places: Any) -> None:
        model, data, nominal = self.model, self.data, self._nominal
        data.qpos[:], data.qvel[:] = state[0], state[1]
        data.qacc_warmstart[:] = state[2]
        friction, mass, damping = factors
        model.geom_friction[:] = nominal["geom_friction"] * friction
        model.pair_friction[:] = nominal["pair_friction"] * friction
        model.dof_damping[:] = nominal["dof_damping"] * damping
        rows = self._handled
        model.body_mass[rows] = nominal["body_mass"][rows] * mass
        model.body_inertia[rows] = nominal["body_inertia"][rows] * mass
        if len(self._moved):
            model.geom_pos[self._moved] = places

    def measure(self, state: MujocoState, factors: Factors = NOMINAL) -> Measured:
        """Jacobian, inertia and bias forces of the arm in a state."""
        count = len(self.dofs)
        shapes = Measured(*(_shaped(s) for s in ((count, 6), (count, count), count, 3, (3, 3))))

        def host(state: Any, factors: Any) -> Measured:
            model, data, mujoco = self.model, self.data, self.mujoco
            with self._lock:
                self._place([np.asarray(leaf) for leaf in state], np.asarray(factors), 0.0)
                mujoco.mj_fwdPosition(model, data)
                mujoco.mj_fwdVelocity(model, data)
                jacobian, mass = np.zeros((6, model.nv)), np.zeros((model.nv, model.nv))
                mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self.site)
                mujoco.mj_fullM(model, data, mass)
                return Measured(
                    jacobian=_float(jacobian[:, self.dofs].T),
                    mass=_float(mass[np.ix_(self.dofs, self.dofs)]),
                    bias=_float(data.qfrc_bias[self.dofs]),
                    position=_float(data.site_xpos[self.site]),
                    rotation=_float(data.site_xmat[self.site].reshape(3, 3)),
                )

        return jax.pure_callback(
            host, shapes, tuple(state), _factors(factors), vmap_method="sequential"
        )

    def step(
        self,
        state: MujocoState,
        torque: jax.Array,
        *,
        factors: Factors = NOMINAL,
        places: Any = 0.0,
    ) -> tuple[MujocoState, Touched]:
        """One physics step.

        Args:
            state: State.
            torque: [nv] applied.
            factors: On frictions, masses and damping.
            places: [M, 3] of the geoms `moved` in their bodies, m.
        """
        groups = 1 + max((group for group, _ in self._groups.values()), default=-1)
        model = self.model
        shapes = (
            MujocoState(_shaped(model.nq), _shaped(model.nv), _shaped(model.nv)),
            Touched(
                _shaped((groups, 3)), _shaped(groups), jax.ShapeDtypeStruct((groups,), jnp.bool_)
            ),
        )

        def host(state: Any, torque: Any, factors: Any, places: Any) -> Any:
            data = self.data
            with self._lock:
                self._place(
                    [np.asarray(leaf) for leaf in state], np.asarray(factors), np.asarray(places)
                )
                data.qfrc_applied[:] = np.asarray(torque)
                self._step()
                touched = self._touched(groups)
                after = MujocoState(_float(data.qpos), _float(data.qvel), _float(data.qacc))
                return after, touched

        return jax.pure_callback(
            host,
            shapes,
            tuple(state),
            torque,
            _factors(factors),
            places,
            vmap_method="sequential",
        )

    def _step(self) -> None:
        """`mj_step` with Euler's integrator, and contacts that may not close left out."""
        model, data, mujoco = self.model, self.data, self.mujoco
        mujoco.mj_fwdPosition(model, data)
        if self._may_close is not None and data.ncon:
            closing = self._may_close(model, data, data.contact)
            if not np.all(closing):
                data.contact.exclude[:] = np.where(closing, data.contact.exclude, 1)
                mujoco.mj_makeConstraint(model, data)
                mujoco.mj_island(model, data)
                mujoco.mj_projectConstraint(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        mujoco.mj_fwdConstraint(model, data)
        mujoco.mj_Euler(model, data)

    def _touched(self, groups: int) -> Touched:
        model, data, mujoco = self.model, self.data, self.mujoco
        force, normal, closed = np.zeros((groups, 3)), np.zeros(groups), np.zeros(groups, bool)
        local = np.zeros(6)
        for index in range(data.ncon):
            contact = data.contact[index]
            found = self._groups.get((int(contact.geom1), int(contact.geom2)))
            if found is None or contact.exclude:
                continue
            group, sign = found
            mujoco.mj_contactForce(model, data, index, local)
            force[group] += sign * (local[:3] @ contact.frame.reshape(3, 3))
            normal[group] += local[0]
            closed[group] |= contact.dist < contact.includemargin
        return Touched(_float(force), _float(normal), closed)


def _factors(factors: Factors) -> jax.Array:
    wanted = (factors.friction, factors.mass, factors.damping)
    return jnp.stack([jnp.asarray(each, jnp.float32) for each in wanted])


def _shaped(shape: int | tuple[int, ...]) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((shape,) if isinstance(shape, int) else shape, jnp.float32)


def _float(value: Any) -> np.ndarray:
    return np.array(value, np.float32)  # a copy: MuJoCo goes on in its own
