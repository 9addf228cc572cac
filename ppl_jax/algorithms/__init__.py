"""The learning methods, one file each, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ppl_jax.algorithms.base import Algorithm, MakeAlgorithm
from ppl_jax.algorithms.bc import ClonerHParams, make_bc
from ppl_jax.algorithms.eil import EILHParams, make_eil
from ppl_jax.algorithms.ensemble_dagger import (
    EnsembleConfig,
    EnsembleDAggerHParams,
    make_ensemble_dagger,
)
from ppl_jax.algorithms.gail import GAILConfig, GAILHParams, make_gail
from ppl_jax.algorithms.haco import HACOHParams, make_haco, make_haco_port
from ppl_jax.algorithms.hg_dagger import make_hg_dagger
from ppl_jax.algorithms.iwr import make_iwr
from ppl_jax.algorithms.ppl import PPLConfig, PPLHParams, fit_horizons, make_ppl
from ppl_jax.algorithms.pvp import PVPHParams, make_pvp, make_pvp4real
from ppl_jax.algorithms.registry import AlgorithmSpec, method, register, registered, settings
from ppl_jax.algorithms.thrifty_dagger import ThriftyDAggerHParams, make_thrifty_dagger
from ppl_jax.cards import EnvCard
from ppl_jax.policies import ClonerConfig

GAIL_STEPS = 1_000_000


def _bc(card: EnvCard) -> Mapping[str, Any]:
    steps = card.demonstrations  # the paper's number for methods that learn from them alone
    return {
        "total_steps": steps,
        "demonstrations": steps,
        "human_capacity": steps,
        "offline_updates": 20_000,
    }


def _gail(card: EnvCard) -> Mapping[str, Any]:
    steps = card.demonstrations
    return {"total_steps": steps + GAIL_STEPS, "demonstrations": steps}


# several networks see every sample; the published sizes range from 50 (Thrifty-DAgger) and 128
# (PVP) to 1024 (HACO)
BATCH_OF_CRITICS = 128


def _warmed_up(card: EnvCard) -> Mapping[str, Any]:
    return {"demonstrations": card.warm_up, "offline_updates": 1000}


def _thrifty(card: EnvCard) -> Mapping[str, Any]:
    return {**_warmed_up(card), "batch_size": BATCH_OF_CRITICS}


# `tuned` is the best of four settings each, found by `ppl tune driving --seeds 1` on training
# scenarios after 3,000 steps (experiments/results/driving_tuning.csv), and used in every
# environment. `grid` holds the values tried: two learning rates by two values of the setting that
# matters most.
_CRITICS = {"batch_size": BATCH_OF_CRITICS}
_VALUES_ALONE = {**_CRITICS, "bc_weight": 0.0}  # no cloning term in the published losses
_LIKELIHOOD = {"likelihood": ("gaussian", "laplace")}
_FAST, _SLOW = {"learning_rate": (3e-4, 1e-3)}, {"learning_rate": (1e-4, 3e-4)}

register(
    "ppl",
    make_ppl,
    tuned={"learning_rate": 1e-3},
    config=PPLConfig,
    hparams=PPLHParams,
    derive=fit_horizons,
    grid=_FAST | _LIKELIHOOD,
)
register(
    "bc",
    make_bc,
    _bc,
    {"likelihood": "laplace"},
    config=ClonerConfig,
    hparams=ClonerHParams,
    gated=False,
    grid=_FAST | _LIKELIHOOD,
    cost=0.6,
)
register(
    "gail",
    make_gail,
    _gail,
    {"survival_correction": 0.0},
    config=GAILConfig,
    hparams=GAILHParams,
    gated=False,
    grid={"discriminator_rate": (1e-4, 3e-4), "survival_correction": (0.0, 1.0)},
    cost=0.04,
)
register(
    "hg_dagger",
    make_hg_dagger,
    tuned={"likelihood": "laplace"},
    config=ClonerConfig,
    hparams=ClonerHParams,
    grid=_FAST | _LIKELIHOOD,
    cost=0.57,
)
register(
    "ensemble_dagger",
    make_ensemble_dagger,
    _warmed_up,
    {"max_discrepancy": 0.1},
    config=EnsembleConfig,
    hparams=EnsembleDAggerHParams,
    gated=False,
    grid=_FAST | {"max_discrepancy": (0.02, 0.1)},
    cost=1.9,
)
register(
    "thrifty_dagger",
    make_thrifty_dagger,
    _thrifty,
    {"learning_rate": 1e-3, "switch_rate": 0.05},
    config=EnsembleConfig,
    hparams=ThriftyDAggerHParams,
    gated=False,
    grid=_FAST | {"switch_rate": (0.05, 0.2)},
    cost=5.4,  # at the batch of 256 that estimates count in; likewise below
)
register(
    "iwr",
    make_iwr,
    _warmed_up,
    {"likelihood": "laplace"},
    config=ClonerConfig,
    grid=_FAST | _LIKELIHOOD,
    cost=0.57,
)
register(
    "eil",
    make_eil,
    _VALUES_ALONE,
    {"margin": 1.0},
    hparams=EILHParams,
    grid=_SLOW | {"margin": (0.1, 1.0)},
    cost=5.3,
)
_HACO_GRID = _SLOW | {"conservative_weight": (1.0, 10.0)}
register(
    "haco",
    make_haco,
    _CRITICS,
    {"conservative_weight": 10.0},
    hparams=HACOHParams,
    grid=_HACO_GRID,
    cost=6.8,
)
register(
    "haco_port",
    make_haco_port,
    {**_CRITICS, "conservative_weight": 1.0},
    hparams=HACOHParams,
    variant=True,
    cost=6.8,
)
register(
    "pvp",
    make_pvp,
    _VALUES_ALONE,
    {"discount": 0.9},
    hparams=PVPHParams,
    grid=_SLOW | {"discount": (0.9, 0.99)},
    cost=3.6,
)
register(
    "pvp4real",
    make_pvp4real,
    {**_CRITICS, "bc_weight": 1.0},
    {"discount": 0.9},
    hparams=PVPHParams,
    variant=True,
    cost=3.6,
)

__all__ = [
    "Algorithm",
    "AlgorithmSpec",
    "MakeAlgorithm",
    "method",
    "register",
    "registered",
    "settings",
]
