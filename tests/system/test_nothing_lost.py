"""Two at once, workers started from anywhere: what is written stays whole and belongs to one."""

import json
import os
import re
import subprocess
import sys
import time

import pytest

from experiments.engine import preparation, schedulers
from ppl_jax import plugins
from tests.helpers import PROGRAM, ROOT

SMALL = ["--total-steps", "40", "--evaluate-every", "20", "--batch-size", "8"]
MODULE = """
import envs
from tests.helpers import Probe
envs.register("probe", Probe)
"""
FROM_C = """
import my_worlds
from experiments.cli import main
main({words})
"""
UNGUARDED = """
import envs
from experiments.cli import main
from tests.helpers import Probe
envs.register("probe", Probe)
main()
"""
CELL = """
import envs
from experiments.cli import main
from tests.helpers import Probe
envs.register("probe", lambda: Probe())
main({words})
"""


def started(code, *words, cwd, module=True):
    """A Python that was started with other words, where its modules are in the current folder."""
    if module:
        (cwd / "my_worlds.py").write_text(MODULE)
    return subprocess.Popen(
        [sys.executable, *code, *map(str, words)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process, code):
    out, told = process.communicate(timeout=400)
    assert process.returncode == code, out + told
    return told


def sweep_words(out, seeds=1):
    return ["sweep", "probe", *SMALL, "--seeds", str(seeds), "--processes", "1", "--out", str(out)]


def rows(out):
    return [line for line in (out / "results.csv").read_text().splitlines()[1:] if "done" in line]


def test_a_second_sweep_of_a_folder_is_refused_while_the_first_writes_it(tmp_path):
    (tmp_path / "own.py").write_text(PROGRAM)
    out = tmp_path / "s"
    first = started(["own.py"], *sweep_words(out, 20), "--beta", "0.1", cwd=tmp_path, module=False)
    deadline = time.time() + 200
    while not (out / "sweep.json").is_file() and time.time() < deadline:
        time.sleep(0.05)
    again = [*sweep_words(out, 2), "--beta", "0.5"]
    told = ended(started(["own.py"], *again, cwd=tmp_path, module=False), 2)
    assert first.poll() is None, "the first was done already"
    assert f"error: out {str(out)!r} is being written by process {first.pid} on " in told
    assert "(own.py sweep probe" in told
    ended(first, 0)
    assert len(rows(out)) == 20 * 2
    ended(started(["own.py"], *again, cwd=tmp_path, module=False), 0)
    assert len(rows(out)) == 22 * 2
    assert len(json.loads((out / "sweep.json").read_text())["runs"]) == 22


def test_a_run_has_one_process_new_or_resumed(tmp_path):
    (tmp_path / "own.py").write_text(PROGRAM)
    words = ["train", "probe", "--total-steps", "20000", "--batch-size", "8", "--out", "r"]
    first = started(["own.py"], *words, cwd=tmp_path, module=False)
    deadline = time.time() + 200
    while not (tmp_path / "r" / "config.json").is_file() and time.time() < deadline:
        time.sleep(0.05)
    for more in ([], ["--resume"]):
        told = ended(started(["own.py"], *words, *more, cwd=tmp_path, module=False), 2)
        assert re.search(rf"error: .*written by process {first.pid} on .* or give another", told)
    first.kill()
    first.communicate()
    told = ended(started(["own.py"], *words, cwd=tmp_path, module=False), 2)
    assert "already holds a run: give --resume" in told


@pytest.mark.parametrize("how", ["python -c", "python -m", "without a guard", "--import"])
def test_a_sweep_starts_from_wherever_python_runs(how, tmp_path):
    words, out = sweep_words(tmp_path / "s"), tmp_path / "s"
    if how == "python -c":
        process = started(["-c", FROM_C.format(words=words)], cwd=tmp_path)
    elif how == "python -m":
        (tmp_path / "package").mkdir()
        (tmp_path / "package" / "program.py").write_text(PROGRAM)
        process = started(["-m", "package.program"], *words, cwd=tmp_path)
    elif how == "without a guard":
        (tmp_path / "own.py").write_text(UNGUARDED)
        process = started(["own.py"], *words, cwd=tmp_path)
    else:
        main = "from experiments.cli import main; main()"
        process = started(["-c", main, "--import", "my_worlds"], *words, cwd=tmp_path)
    ended(process, 0)
    assert len(rows(out)) == 2


def test_what_only_a_prompt_knows_is_said_with_the_way_out(tmp_path):
    told = ended(started(["-c", CELL.format(words=sweep_words(tmp_path / "s"))], cwd=tmp_path), 2)
    assert "a worker process does not know environment 'probe': " in told
    assert "put it into a module and name it in PPL_JAX_IMPORT=MODULE" in told


def test_a_module_that_cannot_be_imported_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "broken_worlds.py").write_text("raise RuntimeError('no licence\\nfound')")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="'broken_worlds' cannot be imported: RuntimeError: no"):
        plugins.import_modules(["broken_worlds"])


@pytest.mark.parametrize("how", ["silent", "dead"])
def test_a_worker_that_does_not_come_is_reported_with_its_log(how, tmp_path, monkeypatch):
    wait = "import time; time.sleep(60)" if how == "silent" else "raise SystemExit(3)"
    code = f"import sys; print('no licence', file=sys.stderr); sys.stderr.flush(); {wait}"
    monkeypatch.setattr(schedulers, "words", lambda: [sys.executable, "-c", code])
    monkeypatch.setattr(schedulers, "SILENCE_S", 2.0)
    began, log = time.monotonic(), tmp_path / "workers.log"
    found = dict(schedulers.local([{}, {}, {}], 1, log))
    assert time.monotonic() - began < 30
    why = "did not answer for 2 s" if how == "silent" else "died (exit status 3)"
    assert [reply["error"] for reply in found.values()] == 3 * [
        f"its worker {why}; see {log}, which ends with: no licence"
    ]


def test_a_frozen_program_is_started_by_itself(monkeypatch):
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert preparation.words() == [sys.executable, preparation.SERVE]
