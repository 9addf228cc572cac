"""`ppl list`: the names that commands take."""

from __future__ import annotations

from envs.registry import registered
from experiments.studies.grid import STUDIES
from ppl_jax import algorithms
from ppl_jax.cards import card
from ppl_jax.config import PRESETS
from ppl_jax.gates import gate, registered_gates
from ppl_jax.losses import OBJECTIVES
from ppl_jax.predictors import registered_predictors


def listing() -> str:
    """Every name by kind, a line each."""
    sections = {
        "environments": [
            f"{name:16} {card(name).summary or card(name).title}".rstrip() for name in registered()
        ]
        + ["brax:NAME        any environment of brax"],
        "methods": algorithms.registered(),
        "gates": [
            f"{name:20} {(gate(name).decide.__doc__ or '').strip().splitlines()[0]}".rstrip()
            if gate(name).decide.__doc__
            else name
            for name in registered_gates()
        ],
        "predictors": list(registered_predictors()),
        "objectives": list(OBJECTIVES),
        "studies": [f"{name:20} {study.title}" for name, study in STUDIES.items()],
        "presets": list(PRESETS),
        "experts": ["scripted", "neural", "a policy file or run folder", "recorded PATH"],
    }
    lines = []
    for title, names in sections.items():
        lines += [title, *(f"  {name}" for name in names), ""]
    return "\n".join(lines).rstrip()
