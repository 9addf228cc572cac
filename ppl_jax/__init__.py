"""Predictive Preference Learning from human interventions, in JAX.

    result = ppl_jax.train("driving", "ppl", seed=0, beta=0.05)

Names are loaded when they are first used, so that the import costs nothing. Environments and the
command line live in the packages `envs` and `experiments`, which a project may have of its own;
everything a notebook or a script needs of them is here.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

_NAMES = {
    "make": "envs.registry",
    "register": "envs.registry",
    "registered": "envs.registry",
    "Environment": "envs.base",
    "train": "experiments.studies.quick",
    "main": "experiments.cli",
    "load_policy": "experiments.engine.policy_file",
    "read_points": "experiments.report.points",
    "difference": "experiments.report.points",
    "EnvCard": "ppl_jax.cards",
    "EnvSpec": "ppl_jax.types",
    "Outcome": "ppl_jax.types",
    "TrainConfig": "ppl_jax.config",
    "HParams": "ppl_jax.config",
    "setting": "ppl_jax.fields",
    "settings": "ppl_jax.algorithms.registry",
    "Algorithm": "ppl_jax.algorithms.base",
    "register_method": "ppl_jax.algorithms.registry",
    "registered_methods": "ppl_jax.algorithms.registry",
    "register_gate": "ppl_jax.gates",
    "register_predictor": "ppl_jax.predictors",
    "register_study": "experiments.studies.grid",
    "make_train": "ppl_jax.training",
    "make_live": "ppl_jax.live",
    "make_evaluate": "ppl_jax.evaluation",
    "predict": "ppl_jax.predictors",
    "preference_pairs": "ppl_jax.preference",
    "pair_likelihoods": "ppl_jax.losses",
    "preference_loss": "ppl_jax.losses",
    "bc_loss": "ppl_jax.losses",
}
_RENAMED = {"register_method": "register", "registered_methods": "registered"}

if TYPE_CHECKING:
    from ppl_jax.algorithms.base import Algorithm
    from ppl_jax.algorithms.registry import register as register_method
    from ppl_jax.algorithms.registry import registered as registered_methods
    from ppl_jax.algorithms.registry import settings
    from ppl_jax.cards import EnvCard
    from ppl_jax.config import HParams, TrainConfig
    from ppl_jax.evaluation import make_evaluate
    from ppl_jax.fields import setting
    from ppl_jax.gates import register_gate
    from ppl_jax.live import make_live
    from ppl_jax.losses import bc_loss, pair_likelihoods, preference_loss
    from ppl_jax.predictors import predict, register_predictor
    from ppl_jax.preference import preference_pairs
    from ppl_jax.training import make_train
    from ppl_jax.types import EnvSpec, Outcome

    make: Any
    register: Any
    registered: Any
    Environment: Any
    train: Any
    main: Any
    load_policy: Any
    read_points: Any
    difference: Any
    register_study: Any

__all__ = [
    "Algorithm",
    "EnvCard",
    "EnvSpec",
    "Environment",
    "HParams",
    "Outcome",
    "TrainConfig",
    "__version__",
    "bc_loss",
    "difference",
    "load_policy",
    "main",
    "make",
    "make_evaluate",
    "make_live",
    "make_train",
    "pair_likelihoods",
    "predict",
    "preference_loss",
    "preference_pairs",
    "read_points",
    "register",
    "register_gate",
    "register_method",
    "register_predictor",
    "register_study",
    "registered",
    "registered_methods",
    "setting",
    "settings",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _NAMES:
        raise AttributeError(f"module 'ppl_jax' has no attribute {name!r}")
    from ppl_jax.packages import own_packages

    own_packages()
    module = importlib.import_module(_NAMES[name])
    algorithms = _NAMES[name] == "ppl_jax.algorithms.registry"
    if algorithms:
        importlib.import_module("ppl_jax.algorithms")  # registers those that ship
    value = getattr(module, _RENAMED.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
