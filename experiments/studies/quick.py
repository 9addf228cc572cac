"""`ppl_jax.train`: one run, or a grid of them, as one call that returns its results."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.runtime import UserError, need, start_jax
from experiments.engine.settings import RunSettings, check, run_settings
from ppl_jax.config import catalogue, replace

if TYPE_CHECKING:
    import pandas as pd

    from ppl_jax.experts import SavedPolicy

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
        groups = self.curve.groupby(names, sort=False) if names else [((), self.curve)]
        count = 0
        for values, rows in groups:
            by_step = rows.groupby("step")[column]
            label = ", ".join(f"{k} = {v:g}" for k, v in zip(names, values, strict=True))
            (line,) = axes.plot(by_step.mean(), label=label or None)
            axes.fill_between(
                by_step.min().index, by_step.min(), by_step.max(), color=line.get_color(), alpha=0.2
            )
            count += 1
        axes.set(xlabel="environment steps", ylabel=column.replace("_", " "))
        if column in ("success", "progress"):
            axes.set_ylim(0, 1)
        if count > 1:
            axes.legend()
        return axes


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

    All runs are one compiled program. On a CPU they run one after another, on accelerators side by
    side.

    Args:
        env: Name of the environment.
        method: Name of the method.
        seed: A seed, or several.
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
    seeds = tuple(int(one) for one in np.atleast_1d(seed))
    swept = {k: tuple(np.asarray(v).tolist()) for k, v in given.items() if _several(v)}
    one = {k: v for k, v in given.items() if k not in swept}
    common = {"preset": preset, "expert": expert, "evaluate_every": evaluate_every}
    # the largest value first: it sets what bounds the others, such as the number of pairs
    widest = run_settings(
        env, method, seeds[0], given={**one, **{k: max(v) for k, v in swept.items()}}, **common
    )
    known = catalogue(widest.config, widest.hparams)
    for name in swept:
        if not known[name].traced:
            raise UserError(
                f"{name} sets the program and cannot be a list here: call train once for each "
                f"value, or use `ppl sweep`"
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
    histories, layers, numbers = _run(widest, settings)
    return _result(settings, {**swept, "seed": seeds}, histories, layers, numbers=numbers)


def _several(value: Any) -> bool:
    """Whether a setting was given several values; widths of layers are one."""
    if isinstance(value, tuple):
        return False
    return isinstance(value, list) or getattr(value, "ndim", 0) == 1


def _run(widest: RunSettings, settings: list[RunSettings]) -> tuple[Any, Any, Any]:
    """All runs as one program: histories [R, P, ...], layers of policies [R, ...], scenarios."""
    import jax

    from experiments.engine.run import algorithm_factory, make_env_and_expert
    from ppl_jax.sweep import make_batch, make_run, stack
    from ppl_jax.training import make_train

    env, expert = make_env_and_expert(widest)
    try:
        functions = make_train(env, expert, algorithm_factory(widest, env), widest.config)
    except ValueError as error:
        raise UserError(str(error)) from error
    run = make_run(env, functions, widest.config, widest.evaluate_every, keep_policy=True)
    batch = jax.jit(make_batch(run, side_by_side=jax.default_backend() != "cpu"))
    keys = jax.vmap(jax.random.key)(np.array([one.seed for one in settings], np.uint32))
    hparams = stack([one.hparams for one in settings])
    history, layers = jax.tree.map(np.asarray, batch(keys, hparams, env.held_out_params))
    return history, (layers, env.spec), env.scenario_numbers(env.held_out_params)


def _result(
    settings: list[RunSettings],
    axes: Mapping[str, tuple[Any, ...]],
    history: Any,
    layers: Any,
    *,
    numbers: Any,
) -> Result:
    import jax
    import pandas as pd

    from experiments.engine.evaluate import rows_of
    from ppl_jax.experts import SavedPolicy
    from ppl_jax.sweep import evaluation_steps

    weights, spec = layers
    curve, episodes, policies = [], [], []
    for number, (run, chosen) in enumerate(
        zip(settings, itertools.product(*axes.values()), strict=True)
    ):
        where = {"run": number, **dict(zip(axes, chosen, strict=True))}
        mine = jax.tree.map(lambda leaf, i=number: leaf[i], history)
        rows = []
        for at, step in enumerate(evaluation_steps(run.config, run.evaluate_every)):
            played = jax.tree.map(lambda leaf, i=at: leaf[i], mine.episodes)
            rows = rows_of(played, numbers, step)
            means = {name: np.mean([getattr(row, name) for row in rows]) for name in SCORES}
            human = int(mine.counters.human_data[at])
            curve.append(
                {**where, "step": step, "human_data_usage": human}
                | means
                | {"diverged": bool(mine.diverged[at])}
            )
        episodes += [where | row._asdict() for row in rows]
        policies.append(
            SavedPolicy(
                weights=[(w[number], b[number]) for w, b in weights],
                activation="relu",
                output="tanh",
                obs_mean=spec.observation_mean,
                obs_scale=spec.observation_scale,
            )
        )
    return Result(
        settings=tuple(settings),
        axes=axes,
        curve=pd.DataFrame(curve),
        episodes=pd.DataFrame(episodes),
        policies=tuple(policies),
    )
