"""`ppl figure`: pictures from result files alone.

Lines differ in marker and dash as well as in colour; every picture says what its bars are, over how
many seeds, and in which units.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.engine.fields import read_fields, read_json
from experiments.engine.files import check_ending
from experiments.engine.runtime import UserError, need
from experiments.report.points import (
    NOTHING,
    SEEDS,
    Frame,
    Point,
    at_step,
    common_over,
    describe,
    known,
    number_column,
    read_csv,
    read_points,
)
from experiments.report.tables import show
from ppl_jax.statistics import Interval, mean_interval

KINDS = ("curves", "axis", "heatmap", "training", "experts", "steering", "horizon", "growth")
SHARES = ("success", "progress")
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
GROWTH = {
    "steps": "steps of the run",
    "lanes": "runs side by side in one program",
    "batch_size": "batch size",
    "human_capacity": "rows of each buffer",
    "preference_horizon": "preference horizon L, without updates",
    "prediction_horizon": "prediction horizon H, without updates",
}
MARKERS, DASHES = "osD^vP*Xph", ["-", "--", "-.", ":"]
_OFFLINE = ("bc", "gail")  # learn from demonstrations alone: their steps are not the others'


def figure(
    results: Path,
    *,
    other: Sequence[Path] = (),
    kind: str | None = None,
    column: str = "success",
    steps: Sequence[int] = (),
    scenario: int = 1000,
    out: Path = Path("figure.png"),
) -> None:
    """`ppl figure`: draw results.

    Args:
        results: Run folder, folder of several runs, a file of theirs, a folder of experts' cards,
            or (kind steering) a policy file.
        other: Kind steering: more policies; kind horizon: results over L, to show beside.
        kind: One of `KINDS` (default: what the results have).
        column: Column to draw.
        steps: Kind axis: steps to draw (default: the end of each run).
        scenario: Kind steering: number of a held-out scenario.
        out: Picture to write; its ending decides how.

    Raises:
        UserError: If the results do not have it, or matplotlib is missing.
    """
    known("column", column, list(NAMES))
    if kind is not None:
        known("kind", kind, KINDS)
    need("matplotlib", "plot", "ppl figure")
    from matplotlib.figure import Figure

    kinds = Figure().canvas.get_supported_filetypes()
    check_ending(out.with_suffix(out.suffix.lower()), [f".{kind}" for kind in sorted(kinds)])
    if kind == "steering":
        from experiments.report.steering import steering

        return steering([results, *other], scenario, out)
    if kind == "horizon" or (kind is None and _is_measured(results, "horizon")):
        return what_horizons_cost(results, other, out)
    if other:
        raise UserError("more than one path is for --kind steering and horizon alone")
    if kind == "growth" or (kind is None and _is_measured(results, "growth")):
        return growth(results, out)
    if kind == "experts" or (kind is None and _cards(results)):
        return expert_curves(results, out)
    points = read_points(results)
    if not points:
        raise UserError(f"{str(results)!r}: no run finished, every one failed or diverged")
    several = _varied(points)
    kind = kind or {0: "curves", 1: "axis", 2: "heatmap"}.get(len(several), "curves")
    wanted = {"axis": 1, "heatmap": 2}.get(kind)
    if wanted is not None and len(several) != wanted:
        what = ", ".join(several) or "none"
        raise UserError(f"kind {kind} needs results over {wanted} settings, these have {what}")
    if kind == "curves":
        curves(points, out, column)
    elif kind == "training":
        training(points, out)
    elif kind == "axis":
        over_axis(points, several[0], out, column, steps=steps)
    else:
        heatmap(points, several, out, column)


def _cards(folder: Path) -> list[Path]:
    """Curves of experts in a folder: a NAME.csv with a NAME.json each."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.glob("*.csv") if path.with_suffix(".json").is_file())


# kinds of figures that no run is in: the command that measures them, and a column of its file alone
_MEASURED = {
    "horizon": ("ppl horizon", "predicted_step"),
    "growth": ("ppl bench --parts growth", "cpu_ms_per_step"),
}


def _is_measured(path: Path, kind: str) -> bool:
    """Whether a file is one of the command behind such a kind."""
    return path.is_file() and _MEASURED[kind][1] in read_csv(path)


def _measured(path: Path, kind: str) -> Frame:
    """What such a file holds.

    Raises:
        UserError: If the file is another.
    """
    if not _is_measured(path, kind):
        raise UserError(f"{str(path)!r} is no file of `{_MEASURED[kind][0]}`")
    return read_csv(path)


def _varied(points: Sequence[Point]) -> list[str]:
    """Settings that differ between points of one method, and mean something for all of them."""
    names = list(dict.fromkeys(name for point in points for name in point.values))
    return [name for name in names if all(name in point.values for point in points)]


def _canvas(rows: int, columns: int, size: tuple[float, float]) -> Any:
    need("matplotlib", "plot", "a figure").use("Agg")
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


def _styles(count: int) -> list[dict[str, Any]]:
    """A style for each of some lines: no colour twice, and other dashes and markers."""
    import matplotlib

    if count <= 10:
        colours = [f"C{i}" for i in range(count)]
    else:
        colours = [matplotlib.colormaps["turbo"](x) for x in np.linspace(0.03, 0.97, count)]
    return [
        {
            "color": colour,
            "marker": MARKERS[i % len(MARKERS)],
            "linestyle": DASHES[i % len(DASHES)],
            "markersize": 5,
            "markerfacecolor": "white" if i % 2 else colour,
        }
        for i, colour in enumerate(colours)
    ]


def _legend(axes: Any, count: int) -> None:
    """To the right of a panel, in as many columns as it takes."""
    columns = -(-count // 18)
    axes.legend(
        frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=columns
    )


def _stack(intervals: Sequence[Interval]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, low and high ends of intervals, [points] each."""
    mean, low, high = np.array(intervals, float).T
    return mean, low, high


def _lines(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Points of the same runs, by label, each in the order of its steps."""
    several = len({point.env for point in points}) > 1
    found: dict[str, list[Point]] = {}
    for point in points:
        name = f"{point.env} {point.label}" if several else point.label
        found.setdefault(name, []).append(point)
    return {name: sorted(mine, key=lambda point: point.step) for name, mine in found.items()}


def curves(points: Sequence[Point], out: Path, column: str = "success") -> None:
    """A column against steps and against human data, one line per method and setting."""
    lines = _lines(points)
    over = common_over(points)
    picture, ((by_step, by_human),) = _canvas(1, 2, (11 + 2.4 * (len(lines) // 18), 4.6))
    for (name, mine), style in zip(lines.items(), _styles(len(lines)), strict=True):
        mean, low, high = _stack([point.interval(column, over) for point in mine])
        counted = all("human_data_usage" in point.measured for point in mine)
        human = [point.measured["human_data_usage"].mean() for point in mine] if counted else []
        if mine[0].algorithm in _OFFLINE and counted:  # another axis altogether: its end alone
            bar = [[mean[-1] - low[-1]], [high[-1] - mean[-1]]]
            by_human.errorbar(human[-1], mean[-1], bar, **style, label=name)
            continue
        steps = [point.step for point in mine]
        by_step.plot(steps, mean, **style, label=name)
        by_step.fill_between(steps, low, high, color=style["color"], alpha=0.12, linewidth=0)
        by_human.plot(human, mean if counted else [], **style, label=name)
    by_step.set(xlabel="environment steps", ylabel=NAMES[column])
    by_human.set(xlabel="steps under the expert's control", xscale="log")
    for axes in (by_step, by_human):
        _plain(axes)
        if column in SHARES:
            axes.set_ylim(0, 1.02)
    _legend(by_human, len(lines))
    _finish(picture, f"Means with {describe(points, over)}.", out)


def over_axis(
    points: Sequence[Point], name: str, out: Path, column: str, *, steps: Sequence[int] = ()
) -> None:
    """A column over the values of one setting, one line per method and step."""
    envs = list(dict.fromkeys(point.env for point in points))
    picture, (row,) = _canvas(1, len(envs), (1.5 + 4.6 * len(envs), 4.6))
    drawn: list[Point] = []
    for axes, env in zip(row, envs, strict=True):
        mine = [point for point in points if point.env == env]
        wanted = steps or sorted({point.step for point in at_step(mine, None)})
        here = [point for step in wanted for point in at_step(mine, step)]
        _axis_panel(axes, here, name, column)
        axes.set(xlabel=SETTINGS.get(name, name), ylabel=NAMES[column], title=env)
        drawn += here
    _finish(picture, f"Means with {describe(drawn, common_over(drawn))}.", out)


def _axis_panel(axes: Any, points: Sequence[Point], name: str, column: str) -> None:
    """One environment: a column over a setting."""
    values = list(dict.fromkeys(point.values[name] for point in points))
    if all(_is_number(point, name) for point in points):
        values.sort(key=float)
    pairs = [(point.algorithm, point.step) for point in points]
    lines = sorted(set(pairs), key=pairs.index)
    over = common_over(points)
    for i, ((algorithm, step), style) in enumerate(zip(lines, _styles(len(lines)), strict=True)):
        here = {
            point.values[name]: point.interval(column, over)
            for point in points
            if (point.algorithm, point.step) == (algorithm, step)
        }
        at = [x for x, value in enumerate(values) if value in here]
        mean, low, high = _stack([here[values[x]] for x in at])
        bars = [mean - low, high - mean]
        label = f"{algorithm}, {step:,} steps"
        axes.errorbar(np.array(at) + 0.06 * i, mean, bars, capsize=3, label=label, **style)
    axes.set_xticks(range(len(values)), values)
    if column in SHARES:
        axes.set_ylim(0, 1.02)
    _plain(axes)
    axes.legend(frameon=False, fontsize=8, loc="best")


def heatmap(points: Sequence[Point], names: Sequence[str], out: Path, column: str) -> None:
    """A column over two settings, one panel per environment and method; figures inside.

    Colours of a share run from 0 to 1, those of another column over the values shown.
    """
    points = at_step(points, None)
    panels = list(dict.fromkeys((point.env, point.algorithm) for point in points))
    picture, (row,) = _canvas(1, len(panels), (1.2 + 4.4 * len(panels), 4.4))
    every = [float(point.measured[column].mean()) for point in points]
    scale = (0.0, 1.0) if column in SHARES else (min(every), max(every))
    drawn = None
    for axes, (env, algorithm) in zip(row, panels, strict=True):
        mine = [point for point in points if (point.env, point.algorithm) == (env, algorithm)]
        drawn = _heat_panel(axes, mine, names, column, scale=scale)
        axes.set_title(" ".join(part for part in (env, algorithm) if part))
    label = NAMES[column]
    if column not in SHARES:
        label += f" (colours from {scale[0]:.3g} to {scale[1]:.3g})"
    picture.colorbar(drawn, ax=row, label=label)
    steps = sorted({point.step for point in points})
    after = " or ".join(f"{step:,}" for step in steps)
    caption = f"Means with {describe(points, common_over(points))}, after {after} steps."
    _finish(picture, caption, out)


def _heat_panel(
    axes: Any,
    points: Sequence[Point],
    names: Sequence[str],
    column: str,
    *,
    scale: tuple[float, float],
) -> Any:
    """One environment and method; returns the image, for the colour bar."""
    across, down = (list(dict.fromkeys(p.values[name] for p in points)) for name in names)
    grid = np.full((len(down), len(across)), np.nan)
    over = common_over(points)
    for point in points:
        x, y = across.index(point.values[names[0]]), down.index(point.values[names[1]])
        interval = point.interval(column, over)
        grid[y, x] = interval.mean
        bright = (interval.mean - scale[0]) / max(scale[1] - scale[0], 1e-9)
        text = show(interval, 2).replace(" [", "\n[")
        colour = "black" if bright > 0.5 else "white"
        axes.text(x, y, text, ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(across)), across)
    axes.set_yticks(range(len(down)), down)
    axes.set(xlabel=SETTINGS.get(names[0], names[0]), ylabel=SETTINGS.get(names[1], names[1]))
    return axes.imshow(grid, cmap="cividis", vmin=scale[0], vmax=scale[1], aspect="auto")


def training(points: Sequence[Point], out: Path) -> None:
    """Share of steps under the expert and cost per 1,000 steps, between evaluations."""
    if any("training_cost" not in point.measured for point in points):
        raise UserError("kind training needs results of ppl sweep, which count cost in training")
    lines = _lines(points)
    picture, ((rate, cost),) = _canvas(1, 2, (11 + 2.4 * (len(lines) // 18), 4.6))
    for (name, mine), style in zip(lines.items(), _styles(len(lines)), strict=True):
        steps = np.array([0] + [point.step for point in mine])
        middle, length = (steps[1:] + steps[:-1]) / 2, np.diff(steps)
        for axes, column, unit in (
            (rate, "human_data_usage", 1.0),
            (cost, "training_cost", 1000.0),
        ):
            totals = np.stack([point.measured[column] for point in mine])
            spent = np.diff(totals, axis=0, prepend=0) / length[:, None] * unit
            mean, low, high = _stack([mean_interval(row[:, None]) for row in spent])
            axes.plot(middle, mean, **style, label=name)
            axes.fill_between(middle, low, high, color=style["color"], alpha=0.12, linewidth=0)
    rate.set(xlabel="environment steps", ylabel="share of steps under the expert's control")
    cost.set(xlabel="environment steps", ylabel="cost per 1,000 training steps")
    for axes in (rate, cost):
        axes.set_ylim(bottom=0)
        _plain(axes)
    _legend(cost, len(lines))
    over = SEEDS if any(len(point.seeds) > 1 for point in points) else NOTHING
    _finish(picture, f"Between evaluations; means with {describe(points, over)}.", out)


def what_horizons_cost(measured: Path, results: Sequence[Path], out: Path) -> None:
    """The benefit and cost of a longer preference horizon L, and the success that it led to.

    Args:
        measured: A file of `ppl horizon`.
        results: Results over L of the same environment, or none.
        out: Picture to write.

    Raises:
        UserError: If the files are others.
    """
    frame = _measured(measured, "horizon")
    names = ["seed", "step", "predicted_step", "drift", "coverage", "gap", "error"]
    for name in names:
        frame[name] = number_column(measured, frame, name, whole=name in names[:3])
    frame = frame[names].drop_duplicates()
    if (twice := frame.duplicated(names[:3])).any():
        raise UserError(
            f"{str(measured)!r}, row {frame.index[twice][0]}: the same seed, step and predicted "
            "step as in a row before, with other numbers"
        )
    seeds = frame["seed"].nunique()
    # one row per predicted step, one column per measured value and training step
    mean = frame.pivot_table(index="predicted_step", columns="step", values=names[3:])
    count = 3 + bool(results)
    picture, (panels,) = _canvas(1, count, (4.2 * count, 4.4))
    _drift_panels(panels, mean)
    for path in results:
        _led_to(panels[3], read_points(path))
    for axes in panels:
        _plain(axes)
        axes.legend(frameon=False, fontsize=8)
        axes.set_xticks(mean.index)
        if axes is not panels[-1] or not results:
            axes.set_ylim(bottom=0)
    caption = (
        f"Where the novice alone would be taken over; means over n = {seeds} seeds, without "
        "intervals. gap(L) = 1 - reach_L / reach_M; error(L) = drift_L / |a_h - a_n|."
    )
    if results:
        led = [point for path in results for point in read_points(path)]
        caption += f" Success: means with {describe(led, SEEDS)}."
    _finish(picture, caption, out)


def _drift_panels(panels: Any, mean: Frame) -> None:
    """Drift, coverage and their balance over the predicted steps."""
    stops = mean["drift"].columns
    at = mean.index.to_numpy()
    for stop, style in zip(stops, _styles(len(stops)), strict=True):
        style = style | {"label": f"after {stop:,.0f} steps"}
        panels[0].plot(at, mean["drift"][stop], **style)
        panels[1].plot(at, mean["coverage"][stop], **style)
    gap, error = (mean[name].mean(axis=1).to_numpy() for name in ("gap", "error"))
    first, second = _styles(2)
    panels[2].plot(at, gap, **first, label="gap(L)")
    panels[2].plot(at, error, **second, label="error(L)")
    best = at[int(np.argmin(np.maximum(gap, error)))]
    panels[2].axvline(best, color="black", linewidth=0.8, linestyle=":")
    panels[2].set(xlabel="preference horizon L (steps)", title=f"balanced at L = {best:.0f}")
    panels[0].set(xlabel="predicted step i", title="how far the expert's action drifts")
    panels[0].set_ylabel("|h(s_i) - a_h|, units of the action")
    panels[1].set(xlabel="preference horizon L (steps)", title="states visited, states preferred")
    panels[1].set_ylabel("mean distance to the nearest, scaled observation")
    panels[2].set_ylabel("share of its worst")


def _led_to(axes: Any, points: Sequence[Point]) -> None:
    """Success over L, a line per step."""
    points = [point for point in points if _is_number(point, "preference_horizon")]
    steps = sorted({point.step for point in points})
    for step, style in zip(steps, _styles(len(steps)), strict=True):
        here = [point for point in points if point.step == step]
        x = [float(point.values["preference_horizon"]) for point in here]
        mean, low, high = _stack([point.interval("success", SEEDS) for point in here])
        label = f"{here[0].algorithm}, {step:,} steps"
        axes.errorbar(x, mean, [mean - low, high - mean], capsize=3, label=label, **style)
    axes.set(xlabel="preference horizon L (steps)", title="what it led to")
    axes.set_ylabel(NAMES["success"])
    axes.set_ylim(0, 1.02)


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
    paths = _cards(folder)
    if not paths:
        raise UserError(f"{str(folder)!r} holds no cards of `ppl expert card`")
    picture, rows = _canvas(len(paths), 3, (11, 2.6 * len(paths) + 0.4))
    for row, path in zip(rows, paths, strict=True):
        _expert_row(row, path)
    for axes in rows[-1]:
        axes.set_xlabel("environment steps, millions")
    rows[0][0].legend(frameon=False)
    rows[0][1].legend(frameon=False)
    caption = "One seed each, without intervals; held out: 50 scenarios, each once."
    _finish(picture, caption, out)


def _expert_row(panels: Any, path: Path) -> None:
    """Success, cost and multiplier over one expert's training."""
    card, where = path.with_suffix(".json"), repr(str(path.with_suffix(".json")))
    held = read_fields(read_json(card), {"hparams": dict}, where, needed=("hparams",))["hparams"]
    limits = read_fields(held, {"cost_limit": float}, f"{where}, hparams", needed=("cost_limit",))
    limit, frame = limits["cost_limit"], read_csv(path)
    steps = number_column(path, frame, "step", whole=True, low=0) / 1e6
    success, cost, multiplier = panels
    for axes, column, label, dash in (
        (success, "held_out_success_rate", "held out, without noise", "-"),
        (success, "train_success_rate", "in training, with noise", ":"),
        (cost, "held_out_episodic_cost", "held out", "-"),
        (cost, "train_episodic_cost", "in training", ":"),
        (multiplier, "train_multiplier", "multiplier", "-"),
    ):
        frame[column] = number_column(path, frame, column, empty=True)
        axes.plot(steps, frame[column], dash, label=label)
    success.set_ylim(0, 1.03)
    success.set_ylabel(f"{path.stem}\nsuccess")
    cost.axhline(limit, color="black", linewidth=0.8, linestyle="--", label="limit")
    if frame["held_out_episodic_cost"].max() > 10:
        cost.set_yscale("symlog", linthresh=1)
    cost.set_ylim(bottom=0)
    cost.set_ylabel("cost per episode")
    multiplier.set_ylabel("multiplier")
    multiplier.set_ylim(bottom=0)
    for axes in panels:
        _plain(axes)


def growth(measured: Path, out: Path) -> None:
    """What a training step costs over each size of a run; of steps, what the run costs.

    Args:
        measured: A file of `ppl bench --parts growth`.
        out: Picture to write.

    Raises:
        UserError: If the file is another.
    """
    frame = _measured(measured, "growth")
    if "axis" not in frame:
        raise UserError(f"{str(measured)!r} has no column 'axis'")
    for name in ("value", "cpu_ms", "cpu_ms_per_step"):
        frame[name] = number_column(measured, frame, name, low=0)
    names = [name for name in GROWTH if (frame["axis"] == name).any()]
    picture, rows = _canvas(2, -(-len(names) // 2), (11, 6.2))
    for panel in rows.ravel()[len(names) :]:
        panel.set_visible(False)
    for name, axes in zip(names, rows.ravel(), strict=False):
        here, whole = frame[frame["axis"] == name], name == "steps"
        cost = here["cpu_ms"] / 1e3 if whole else here["cpu_ms_per_step"]
        axes.plot(here["value"], cost, "o-", color="C0")
        axes.set(xlabel=GROWTH[name], ylabel="CPU-s" if whole else "CPU-ms per step")
        axes.set_ylim(0, 1.15 * cost.max())
        axes.set_xlim(left=0)
        axes.locator_params(axis="x", nbins=5)
        _plain(axes)
    _finish(
        picture,
        "PPL in driving, the expert always in control; the fastest of several calls of one run on "
        "one core, no intervals. Straight lines from the origin: linear; level ones: constant.",
        out,
    )
