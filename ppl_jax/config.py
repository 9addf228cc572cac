"""Settings: `HParams` are traced (changing one compiles nothing), `TrainConfig` is static.

Both hold what every run has. A method, a gate and a predictor own the rest: `config.method`,
`hparams.method`, `hparams.gate` and `hparams.predictor` are settings classes of theirs, a user's
too. Names are unique among them, so that a run's settings are one flat list of names outside:
`values`, `replace` and `catalogue` read and change them by name.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from ppl_jax.cards import card
from ppl_jax.checks import check_number, did_you_mean
from ppl_jax.distributions import LAPLACE_CORE, LAPLACE_SCALE
from ppl_jax.fields import About, about, setting


@dataclasses.dataclass(frozen=True)
class NoConfig:
    """Static settings of a method that has none of its own."""


@flax.struct.dataclass
class NoHParams:
    """Traced settings of a method, gate or predictor that has none of its own."""


@flax.struct.dataclass
class HParams:
    """Traced settings: leaves of one pytree, so any of them may carry a batch axis.

    Attributes:
        learning_rate, expert_noise, prediction_noise, recency, give_up_after, laplace_scale,
            laplace_core: See the fields' own text.
        method, gate, predictor: Traced settings that these own.
        world: The ranges that worlds are drawn within; `NoHParams` where they are not randomised.
    """

    learning_rate: jax.Array | float = setting(
        3e-4, "Adam's learning rate.", low=0, group="run", common=True
    )
    expert_noise: jax.Array | float = setting(
        0.0,
        "Standard deviation of Gaussian noise on the expert's actions.",
        low=0,
        group="expert",
        common=True,
    )
    prediction_noise: jax.Array | float = setting(
        0.0,
        "epsilon: predicted observations s get noise e with |e| = epsilon |s|; see noise_at.",
        low=0,
        group="predictor",
        common=True,
    )
    recency: jax.Array | float = setting(
        0.0,
        "How much more often recent expert steps (and their pairs) are learned from: the k-th "
        "oldest of n with a chance that grows as (k / n)^recency. GAIL and haco_port have none.",
        low=0,
        group="run",
        common=True,
    )
    give_up_after: jax.Array | float = setting(
        0,
        "Steps with cost in a row under the expert's control after which a training episode is "
        "given up; 0 never.",
        low=0,
        group="gate",
    )
    laplace_scale: jax.Array | float = setting(
        LAPLACE_SCALE, "b of the likelihood laplace: how fast it falls.", low=1e-3
    )
    laplace_core: jax.Array | float = setting(
        LAPLACE_CORE,
        "w of the likelihood laplace: the distance within which it is round.",
        low=1e-3,
    )
    method: Any = dataclasses.field(default_factory=NoHParams)
    gate: Any = dataclasses.field(default_factory=NoHParams)
    predictor: Any = dataclasses.field(default_factory=NoHParams)
    world: Any = dataclasses.field(default_factory=NoHParams)


_ROWS = 10_000


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Static settings: they set shapes and programs.

    Attributes:
        method: Static settings that the method owns.
    """

    total_steps: int = setting(
        10_000, "Environment steps, demonstrations included.", low=1, group="run", common=True
    )
    demonstrations: int = setting(
        0,
        "Steps at the start that the expert makes by itself, without updates.",
        low=0,
        group="run",
        common=True,
    )
    offline_updates: int = setting(
        0,
        "Updates on the demonstrations before the novice makes its first step.",
        low=0,
        group="run",
    )
    batch_size: int = setting(128, "Samples per loss and update.", low=1, group="run", common=True)
    hidden: tuple[int, ...] = setting(
        (256, 256), "Widths of the hidden layers.", low=1, group="run", common=True
    )
    human_capacity: int = setting(
        50_000,
        "Rows of the buffer of expert steps; the oldest go first.",
        low=1,
        group="run",
    )
    random_steps: int = setting(
        0,
        "Steps at the start in which the novice proposes uniform random actions.",
        low=0,
        group="run",
    )
    physics: str = setting(
        "auto",
        "Physics engine of the environment: auto, analytic, mjx or mujoco_c; `ppl list` says "
        "which of them.",
        group="run",
        common=True,
    )
    randomise: bool = setting(
        False,
        "Draw each scenario's dynamics within the environment's ranges, which are settings then.",
        group="world",
        common=True,
    )
    prediction_horizon: int = setting(
        10, "H: steps of the lookahead that the expert sees.", low=1, group="predictor", common=True
    )
    predictor: str = setting(
        "simulator",
        "Transition that predictions use; `ppl list` names them.",
        group="predictor",
        common=True,
    )
    noise_at: Literal["pairs", "gate", "both"] = setting(
        "pairs",
        "What prediction_noise disturbs: the states of the preference pairs (the paper's study), "
        "the steps of the gate's lookahead, or both.",
        choices=("pairs", "gate", "both"),
        group="predictor",
    )
    gate: str = setting(
        "unsafe_or_slow",
        "Rule by which the expert takes over; `ppl list` names them.",
        group="gate",
        common=True,
    )
    decision_interval: int = setting(
        10,
        "K: steps that a decision holds; the gate runs at multiples of K.",
        low=1,
        group="gate",
    )
    gate_rollout: Literal["constant", "closed_loop"] = setting(
        "constant",
        "The lookahead holds the proposed action, or asks the policy at every predicted state.",
        choices=("constant", "closed_loop"),
        group="gate",
    )
    likelihood: Literal["gaussian", "laplace"] = setting(
        "laplace",
        "Density behind log pi in the losses, of a deterministic policy.",
        choices=("gaussian", "laplace"),
        common=True,
    )
    bc_reduction: Literal["sum", "mean"] = setting(
        "sum",
        "Cloning error summed (the log-likelihood) or averaged over action dimensions.",
        choices=("sum", "mean"),
    )
    method: Any = dataclasses.field(default_factory=NoConfig)

    @property
    def human_rows(self) -> int:
        """Rows of the buffers of steps: `human_capacity`, or as many as the run can fill.

        The latter in whole tens of thousands, so that runs of most lengths are one program.
        """
        fillable = -(-self.total_steps // _ROWS) * _ROWS
        return min(self.human_capacity, fillable)


OWNED_CONFIG = ("method",)
OWNED_HPARAMS = ("method", "gate", "predictor", "world")
T = TypeVar("T")


class Setting(NamedTuple):
    """One setting of a run.

    Attributes:
        name: Unique among the settings of a run.
        kind: Its Python type.
        value: Its value in this run.
        about: Help, range, choices, group.
        traced: Whether changing it compiles nothing.
    """

    name: str
    kind: Any
    value: Any
    about: About
    traced: bool


def _parts(config: TrainConfig, hparams: HParams) -> list[tuple[Any, tuple[str, ...], bool]]:
    """Every settings object of a run, its fields that are such objects, and if it is traced."""
    return [
        (config, OWNED_CONFIG, False),
        (config.method, (), False),
        (hparams, OWNED_HPARAMS, True),
        *((getattr(hparams, owner), (), True) for owner in OWNED_HPARAMS),
    ]


def settings_fields(cls: type) -> dict[str, dataclasses.Field[Any]]:
    """The fields of a settings class by name, those that other owners fill left out."""
    owned = {TrainConfig: OWNED_CONFIG, HParams: OWNED_HPARAMS}.get(cls, ())
    return {field.name: field for field in dataclasses.fields(cls) if field.name not in owned}


def _kinds(cls: type) -> dict[str, Any]:
    """The type of each field's value; a traced field has that of its default."""
    try:
        hints = typing.get_type_hints(cls)
    except NameError:  # a class made inside a function
        hints = {}
    kinds = {}
    for name, field in settings_fields(cls).items():
        hint = hints.get(name, type(field.default))
        traced = jax.Array in typing.get_args(hint)
        kinds[name] = type(field.default) if traced else hint
    return kinds


def settings_of(part: Any, *, traced: bool) -> dict[str, Setting]:
    """The settings in one record of a settings class, by name and in its order."""
    kinds = _kinds(type(part))
    return {
        name: Setting(
            name=name,
            kind=kinds[name],
            value=getattr(part, name),
            about=about(field),
            traced=traced,
        )
        for name, field in settings_fields(type(part)).items()
    }


def catalogue(config: TrainConfig, hparams: HParams) -> dict[str, Setting]:
    """Every setting of a run by its flat name, in the order of the classes."""
    found: dict[str, Setting] = {}
    for part, _, traced in _parts(config, hparams):
        found |= settings_of(part, traced=traced)
    return found


def values(config: TrainConfig, hparams: HParams) -> dict[str, Any]:
    """Every setting's value by its flat name."""
    return {name: setting.value for name, setting in catalogue(config, hparams).items()}


def traced_values(hparams: HParams) -> dict[str, Any]:
    """The traced settings' values by their flat names."""
    config = TrainConfig()
    return {name: s.value for name, s in catalogue(config, hparams).items() if s.traced}


def replace(config: TrainConfig, hparams: HParams, **changes: Any) -> tuple[TrainConfig, HParams]:
    """The settings with some of them changed by their flat names.

    Raises:
        ValueError: If a name is no setting of this run.
    """
    known = catalogue(config, hparams)
    for name in changes:
        if name not in known:
            raise ValueError(f"unknown setting {name!r}{did_you_mean(name, known)}")

    def changed(part: T) -> T:
        mine = {k: v for k, v in changes.items() if k in settings_fields(type(part))}
        return dataclasses.replace(part, **mine) if mine else part  # pyright: ignore[reportArgumentType]

    owned = {name: changed(getattr(hparams, name)) for name in OWNED_HPARAMS}
    config = dataclasses.replace(changed(config), method=changed(config.method))
    return config, dataclasses.replace(changed(hparams), **owned)


def check_unique(*classes: type) -> None:
    """Check that settings classes share no name with each other or with what every run has.

    Raises:
        ValueError: If one is there twice.
    """
    seen: dict[str, type] = {}
    for cls in (TrainConfig, HParams, *classes):
        for name in settings_fields(cls):
            if seen.get(name, cls) is not cls:
                raise ValueError(
                    f"setting {name!r} of {cls.__name__} is one of {seen[name].__name__} already"
                )
            seen[name] = cls


def world_ranges(env: str, randomise: bool) -> Any:
    """The default of `HParams.world`: the environment's ranges where `randomise` is on.

    Raises:
        ValueError: If the environment has none.
    """
    ranges = card(env).ranges
    if not randomise:
        return NoHParams()
    if ranges is None:
        raise ValueError(f"randomise must be off for {env!r}: it has no ranges to draw worlds from")
    return ranges()


def range_names(env: str) -> tuple[str, ...]:
    """Names of the settings that only randomised runs in an environment have."""
    ranges = card(env).ranges
    return () if ranges is None else tuple(settings_fields(type(ranges())))


def check_range(env: str, name: str) -> None:
    """Refuse a range as a setting of a run that is not randomised.

    Raises:
        ValueError: One line that says how to randomise it.
    """
    if name in range_names(env):
        raise ValueError(
            f"{name} is a range of randomised worlds: add --randomise (randomise=True)"
        )


def env_params(env: Any, params: Any, hparams: HParams) -> Any:
    """An environment's parameters as a run with these settings has them.

    Args:
        env: The environment; one whose card has ranges has `with_ranges(params, ranges)`.
        params: Its parameters, such as `env.default_params`.
        hparams: Settings of the run.

    Returns:
        Parameters within the ranges `hparams.world`; the very same ones where it has none.
    """
    if isinstance(hparams.world, NoHParams):
        return params
    return env.with_ranges(params, hparams.world)


PRESETS = ("default", "paper", "reference")


def preset_values(preset: str, env: str) -> dict[str, Any]:
    """The flat settings that a preset gives a run in an environment.

    `paper`: the paper to the letter: H = 10, L = 4 (6 in nut assembly), beta = 0.1, bias 1, its
    gates. It leaves network, batch, learning rate and likelihood open; under the Laplace
    likelihood its formula holds the policy near the preferred action (`ppl_jax.distributions`).

    `default`: the same, and what was found to help: the method's own (`AlgorithmSpec.tuned`), and
    in driving a gate that also minds how near a prediction comes to the edge.

    `reference`: the released code's settings (metadriverse/PPL at 7a55c24), for driving alone.

    Args:
        preset: "default", "paper" or "reference".
        env: Name of the environment.

    Raises:
        ValueError: If there is no such preset, or it is not for the environment.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {preset!r}")
    about_env = card(env)
    if preset in about_env.missing_presets:
        others = [name for name in PRESETS if name not in about_env.missing_presets]
        raise ValueError(f"preset {preset!r} is not for {env}: choose {' or '.join(others)}")
    own = about_env.changes(preset)
    if preset == "reference":
        return {**_REFERENCE, **own}
    return own


_REFERENCE: Mapping[str, Any] = {
    "prediction_horizon": 20,
    "decision_interval": 10,
    "max_preference_horizon": 3,
    "batch_size": 1024,
    "predictor": "kinematic",
    "gate": "low_return",
    "gate_rollout": "closed_loop",
    "pair_states": "shifted",
    "likelihood": "gaussian",
    "bc_reduction": "mean",
    "random_steps": 10,
    "preference_horizon": 3,
    "preference_bias": 0.5,
    "learning_rate": 1e-4,
}


def validate(config: TrainConfig, hparams: HParams) -> None:
    """Check settings before anything compiles.

    Args:
        config: Static settings.
        hparams: Concrete (not traced) hyper-parameters, scalars or arrays.

    Raises:
        ValueError: One line naming field, value and what is allowed.
    """
    for one in catalogue(config, hparams).values():
        check_value(one.name, one.value, one.about)
    for field in ("total_steps", "demonstrations", "offline_updates"):
        value = getattr(config, field)
        if value % config.decision_interval:
            raise ValueError(
                f"{field} must be a multiple of decision_interval ({config.decision_interval}), "
                f"got {value}"
            )
    if config.demonstrations > config.total_steps:
        raise ValueError(
            f"demonstrations must not exceed total_steps ({config.total_steps}), got "
            f"{config.demonstrations}"
        )
    if config.offline_updates and not config.demonstrations:
        raise ValueError(
            f"offline_updates needs demonstrations to learn from, got {config.offline_updates} "
            "without any"
        )
    if not config.hidden:
        raise ValueError(f"hidden must name at least one width of 1 or more, got {config.hidden}")
    check = getattr(config.method, "check", None)
    if check is not None:
        check(config, hparams)


def check_value(name: str, value: Any, about: About) -> None:
    """Check one setting against what its field allows.

    Args:
        name: Name of the setting.
        value: A name, a switch, or numbers.
        about: Range and choices.

    Raises:
        ValueError: One line naming field, value and what is allowed.
    """
    if isinstance(value, str):
        if about.choices is not None and value not in about.choices:
            raise ValueError(
                f"{name} must be one of {', '.join(about.choices)}, got {value!r}"
                + did_you_mean(value, about.choices)
            )
        return
    if isinstance(value, bool) or value is None:
        return
    numbers = np.asarray(value, np.float64)
    shown = numbers.tolist() if numbers.ndim else value
    if name == "hidden":
        shown = value
    low, high = about.low, about.high
    if low is not None and high is not None and not ((numbers >= low) & (numbers <= high)).all():
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {shown}")
    if low is not None and not (numbers >= low).all():
        allowed = "not be negative" if low == 0 else f"be at least {low:g}"
        raise ValueError(f"{name} must {allowed}, got {shown}")
    if high is not None and not (numbers <= high).all():
        raise ValueError(f"{name} must be at most {high:g}, got {shown}")
    check_number(name, value)


def as_arrays(hparams: HParams) -> HParams:
    """All leaves as float32 arrays, so that no value changes a program's types."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)
