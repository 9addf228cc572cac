"""Figures, from result files only: `python -m experiments.figures RESULTS.csv OUT.png`.

With a folder of experts' curves (`envs/pretrained`) in the place of RESULTS.csv it draws those.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ppl_jax.statistics import mean_interval


def learning_curves(results: Path, out: Path, column: str = "success") -> None:
    """Held-out success against steps and against human data, one line per method.

    Bands are 95% intervals over seeds. Methods that learn from demonstrations alone are dots.

    Args:
        results: A results.csv of `ppl compare` or `ppl ablation`.
        out: Picture to write.
        column: What to draw.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with open(results, newline="") as file:
        rows = list(csv.DictReader(file))
    figure, (by_step, by_human) = pyplot.subplots(1, 2, figsize=(11, 4.2), sharey=True)
    rng = np.random.default_rng(0)
    colours = pyplot.get_cmap("tab10")
    labels = list(dict.fromkeys(row["algorithm"] for row in rows))
    longest = max(
        (int(row["step"]) for row in rows if row["algorithm"] not in _OFFLINE), default=None
    )
    for i, label in enumerate(labels):
        mine = [row for row in rows if row["algorithm"] == label]
        steps = sorted({int(row["step"]) for row in mine})
        means, lows, highs, human = [], [], [], []
        for step in steps:
            at = [row for row in mine if int(row["step"]) == step]
            scores = np.array([[float(row[column])] for row in at])
            interval = mean_interval(scores, rng)
            means.append(interval.mean)
            lows.append(interval.low)
            highs.append(interval.high)
            human.append(np.mean([float(row["human_data_usage"]) for row in at]))
        wide = 2.5 if i == 0 else 1.3
        if label in _OFFLINE:  # another axis altogether: its end alone
            by_human.errorbar(
                human[-1],
                means[-1],
                [[means[-1] - lows[-1]], [highs[-1] - means[-1]]],
                fmt="o",
                color=colours(i % 10),
                label=label,
            )
            continue
        by_step.plot(steps, means, color=colours(i % 10), linewidth=wide, label=label)
        by_step.fill_between(steps, lows, highs, color=colours(i % 10), alpha=0.12, linewidth=0)
        by_human.plot(human, means, color=colours(i % 10), linewidth=wide, label=label)
    if longest:
        by_step.set_xlim(0, longest)
    by_step.set_xlabel("environment steps")
    by_human.set_xlabel("steps under the expert's control")
    by_human.set_xscale("log")
    by_step.set_ylabel(f"held-out {column}")
    by_step.set_ylim(0, 1)
    for axes in (by_step, by_human):
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    handles, names = by_human.get_legend_handles_labels()
    figure.legend(handles, names, loc="center right", frameon=False)
    figure.tight_layout(rect=(0, 0, 0.85, 1))
    figure.savefig(out, dpi=120)
    pyplot.close(figure)


def expert_curves(folder: Path, out: Path) -> None:
    """Success, cost and multiplier over the training of each expert in a folder.

    Args:
        folder: With a NAME.csv and a NAME.json for each, as `ppl expert card` writes them.
        out: Picture to write.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    paths = sorted(folder.glob("*.csv"))
    figure, rows = pyplot.subplots(len(paths), 3, figsize=(11, 2.6 * len(paths)), squeeze=False)
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
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
    for axes in rows[-1]:
        axes.set_xlabel("environment steps, millions")
    rows[0][0].legend(frameon=False)
    rows[0][1].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(out, dpi=120)
    pyplot.close(figure)


_OFFLINE = ("bc", "gail")  # learn from demonstrations alone: their steps are not the others'

if __name__ == "__main__":
    draw = expert_curves if Path(sys.argv[1]).is_dir() else learning_curves
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
