"""Files that are written whole, folders that have one owner, policies for other programs."""

import contextlib
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from experiments.engine.export import export, to_onnx
from experiments.engine.files import as_json, check_out_file, make_out_folder, write_atomic
from experiments.engine.ownership import owned
from experiments.engine.policy_file import save_policy
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError
from ppl_jax.experts import SavedPolicy
from tests.helpers import ROOT, numpy_action

HOLD = """
import sys, time
from pathlib import Path
from experiments.engine.ownership import owned
with owned(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(100)
"""


def test_json_is_strict():
    content = {"a": [1.5, float("nan")], "b": {"c": float("-inf")}, "d": (1, True, None, "NaN")}
    read = json.loads(as_json(content), parse_constant=pytest.fail)
    assert read == {"a": [1.5, None], "b": {"c": None}, "d": [1, True, None, "NaN"]}


def test_metrics_of_a_loss_that_is_not_finite_are_json(tmp_path):
    RunFolder(tmp_path).append_metrics({"step": 1, "train/bc_loss": float("inf")})
    line = (tmp_path / "metrics.jsonl").read_text()
    assert json.loads(line, parse_constant=pytest.fail) == {"step": 1, "train/bc_loss": None}


def test_a_file_that_cannot_be_written_stays_as_it_was(tmp_path):
    path = tmp_path / "x"
    path.write_text("before")

    def fail(file):
        file.write(b"half")
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        write_atomic(path, fail)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("place", ["/proc/nowhere/x", "{}/file/x", "/dev/null/x"])
def test_a_path_that_cannot_be_is_refused_before_the_work(place, tmp_path):
    (tmp_path / "file").touch()
    path = tmp_path.__class__(place.format(tmp_path))
    for check in (make_out_folder, check_out_file):
        with pytest.raises(UserError, match="cannot be written: ") as told:
            check(path)
        assert len(str(told.value).splitlines()) == 1
    with pytest.raises(UserError, match="cannot be written: "), owned(path):
        pytest.fail("a folder was made there")


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(UserError, match="is a folder: name a file"):
        check_out_file(tmp_path)
    check_out_file(tmp_path / "new" / "file.csv")
    assert list((tmp_path / "new").iterdir()) == []


def test_a_folder_has_one_owner_and_a_dead_one_does_not_block(tmp_path):
    folder = tmp_path / "run"
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout is not None
    with other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UserError) as told, owned(folder):
            pytest.fail("two owners")
        assert f"out {str(folder)!r} is being written by process {other.pid} on " in str(told.value)
        assert len(str(told.value).splitlines()) == 1
        other.send_signal(signal.SIGKILL)
        other.wait()
    with owned(folder), pytest.raises(UserError, match=f"process {os.getpid()}"), owned(folder):
        pytest.fail("twice in one process")
    with pytest.raises(ZeroDivisionError), owned(folder):
        raise ZeroDivisionError  # an error lets go of it too
    with owned(folder):
        pass
    with owned(tmp_path / "tried"):
        pass
    assert not (tmp_path / "tried").exists()  # nothing came of it


def test_a_folder_without_room_is_refused_in_a_line(tmp_path):
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(small)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("a small disk cannot be mounted here (needs root)")
    try:
        (small / "run").mkdir()
        with contextlib.suppress(OSError), open(small / "filler", "wb", buffering=0) as filler:
            while True:
                filler.write(bytes(4096))
        with (
            pytest.raises(UserError, match="cannot be written: No space left"),
            owned(small / "run"),
        ):
            pytest.fail("owned without room")
        (small / "filler").unlink()
        with owned(small / "run"):
            pass
    finally:
        subprocess.run(["umount", str(small)], check=True)


def random_policy(activation, output):
    rng = np.random.default_rng(3)
    sizes = [(5, 8), (8, 8), (8, 2)]
    return SavedPolicy(
        weights=[(rng.normal(size=s) / 3, rng.normal(size=s[1]) / 3) for s in sizes],
        activation=activation,
        output=output,
        obs_mean=rng.normal(size=5),
        obs_scale=rng.uniform(0.5, 2.0, 5),
    )


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("output", ["tanh", "clip"])
def test_an_onnx_policy_acts_like_the_numpy_one(activation, output):
    runtime = pytest.importorskip("onnxruntime")
    policy = random_policy(activation, output)
    model = to_onnx(policy, {"env": "toy", "step": 7})
    session = runtime.InferenceSession(model.SerializeToString())
    observation = np.random.default_rng(4).normal(size=(6, 5)).astype(np.float32)
    (action,) = session.run(None, {"observation": observation})
    assert action.shape == (6, 2)
    expected = numpy_action(policy, observation)
    np.testing.assert_allclose(action, expected, atol=1e-5)
    assert expected.std() > 0.1
    assert {one.key: one.value for one in model.metadata_props} == {"env": '"toy"', "step": "7"}


@pytest.mark.parametrize("name", ["policy.pt", "policy", "policy.npz.gz", "policy.ONNX"])
def test_other_kinds_of_policy_files_are_refused(name, tmp_path):
    save_policy(tmp_path / "p.npz", random_policy("relu", "tanh"), {"env": "driving"})
    with pytest.raises(UserError, match=r"out must end in \.npz or \.onnx, got "):
        export(tmp_path / "p.npz", tmp_path / name)
    assert not (tmp_path / name).exists()


def logged(tmp_path):
    tmp_path.mkdir()
    folder = RunFolder(tmp_path)
    for step in (10, 20, 30):
        folder.append_metrics({"step": step, "done": step})
        folder.append_evaluation([{"step": step, "scenario": n, "success": 1} for n in (0, 1)])
    return folder


def texts(folder):
    return [(folder.path / name).read_text() for name in FILES]


FILES = ("metrics.jsonl", "evaluation.csv")


def test_rewinding_drops_what_is_later_and_what_was_cut_off(tmp_path):
    folder = logged(tmp_path / "a")
    before = texts(folder)
    for name, text, cut in zip(FILES, before, ('{"step": 40, "do', "40,0"), strict=True):
        (tmp_path / "a" / name).write_text(text + cut)
    folder.rewind(30, 30)
    assert texts(folder) == before
    folder.rewind(20, 20)
    assert [text.count("\n") for text in texts(folder)] == [2, 1 + 4]
    folder.append_metrics({"step": 30, "done": 30})
    folder.append_evaluation([{"step": 30, "scenario": n, "success": 1} for n in (0, 1)])
    assert texts(folder) == before


def test_rewinding_takes_what_another_program_wrote(tmp_path):
    folder = logged(tmp_path / "a")
    path = tmp_path / "a" / "evaluation.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()]
    lines = [";".join([row[2], row[0] + (".0" if i else ""), row[1]]) for i, row in enumerate(rows)]
    path.write_bytes("\r\n".join(["\ufeff" + lines[0], *lines[1:], ""]).encode())
    folder.rewind(20, 20)
    folder.append_evaluation([{"step": 30, "scenario": 0, "success": 0}])
    text = path.read_text()
    assert text == "success,step,scenario\n1,10.0,0\n1,10.0,1\n1,20.0,0\n1,20.0,1\n0,30,0\n"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("metrics.jsonl", "{}\n", "line 1 is no line of a run"),
        ("metrics.jsonl", '{"done": 10}\n[1]\n{"done": 30}\n', "line 2 is no line of a run"),
        ("evaluation.csv", "a,b\n1,2\n", "has no column 'step'"),
        ("evaluation.csv", "step,success\nx,1\n", "row 2: step must be a whole number"),
    ],
)
def test_rewinding_loses_nothing_of_what_it_does_not_know(name, content, said, tmp_path):
    folder = logged(tmp_path / "a")
    (tmp_path / "a" / name).write_text(content)
    before = texts(folder)
    with pytest.raises(UserError, match=said):
        folder.rewind(10, 10)
    assert texts(folder) == before
