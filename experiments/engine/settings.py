"""Everything that defines a run, as config.json holds it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envs.registry import check_physics, known, unknown
from experiments.engine.config_file import KINDS, checked_content, config_path, read_config
from experiments.engine.fields import of_kind, read_fields, shown
from experiments.engine.run_folder import CONFIG
from experiments.engine.runtime import UserError
from ppl_jax import algorithms
from ppl_jax.cards import card
from ppl_jax.config import (
    HParams,
    Setting,
    TrainConfig,
    catalogue,
    did_you_mean,
    replace,
    validate,
    values,
    world_ranges,
)
from ppl_jax.gates import gate
from ppl_jax.losses import NEEDS_REFERENCE
from ppl_jax.predictors import predictor

# of config.json; 1 had separate "config" and "hparams" under older names, 2 smaller buffers, 3 no
# pairs at s_t where `pair_states` is "predicted", 4 no decision at the start of an episode
SCHEMA = 5
MAX_SEED = 2**32 - 1

RENAMED = {
    "max_doubt": "max_ensemble_variance",
    "target_rate": "polyak_tau",
}
RENAMED_VALUES = {
    "gate": {"departs": "deviates_from_expert", "unlikely": "action_probability"},
}
# settings that older files lack, and the value that those runs had
ADDED = {
    "physics": "auto",
    "randomise": False,
    "noise_at": "pairs",
    "policy": "deterministic",
    "laplace_scale": 0.1,
    "laplace_core": 0.1,
    "give_up_after": 0.0,
    "recency": 0.0,
    "min_clearance": 0.0,
    "min_gain": 100.0,
}


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """Everything that defines a run; config.json holds it.

    Attributes:
        env, algorithm, seed: What is trained.
        config, hparams: Static and traced settings.
        expert: "scripted", "neural" (the shipped one), a policy file, "person" (see
            `experiments.ui`) or "recorded PATH" of such a session or of demonstrations.
        reference_policy: Policy file of the objectives that have a reference.
        scenarios, held_out_scenarios: Folders of recorded scenarios, or None for generated ones.
        evaluate_on: "held_out", or (to choose settings by) "training", or a set that the
            environment's card names.
        evaluate_every: Steps between evaluations (and checkpoints), after any demonstrations.
    """

    env: str
    algorithm: str
    seed: int
    config: TrainConfig
    hparams: HParams
    expert: str = "scripted"
    reference_policy: str | None = None
    scenarios: str | None = None
    held_out_scenarios: str | None = None
    evaluate_every: int = 1000
    evaluate_on: str = "held_out"

    @property
    def where(self) -> str:
        """Its environment for messages, with the physics where one was asked for."""
        physics = self.config.physics
        return self.env if physics == "auto" else f"{self.env} on {physics}"

    def as_json(self) -> dict[str, Any]:
        """For config.json."""
        content = {name: getattr(self, name) for name in _PLAIN}
        return {"schema": SCHEMA} | content | {"settings": flat(self.config, self.hparams)}

    @staticmethod
    def from_json(content: Mapping[str, Any], where: str = CONFIG) -> RunSettings:
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
        content = as_it_was(content)
        given = read_fields(content, _KINDS, where, needed=(*_NEEDED, *parts))
        try:
            found = _of_schema_1(content) if schema == 1 else dict(content["settings"])
            config, hparams = with_values(given["env"], given["algorithm"], found)
        except ValueError as error:
            raise UserError(f"{where}: {error}") from error
        given.setdefault("evaluate_every", default_interval(config))
        return RunSettings(**given, config=config, hparams=hparams)


_PLAIN = tuple(
    field.name
    for field in dataclasses.fields(RunSettings)
    if field.name not in ("config", "hparams")
)
_KINDS = {name: KINDS[name] for name in _PLAIN}
_NEEDED = ("env", "algorithm", "seed")
# beside the settings: what a run is that says nothing of them
_UNSAID = {
    field.name: field.default
    for field in dataclasses.fields(RunSettings)
    if field.default is not dataclasses.MISSING and field.name != "evaluate_every"
}


def read_run_settings(path: Path) -> RunSettings:
    """The settings of the run in a folder (see `RunSettings.from_json`)."""
    return RunSettings.from_json(read_config(path), config_path(path))


def program_key(settings: RunSettings) -> tuple[str, ...]:
    """Equal for runs that share their programs."""
    config = dataclasses.replace(
        settings.config, total_steps=settings.config.human_rows, offline_updates=0
    )
    static = dataclasses.replace(
        settings, seed=0, hparams=HParams(), config=config, evaluate_every=0
    )
    owners = settings.hparams.gate, settings.hparams.predictor
    parts = [getattr(static, field.name) for field in dataclasses.fields(static)]
    return tuple(str(part) for part in (*parts, *map(type, owners)))


def as_it_was(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """A config.json of an older version with what its run does, in today's words.

    Before schema 3 no buffer was longer than the run. Before schema 4 there were no pairs at s_t.
    Before schema 5 the Laplace likelihood was narrower.
    """
    schema, held = schema_of(content), "settings" if "settings" in content else "config"
    settings = dict(content.get(held, {}))
    rows, steps = (settings.get(name) for name in ("human_capacity", "total_steps"))
    if schema < 3 and isinstance(rows, int) and isinstance(steps, int):
        settings["human_capacity"] = min(rows, steps)
    if schema < 4 and settings.get("pair_states") == "predicted":
        settings["pair_states"] = "future"
    if schema < 5 and "likelihood" in settings:
        settings = {name: ADDED[name] for name in ("laplace_scale", "laplace_core")} | settings
    return {**content, held: settings} if held in content else content


def schema_of(content: Mapping[str, Any], where: str = CONFIG) -> int:
    """The schema version of a config.json; the first wrote none.

    Raises:
        UserError: If it is a later one than this version knows.
    """
    schema = content.get("schema", 1)
    if schema > SCHEMA:
        raise UserError(
            f"{where} has schema {schema}; this version reads up to {SCHEMA}: it was "
            "written by a newer ppl-jax"
        )
    if schema < 1:
        raise UserError(f"{where}: schema must be 1 to {SCHEMA}, got {schema}")
    return schema


def flat(config: TrainConfig, hparams: HParams) -> dict[str, Any]:
    """Every setting by its flat name, as JSON has it: traced ones are floats."""
    found = {}
    for name, one in catalogue(config, hparams).items():
        value = float(np.asarray(one.value)) if one.traced else one.value
        found[name] = list(value) if isinstance(value, tuple) else value
    return found


def traced_values(settings: RunSettings) -> dict[str, float]:
    """The traced settings of a run by name."""
    mine = catalogue(settings.config, settings.hparams)
    return {name: float(np.asarray(one.value)) for name, one in mine.items() if one.traced}


def with_values(env: str, algorithm: str, given: Mapping[str, Any]) -> tuple[TrainConfig, HParams]:
    """The settings of a run in an environment from all of their values.

    Raises:
        ValueError: If one is unknown or of another kind, or the environment cannot be randomised
            as they say.
    """
    spec = algorithms.method(algorithm)
    config = TrainConfig(method=spec.config())
    given = of_their_kinds(given, catalogue(config, HParams(method=spec.hparams())))
    hparams = HParams(
        method=spec.hparams(),
        gate=gate(given.get("gate", config.gate)).hparams(),
        predictor=predictor(given.get("predictor", config.predictor)).hparams(),
        world=world_ranges(env, given.get("randomise", config.randomise)),
    )
    return replace(config, hparams, **of_their_kinds(given, catalogue(config, hparams)))


def of_their_kinds(given: Mapping[str, Any], known: Mapping[str, Setting]) -> dict[str, Any]:
    """Values read from JSON as their settings have them; those of no setting as they are.

    Raises:
        ValueError: One line naming setting, value and what is allowed.
    """
    found = dict(given)
    for name in found.keys() & known.keys():
        one = known[name]
        try:
            found[name] = of_kind(given[name], float if one.traced else one.kind)
        except ValueError as error:
            raise ValueError(f"{name} {error}") from error
    return found


def one_level(content: Mapping[str, Any]) -> dict[str, Any]:
    """A run's config.json, of any version, as one level of names."""
    content = as_it_was(content)
    of_a_method = content.get("algorithm") in algorithms.registered()
    if of_a_method and content.get("schema", 1) == 1:
        found = {**content, "settings": _of_schema_1(content)}
        content = {k: v for k, v in found.items() if k not in ("config", "hparams")}
    flat_content: dict[str, Any] = {}
    for name, value in content.items():
        nested = isinstance(value, dict) and name in ("settings", "config", "hparams")
        flat_content |= value if nested else {name: value}
    return ADDED | _UNSAID | flat_content if of_a_method else flat_content


def refuse_contradictions(out: Any, held: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Check that a run is continued with its own settings.

    Args:
        out: Its folder.
        held: Its settings, one level of names.
        asked: Those that were asked for, one level of names.

    Raises:
        UserError: One line naming each that differs.
    """
    differing = [
        f"{name} is {shown(held[name])}, asked for {shown(value)}"
        if name in held
        else f"{CONFIG} lacks {name}, asked for {shown(value)}"
        for name, value in asked.items()
        if name != "schema" and (name not in held or held[name] != value)
    ]
    if differing:
        raise UserError(f"cannot resume {str(out)!r}: its {'; its '.join(differing)}")


def _of_schema_1(content: Mapping[str, Any]) -> dict[str, Any]:
    """The settings in a config.json of the first version, under today's names.

    It held the settings of all methods and gates; those that are not this run's are left out.
    """
    old = {**content.get("config", {}), **content.get("hparams", {})}
    found = {str(RENAMED.get(name, name)): value for name, value in old.items()}
    config = TrainConfig()
    for name, renamed in RENAMED_VALUES.items():
        if isinstance(found.get(name), str):
            found[name] = renamed.get(found[name], found[name])
    of_their_kinds(found, catalogue(config, HParams()))
    spec = algorithms.method(content["algorithm"])
    hparams = HParams(
        method=spec.hparams(),
        gate=gate(found.get("gate", config.gate)).hparams(),
        predictor=predictor(found.get("predictor", config.predictor)).hparams(),
    )
    mine = values(TrainConfig(method=spec.config()), hparams)
    return {name: value for name, value in found.items() if name in mine}


def default_interval(config: TrainConfig) -> int:
    """A tenth of what follows the demonstrations, in whole decisions."""
    steps = config.total_steps - config.demonstrations
    return max(steps // 10 // config.decision_interval, 1) * config.decision_interval


def run_settings(
    env: str,
    algorithm: str = "ppl",
    seed: int = 0,
    *,
    preset: str = "default",
    expert: str = "scripted",
    reference_policy: str | None = None,
    scenarios: str | None = None,
    held_out_scenarios: str | None = None,
    evaluate_on: str = "held_out",
    evaluate_every: int | None = None,
    given: Mapping[str, Any] | None = None,
) -> RunSettings:
    """The settings of a run from what somebody asked for.

    Args:
        env, algorithm, seed, expert, reference_policy, scenarios, held_out_scenarios, evaluate_on:
            See `RunSettings`.
        preset: "default", "paper" or "reference".
        evaluate_every: Steps between evaluations; a tenth of the run where None.
        given: Settings by their flat names.

    Raises:
        UserError: One line naming field, value and what is allowed.
    """
    from experiments.engine.recorded import default_lengths, recording_of

    if not known(env):
        raise UserError(unknown(env))
    given = dict(given or {})
    try:
        config, _ = algorithms.settings(algorithm, env, preset)
        if expert == "recorded":
            raise UserError("expert recorded needs the session: --expert recorded PATH")
        if (path := recording_of(expert)) is not None:
            given = default_lengths(path, env, algorithm, config, given) | given
        if "total_steps" in given and "demonstrations" not in given:
            given["demonstrations"] = min(config.demonstrations, max(given["total_steps"], 0))
            if not given["demonstrations"]:
                given.setdefault("offline_updates", 0)
        config, hparams = algorithms.settings(algorithm, env, preset, **given)
    except ValueError as error:
        raise UserError(str(error)) from error
    return RunSettings(
        env=env,
        algorithm=algorithm,
        seed=seed,
        config=config,
        hparams=hparams,
        expert=expert,
        reference_policy=reference_policy,
        scenarios=scenarios,
        held_out_scenarios=held_out_scenarios,
        evaluate_on=evaluate_on,
        evaluate_every=default_interval(config) if evaluate_every is None else evaluate_every,
    )


def check(settings: RunSettings) -> None:
    """Refuse what cannot work, before anything is built.

    Raises:
        UserError: One line naming field, value and what is allowed.
    """
    if not known(settings.env):
        raise UserError(unknown(settings.env))
    if not 0 <= settings.seed <= MAX_SEED:
        allowed = "not be negative" if settings.seed < 0 else f"be at most {MAX_SEED}"
        raise UserError(f"seed must {allowed}, got {settings.seed}")
    interval = settings.config.decision_interval
    try:
        check_physics(settings.env, settings.config.physics)
        algorithms.method(settings.algorithm)
        validate(settings.config, settings.hparams)
    except ValueError as error:
        raise UserError(str(error)) from error
    if settings.evaluate_every < 1 or settings.evaluate_every % interval:
        raise UserError(
            f"evaluate_every must be a positive multiple of decision_interval ({interval}), got "
            f"{settings.evaluate_every}"
        )
    _check_evaluate_on(settings)
    objective = getattr(settings.config.method, "objective", None)
    needs = objective in NEEDS_REFERENCE
    if needs and settings.reference_policy is None:
        raise UserError(
            f"objective {objective!r} needs a reference policy: give "
            "--reference-policy FILE, a policy trained by --algorithm bc, for one"
        )
    if settings.reference_policy is not None and not needs:
        raise UserError(
            f"reference_policy is for ppl with objective {' or '.join(NEEDS_REFERENCE)}, got "
            f"{settings.algorithm} with {objective}"
        )


def _check_evaluate_on(settings: RunSettings) -> None:
    sets = card(settings.env).sets
    allowed = ("held_out", "training", *sets)
    if settings.evaluate_on not in allowed:
        raise UserError(
            f"evaluate_on must be one of {', '.join(allowed)} for {settings.env}, got "
            f"{settings.evaluate_on!r}{did_you_mean(settings.evaluate_on, allowed)}"
        )
    recorded = settings.scenarios is not None or settings.held_out_scenarios is not None
    if settings.evaluate_on in sets and recorded:
        raise UserError(
            f"evaluate_on {settings.evaluate_on} is a set of generated scenarios: leave scenarios "
            "and held_out_scenarios out, or evaluate on held_out"
        )
