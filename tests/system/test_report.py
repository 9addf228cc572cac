"""Tables and figures, from result files alone."""

import csv
import gzip
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.engine.runtime import UserError
from experiments.report import figures, film, tables
from experiments.report import points as report
from ppl_jax.statistics import interquartile_mean, mean_interval, paired_difference

RESULTS = Path(report.__file__).parent.parent / "results"
TABULAR = r"(\\begin\{tabular\}.*?)\\end\{tabular\}"
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
    tables.table(path, format="markdown")
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("| method | preference_horizon | seeds |") for line in lines)
    rows = [line for line in lines if line.startswith("| ppl")]
    assert rows[0].startswith("| ppl | 1 | 4 | 50 (0.25) | 200 |")
    assert f"| {SCORES[0, 0].mean():.2f} [" in rows[0]
    assert f"| {interquartile_mean(SCORES[0, 0]):.2f} [" in rows[0]
    gap = SCORES[0, 0].mean() - SCORES[1, 0].mean()
    assert rows[2].startswith(f"| ppl | 1 | {gap:.2f} [")  # paired with the default, L = 4
    assert "95% bootstrap intervals over 4 seeds;" in lines[-1]
    tables.table(path, format="latex", paper=True)
    told = capsys.readouterr().out
    assert r"method & $L$ & seeds &" in told
    assert "ppl & 4 & 4 &" in told
    assert told.count(r"\begin{tabular}") == told.count(r"\end{tabular}") == 2
    assert r"0.80$\pm$0.04" in told  # the paper's own
    tables.table(path, against="ppl preference_horizon=1")
    told = capsys.readouterr().out
    assert "Success less that of ppl preference_horizon=1:" in told
    assert f"ppl     4                   {-gap:.2f} [" in told
    with pytest.raises(UserError, match="did you mean 'ppl preference_horizon=1'"):
        tables.table(path, against="ppl preference_horizont=1")


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX here")
def test_latex_compiles(tmp_path, capsys):
    tables.table(results(tmp_path / "results.csv"), format="latex", paper=True)
    tables.table(RESULTS / "driving_methods.csv", format="latex")
    told = capsys.readouterr().out
    body = "".join(f"{part}\\end{{tabular}}\n\n" for part in re.findall(TABULAR, told, re.S))
    head = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}\n"
    (tmp_path / "t.tex").write_text(head + body + "\\end{document}\n")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]


@pytest.mark.parametrize(
    ("betas", "kind"),
    [((0.1, 0.3), None), ((0.1,), None), ((0.1,), "curves"), ((0.1,), "training")],
)
def test_every_kind_is_drawn(betas, kind, tmp_path):
    path = results(tmp_path / "results.csv", betas=betas, algorithms=("ppl", "pvp"))
    out = tmp_path / "figure.png"
    figures.figure(path, kind=kind, out=out)
    assert out.read_bytes().startswith(b"\x89PNG")
    assert out.stat().st_size > 10_000


def test_a_figure_that_the_results_do_not_have(tmp_path):
    path = results(tmp_path / "results.csv", betas=(0.1,))
    with pytest.raises(UserError, match="needs results over 2 settings, these have preference"):
        figures.figure(path, kind="heatmap", out=tmp_path / "x.png")
    with pytest.raises(UserError, match="neither a results file nor a folder"):
        figures.figure(tmp_path / "nothing", out=tmp_path / "x.png")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(UserError, match="holds no results"):
        figures.figure(tmp_path / "other.csv", out=tmp_path / "x.png")
    with pytest.raises(UserError, match=r"out must end in .*\.png.*, got "):
        figures.figure(path, out=tmp_path / "x.xyz")
    with pytest.raises(UserError, match="no file of `ppl horizon`"):
        figures.figure(path, kind="horizon", out=tmp_path / "x.png")


def test_what_horizons_cost_is_drawn(tmp_path):
    columns = ["drift", "coverage", "gap", "error"]
    with open(tmp_path / "h.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ["seed", "step", "predicted_step", *columns])
        writer.writeheader()
        for i in range(1, 5):
            values = dict.fromkeys(columns, i / 5) | {"gap": 1 - i / 4}
            writer.writerow({"seed": 0, "step": 100, "predicted_step": i} | values)
    path = results(tmp_path / "results.csv", betas=(0.1,))
    figures.figure(tmp_path / "h.csv", other=(path,), kind="horizon", out=tmp_path / "h.png")
    assert (tmp_path / "h.png").stat().st_size > 10_000


def write(path, rows):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def episode_rows(seeds, algorithms=("ppl", "pvp")):
    rng = np.random.default_rng(2)
    return [
        {"algorithm": algorithm, "seed": seed, "total_steps": 200, "training_cost": 3, "step": 200}
        | {"scenario": scenario, "success": int(rng.random() < 0.6), "episodic_return": 1.5}
        | {"progress": 0.5, "episodic_cost": 0, "length": 10, "human_data_usage": 40}
        for algorithm in algorithms
        for seed in seeds
        for scenario in range(1000, 1020)
    ]


@pytest.mark.parametrize("schema", [1, 2])
def test_a_single_run_has_intervals_over_scenarios(schema, tmp_path, capsys):
    config = {"env": "driving", "algorithm": "ppl", "seed": 7}
    config |= {"config": {}, "hparams": {}} if schema == 1 else {"schema": 2, "settings": {}}
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "policy.npz").touch()  # not a folder of experts
    with pytest.raises(UserError, match=r"has no evaluation\.csv yet"):
        report.read_points(tmp_path)
    rows = episode_rows([7], ("ppl",))
    names = [name for name in rows[0] if name not in ("algorithm", "seed", "training_cost")]
    half = [row | {"step": 100} for row in rows]
    write(tmp_path / "evaluation.csv", [{n: row[n] for n in names} for row in half + rows])
    points = report.read_points(tmp_path)
    assert [(point.step, point.seeds, len(point.scenarios)) for point in points] == [
        (100, [7], 20),
        (200, [7], 20),
    ]
    tables.table(tmp_path)
    told = capsys.readouterr().out
    assert "over 20 held-out scenarios of one seed (other seeds are not in them)" in told
    successes = np.array([[row["success"] for row in rows]])
    assert tables.show(mean_interval(successes), 2) in told
    figures.figure(tmp_path, out=tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 10_000


def test_one_number_is_shown_without_an_interval(tmp_path, capsys):
    row = {"algorithm": "ppl", "seed": 0, "step": 100, "success": 0.28, "progress": 0.5}
    write(tmp_path / "results.csv", [row, row | {"algorithm": "bc"}])
    tables.table(tmp_path)
    told = capsys.readouterr().out
    assert re.search(r" 0\.28 ", told)
    assert "[" not in told
    assert "not given for one seed without a row per scenario" in told


def test_table_compare_and_notebook_give_the_same_interval(tmp_path, capsys):
    rows = episode_rows([0, 1, 2])
    write(tmp_path / "episodes.csv", rows)
    scores = {}
    for row in rows:
        scores.setdefault((row["algorithm"], row["seed"]), []).append(row["success"])
    write(
        tmp_path / "results.csv",
        [
            {"algorithm": algorithm, "seed": seed, "total_steps": 200, "step": 200}
            | {"human_data_usage": 40, "success": np.mean(values), "episodic_return": 1.5}
            | {"progress": 0.5, "episodic_cost": 0}
            for (algorithm, seed), values in scores.items()
        ],
    )
    ppl, pvp = report.read_points(tmp_path)
    ours, theirs = (np.array([scores[name, seed] for seed in range(3)]) for name in ("ppl", "pvp"))
    assert ppl.interval("success") == mean_interval(ours)
    assert report.difference(pvp, ppl) == paired_difference(theirs, ours)
    shown = tables.show(paired_difference(theirs, ours), 2)
    tables.table(tmp_path)
    told = capsys.readouterr().out
    assert f"pvp     {shown}" in told
    assert "over 3 seeds and 20 held-out scenarios" in told
    tables.print_comparison(tmp_path / "episodes.csv")
    assert f"pvp     {shown}" in capsys.readouterr().out
    (tmp_path / "episodes.csv.gz").write_bytes(
        gzip.compress((tmp_path / "episodes.csv").read_bytes())
    )
    (tmp_path / "episodes.csv").unlink()
    assert report.difference(*reversed(report.read_points(tmp_path))) == report.difference(pvp, ppl)


@pytest.mark.parametrize(
    "path",
    sorted(
        path
        for path in RESULTS.glob("*.csv")
        if path.stem not in ("driving_horizon_measured", "expert_driving_trials")
        and not path.stem.startswith("bench_")
    ),
    ids=lambda path: path.stem,
)
def test_committed_results_are_readable(path, capsys):
    if not path.stem.startswith("driving_tuning"):
        assert all(point.measured["success"].size for point in report.read_points(path))
    else:
        tables.table(path)
        assert "learning_rate" in capsys.readouterr().out


def test_a_file_that_pandas_wrote_is_the_same(tmp_path):
    import pandas as pd

    path = results(tmp_path / "results.csv", betas=(0.1,))
    before = report.read_points(path)
    frame = pd.read_csv(path)
    for name in ("seed", "step", "preference_horizon"):
        frame[name] = frame[name].astype(float)
    frame.iloc[:-1].to_csv(tmp_path / "again.csv")  # with an index column
    after = report.read_points(tmp_path / "again.csv")
    assert [(p.label, p.step, p.seeds) for p in after] == [
        (p.label, p.step, p.seeds) for p in before
    ]
    frame["step"] = frame["step"].astype(object)
    frame.loc[3, "step"] = "soon"
    frame.to_csv(tmp_path / "wrong.csv")
    with pytest.raises(UserError, match=r"row 5: step must be a whole number .*, got 'soon'"):
        report.read_points(tmp_path / "wrong.csv")


def test_written_rows_are_plain_csv(tmp_path):
    tables.write_rows(tmp_path / "x.csv", [{"a": 1, "b": 0.1}, {"a": 2, "b": ""}])
    assert (tmp_path / "x.csv").read_bytes() == b"a,b\n1,0.1\n2,\n"


def test_no_colour_is_drawn_twice():
    import matplotlib.colors

    for count in (3, 10, 11, 45):
        colours = [matplotlib.colors.to_hex(style["color"]) for style in figures._styles(count)]
        assert len(set(colours)) == count


def test_heat_maps_of_shares_run_from_0_to_1(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "_finish", lambda picture, caption, out: drawn.append(picture))
    points = report.read_points(results(tmp_path / "results.csv"))
    names = ["preference_horizon", "beta"]
    figures.heatmap(points, names, tmp_path / "x.png", "success")
    figures.heatmap(points, names, tmp_path / "x.png", "episodic_cost")
    share, cost = (picture.axes[-1] for picture in drawn)
    assert share.get_ylim() == (0.0, 1.0)
    assert "colours from 1 to 1" in cost.get_ylabel()


def test_unknown_columns_and_kinds_are_refused(tmp_path):
    path = results(tmp_path / "results.csv", betas=(0.1,))
    with pytest.raises(UserError, match=r"column must be one of .* did you mean 'success'"):
        report.read_points(path)[0].interval("sucess")
    with pytest.raises(UserError, match=r"kind must be one of .* did you mean 'heatmap'"):
        figures.figure(path, kind="heatmaps", out=tmp_path / "x.png")


@pytest.mark.parametrize(
    ("module", "call", "told"),
    [
        (
            "matplotlib",
            lambda path: figures.figure(path),
            r"ppl figure needs matplotlib: pip install 'ppl-jax\[plot\]'",
        ),
        (
            "PIL",
            lambda path: film.render("scripted", 1000, path / "x.gif", 1),
            r"ppl render needs PIL: pip install 'ppl-jax\[render\]'",
        ),
        (
            "av",
            lambda path: film.render("scripted", 1000, path / "x.mp4", 1),
            r"ppl render to .mp4 needs av: pip install 'ppl-jax\[render\]'",
        ),
    ],
)
def test_a_missing_package_is_one_line(module, call, told, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match=told):
        call(tmp_path)


def test_the_command_line_starts_without_pandas():
    code = "import sys, experiments.cli; sys.exit('pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
