"""The ten rows of the paper's ablation table."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.tables import EPISODES, RESULTS
from experiments.studies.compare import Row, budget, check_counts, run_rows

if TYPE_CHECKING:
    from experiments.cli import Ablation

ROWS: dict[str, tuple[str, ...]] = {
    "PPL": (),
    "imitation on a+": ("--objective", "imitation"),
    "random a+": ("--preferred", "random"),
    "random a-": ("--rejected", "random"),
    "DPO": ("--objective", "dpo"),
    "IPO": ("--objective", "ipo"),
    "SLiC-HF": ("--objective", "slic_hf"),
    "BC loss only": ("--preference-weight", "0"),
    "CPO loss only": ("--bc-weight", "0"),
    "rule-based f": ("--predictor", "kinematic"),
}
LIBRARY: dict[str, tuple[str, ...]] = {
    "IPO, library target": ("--objective", "ipo", "--objective-target", "library"),
    "SLiC-HF, library target": ("--objective", "slic_hf", "--objective-target", "library"),
}


def ablation(command: Ablation) -> None:
    """Train every row with every seed; the reference policy of DPO and IPO comes first.

    Raises:
        UserError: If a setting is wrong or a run failed (the others go on).
    """
    check_counts(command)
    rows = ROWS | LIBRARY
    if command.env != "driving":
        del rows["rule-based f"]  # its predictor is a bicycle
    reference = _reference(command)
    jobs = []
    for label, words in rows.items():
        if "dpo" in words or "ipo" in words:
            words = (*words, "--reference-policy", str(reference))
        signs = label.replace("a+", "preferred").replace("a-", "rejected").replace(",", "")
        folder = signs.replace("-", "_").replace(" ", "_").lower()
        jobs.append(Row(label, folder, (*words, *budget(command))))
    run_rows(command, jobs)


def _reference(command: Ablation) -> Path:
    """Clone `reference_steps` expert steps, once; the policy file."""
    steps = str(command.reference_steps)
    words = ("--algorithm", "bc", "--demonstrations", steps, "--total-steps", steps)
    run_rows(dataclasses.replace(command, seeds=(0,)), [Row("reference", "reference", words)])
    for name in (RESULTS, EPISODES):
        (command.out / name).unlink()
    return command.out / "reference-0" / "policy.npz"
