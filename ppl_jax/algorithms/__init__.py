"""The learning methods, one file each, by name."""

from __future__ import annotations

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.algorithms.ppl import make_bc_only, make_ppl

ALGORITHMS: dict[str, MakeAlgorithm] = {"ppl": make_ppl, "bc_only": make_bc_only}

__all__ = ["ALGORITHMS", "Algorithm", "MakeAlgorithm"]
