"""Everything that defines a run of `ppl expert train`, as config.json holds it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from envs.registry import check_physics, known, unknown
from experiments.engine.config_file import KINDS, checked_content, config_path, read_config
from experiments.engine.fields import read_fields
from experiments.engine.run_folder import CONFIG, RunFolder
from experiments.engine.runtime import UserError
from experiments.engine.settings import MAX_SEED, SCHEMA, of_their_kinds, schema_of
from ppl_jax.cards import card
from ppl_jax.ppo.config import OLD_NAMES, PPOConfig, PPOHParams, catalogue, read, replace, validate

ALGORITHM = "ppo_lagrangian"  # in config.json
FIRST_SCENARIO = 10_000  # of those an expert trains on: neither the novice's nor held out
EVALUATIONS = 40  # over a run, unless asked for otherwise


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExpertSettings:
    """Everything that defines a run; config.json holds it.

    Attributes:
        env, seed: What is trained.
        config, hparams: Static and traced settings.
        scenarios, held_out_scenarios: Folders of recorded scenarios, or None for generated ones.
        training_scenarios: Number of generated scenarios to train on; 0 for the environment's own.
        evaluate_every: Batches between evaluations and checkpoints.
        physics: Physics engine of the environment.
    """

    env: str
    seed: int
    config: PPOConfig
    hparams: PPOHParams
    scenarios: str | None = None
    held_out_scenarios: str | None = None
    training_scenarios: int = 0
    evaluate_every: int = 1
    physics: str = "auto"

    def as_json(self) -> dict[str, Any]:
        """For config.json."""
        plain = {name: getattr(self, name) for name in PLAIN}
        settings = flat(self.config, self.hparams)
        return {"schema": SCHEMA, **plain, "algorithm": ALGORITHM, "settings": settings}

    @staticmethod
    def from_json(content: Mapping[str, Any], where: str = CONFIG) -> ExpertSettings:
        """The inverse of `as_json`, of older versions too; ignores what else config.json holds.

        What it lacks and has a default is that.

        Args:
            content: Content of config.json.
            where: The file, for messages.

        Raises:
            UserError: One line naming file and field: it is of a newer version, lacks what has no
                default, or holds what no version has or what is of another kind.
        """
        schema = schema_of(checked_content(content, where), where)
        parts = ("config", "hparams") if schema == 1 else ("settings",)
        plain = read_fields(content, _KINDS, where, needed=("env", "seed", *parts))
        given = {name: value for part in parts for name, value in content[part].items()}
        given = {str(OLD_NAMES.get(name, name)): value for name, value in given.items()}
        try:
            known = catalogue(PPOConfig(), PPOHParams())
            config, hparams = read(of_their_kinds(given, known))
        except ValueError as error:
            raise UserError(f"{where}: {error}") from error
        return ExpertSettings(**plain, config=config, hparams=hparams)


PLAIN = tuple(
    field.name
    for field in dataclasses.fields(ExpertSettings)
    if field.name not in ("config", "hparams")
)
"""The fields of `ExpertSettings` beside the settings of PPO-Lagrangian."""
_KINDS = {name: KINDS[name] for name in PLAIN}


def read_settings(folder: RunFolder) -> ExpertSettings:
    """The settings of the run in a folder.

    Raises:
        UserError: If it is no run folder of `ppl expert train`.
    """
    content = read_config(folder.path)
    if content.get("algorithm") != ALGORITHM:
        raise UserError(
            f"{str(folder.path)!r} is a run of {content.get('algorithm')}, not of "
            "`ppl expert train`"
        )
    return ExpertSettings.from_json(content, config_path(folder.path))


def flat(config: PPOConfig, hparams: PPOHParams) -> dict[str, Any]:
    """Every setting of PPO-Lagrangian by name, as JSON has it: traced ones are floats."""
    found: dict[str, Any] = {}
    for name, one in catalogue(config, hparams).items():
        value = float(np.asarray(one.value)) if one.traced else one.value
        found[name] = list(value) if isinstance(value, tuple) else value
    return found


def settings_for(env: str) -> tuple[PPOConfig, PPOHParams, int]:
    """The settings of an environment's expert, and on how many scenarios: those of its card.

    Raises:
        UserError: If the card names a setting that does not exist.
    """
    changes = card(env).expert
    try:
        config, hparams = replace(
            PPOConfig(), PPOHParams(), **{**changes.config, **changes.hparams}
        )
    except ValueError as error:
        raise UserError(f"the card of {env}: {error}") from error
    return config, hparams, changes.scenarios


def default_interval(config: PPOConfig) -> int:
    """Batches between evaluations: a fortieth of the run."""
    return max(config.batches // EVALUATIONS, 1)


def check(settings: ExpertSettings) -> None:
    """Refuse what cannot work, before anything is built.

    Raises:
        UserError: One line naming field, value and what is allowed.
    """
    if not known(settings.env):
        raise UserError(unknown(settings.env))
    for name, least in (("seed", 0), ("training_scenarios", 0), ("evaluate_every", 1)):
        value = getattr(settings, name)
        if value < least:
            raise UserError(f"{name} must be at least {least}, got {value}")
    if settings.seed > MAX_SEED:
        raise UserError(f"seed must be at most {MAX_SEED}, got {settings.seed}")
    if settings.training_scenarios and settings.scenarios is not None:
        raise UserError("training_scenarios is for generated scenarios: give it, or --scenarios")
    try:
        check_physics(settings.env, settings.physics)
        validate(settings.config, settings.hparams)
    except ValueError as error:
        raise UserError(str(error)) from error
