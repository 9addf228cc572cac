"""`ppl figure`: pictures from result files alone.

Lines differ in marker and dash as well as in colour; every picture says what its bars are, over how
many seeds, and in which units.
"""

from __future__ import annotations

import csv
import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.engine.runtime import UserError
from experiments.report.points import Point, at_step, read_points

if TYPE_CHECKING:
    from experiments.cli import Figure

NAMES = {
    "success": "held-out success",
    "progress": "held-out share of the task done",
    "episodic_return": "held-out return per episode",
    "episodic_cost": "held-out cost per episode",
}
SETTINGS = {
    "preference_horizon": "preference horizon L (steps)",
    "prediction_horizon": "prediction horizon H (steps)",
    "beta": "temperature beta",
    "prediction_noise": "prediction noise epsilon (share of |s|)",
    "expert_noise": "noise on the expert's action (std)",
    "learning_rate": "learning rate",
    "bc_weight": "weight of the cloning loss",
}
MARKERS, DASHES = "osD^vP*Xph", ["-", "--", "-.", ":"]
_OFFLINE = ("bc", "gail")  # learn from demonstrations alone: their steps are not the others'


def figure(command: Figure) -> None:
    """Draw what was asked for.

    Raises:
        UserError: If the results do not have it.
    """
    if command.kind == "steering":
        from experiments.report.steering import steering

        steering([command.results, *command.other], command.scenario, command.out)
        return
    if command.kind == "horizon":
        what_horizons_cost(command.results, command.other, command.out)
        return
    if command.other:
        raise UserError("more than one path is for --kind steering and horizon alone")
    cards = command.results.is_dir() and bool(list(command.results.glob("*.npz")))
    if command.kind == "experts" or (command.kind is None and cards):
        expert_curves(command.results, command.out)
        return
    points = read_points(command.results)
    several = _varied(points)
    kind = command.kind or {0: "curves", 1: "axis", 2: "heatmap"}.get(len(several), "curves")
    if kind == "curves":
        curves(points, command.out, command.column)
    elif kind == "training":
        training(points, command.out)
    elif len(several) != (need := {"axis": 1, "heatmap": 2}[kind]):
        what = ", ".join(several) or "none"
        raise UserError(f"kind {kind} needs results over {need} settings, these have {what}")
    elif kind == "axis":
        over_axis(points, several[0], command.out, command.column, command.steps)
    else:
        heatmap(points, several, command.out, command.column)


def _varied(points: Sequence[Point]) -> list[str]:
    """Settings that differ between points of one method, and mean something for all of them."""
    names = list(dict.fromkeys(name for point in points for name in point.values))
    return [name for name in names if all(name in point.values for point in points)]


def _canvas(rows: int, columns: int, size: tuple[float, float]) -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")


def _finish(picture: Any, caption: str, out: Path) -> None:
    """Put the caption under the picture and write it."""
    from matplotlib import pyplot

    wide = int(picture.get_figwidth() * 15)
    picture.supxlabel("\n".join(textwrap.wrap(caption, wide)), fontsize=8, x=0.02, ha="left")
    picture.savefig(out, dpi=130)
    pyplot.close(picture)


def _plain(axes: Any) -> None:
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _seeds(points: Sequence[Point]) -> str:
    counts = sorted({len(point.seeds) for point in points})
    return f"n = {' to '.join(str(n) for n in dict.fromkeys((counts[0], counts[-1])))} seeds"


def _style(i: int) -> dict[str, Any]:
    return {
        "color": f"C{i % 10}",
        "marker": MARKERS[i % len(MARKERS)],
        "linestyle": DASHES[i % len(DASHES)],
        "markersize": 5,
        "markerfacecolor": "white" if i % 2 else f"C{i % 10}",
    }


def _lines(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Points of the same runs, by label, each in the order of its steps."""
    several = len({point.env for point in points}) > 1
    found: dict[str, list[Point]] = {}
    for point in points:
        name = f"{point.env} {point.label}" if several else point.label
        found.setdefault(name, []).append(point)
    return {name: sorted(mine, key=lambda point: point.step) for name, mine in found.items()}


def curves(points: Sequence[Point], out: Path, column: str) -> None:
    """A column against steps and against human data, one line per method and setting."""
    picture, ((by_step, by_human),) = _canvas(1, 2, (11, 4.6))
    for i, (name, mine) in enumerate(_lines(points).items()):
        found = [point.interval(column) for point in mine]
        mean, low, high = (np.array(part) for part in zip(*found, strict=True))
        human = [point.measured["human_data_usage"].mean() for point in mine]
        style = _style(i)
        if mine[0].algorithm in _OFFLINE:  # another axis altogether: its end alone
            bar = [[mean[-1] - low[-1]], [high[-1] - mean[-1]]]
            by_human.errorbar(human[-1], mean[-1], bar, **style, label=name)
            continue
        steps = [point.step for point in mine]
        by_step.plot(steps, mean, **style, label=name)
        by_step.fill_between(steps, low, high, color=style["color"], alpha=0.12, linewidth=0)
        by_human.plot(human, mean, **style, label=name)
    by_step.set(xlabel="environment steps", ylabel=NAMES[column])
    by_human.set(xlabel="steps under the expert's control", xscale="log")
    for axes in (by_step, by_human):
        _plain(axes)
        if column in ("success", "progress"):
            axes.set_ylim(0, 1.02)
    by_human.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    _finish(picture, f"Means with 95% bootstrap intervals, {_seeds(points)}.", out)


def over_axis(
    points: Sequence[Point], name: str, out: Path, column: str, steps: Sequence[int]
) -> None:
    """A column over the values of one setting, one line per method and step."""
    envs = list(dict.fromkeys(point.env for point in points))
    picture, (row,) = _canvas(1, len(envs), (1.5 + 4.6 * len(envs), 4.6))
    for axes, env in zip(row, envs, strict=True):
        mine = [point for point in points if point.env == env]
        wanted = steps or sorted({point.step for point in at_step(mine, None)})
        values = list(dict.fromkeys(point.values[name] for point in mine))
        i = 0
        for algorithm in dict.fromkeys(point.algorithm for point in mine):
            for step in wanted:
                here = {
                    point.values[name]: point.interval(column)
                    for point in at_step(mine, step)
                    if point.algorithm == algorithm
                }
                at = [x for x, value in enumerate(values) if value in here]
                mean, low, high = (
                    np.array(part) for part in zip(*(here[values[x]] for x in at), strict=True)
                )
                shifted = np.array(at) + 0.06 * i
                label = f"{algorithm}, {step:,} steps"
                bars = [mean - low, high - mean]
                axes.errorbar(shifted, mean, bars, capsize=3, label=label, **_style(i))
                i += 1
        axes.set_xticks(range(len(values)), values)
        axes.set(xlabel=SETTINGS.get(name, name), ylabel=NAMES[column], title=env)
        if column in ("success", "progress"):
            axes.set_ylim(0, 1.02)
        _plain(axes)
        axes.legend(frameon=False, fontsize=8, loc="best")
    _finish(picture, f"Means with 95% bootstrap intervals over seeds, {_seeds(points)}.", out)


def heatmap(points: Sequence[Point], names: Sequence[str], out: Path, column: str) -> None:
    """A column over the values of two settings, one panel per world and method; figures inside."""
    points = at_step(points, None)
    panels = list(dict.fromkeys((point.env, point.algorithm) for point in points))
    picture, (row,) = _canvas(1, len(panels), (1.2 + 4.4 * len(panels), 4.4))
    every = [point.measured[column].mean() for point in points]
    for axes, (env, algorithm) in zip(row, panels, strict=True):
        mine = [point for point in points if (point.env, point.algorithm) == (env, algorithm)]
        across, down = (list(dict.fromkeys(p.values[name] for p in mine)) for name in names)
        grid = np.full((len(down), len(across)), np.nan)
        for point in mine:
            x, y = across.index(point.values[names[0]]), down.index(point.values[names[1]])
            interval = point.interval(column)
            grid[y, x] = interval.mean
            bright = (interval.mean - min(every)) / max(max(every) - min(every), 1e-9)
            text = f"{interval.mean:.2f}\n[{interval.low:.2f}, {interval.high:.2f}]"
            colour = "black" if bright > 0.5 else "white"
            axes.text(x, y, text, ha="center", va="center", fontsize=8, color=colour)
        drawn = axes.imshow(grid, cmap="cividis", vmin=min(every), vmax=max(every), aspect="auto")
        axes.set_xticks(range(len(across)), across)
        axes.set_yticks(range(len(down)), down)
        axes.set(xlabel=SETTINGS.get(names[0], names[0]), ylabel=SETTINGS.get(names[1], names[1]))
        axes.set_title(" ".join(part for part in (env, algorithm) if part))
    picture.colorbar(drawn, ax=row, label=NAMES[column])
    steps = sorted({point.step for point in points})
    caption = f"Means over {_seeds(points)} with 95% bootstrap intervals, after "
    _finish(picture, caption + " or ".join(f"{step:,}" for step in steps) + " steps.", out)


def training(points: Sequence[Point], out: Path) -> None:
    """Share of steps under the expert and cost per 1,000 steps, between evaluations."""
    if any("training_cost" not in point.measured for point in points):
        raise UserError("kind training needs results of ppl sweep, which count cost in training")
    picture, ((rate, cost),) = _canvas(1, 2, (11, 4.6))
    for i, (name, mine) in enumerate(_lines(points).items()):
        steps = np.array([0] + [point.step for point in mine])
        middle, length = (steps[1:] + steps[:-1]) / 2, np.diff(steps)
        for axes, column, unit in (
            (rate, "human_data_usage", 1.0),
            (cost, "training_cost", 1000.0),
        ):
            totals = np.stack([point.measured[column] for point in mine])
            spent = np.diff(totals, axis=0, prepend=0) / length[:, None] * unit
            found = [
                Point("", "", {}, 0, mine[0].seeds, {column: row}).interval(column) for row in spent
            ]
            mean, low, high = (np.array(part) for part in zip(*found, strict=True))
            axes.plot(middle, mean, **_style(i), label=name)
            axes.fill_between(middle, low, high, color=f"C{i % 10}", alpha=0.12, linewidth=0)
    rate.set(xlabel="environment steps", ylabel="share of steps under the expert's control")
    cost.set(xlabel="environment steps", ylabel="cost per 1,000 training steps")
    for axes in (rate, cost):
        axes.set_ylim(bottom=0)
        _plain(axes)
    cost.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    caption = "Between evaluations; means with 95% bootstrap intervals over seeds, "
    _finish(picture, f"{caption}{_seeds(points)}.", out)


def what_horizons_cost(measured: Path, results: Sequence[Path], out: Path) -> None:
    """What a longer preference horizon L buys and costs, and the success that it led to.

    Args:
        measured: A file of `ppl horizon`.
        results: Results over L of the same world, or none.
        out: Picture to write.

    Raises:
        UserError: If the files are others.
    """
    try:
        with open(measured, newline="") as file:
            rows = [{k: _number(v) for k, v in row.items()} for row in csv.DictReader(file)]
    except OSError as error:
        raise UserError(str(error)) from error
    if not rows or "predicted_step" not in rows[0]:
        raise UserError(f"{str(measured)!r} is no file of `ppl horizon`")
    stops = sorted({row["step"] for row in rows})
    at = sorted({row["predicted_step"] for row in rows})
    seeds = len({row["seed"] for row in rows})
    picture, (panels,) = _canvas(1, 3 + bool(results), (4.2 * (3 + bool(results)), 4.4))

    def mean(column: str, stop: float) -> np.ndarray:
        return np.array(
            [
                np.mean([r[column] for r in rows if (r["predicted_step"], r["step"]) == (i, stop)])
                for i in at
            ]
        )

    for i, stop in enumerate(stops):
        style = _style(i) | {"label": f"after {stop:,.0f} steps"}
        panels[0].plot(at, mean("drift", stop), **style)
        panels[1].plot(at, mean("coverage", stop), **style)
    gap, error = (np.mean([mean(c, stop) for stop in stops], 0) for c in ("gap", "error"))
    panels[2].plot(at, gap, **_style(0), label="gap(L)")
    panels[2].plot(at, error, **_style(1), label="error(L)")
    best = at[int(np.argmin(np.maximum(gap, error)))]
    panels[2].axvline(best, color="black", linewidth=0.8, linestyle=":")
    panels[2].set(xlabel="preference horizon L (steps)", title=f"balanced at L = {best:.0f}")
    panels[0].set(xlabel="predicted step i", title="how far the expert's action drifts")
    panels[0].set_ylabel("|h(s_i) - a_h|, units of the action")
    panels[1].set(xlabel="preference horizon L (steps)", title="states visited, states preferred")
    panels[1].set_ylabel("mean distance to the nearest, scaled observation")
    panels[2].set_ylabel("share of its worst")
    for column, _ in enumerate(results):
        points = read_points(results[column])
        for i, step in enumerate(sorted({point.step for point in points})):
            here = [p for p in points if p.step == step and _is_number(p, "preference_horizon")]
            if not here:
                continue
            x = [float(p.values["preference_horizon"]) for p in here]
            found = [p.interval("success") for p in here]
            middle, low, high = (np.array(part) for part in zip(*found, strict=True))
            bars = [middle - low, high - middle]
            label = f"{here[0].algorithm}, {step:,} steps"
            panels[3].errorbar(x, middle, bars, capsize=3, label=label, **_style(i))
        panels[3].set(xlabel="preference horizon L (steps)", title="what it led to")
        panels[3].set_ylabel(NAMES["success"])
        panels[3].set_ylim(0, 1.02)
    for axes in panels:
        _plain(axes)
        axes.legend(frameon=False, fontsize=8)
        axes.set_xticks(at)
        if axes is not panels[-1] or not results:
            axes.set_ylim(bottom=0)
    caption = (
        f"Where the novice alone would be taken over; means over n = {seeds} seeds. gap(L) = 1 - "
        "reach_L / reach_M; error(L) = drift_L / |a_h - a_n|. Success: 95% bootstrap intervals."
    )
    _finish(picture, caption, out)


def _number(value: str) -> float:
    try:
        return float(value)
    except ValueError:
        return float("nan")


def _is_number(point: Point, name: str) -> bool:
    return not np.isnan(_number(point.values.get(name, "")))


def expert_curves(folder: Path, out: Path) -> None:
    """Success, cost and multiplier over the training of each expert in a folder.

    Args:
        folder: With a NAME.csv and a NAME.json for each, as `ppl expert card` writes them.
        out: Picture to write.

    Raises:
        UserError: If there is none.
    """
    paths = sorted(path for path in folder.glob("*.csv") if path.with_suffix(".json").is_file())
    if not paths:
        raise UserError(f"{str(folder)!r} holds no cards of `ppl expert card`")
    picture, rows = _canvas(len(paths), 3, (11, 2.6 * len(paths) + 0.4))
    for (success, cost, multiplier), path in zip(rows, paths, strict=True):
        limit = json.loads(path.with_suffix(".json").read_text())["hparams"]["cost_limit"]
        with open(path, newline="") as file:
            table = [
                {k: float(v) if v else np.nan for k, v in row.items()}
                for row in csv.DictReader(file)
            ]
        steps = np.array([row["step"] for row in table]) / 1e6

        def line(axes: Any, column: str, label: str, style: str, steps=steps, table=table) -> None:
            axes.plot(steps, [row[column] for row in table], style, label=label)

        line(success, "held_out_success_rate", "held out, without noise", "-")
        line(success, "train_success_rate", "in training, with noise", ":")
        success.set_ylim(0, 1.03)
        success.set_ylabel(f"{path.stem}\nsuccess")
        line(cost, "held_out_episodic_cost", "held out", "-")
        line(cost, "train_episodic_cost", "in training", ":")
        cost.axhline(limit, color="black", linewidth=0.8, linestyle="--", label="limit")
        if max(row["held_out_episodic_cost"] for row in table) > 10:
            cost.set_yscale("symlog", linthresh=1)
        cost.set_ylim(bottom=0)
        cost.set_ylabel("cost per episode")
        line(multiplier, "train_multiplier", "multiplier", "-")
        multiplier.set_ylabel("multiplier")
        multiplier.set_ylim(bottom=0)
        for axes in (success, cost, multiplier):
            _plain(axes)
    for axes in rows[-1]:
        axes.set_xlabel("environment steps, millions")
    rows[0][0].legend(frameon=False)
    rows[0][1].legend(frameon=False)
    _finish(picture, "One seed each; held out: 50 scenarios, each once.", out)
