"""An MJCF scene on MJX: what a physics step and a control step do to it, and where things are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.mjx import newton, source, warp
from envs.manipulation.physics.mjx import rows as constraint_rows
from envs.manipulation.physics.mjx.repairs import mjx, private, with_mjx_flags
from envs.manipulation.physics.mujoco_c import MayClose, import_mujoco
from envs.manipulation.randomisation import NOMINAL, Factors

CONTROL_STEP = 0.05  # s
SOLVERS = ("newton", "mjx")
IMPLS = ("jax", "warp")

Control = Callable[[Any], Any]
"""`control(data) -> data` with `qfrc_applied` or `ctrl` set. It is called in every physics step,
when positions, velocities, inertia and bias forces of `data` are those of the step's start."""

Sense = Callable[[Any], Any]
"""`sense(data) -> values` of a physics step. As in MuJoCo, frames, contacts and forces are those of
the step's start, and `qpos` and `qvel` those of its end."""


@flax.struct.dataclass
class Bodies:
    """All that the physics of the next step depends on; MJX's own data is rebuilt from it.

    Attributes:
        qpos, qvel: [nq], [nv] of MuJoCo.
        warm: [nv] last acceleration, where the contact solver starts.
        act, ctrl: [na], [nu] of actuators, or None (a checkpoint cannot hold arrays of no size).
        mocap: [nmocap, 7] positions and quaternions, or None.
    """

    qpos: jax.Array
    qvel: jax.Array
    warm: jax.Array
    act: jax.Array | None = None
    ctrl: jax.Array | None = None
    mocap: jax.Array | None = None


class Scene:
    """A scene that MJX can run.

    Attributes:
        model: C MuJoCo's model of what moves and touches; the names are in it.
        full: C MuJoCo's model with all that is drawn. Places in `qpos` and `qvel` are the same.
        put: MJX's model.
        timestep: Of physics, s. substeps: Physics steps per control step.
        impl: Of MJX: "jax", or "warp" (MuJoCo Warp).
        solver: Of contacts: "newton" (`newton.py`), "mjx" (MJX's own) or "warp" (Warp's own).
        pairs: [C, 2] geoms of each contact of MJX's; None where they have no fixed places.
    """

    @with_mjx_flags
    def __init__(
        self,
        model: source.Source,
        *,
        control_step: float = CONTROL_STEP,
        solver: str | None = None,
        keep: Iterable[str] = (),
        may_close: MayClose | None = None,
        impl: str = "jax",
        room: warp.Room = warp.Room(),  # noqa: B008
    ):
        """Parse, compile and check a scene.

        Args:
            model: MJCF as text, a path, an `MjSpec`, or a compiled `MjModel`.
            control_step: Of the controller, s; a multiple of the model's timestep.
            solver: "newton", "mjx", or None for "newton" where it can solve the scene: elliptic
                cones without torsion, rolling or uneven friction.
            keep: Names of geoms that touch nothing, but whose places are asked for.
            may_close: Which contacts a step may close; all where None.
            impl: "jax", or "warp" where MuJoCo Warp is installed and there is a CUDA device (it
                also runs, slowly, on a CPU). Contacts then have no fixed rows: what reads their
                forces (`contacts`, `TwoFingerGripper`) needs "jax".
            room: For contacts and constraints with "warp".

        Raises:
            ValueError: One line, if the MJCF does not parse, the timestep does not divide the
                control step, MJX cannot collide two of its shapes or lacks another feature, or
                `solver` is none.
            ImportError: Without MuJoCo XLA, or with "warp" without Warp.
        """
        mujoco = import_mujoco()
        self.impl = impl
        if isinstance(model, mujoco.MjModel):
            self.full = self.model = model
        else:
            spec = source.read(model)
            self.full = source.compiled(spec)
            self.model = source.without_looks(spec, self.full, keep)
        self._may_close = may_close
        self._check(control_step, solver)
        self.substeps = round(control_step / self.timestep)
        try:
            if impl == "warp":
                self.put, self._blank = warp.put(self.model, room)
                self.solver, self.pairs = "warp", None
                return
            self.put = mjx().put_model(self.model)
            self._blank = mjx().make_data(self.put)
        except (NotImplementedError, ValueError) as error:
            raise ValueError(f"MJX cannot simulate this scene: {source.one_line(error)}") from error
        contact = self._blank._impl.contact
        able = constraint_rows.elliptic_only(self.model)
        self.solver = solver or ("newton" if able else "mjx")
        if self.solver == "newton" and not able:
            raise ValueError(
                "solver 'newton' cannot solve pyramidal cones, contacts of condim 4 or 6, nor "
                "uneven friction: choose 'mjx'"
            )
        dims = np.asarray(contact.dim, int)
        wide = np.flatnonzero(dims == 3)
        self.cone_rows = wide if len(wide) else None
        self.mixed = len(wide) != len(dims)
        self.row_kinds = constraint_rows.kinds(self.put, dims)
        self.moved_by = constraint_rows.moved_by(self.model)
        self.dof_root = self.model.body_rootid[self.model.dof_bodyid]
        self.ratio = float(self.model.opt.impratio)
        powers = np.concatenate([self.model.geom_solimp[:, 4], self.model.pair_solimp[:, 4]])
        self.plain_powers = bool(np.all(powers == 2.0))
        self.pairs = self._find_pairs()

    def _check(self, control_step: float, solver: str | None) -> None:
        mujoco = import_mujoco()
        self.timestep = float(self.model.opt.timestep)
        count = round(control_step / self.timestep)
        if count < 1 or abs(count * self.timestep - control_step) > 1e-9:
            raise ValueError(
                f"the MJCF's timestep must divide the control step of {control_step:g} s, got "
                f"{self.timestep:g}"
            )
        if solver is not None and solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(SOLVERS)}, got {solver!r}")
        if self.impl not in IMPLS:
            raise ValueError(f"impl must be one of {', '.join(IMPLS)}, got {self.impl!r}")
        if self.impl == "warp" and (solver is not None or self._may_close is not None):
            raise ValueError("impl 'warp' has its own solver and contacts: solver and may_close "
                             "must be None")  # fmt: skip
        if self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise ValueError("integrator must be Euler, implicit or implicitfast, got RK4")

    def _find_pairs(self) -> np.ndarray | None:
        if not self._blank._impl.ncon:
            return np.zeros((0, 2), int)
        limits = {"max_geom_pairs", "max_contact_points"}
        if limits & {self.model.numeric(i).name for i in range(self.model.nnumeric)}:
            return None

        def geoms() -> jax.Array:
            placed = mjx().kinematics(self.put, self._blank)
            return mjx().collision(self.put, placed)._impl.contact.geom

        # as one program, of which the compiler keeps the constant alone
        return np.asarray(jax.jit(geoms)())

    # ---- names

    def site(self, name: str) -> int:
        """Index of a site.

        Raises:
            ValueError: Without it; so do `body`, `geom` and `joints`.
        """
        return self._named("site", name)

    def body(self, name: str) -> int:
        """Index of a body."""
        return self._named("body", name)

    def geom(self, name: str) -> int:
        """Index of a geom."""
        return self._named("geom", name)

    def actuator(self, name: str) -> int:
        """Index of an actuator."""
        return self._named("actuator", name)

    def _named(self, kind: str, name: str) -> int:
        try:
            return int(getattr(self.model, kind)(name).id)
        except KeyError:
            count = {"site": "nsite", "body": "nbody", "geom": "ngeom", "joint": "njnt",
                     "actuator": "nu"}[kind]  # fmt: skip
            every = [getattr(self.model, kind)(i).name for i in range(getattr(self.model, count))]
            there = ", ".join(repr(each) for each in every if each) or "none with a name"
            raise ValueError(f"the scene has no {kind} {name!r}; it has {there}") from None

    def joints(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Places of hinges and slides in `qpos` and in `qvel`."""
        found = [self._named("joint", name) for name in names]
        wide = [n for n, i in zip(names, found, strict=True) if self.model.jnt_type[i] < 2]
        if wide:
            raise ValueError(f"joint {wide[0]!r} must be a hinge or a slide")
        model = self.model
        return model.jnt_qposadr[found].astype(np.int32), model.jnt_dofadr[found].astype(np.int32)

    def free_joint(self, name: str) -> tuple[slice, slice]:
        """Places of a free joint: seven of `qpos`, six of `qvel`."""
        index = self._named("joint", name)
        if self.model.jnt_type[index] != 0:
            raise ValueError(f"joint {name!r} must be a free joint")
        at, dof = int(self.model.jnt_qposadr[index]), int(self.model.jnt_dofadr[index])
        return slice(at, at + 7), slice(dof, dof + 6)

    def contacts(self, first: str, second: str) -> np.ndarray:
        """Rows of MJX's contacts between geoms whose names begin so, in either order.

        Raises:
            ValueError: If the two never meet, or a broad phase picks the contacts.
        """
        if self.pairs is None:
            raise ValueError("contacts have no fixed rows with impl 'warp', nor where "
                             "max_geom_pairs or max_contact_points is set")  # fmt: skip
        names = [self.model.geom(i).name for i in range(self.model.ngeom)]
        found = [
            row
            for row, (a, b) in enumerate(self.pairs)
            if (names[a].startswith(first) and names[b].startswith(second))
            or (names[b].startswith(first) and names[a].startswith(second))
        ]
        if not found:
            raise ValueError(f"no contact between geoms {first!r}... and {second!r}... is possible")
        return np.array(found, np.int32)

    # ---- states

    def start(self, qpos: Any = None, ctrl: Any = None) -> Bodies:
        """All at rest.

        Args:
            qpos: [nq]; the model's own where None.
            ctrl: [nu]; zero where None.
        """
        model = self.model
        mocap = None
        if model.nmocap:
            which = np.flatnonzero(model.body_mocapid >= 0)
            which = which[np.argsort(model.body_mocapid[which])]
            mocap = np.concatenate([model.body_pos[which], model.body_quat[which]], -1)
            mocap = jnp.asarray(mocap, jnp.float32)
        return Bodies(
            qpos=jnp.asarray(model.qpos0 if qpos is None else qpos, jnp.float32),
            qvel=jnp.zeros(model.nv, jnp.float32),
            warm=jnp.zeros(model.nv, jnp.float32),
            act=jnp.zeros(model.na, jnp.float32) if model.na else None,
            ctrl=(
                jnp.zeros(model.nu, jnp.float32) if ctrl is None else jnp.asarray(ctrl, jnp.float32)
            )
            if model.nu
            else None,
            mocap=mocap,
        )

    def data(self, bodies: Bodies) -> Any:
        """MJX's data of a state; nothing derived is computed yet."""
        given = {"act": bodies.act, "ctrl": bodies.ctrl}
        if bodies.mocap is not None:
            given |= {"mocap_pos": bodies.mocap[:, :3], "mocap_quat": bodies.mocap[:, 3:]}
        return self._blank.replace(
            qpos=bodies.qpos,
            qvel=bodies.qvel,
            qacc_warmstart=bodies.warm,
            **{name: value for name, value in given.items() if value is not None},
        )

    @with_mjx_flags
    def placed(self, bodies: Bodies, put: Any = None) -> Any:
        """MJX's data with the frames of bodies, geoms and sites, and the joints' axes."""
        put = self.put if put is None else put
        if self.impl == "warp":
            return mjx().forward(put, self.data(bodies))
        return mjx().com_pos(put, mjx().kinematics(put, self.data(bodies)))

    def _collided(self, put: Any, data: Any) -> Any:
        if self.impl == "warp":
            return data  # `placed` did it
        data = mjx().collision(put, data)
        if self._may_close is not None:
            contact = data._impl.contact
            gap = jnp.where(self._may_close(self.model, data, contact), contact.dist, 1.0)
            data = data.tree_replace({"_impl.contact.dist": gap})
        return data

    @with_mjx_flags
    def at_rest(self, bodies: Bodies, put: Any = None) -> Any:
        """MJX's data of a start, as `sense` takes it: frames and contacts; forces are zero."""
        put = self.put if put is None else put
        return self._collided(put, self.placed(bodies, put))

    def varied(self, factors: Factors, handled: Sequence[int] = ()) -> Any:
        """MJX's model of a scenario: frictions, damping, and masses of the bodies `handled`."""
        if factors is NOMINAL:
            return self.put
        put, bodies = self.put, np.asarray(handled, int)
        changed = {
            "geom_friction": put.geom_friction * factors.friction,
            "pair_friction": put.pair_friction * factors.friction,
            "dof_damping": put.dof_damping * factors.damping,
        }
        if len(bodies):
            changed["body_mass"] = put.body_mass.at[bodies].multiply(factors.mass)
            changed["body_inertia"] = put.body_inertia.at[bodies].multiply(factors.mass)
        return put.replace(**changed)

    # ---- physics

    @with_mjx_flags
    def step(self, data: Any, control: Control, put: Any = None) -> Any:
        """One physics step: MuJoCo's `mj_step1`, the controller, `mj_step2`.

        Args:
            data: MJX's data; only the state in it is read.
            control: Controller.
            put: Another MJX model of the same shapes, with other masses, frictions or places.
        """
        put, x = self.put if put is None else put, mjx()
        if self.impl == "warp":  # its stages have no names of their own: forward is computed twice
            return x.step(put, control(x.forward(put, data)))
        data = x.com_pos(put, x.kinematics(put, data))
        if self.model.ntendon:
            data = private("smooth").tendon(put, data)
        data = x.crb(put, data)
        if self.model.ntendon:
            data = private("smooth").tendon_armature(put, data)
        data = self._collided(put, data)
        moments = {}
        if self.model.nu:
            data = x.transmission(put, data)
            moments["_impl.actuator_velocity"] = data._impl.actuator_moment @ data.qvel
        if self.model.ntendon:
            moments["_impl.ten_velocity"] = data._impl.ten_J @ data.qvel
        data = data.tree_replace(moments) if moments else data
        data = x.rne(put, x.passive(put, x.com_vel(put, data)))
        if self.model.ntendon:
            data = private("smooth").tendon_bias(put, data)
        data = control(data)
        if self.model.nu:
            data = x.fwd_actuation(put, data)
        # `fwd_acceleration` without `xfrc_applied`, which costs a Jacobian per body
        smooth = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + data.qfrc_applied
        data = data.replace(qfrc_smooth=smooth)
        return self._integrate(put, self._constrained(put, data))

    def _constrained(self, put: Any, data: Any) -> Any:
        if self.solver == "mjx":
            x = mjx()
            data = x.make_constraint(put, x.factor_m(put, data))
            data = data.replace(qacc_smooth=private("smooth").solve_m(put, data, data.qfrc_smooth))
            if data._impl.efc_J.size:
                return x.solve(put, data)
            return data.replace(qacc=data.qacc_smooth)
        mass = self.mass_matrix(data)
        free = newton.solve_spd(mass, data.qfrc_smooth)
        rows, cones = constraint_rows.rows(self, put, data), constraint_rows.cones(self, put, data)
        data = data.replace(qacc_smooth=free)
        if rows is None and cones is None:
            return data.replace(qacc=free)
        solved = newton.solve(
            mass,
            free,
            data.qacc_warmstart,
            rows=rows,
            cones=cones,
            iterations=self.model.opt.iterations,
        )
        forces, pulls = [], jnp.zeros_like(free)
        if rows is not None:
            forces.append(solved.rows)
            pulls = pulls + rows.jacobian.T @ solved.rows
        if cones is not None:
            forces.append(jnp.roll(solved.cones, 1, 0).T.reshape(-1))  # normal first, as MJX's
            pulls = pulls + jnp.sum(cones.jacobian * solved.cones, (1, 2))
        return data.replace(qacc=solved.acceleration, qfrc_constraint=pulls).tree_replace(
            {"_impl.efc_force": jnp.concatenate(forces)}
        )

    def _integrate(self, put: Any, data: Any) -> Any:
        mujoco, forward = import_mujoco(), private("forward")
        acceleration = data.qacc
        if self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
            off = put.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
            if not off and np.any(self.model.dof_damping):
                stiff = self.mass_matrix(data) + jnp.diag(put.opt.timestep * put.dof_damping)
                acceleration = newton.solve_spd(stiff, data.qfrc_smooth + data.qfrc_constraint)
        else:
            slope = private("derivative").deriv_smooth_vel(put, data)
            if slope is not None:
                stiff = self.mass_matrix(data) - put.opt.timestep * slope
                acceleration = newton.solve_spd(stiff, data.qfrc_smooth + data.qfrc_constraint)
        return forward._advance(put, data, data.act_dot, acceleration)

    def mass_matrix(self, data: Any) -> jax.Array:
        """Joint-space inertia of a step's start, [nv, nv]."""
        if self.impl == "warp":
            return warp.mass_matrix(self.model, data)
        return mjx().full_m(self.put, data)

    def advance(
        self, bodies: Bodies, control: Control, sense: Sense, put: Any = None
    ) -> tuple[Bodies, Any]:
        """One control step: `substeps` physics steps.

        Only `Bodies` and what `sense` returns are carried from one to the next: 0.3 kB, where
        MJX's data is 60 kB.

        Args:
            bodies: State.
            control: Controller.
            sense: What to keep of the last physics step.
            put: See `step`.
        """

        def one(bodies: Bodies) -> tuple[Bodies, Any]:
            data = self.step(self.data(bodies), control, put)
            return self.kept(bodies, data), sense(data)

        blank = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, bodies)[1]
        )
        carry, _ = jax.lax.scan(
            lambda carry, _: (one(carry[0]), None), (bodies, blank), None, length=self.substeps
        )
        return carry

    @staticmethod
    def kept(bodies: Bodies, data: Any) -> Bodies:
        """The state after a physics step."""
        return dataclasses.replace(
            bodies,
            qpos=data.qpos,
            qvel=data.qvel,
            warm=data.qacc_warmstart,
            act=None if bodies.act is None else data.act,
            ctrl=None if bodies.ctrl is None else data.ctrl,
        )

    # ---- contacts of a finished step

    def touching(self, data: Any, rows: np.ndarray) -> jax.Array:
        """Whether any of these contacts is closed."""
        contact = data._impl.contact
        return jnp.any(contact.dist[rows] < contact.includemargin[rows])

    def normal(self, data: Any, rows: np.ndarray) -> jax.Array:
        """Normal force of each of these contacts, [C] N."""
        return self._local(data, rows)[:, 0]

    def forces(self, data: Any, rows: np.ndarray) -> jax.Array:
        """Force of each of these contacts on its second geom, [C, 3] N, world axes."""
        frame = data._impl.contact.frame[rows].reshape(-1, 3, 3)
        return jnp.sum(self._local(data, rows)[:, :, None] * frame, 1)

    def _local(self, data: Any, rows: np.ndarray) -> jax.Array:
        contact, force = data._impl.contact, data._impl.efc_force
        at, dims = np.asarray(contact.efc_address)[rows], np.asarray(contact.dim)[rows]
        if len(set(dims.tolist())) > 1:
            raise ValueError("these contacts differ in condim: ask for their forces apart")
        if dims[0] == 1:
            return jnp.pad(force[at][:, None], ((0, 0), (0, 2)))
        if self.model.opt.cone == import_mujoco().mjtCone.mjCONE_ELLIPTIC:
            return force[at[:, None] + np.arange(3)]
        edges = force[at[:, None] + np.arange(2 * (dims[0] - 1))]
        friction = contact.friction[rows]
        plane = [(edges[:, 2 * i] - edges[:, 2 * i + 1]) * friction[:, i] for i in (0, 1)]
        return jnp.stack([jnp.sum(edges, -1), *plane], -1)
