"""Atomic writes, the memory of compile times, and what a run shows of its progress."""

import io
import json

import pytest

from experiments.engine import compile_log, progress
from experiments.engine.files import write_atomic, write_text_atomic
from experiments.engine.runtime import UserError, need

NOTE = "success 0.62; best so far driving ppl preference_horizon=4 beta=0.03 0.81; human data 12"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PPL_JAX_CACHE", str(tmp_path))
    return tmp_path


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "rows.csv"
    write_text_atomic(path, "old\r\n")

    def half(file):
        file.write(b"ne")
        raise RuntimeError("no more room")

    with pytest.raises(RuntimeError, match="no more room"):
        write_atomic(path, half)
    assert path.read_bytes() == b"old\r\n"
    assert [file.name for file in tmp_path.iterdir()] == ["rows.csv"]


def test_a_missing_package_is_one_line_with_its_command():
    with pytest.raises(UserError) as error:
        need("no_such_package", "plot", "ppl figure")
    assert str(error.value) == "ppl figure needs no_such_package: pip install 'ppl-jax[plot]'"
    assert need("json", "plot", "ppl figure") is json


def test_the_wait_for_a_compile_is_announced_with_the_last_time(cache, capsys):
    with compile_log.announce_compile("training step", "ppl in driving"):
        pass
    assert capsys.readouterr().err == "compiling training step (for the first time)\n"
    compile_log.remember("ppl in driving", 18.2)
    compile_log.remember("another", 3.0)
    with compile_log.announce_compile("training step", "ppl in driving"):
        pass
    assert capsys.readouterr().err == "compiling training step (took 18 s last time)\n"
    assert compile_log.last_time("another") == 3.0
    assert compile_log.last_time("ppl in driving") < 1.0  # just now: it waited for nothing
    with compile_log.announce_compile("training step", "ppl in driving"):
        pass
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("content", ["", "[1]", '{"a": "x", "b": -1}', "\udcff"])
def test_a_broken_memory_of_compile_times_is_no_memory(cache, content):
    (cache / compile_log.FILE).write_text(content, errors="surrogateescape")
    assert compile_log.last_time("a") is None
    assert compile_log.last_time("b") is None
    compile_log.remember("a", 2.0)
    assert compile_log.last_time("a") == 2.0


def test_a_compile_that_fails_is_not_remembered(cache):
    def fail():
        with compile_log.announce_compile("step"):
            raise ValueError("does not fit")

    with pytest.raises(ValueError, match="does not fit"):
        fail()
    assert compile_log.last_time("step") is None


def test_plain_lines_where_there_is_no_terminal(cache, capsys):
    with progress.Progress(100, "train driving") as shown:
        with shown.compiling("training step"):
            pass
        shown.start()
        shown.update(50, "success 0.50")
    first, second = capsys.readouterr().err.splitlines()
    assert first == "compiling training step (for the first time)"
    assert second.startswith("train driving 50/100  success 0.50  [0s, 0s left]")


def test_bar_percentage_and_time_left_stay_on_a_narrow_terminal(cache, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", terminal := Terminal())
    compile_log.remember("training step", 18.0)
    with progress.Progress(100, "expert nut_assembly") as shown:
        with shown.compiling("training step"):
            pass
        shown.start()
        shown.began -= 10.0  # ten seconds for a quarter
        shown.update(25, NOTE * 3)
        from rich.console import Console

        page = Console(width=80, file=io.StringIO(), record=True)
        page.print(shown.bar.get_renderable())
    line, note = page.export_text().splitlines()
    assert "compiling training step (took 18 s last time)" in terminal.getvalue()
    assert len(line) <= 80
    assert line.startswith("expert nut_assembly ━━━")
    assert line.rstrip().endswith("25% 0:00:30 left")
    assert note.strip().startswith("success 0.62")
    assert len(note) <= 80


def test_compiling_between_two_updates_does_not_count(cache, monkeypatch):
    clock = iter(range(0, 10_000, 100))
    monkeypatch.setattr(progress.time, "perf_counter", lambda: float(next(clock)))
    shown = progress.Progress(100, "train")
    began = shown.began
    with shown.compiling("step"):
        pass
    assert shown.began > began
