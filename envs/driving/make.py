"""How driving is built: scenarios, generated or recorded, and the experts handed to it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from envs.driving.env import Driving, make_params
from envs.driving.expert import cautious_expert, scripted_expert
from envs.driving.maps import MapSettings, generate
from envs.driving.recorded import load_recordings
from envs.driving.scenario import Capacity

TRAINING_SCENARIOS = range(100, 150)
HELD_OUT_SCENARIOS = range(1000, 1050)
EXPERTS = {"scripted": scripted_expert, "cautious": cautious_expert}


def make_driving(
    scenarios: str | Path | None = None,
    held_out_scenarios: str | Path | None = None,
    settings: MapSettings | None = None,
    training: Sequence[int] = TRAINING_SCENARIOS,
    *,
    held_out: Sequence[int] = HELD_OUT_SCENARIOS,
) -> Driving:
    """Build the driving environment.

    Args:
        scenarios: Folder of recorded scenarios to train on; generated ones where None.
        held_out_scenarios: Folder of recorded scenarios to evaluate on; those of `scenarios`
            where None and `scenarios` is given.
        settings: Of generated maps.
        training, held_out: Numbers of the generated scenarios.

    Raises:
        ValueError: If a folder is missing or holds no recording.
    """
    settings = settings or MapSettings()
    if scenarios is not None:
        train = load_recordings(scenarios)
    else:
        train = [generate(number, settings) for number in training]
    if held_out_scenarios is not None:
        evaluate = load_recordings(held_out_scenarios)
    elif scenarios is not None:
        evaluate = train
    else:
        evaluate = [generate(number, settings) for number in held_out]
    capacity = Capacity.of([*train, *evaluate])
    return Driving(make_params(train, capacity), make_params(evaluate, capacity), EXPERTS)
