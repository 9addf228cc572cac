"""The only door to MJX: `mjx()` imports it, with what it needs to run well on a CPU.

Three repairs. None changes a number (`tests/worlds/test_mjx.py` holds them against MJX as it is),
and all do nothing but on a CPU.

1. **A barrier behind `math.quat_mul`.** `mjx.kinematics` walks the tree with a product of
   quaternions per joint. XLA's CPU compiler fuses the walk, so that every joint computes all of its
   ancestors again: a batch of 16 UR5e is sixty to two hundred times slower. The barrier makes each
   frame a stored value. Known upstream (jax-ml/jax#33761, google-deepmind/mujoco#2957).
2. **No LAPACK.** MJX factors the mass matrix and the solver's Hessian by `cho_factor`, a LAPACK
   call per world, which waits for itself where a large batch meets few threads. `Scene` steps with
   `newton.py` and `unrolled_linalg.py` instead and never calls it (but see `Scene`'s `solver`).
3. **No scatter.** XLA's CPU compiler makes one function of a loop that moves little data
   (`envs.compiler`), but not of one with a scatter: each of a step's 400 operations is then a task
   of its own, and dealing them out takes more than half of the time. MJX scatters where it inserts
   one number into a quaternion, sums over the children of a body, and places a joint's limit or
   motor among the degrees of freedom. (Left as they are: equalities, ball joints' limits, tendons.)

Beside these, `closed_forms.py` takes the place of two of MJX's searches; it agrees with C MuJoCo to
rounding and serves all backends.

Without warp-lang, importing MJX prints two lines to the standard output; they are swallowed.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import types
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.mjx import closed_forms
from envs.manipulation.physics.mujoco_c import import_mujoco

_SLIDE, _HINGE = 2, 3  # MuJoCo's mjtJoint
_JOINT_TRANSMISSIONS = (0, 1)  # mjtTrn: JOINT, JOINTINPARENT


@functools.cache
def mjx() -> Any:
    """The module `mujoco.mjx`, repaired; its names are unknown to type checkers.

    Raises:
        ImportError: Without MuJoCo XLA.
    """
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            module: Any = importlib.import_module("mujoco.mjx")
            math: Any = importlib.import_module("mujoco.mjx._src.math")
    except ImportError as error:
        raise ImportError("physics 'mjx' needs mujoco-mjx: pip install mujoco-mjx") from error
    scan: Any = importlib.import_module("mujoco.mjx._src.scan")
    constraint: Any = importlib.import_module("mujoco.mjx._src.constraint")
    math.quat_mul = _on_cpu(math.quat_mul, _barred(math.quat_mul))
    math.axis_angle_to_quat = _on_cpu(math.axis_angle_to_quat, _quaternion)
    scan.jax = _JaxOfScan("jax")
    constraint._efc_limit_slide_hinge = _on_cpu(
        constraint._efc_limit_slide_hinge, _limits(constraint._Efc)
    )
    module.transmission = _on_cpu(module.transmission, _motors(module.transmission))
    _close_forms(math)
    return module


def with_mjx_flags(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that calls MJX, traced as without `jax_enable_x64` and strict type promotion.

    MJX's own constants have the type that the flag says, so that with it a step would be partly in
    double precision, and its loops would not trace. All that it is given is in single precision.
    """

    @functools.wraps(function)
    def traced(*args: Any, **kwargs: Any) -> Any:
        with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
            return function(*args, **kwargs)

    return traced


def _close_forms(math: Any) -> None:
    """Let MJX collide spheres with cylinders and boxes by `closed_forms.py`."""
    driver: Any = importlib.import_module("mujoco.mjx._src.collision_driver")
    primitive: Any = importlib.import_module("mujoco.mjx._src.collision_primitive")
    sphere, kinds = driver.GeomType.SPHERE, driver.GeomType

    def collider(contact: Callable[..., Any]) -> Callable[..., Any]:
        def framed(first: Any, second: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
            distance, point, normal = contact(first, second)
            return distance, point, math.make_frame(normal)

        return primitive.collider(ncon=1)(framed)

    driver._COLLISION_FUNC[sphere, kinds.CYLINDER] = collider(closed_forms.sphere_cylinder)
    driver._COLLISION_FUNC[sphere, kinds.BOX] = collider(closed_forms.sphere_box)


def _on_cpu(original: Callable[..., Any], repaired: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(original)
    def either(*args: Any) -> Any:
        return (repaired if jax.default_backend() == "cpu" else original)(*args)

    return either


def _barred(product: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    return lambda u, v: jax.lax.optimization_barrier(product(u, v))


def _quaternion(axis: jax.Array, angle: jax.Array) -> jax.Array:
    """`math.axis_angle_to_quat` without `jnp.insert`."""
    s, c = jnp.sin(angle * 0.5), jnp.cos(angle * 0.5)
    return jnp.concatenate([c[None], axis * s])


def _segment_sum(values: jax.Array, segments: np.ndarray, count: int) -> jax.Array:
    """`jax.ops.segment_sum` whose segments are known before tracing."""
    sums = [jnp.zeros(values.shape[1:], values.dtype)] * count
    for row, segment in enumerate(segments):
        sums[segment] = sums[segment] + values[row]
    return jnp.stack(sums)


def _limits(row: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """`constraint._efc_limit_slide_hinge`, all limits at once."""

    def rows(m: Any, d: Any) -> Any:
        limited = np.isin(m.jnt_type, (_SLIDE, _HINGE)) & (np.asarray(m.jnt_limited) != 0)
        which = np.flatnonzero(limited)
        if m.opt.disableflags & import_mujoco().mjtDisableBit.mjDSBL_LIMIT or not which.size:
            return None
        place, dof = d.qpos[m.jnt_qposadr[which]], m.jnt_dofadr[which]
        margin = m.jnt_margin[which]
        below, above = place - m.jnt_range[which, 0], m.jnt_range[which, 1] - place
        position = jnp.minimum(below, above) - margin
        acts = position < 0
        side = jnp.where(below < above, 1.0, -1.0) * acts
        return row(
            side[:, None] * np.eye(m.nv, dtype=np.float32)[dof],
            position * acts,
            position,
            m.dof_invweight0[dof],
            m.jnt_solref[which],
            m.jnt_solimp[which],
            margin,
            jnp.zeros_like(position),
        )

    return rows


def _motors(original: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """`smooth.transmission`, all at once where every actuator turns a hinge or moves a slide."""

    def transmission(m: Any, d: Any) -> Any:
        joints = np.asarray(m.actuator_trnid)[:, 0] if m.nu else np.zeros(0, int)
        on_joints = np.all(np.isin(m.actuator_trntype, _JOINT_TRANSMISSIONS))
        if not (m.nu and on_joints and np.all(np.isin(m.jnt_type[joints], (_SLIDE, _HINGE)))):
            return original(m, d)
        gear = m.actuator_gear[:, 0]
        moment = gear[:, None] * np.eye(m.nv, dtype=np.float32)[m.jnt_dofadr[joints]]
        return d.tree_replace(
            {
                "actuator_length": d.qpos[m.jnt_qposadr[joints]] * gear,
                "_impl.actuator_moment": moment,
            }
        )

    return transmission


class _JaxOfScan(types.ModuleType):
    """JAX as `mjx._src.scan` sees it: with another `ops.segment_sum`."""

    ops = types.SimpleNamespace(segment_sum=_on_cpu(jax.ops.segment_sum, _segment_sum))

    def __getattr__(self, name: str) -> Any:
        return getattr(jax, name)


def private(module: str) -> Any:
    """A module of MJX's own, such as "constraint": the rows of a constraint have no other name."""
    mjx()
    return importlib.import_module(f"mujoco.mjx._src.{module}")
