"""Contacts of a sphere with a cylinder and with a box in closed form, as in C MuJoCo.

MJX searches for the first by gradient descent on distance fields (its source says that an
analytic version is still to be written), and goes through the faces and edges of a box as if it
were any mesh: two fifths of a step of the nut. C MuJoCo has closed forms (`mjc_SphereCylinder`,
`mjc_SphereBox` of `engine_collision_primitive.c` and `engine_collision_box.c`), which these are;
`tests/worlds/test_mjx.py` holds them against it.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from envs.derivatives import length

_NEXT_TO_NOTHING = 1e-12


def _touch(sphere: Any, normal: jax.Array, gap: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance and point of a contact.

    Args:
        sphere: MJX's `pos`, `mat`, `size`.
        normal: [3] from the sphere to the other shape.
        gap: From the sphere's centre to the other's surface, m.
    """
    radius = sphere.size[0]
    distance = gap - radius
    return distance, sphere.pos + normal * (radius + 0.5 * distance)


def sphere_cylinder(sphere: Any, cylinder: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distance, point [3] and normal [3] of the contact of a sphere with a solid cylinder.

    The nearest surface is the side where the centre is between the two ends, an end where it is
    within the radius, and else the rim; inside, the nearer of side and end.

    Args:
        sphere, cylinder: MJX's `pos`, `mat`, `size`.
    """
    axis = cylinder.mat[:, 2]
    radius, half = cylinder.size[0], cylinder.size[1]
    away = sphere.pos - cylinder.pos
    along = jnp.sum(away * axis)
    across = away - along * axis
    off = length(across)
    outwards = jnp.where(
        off > _NEXT_TO_NOTHING, across / jnp.maximum(off, _NEXT_TO_NOTHING), cylinder.mat[:, 0]
    )
    end = jnp.where(along < 0, -1.0, 1.0)
    above, beside = jnp.abs(along) - half, off - radius  # outside where positive
    rim = jnp.sqrt(jnp.maximum(above * above + beside * beside, _NEXT_TO_NOTHING))
    to_rim = -(beside * outwards + above * end * axis) / rim
    outside_both = (above > 0) & (beside > 0)
    at_side = beside > above
    normal = jnp.where(at_side, -outwards, -end * axis)
    normal = jnp.where(outside_both, to_rim, normal)
    gap = jnp.where(outside_both, rim, jnp.maximum(above, beside))
    return *_touch(sphere, normal, gap), normal


def sphere_box(sphere: Any, box: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distance, point [3] and normal [3] of the contact of a sphere with a solid box.

    Args:
        sphere, box: MJX's `pos`, `mat`, `size`.
    """
    away = sphere.pos - box.pos
    centre = jnp.sum(away[:, None] * box.mat, 0)  # in the box's axes
    to_nearest = jnp.clip(centre, -box.size, box.size) - centre
    outside = length(to_nearest)
    depth = box.size - jnp.abs(centre)
    face = jnp.arange(3, dtype=jnp.int32) == jnp.argmin(depth)
    inwards = jnp.where(face, jnp.where(centre < 0, 1.0, -1.0), 0.0)
    is_outside = outside > _NEXT_TO_NOTHING
    own = jnp.where(is_outside, to_nearest / jnp.maximum(outside, _NEXT_TO_NOTHING), inwards)
    normal = jnp.sum(box.mat * own, 1)
    gap = jnp.where(is_outside, outside, -jnp.min(depth))
    return *_touch(sphere, normal, gap), normal
