"""Constraint rows of a scene for `newton.py`, built from MJX's contacts and joints.

What they contain is MJX's (`mjx._src.constraint`). Contacts with elliptic friction in the plane,
of which a scene has dozens, are built here: their Jacobian is one product, where MJX walks the tree
once per contact. The rest comes from `mjx.make_constraint`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.manipulation.physics.mjx.newton import DRY, ONE_SIDED, TWO_SIDED, Cones, Rows
from envs.manipulation.physics.mjx.repairs import private
from envs.manipulation.physics.mujoco_c import import_mujoco

_LEAST, _MOST = 1e-4, 0.9999  # MuJoCo's mjMINIMP, mjMAXIMP
_TINY = 1e-15  # mjMINVAL


def elliptic_only(model: Any) -> bool:
    """Whether `newton.py` can solve the scene: elliptic cones without torsion or rolling.

    Also excluded: a friction that differs between the two directions of the plane, and `solref` of
    its own for friction, both of which only a `<pair>` can ask for.
    """
    mujoco = import_mujoco()
    if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return False  # the two solvers part there (`tests/worlds/test_mjx.py`): MJX's is right
    dims = np.concatenate([model.pair_dim, model.geom_condim])
    uneven = np.any(model.pair_friction[:, 0] != model.pair_friction[:, 1])
    return bool(
        np.all(np.isin(dims, (1, 3))) and not uneven and not model.pair_solreffriction.any()
    )


def moved_by(model: Any) -> np.ndarray:
    """Whether a degree of freedom moves a body, [nbody, nv] of 0 and 1."""
    table = np.zeros((model.nbody, model.nv), np.float32)
    for body in range(1, model.nbody):
        table[body] = table[model.body_parentid[body]]
        first = model.body_dofadr[body]
        table[body, first : first + model.body_dofnum[body]] = 1.0
    return table


def _stiffness(
    put: Any, solref: jax.Array, solimp: jax.Array, position: jax.Array, plain: bool
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """MuJoCo's k, b and d of contacts, [C] each (`mjx._src.constraint._kbi`).

    `plain` says that all powers of the impedance are 2.
    """
    low, high = (jnp.clip(solimp[:, i], _LEAST, _MOST) for i in (0, 1))
    width, middle = jnp.maximum(_TINY, solimp[:, 2]), jnp.clip(solimp[:, 3], _LEAST, _MOST)
    power = jnp.maximum(1.0, solimp[:, 4])
    time, ratio = solref[:, 0], solref[:, 1]
    soft = jnp.where(time > 0, time, 1.0)
    if not put.opt.disableflags & import_mujoco().mjtDisableBit.mjDSBL_REFSAFE:
        soft = jnp.maximum(soft, 2 * put.opt.timestep)
    damp = jnp.where(ratio > 0, ratio, 1.0)
    k = jnp.where(time <= 0, -time / (high * high), 1 / (high * soft * damp) ** 2)
    b = jnp.where(ratio <= 0, -ratio / high, 2 / (high * soft))
    x = jnp.abs(position) / width
    if plain:
        rise, fall = x * x / middle, (1 - x) * (1 - x) / (1 - middle)
    else:
        rise = jnp.power(x, power) / jnp.power(middle, power - 1)
        fall = jnp.power(jnp.abs(1 - x), power) / jnp.power(1 - middle, power - 1)
    d = low + jnp.where(x < middle, rise, 1 - fall) * (high - low)
    d = jnp.where(x > 1.0, high, jnp.clip(d, low, high))
    return k, b, d


def cones(scene: Any, put: Any, data: Any) -> Cones | None:
    """The contacts with friction in the plane, x and y tangents, z the normal."""
    impl = data._impl
    which = scene.cone_rows
    if which is None:
        return None
    contact = jax.tree.map(lambda leaf: leaf[which], impl.contact) if scene.mixed else impl.contact
    if scene.pairs is None:
        bodies = jnp.asarray(scene.model.geom_bodyid)[contact.geom]
    else:  # known before tracing
        bodies = scene.model.geom_bodyid[scene.pairs[which]]
    first, second = bodies[:, 0], bodies[:, 1]
    sign = scene.moved_by[second] - scene.moved_by[first]  # [C, nv]
    # a degree of freedom moves a point p at v + w x p, w and v seen at the world's origin
    spin = data.cdof[:, :3]
    velocity = data.cdof[:, 3:] - jnp.cross(spin, data.subtree_com[scene.dof_root])
    twist = jax.lax.optimization_barrier(jnp.concatenate([velocity, spin], -1))  # [nv, 6]
    axes = jnp.transpose(contact.frame.reshape(-1, 3, 3), (2, 1, 0))[:, np.array([1, 2, 0])]
    (x, y, z), (ex, ey, ez) = contact.pos.T, axes  # [C] each, [3, C] each
    around = jnp.stack([y * ez - z * ey, z * ex - x * ez, x * ey - y * ex])
    wrench = jax.lax.optimization_barrier(jnp.concatenate([axes, around]))  # [6, 3, C]
    # one product of small matrices would be one number at a time on a CPU
    jacobian = wrench[0] * twist[:, 0, None, None]
    for part in range(1, 6):
        jacobian = jacobian + wrench[part] * twist[:, part, None, None]
    jacobian = jax.lax.optimization_barrier(jacobian * sign.T[:, None])  # [nv, 3, C]
    position = contact.dist - contact.includemargin
    k, b, d = _stiffness(put, contact.solref, contact.solimp, position, scene.plain_powers)
    inverse = put.body_invweight0[first, 0] + put.body_invweight0[second, 0]
    weight = d / jnp.maximum(inverse * (1 - d), _TINY)
    speed = jnp.sum(jacobian * data.qvel[:, None, None], 0)
    reference = (-b * speed).at[2].add(-k * d * position)
    return Cones(
        jacobian=jacobian,
        reference=reference,
        weight=jnp.where(position < 0, weight, 0.0),
        friction=contact.friction[:, 0],
        ratio=scene.ratio,
    )


def rows(scene: Any, put: Any, data: Any) -> Rows | None:
    """Equalities, dry friction, limits, and contacts without friction."""
    if scene.row_kinds.size == 0:
        return None
    constraint = private("constraint")
    if scene.cone_rows is not None:  # leave out what `cones` builds
        only = np.where(data._impl.contact.dim == 1, 1, 0)
        data = data.tree_replace({"_impl.contact.dim": only})
    impl = constraint.make_constraint(put, data)._impl
    acts = (scene.row_kinds != ONE_SIDED) | jnp.any(impl.efc_J != 0, -1)
    return Rows(
        jacobian=impl.efc_J,
        reference=impl.efc_aref,
        weight=jnp.where(acts, impl.efc_D, 0.0),
        bound=impl.efc_frictionloss,
        kind=scene.row_kinds,
    )


def kinds(put: Any, dims: np.ndarray) -> np.ndarray:
    """Kind of each row of `rows`, [R], in MJX's order.

    Args:
        put: MJX's model.
        dims: Of the contacts.
    """
    constraint = private("constraint")
    only = np.where(dims == 1, 1, 0)
    equalities, dry, limits, contacts = constraint.counts(constraint.make_efc_type(put, only))
    return np.repeat([TWO_SIDED, DRY, ONE_SIDED], [equalities, dry, limits + contacts])
