"""The ten rows of the paper's ablation table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.studies.compare import settings_of
from experiments.studies.grid import Run
from experiments.studies.runner import POLICIES, Execution, execute, policy_name
from ppl_jax.cards import card
from ppl_jax.losses import NEEDS_REFERENCE

if TYPE_CHECKING:
    from experiments.options.commands import Ablation

ROWS: dict[str, Mapping[str, Any]] = {
    "PPL": {},
    "imitation on a+": {"objective": "imitation"},
    "random a+": {"preferred": "random"},
    "random a-": {"rejected": "random"},
    "DPO": {"objective": "dpo"},
    "IPO": {"objective": "ipo"},
    "SLiC-HF": {"objective": "slic_hf"},
    "BC loss only": {"preference_weight": 0.0},
    "CPO loss only": {"bc_weight": 0.0},
    "rule-based f": {"predictor": "kinematic"},
}
LIBRARY: dict[str, Mapping[str, Any]] = {
    "IPO, library target": {"objective": "ipo", "objective_target": "library"},
    "SLiC-HF, library target": {"objective": "slic_hf", "objective_target": "library"},
}


def ablation(command: Ablation) -> None:
    """Train every row with every seed; the reference policy of DPO and IPO comes first.

    Raises:
        UserError: If a setting is wrong or a run failed (the others are run all the same).
    """
    rows = ROWS | LIBRARY
    predictors = card(command.env).predictors
    rows = {
        label: given
        for label, given in rows.items()
        if given.get("predictor", "simulator") in predictors
    }
    execution = Execution(processes=command.processes)
    reference = str(_reference(command, execution))
    runs = []
    for seed in command.seeds:
        for label, given in rows.items():
            needs = given.get("objective") in NEEDS_REFERENCE
            common: dict[str, Any] = {"reference_policy": reference} if needs else {}
            settings = settings_of(command, "ppl", seed, given, **common)
            name = f"{command.env}/{label}/seed={seed}"
            runs.append(Run(name=name, values=(), settings=settings, label=label))
    execute(runs, command.out, execution)


def _reference(command: Ablation, execution: Execution) -> Path:
    """Clone `reference_steps` expert steps, once; the policy file."""
    steps = {"demonstrations": command.reference_steps, "total_steps": command.reference_steps}
    settings = settings_of(command, "bc", 0, steps, own_length=True)
    run = Run(
        name=f"{command.env}/reference/seed=0", values=(), settings=settings, label="reference"
    )
    out = command.out.with_name(f"{command.out.name}-reference")
    execute([run], out, execution)
    return out / POLICIES / policy_name(run.name)
