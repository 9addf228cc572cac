"""What an environment says of itself beside its physics: an `EnvCard`, readable without building it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True)
class EnvCard:
    """Facts and budgets of an environment; the defaults serve one that says nothing.

    Attributes:
        name: As in `make(name)`.
        title: One line for lists.
        settings: Flat settings of a run that differ from the general defaults, by name.
        paper_settings: What the preset "paper" changes further.
        reference_preset: Whether the preset "reference", the released code's, is for it.
        demonstrations: Expert steps that the paper gives to methods that learn from them alone.
        warm_up: Expert steps, about two episodes, that some methods start with.
        control_rate: Control steps per second.
        drawing: How it is drawn: "road", "arm" or "" for not at all.
        step_ms: Milliseconds that a training step of PPL takes on one core, batch 256: for
            estimates.
    """

    name: str
    title: str = ""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    paper_settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    reference_preset: bool = False
    demonstrations: int = 10_000
    warm_up: int = 300
    control_rate: float = 10.0
    drawing: str = ""
    step_ms: float = 5.0
