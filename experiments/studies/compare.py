"""`ppl compare`: all methods with the same seeds, in one table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings, check, run_settings
from experiments.studies.grid import Run, run_name
from experiments.studies.runner import COMMON, Execution, execute
from ppl_jax import algorithms
from ppl_jax.cards import card
from ppl_jax.config import values

if TYPE_CHECKING:
    from experiments.options.commands import Ablation, Compare, Tune

    Command = Ablation | Compare | Tune

_OF_EVERY_METHOD = ("batch_size", "physics")
OPTIONS = ("gate", "min_return", "max_departure", "min_log_density", *_OF_EVERY_METHOD)


def compare(command: Compare) -> None:
    """Train every method with every seed, several at a time; resumes.

    Raises:
        UserError: If a method is unknown or a run failed (the others are run all the same).
    """
    runs = []
    for name in command.algorithms or algorithms.registered(variants=False):
        try:
            changes = algorithms.method(name).changes(card(command.env))
        except ValueError as error:
            raise UserError(str(error)) from error
        # demonstrations are a method's own budget; the comparison's is that of the others
        own = "total_steps" in changes
        for seed in command.seeds:
            settings = settings_of(command, name, seed, {}, own_length=own)
            runs.append(
                Run(name=run_name(command.env, name, {}, seed), values=(), settings=settings)
            )
    execute(runs, command.out, Execution(processes=command.processes))


def settings_of(
    command: Command,
    algorithm: str,
    seed: int,
    given: Mapping[str, Any],
    *,
    own_length: bool = False,
    **common: Any,
) -> RunSettings:
    """The settings of one run of a comparison.

    Args:
        command: Its options apply where the method has such settings.
        algorithm, seed: Method and seed of the run.
        given: Settings of this run by name.
        own_length: The method keeps its own length and evaluations.
        **common: Further arguments of `run_settings`.

    Raises:
        UserError: If a setting cannot work.
    """
    asked = {name: getattr(command, name, None) for name in OPTIONS}
    asked = {name: value for name, value in asked.items() if value is not None}
    if not algorithms.method(algorithm).gated:
        asked = {name: value for name, value in asked.items() if name in _OF_EVERY_METHOD}
    gate = {"gate": asked["gate"]} if "gate" in asked else {}
    try:
        known = values(*algorithms.settings(algorithm, command.env, **gate))
    except ValueError as error:
        raise UserError(str(error)) from error
    asked = {name: value for name, value in asked.items() if name in known}
    if command.total_steps is not None and not own_length:
        asked["total_steps"] = command.total_steps
    every = None if own_length else command.evaluate_every
    common.setdefault("evaluate_every", every)
    for name in COMMON:
        value = getattr(command, name, None)
        if value is not None:
            common.setdefault(name, value)
    settings = run_settings(
        command.env,
        algorithm,
        seed,
        given={**asked, **given},
        **common,
    )
    check(settings)
    return settings
