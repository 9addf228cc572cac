"""`ppl_jax.train`: one run, or a grid of them, as one call that returns its results."""

from __future__ import annotations

import dataclasses
import itertools
import numbers
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.runtime import UserError, need, start_jax
from experiments.engine.settings import RunSettings, check, run_settings
from ppl_jax.config import Setting, catalogue, replace

if TYPE_CHECKING:
    import pandas as pd

    from ppl_jax.experts import SavedPolicy
    from ppl_jax.types import Env

SCORES = ("success", "episodic_return", "progress", "episodic_cost", "length")


@dataclasses.dataclass(frozen=True)
class Result:
    """Results of one run, or of a grid.

    Attributes:
        settings: `RunSettings` of each run, in order: settings vary slowest, seeds fastest.
        axes: The values of each setting that was given several, by name, and of "seed".
        curve: A row per run and evaluation: the axes, "step", "human_data_usage", means over the
            held-out scenarios of "success", "episodic_return", "progress", "episodic_cost",
            "length", and "diverged".
        episodes: A row per run and held-out scenario of the last evaluation.
        policies: The trained policy of each run.
    """

    settings: tuple[RunSettings, ...]
    axes: Mapping[str, tuple[Any, ...]]
    curve: pd.DataFrame
    episodes: pd.DataFrame
    policies: tuple[SavedPolicy, ...]

    @property
    def success(self) -> Any:
        """Share of held-out scenarios that were solved at the end: [axes ...], or a float."""
        last = self.curve.groupby("run", sort=True)["success"].last().to_numpy()
        shape = tuple(len(values) for values in self.axes.values())
        return float(last[0]) if len(last) == 1 else last.reshape(shape)

    @property
    def policy(self) -> SavedPolicy:
        """The trained policy of a single run.

        Raises:
            ValueError: If there are several runs: take one of `policies`.
        """
        if len(self.policies) != 1:
            raise ValueError(f"there are {len(self.policies)} runs: take one of result.policies")
        return self.policies[0]

    def plot(self, column: str = "success") -> Any:
        """Draw learning curves, means over seeds with their range; returns matplotlib's axes."""
        pyplot = need("matplotlib.pyplot", "plot", "plot()")
        _, axes = pyplot.subplots()
        names = [name for name in self.axes if name != "seed"]
        count = 0
        for values, rows in _groups(self.curve, names):
            shown = rows.groupby("step")[column].agg(["mean", "min", "max"])
            label = ", ".join(f"{k} = {v:g}" for k, v in zip(names, values, strict=True))
            (line,) = axes.plot(shown["mean"], label=label or None)
            axes.fill_between(
                shown.index, shown["min"], shown["max"], color=line.get_color(), alpha=0.2
            )
            count += 1
        axes.set(xlabel="environment steps", ylabel=column.replace("_", " "))
        if column in ("success", "progress"):
            axes.set_ylim(0, 1)
        if count > 1:
            axes.legend()
        return axes


def _groups(
    curve: pd.DataFrame, names: list[str]
) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
    """Rows of `curve` for each combination of values of `names`, in order."""
    if not names:
        yield (), curve
        return
    for values, rows in curve.groupby(names, sort=False):
        yield values if isinstance(values, tuple) else (values,), rows


def train(
    env: str,
    method: str = "ppl",
    *,
    seed: Any = 0,
    preset: str = "default",
    expert: str = "scripted",
    evaluate_every: int | None = None,
    **given: Any,
) -> Result:
    """Train one policy, or one for every combination of seeds and settings given as lists.

    All runs share their compiled programs. On a CPU they run one after another, on accelerators
    side by side.

    Args:
        env: Name of the environment.
        method: Name of the method.
        seed: A seed, or several: a list, a range or an array.
        preset: "default", "paper" or "reference".
        expert: "scripted", "neural", a policy file or a run folder.
        evaluate_every: Environment steps between evaluations; a tenth of the run where None.
        **given: Settings by name, such as `beta=0.05` or `total_steps=2000`. A traced one may be a
            list or an array of values.

    Returns:
        Curve, episodes and policies.

    Raises:
        ValueError: One line naming setting, value and what is allowed.
    """
    try:
        return _train(
            env, method, seed, preset, expert=expert, evaluate_every=evaluate_every, given=given
        )
    except UserError as error:
        raise ValueError(str(error)) from None


def _train(
    env: str,
    method: str,
    seed: Any,
    preset: str,
    *,
    expert: str,
    evaluate_every: int | None,
    given: Mapping[str, Any],
) -> Result:
    start_jax()
    seeds = _seeds(seed)
    owners = {k: v for k, v in given.items() if k in ("gate", "predictor") and isinstance(v, str)}
    owners |= {k: v for k, v in given.items() if k == "randomise" and isinstance(v, bool)}
    plain = run_settings(env, method, preset=preset, given=owners)
    one, swept = _split(given, catalogue(plain.config, plain.hparams))
    # the largest value first: it sets what bounds the others, such as the number of pairs
    widest = run_settings(
        env,
        method,
        seeds[0],
        preset=preset,
        expert=expert,
        evaluate_every=evaluate_every,
        given={**one, **{k: max(v) for k, v in swept.items()}},
    )
    points = [
        dict(zip(swept, chosen, strict=True)) for chosen in itertools.product(*swept.values())
    ]
    settings = []
    for point in points:
        config, hparams = replace(widest.config, widest.hparams, **point)
        for number in seeds:
            run = dataclasses.replace(widest, seed=number, config=config, hparams=hparams)
            check(run)
            settings.append(run)
    built, played = _played(widest, settings)
    return _result(settings, {**swept, "seed": seeds}, built, played)


def _several(name: str, value: Any) -> list[Any] | None:
    """The values of a list, tuple, range or array; None where there is one value."""
    if isinstance(value, str) or not np.ndim(value):
        return None
    found = [one.item() if np.ndim(one) == 0 and hasattr(one, "item") else one for one in value]
    if not found or any(np.ndim(one) for one in found):
        shown = " ".join(repr(value).split())  # an array's has several lines
        raise UserError(f"{name} must be one value or a flat list of values, got {shown}")
    return found


def _seeds(seed: Any) -> tuple[int, ...]:
    several = _several("seed", seed)
    found = [seed] if several is None else several
    for one in found:
        if isinstance(one, bool) or not isinstance(one, numbers.Integral):
            raise UserError(f"seed must be a whole number or several, got {one!r}")
    return tuple(int(one) for one in found)


def _split(
    given: Mapping[str, Any], known: Mapping[str, Setting]
) -> tuple[dict[str, Any], dict[str, tuple[Any, ...]]]:
    """Settings that were given one value, and those that were given several.

    Raises:
        UserError: If a value is not of the setting's kind, or the setting takes one value alone.
    """
    one: dict[str, Any] = {}
    swept: dict[str, tuple[Any, ...]] = {}
    for name, value in given.items():
        if name not in known:  # `run_settings` refuses it
            one[name] = value
            continue
        setting, several = known[name], _several(name, value)
        if isinstance(setting.value, tuple):  # widths of layers: one value is a list already
            one[name] = value if several is None else tuple(several)
        elif several is None:
            one[name] = value.item() if np.ndim(value) == 0 and hasattr(value, "item") else value
            _check_kind(setting, one[name])
        elif not setting.traced:
            raise UserError(
                f"{name} sets the program and cannot be a list here: call train once for each "
                f"value, or use `ppl sweep`"
            )
        else:
            for each in several:
                if isinstance(each, str):
                    raise UserError(f"{name} must be numbers where it is a list, got {each!r}")
                _check_kind(setting, each)
            swept[name] = tuple(several)
    return one, swept


def _check_kind(setting: Setting, value: Any) -> None:
    """Refuse what is no number, or no whole one, where a setting is one."""
    if setting.kind not in (int, float) or (isinstance(value, str) and setting.about.choices):
        return
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise UserError(f"{setting.name} must be a number, got {value!r}")
    whole = setting.kind is int and not setting.traced
    if whole and not isinstance(value, numbers.Integral):
        raise UserError(f"{setting.name} must be a whole number, got {value!r}")


def _played(widest: RunSettings, settings: list[RunSettings]) -> tuple[Env, list[Any]]:
    """The environment, and for each run what its evaluations found and its policy's layers."""
    import jax

    from experiments.engine.plan import plan
    from experiments.engine.programs import Programs
    from experiments.engine.run import algorithm_factory, make_env_and_expert
    from ppl_jax.sweep import stack
    from ppl_jax.training import make_train

    env, expert = make_env_and_expert(widest)
    try:
        functions = make_train(env, expert, algorithm_factory(widest, env), widest.config)
    except ValueError as error:
        raise UserError(str(error)) from error
    side_by_side = jax.default_backend() != "cpu"
    interval = widest.config.decision_interval
    programs = Programs(env, functions, interval, side_by_side=side_by_side)
    chunks = plan(widest.config, widest.evaluate_every)
    keys = jax.vmap(jax.random.key)(np.array([one.seed for one in settings], np.uint32))
    if not side_by_side:
        runs = zip(keys, settings, strict=True)
        return env, [programs.play(key, one.hparams, chunks) for key, one in runs]
    looks, layers = programs.play(keys, stack([one.hparams for one in settings]), chunks)
    return env, [
        ([look.of(i) for look in looks], jax.tree.map(lambda leaf, i=i: leaf[i], layers))
        for i in range(len(settings))
    ]


def _result(
    settings: list[RunSettings], axes: Mapping[str, tuple[Any, ...]], env: Env, played: list[Any]
) -> Result:
    import pandas as pd

    from experiments.engine.evaluate import rows_of
    from experiments.engine.run import saved_policy

    numbers = env.scenario_numbers(env.held_out_params)
    curve, episodes, policies = [], [], []
    for number, (chosen, (looks, layers)) in enumerate(
        zip(itertools.product(*axes.values()), played, strict=True)
    ):
        where = {"run": number, **dict(zip(axes, chosen, strict=True))}
        rows = []
        for look in looks:
            rows = rows_of(look.episodes, numbers, look.step)
            means = {name: np.mean([getattr(row, name) for row in rows]) for name in SCORES}
            human = int(look.counters.human_data)
            curve.append(
                {**where, "step": look.step, "human_data_usage": human}
                | means
                | {"diverged": bool(look.diverged)}
            )
        episodes += [where | row._asdict() for row in rows]
        policies.append(saved_policy(env, layers))
    return Result(
        settings=tuple(settings),
        axes=axes,
        curve=pd.DataFrame(curve),
        episodes=pd.DataFrame(episodes),
        policies=tuple(policies),
    )
