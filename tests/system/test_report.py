"""Tables and figures, from result files alone."""

import csv

import numpy as np
import pytest

from experiments.cli import Figure, Table
from experiments.engine.runtime import UserError
from experiments.report import figures
from experiments.report import points as report
from ppl_jax.statistics import interquartile_mean

COLUMNS = ["run", "env", "algorithm", "seed", "status", "step", *report.MEASURED]
COLUMNS += ["preference_horizon", "beta", "learning_rate"]
RNG = np.random.default_rng(5)
SCORES = RNG.uniform(0.2, 0.9, (2, 3, 4))  # [L, beta, seed]


def results(path, betas=(0.1, 0.3, 1.0), algorithms=("ppl",)):
    rows = []
    for algorithm in algorithms:
        for i, horizon in enumerate((1, 4)):
            for j, beta in enumerate(betas):
                for seed in range(4):
                    for step in (100, 200):
                        row = dict.fromkeys(COLUMNS, "")
                        row |= {"env": "driving", "algorithm": algorithm, "seed": seed}
                        row |= {"status": "done", "step": step, "human_data_usage": step // 4}
                        row |= {name: 1.0 for name in report.MEASURED[1:]}
                        row |= {"success": SCORES[i, j, seed] * step / 200}
                        row |= {"preference_horizon": horizon, "beta": beta}
                        rows.append(row | {"learning_rate": 0.001})
    rows.append(rows[0] | {"seed": 9, "status": "diverged", "success": 0.0})
    rows.append(rows[0] | {"seed": 9, "status": "failed: why", "step": "", "success": ""})
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    return path


def test_points_are_the_runs_and_leave_out_what_failed(tmp_path):
    points = report.read_points(results(tmp_path / "results.csv"))
    assert len(points) == 2 * 3 * 2
    assert points[0].values == {"preference_horizon": "1", "beta": "0.1"}  # not what never varies
    last = report.at_step(report.read_points(tmp_path), None)  # the folder will do
    assert {point.step for point in last} == {200}
    for point, expected in zip(last, SCORES.reshape(6, 4), strict=True):
        assert point.seeds == [0, 1, 2, 3]
        np.testing.assert_allclose(point.measured["success"], expected)
        interval = point.interval("success")
        assert interval.low < interval.mean == pytest.approx(expected.mean())
    with pytest.raises(UserError, match="step 150 was not evaluated, only 100, 200"):
        report.at_step(points, 150)


def test_a_table_in_three_formats(tmp_path, capsys):
    path = results(tmp_path / "results.csv", betas=(0.1,))
    report.table(Table(path, format="markdown"))
    lines = capsys.readouterr().out.splitlines()
    rows = [line for line in lines if line.startswith("| ppl")]
    assert rows[0].startswith("| ppl preference_horizon=1 | 4 | 50 (0.25) | 200 |")
    assert f"| {SCORES[0, 0].mean():.2f} [" in rows[0]
    assert f"| {interquartile_mean(SCORES[0, 0]):.2f} [" in rows[0]
    gap = SCORES[1, 0].mean() - SCORES[0, 0].mean()
    assert f"| {gap:.2f} [" in rows[2]  # paired with the first
    report.table(Table(path, format="latex", paper=True))
    told = capsys.readouterr().out
    assert r"preference\_horizon=4 & 4 &" in told
    assert told.count(r"\begin{tabular}") == told.count(r"\end{tabular}") == 2
    assert r"0.80$\pm$0.04" in told  # the paper's own
    report.table(Table(path, against="ppl preference_horizon=4"))
    assert "ppl preference_horizon=1 against ppl preference_horizon=4" in capsys.readouterr().out
    with pytest.raises(UserError, match="against must be one of 'ppl preference_horizon=1'"):
        report.table(Table(path, against="nothing"))


@pytest.mark.parametrize(
    ("betas", "kind"),
    [((0.1, 0.3), None), ((0.1,), None), ((0.1,), "curves"), ((0.1,), "training")],
)
def test_every_kind_is_drawn(betas, kind, tmp_path):
    path = results(tmp_path / "results.csv", betas=betas, algorithms=("ppl", "pvp"))
    out = tmp_path / "figure.png"
    figures.figure(Figure(path, kind=kind, out=out))
    assert out.read_bytes().startswith(b"\x89PNG")
    assert out.stat().st_size > 10_000


def test_a_figure_that_the_results_do_not_have(tmp_path):
    path = results(tmp_path / "results.csv", betas=(0.1,))
    with pytest.raises(UserError, match="needs results over 2 settings, these have preference"):
        figures.figure(Figure(path, kind="heatmap", out=tmp_path / "x.png"))
    with pytest.raises(UserError, match="neither a results file nor a folder"):
        figures.figure(Figure(tmp_path / "nothing", out=tmp_path / "x.png"))
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(UserError, match="holds no results"):
        figures.figure(Figure(tmp_path / "other.csv", out=tmp_path / "x.png"))
    with pytest.raises(UserError, match="no file of `ppl horizon`"):
        figures.figure(Figure(path, kind="horizon", out=tmp_path / "x.png"))


def test_what_horizons_cost_is_drawn(tmp_path):
    columns = ["drift", "coverage", "gap", "error"]
    with open(tmp_path / "h.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ["seed", "step", "predicted_step", *columns])
        writer.writeheader()
        for i in range(1, 5):
            values = dict.fromkeys(columns, i / 5) | {"gap": 1 - i / 4}
            writer.writerow({"seed": 0, "step": 100, "predicted_step": i} | values)
    path = results(tmp_path / "results.csv", betas=(0.1,))
    command = Figure(tmp_path / "h.csv", (path,), kind="horizon", out=tmp_path / "h.png")
    figures.figure(command)
    assert (tmp_path / "h.png").stat().st_size > 10_000
