"""Many runs as one batch: their settings stacked, shared out over devices, and what one takes.

A core is as fast with one run as with many, so on a CPU runs go one after another; an accelerator
steps them side by side, split over all devices.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ppl_jax.config import HParams
from ppl_jax.training import TrainFunctions
from ppl_jax.types import PyTree


def stack(hparams: list[HParams]) -> HParams:
    """Runs' hyper-parameters as one pytree of float32 arrays [B]."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.array(leaves, np.float32)), *hparams)


def split(batch: PyTree, devices: list[Any]) -> PyTree:
    """A batch [B, ...] with its runs shared out over devices; B is a multiple of their number."""
    mesh = Mesh(np.array(devices), ("runs",))
    return jax.device_put(batch, NamedSharding(mesh, PartitionSpec("runs")))


def run_bytes(functions: TrainFunctions, hparams: HParams) -> int:
    """Memory that one run's state takes, bytes: its buffers, parameters and environment."""
    learner = jax.eval_shape(functions.init, jax.random.key(0), hparams)
    leaves = jax.tree.leaves(learner)
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in leaves)
