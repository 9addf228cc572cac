"""`ppl list`: the names that commands take."""

from __future__ import annotations

from typing import Any

from envs.registry import registered
from experiments.studies.grid import STUDIES
from ppl_jax import algorithms
from ppl_jax.cards import card
from ppl_jax.config import PRESETS
from ppl_jax.gates import gate, registered_gates
from ppl_jax.losses import OBJECTIVES
from ppl_jax.predictors import predictor, registered_predictors


def _first_line(function: Any) -> str:
    """The first line of a docstring; empty where there is none."""
    return (function.__doc__ or "").strip().partition("\n")[0]


def _environment(name: str) -> str:
    """An environment with what it is, and the physics that it can run on."""
    facts = card(name)
    choices = f" Physics: {', '.join(facts.physics)}." if facts.physics else ""
    return f"{name:16} {facts.summary or facts.title}{choices}".rstrip()


def listing() -> str:
    """Every name by kind, a line each."""
    sections = {
        "environments": [_environment(name) for name in registered()]
        + ["brax:NAME        any environment of brax"],
        "methods": [
            f"{name:20} {_first_line(algorithms.method(name).make)}".rstrip()
            for name in algorithms.registered()
        ],
        "gates": [
            f"{name:20} {_first_line(gate(name).decide)}".rstrip() for name in registered_gates()
        ],
        "scenarios to evaluate on": [
            "held_out, training",
            *(
                f"{name:20} {', '.join(card(name).sets)}"
                for name in registered()
                if card(name).sets
            ),
        ],
        "predictors": [
            f"{name:20} {_first_line(predictor(name).make)}".rstrip()
            for name in registered_predictors()
        ],
        "objectives": list(OBJECTIVES),
        "studies": [f"{name:20} {study.title}" for name, study in STUDIES.items()],
        "presets": list(PRESETS),
        "experts": ["scripted", "neural", "a policy file or run folder", "recorded PATH"],
    }
    lines = []
    for title, names in sections.items():
        lines += [title, *(f"  {name}" for name in names), ""]
    return "\n".join(lines).rstrip()
