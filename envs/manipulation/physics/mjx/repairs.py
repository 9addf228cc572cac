"""The only door to MJX: `mjx()` imports it, with what it needs to run well on a CPU.

Two repairs. Neither changes a number (`tests/worlds/test_mjx.py` holds them against MJX as it is),
and both do nothing but on a CPU.

1. **A barrier behind `math.quat_mul`.** `mjx.kinematics` walks the tree with a product of
   quaternions per joint. XLA's CPU compiler fuses the walk, so that every joint computes all of its
   ancestors again: a batch of 16 UR5e is sixty to two hundred times slower. The barrier makes each
   frame a stored value. Known upstream (jax-ml/jax#33761, google-deepmind/mujoco#2957).
2. **No LAPACK.** MJX factors the mass matrix and the solver's Hessian by `cho_factor`, a LAPACK
   call per world, which waits for itself where a large batch meets few threads. `Scene` steps with
   `newton.py` and `unrolled_linalg.py` instead and never calls it (but see `Scene`'s `solver`).

Without warp-lang, importing MJX prints two lines to the standard output; they are swallowed.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import warnings
from typing import Any

import jax


@functools.cache
def mjx() -> Any:
    """The module `mujoco.mjx`, repaired; its names are unknown to type checkers.

    Raises:
        ImportError: Without MuJoCo XLA.
    """
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            module = importlib.import_module("mujoco.mjx")
            math: Any = importlib.import_module("mujoco.mjx._src.math")
    except ImportError as error:
        raise ImportError("physics 'mjx' needs mujoco-mjx: pip install mujoco-mjx") from error
    product = math.quat_mul

    @functools.wraps(product)
    def barred(u: jax.Array, v: jax.Array) -> jax.Array:
        if jax.default_backend() != "cpu":
            return product(u, v)
        return jax.lax.optimization_barrier(product(u, v))

    math.quat_mul = barred
    return module


def private(module: str) -> Any:
    """A module of MJX's own, such as "constraint": the rows of a constraint have no other name."""
    mjx()
    return importlib.import_module(f"mujoco.mjx._src.{module}")
