"""SIGKILL at random moments and a disk that fills: what is resumed ends like what never stopped."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.helpers import PROGRAM, ROOT

CUTS = 20
SIZES = ["--batch-size", "8", "--hidden", "16", "--human-capacity", "400"]
STUDY = ["--total-steps", "200", "--evaluate-every", "100", "--processes", "1"]
COMMANDS = {
    "train": ["train", "probe", "--total-steps", "400", "--evaluate-every", "20", *SIZES],
    "sweep": ["sweep", "probe", "--beta", "0.1", "0.3", "--seeds", "8", *STUDY],
    "compare": ["compare", "probe", "--algorithms", "ppl", "hg_dagger", "--seeds", "8", *STUDY],
    "play": [],
}
SESSION = """
import sys
from pathlib import Path
import numpy as np
from experiments.engine.ownership import owned
from experiments.engine.run import open_folder
from experiments.engine.run_folder import CONFIG, RunFolder
from experiments.engine.settings import RunSettings
from experiments.ui.trainer import InteractiveTrainer
from tests.helpers import Probe, plain_settings

settings = RunSettings("probe", "ppl", 0, *plain_settings(
    "ppl", total_steps=400, batch_size=8, hidden=(16,), prediction_horizon=6, decision_interval=5,
    max_preference_horizon=6, human_capacity=400, preference_capacity=1000), expert="person")
folder = RunFolder(sys.argv[sys.argv.index("--out") + 1])
with owned(folder.path):
    open_folder(folder, settings.as_json(), (folder.path / CONFIG).exists())
    made = InteractiveTrainer(settings, folder, Probe(), lambda state: state.error[None])
    made.prepare(lambda line: None)
    for t in range(made.steps, 400):
        made.step(t % 7 < 4, np.array([np.sin(t)], np.float32), {})
        made.learn()
        if t % 10 == 9:
            made.save(wait=True)
            print("saved", flush=True)
    made.close()
    made.summary(made.evaluate(), {})
"""


class Command:
    """One of the commands, in a folder of its own; begun or, where its folder is there, resumed."""

    def __init__(self, name, tmp_path):
        self.name, self.script = name, tmp_path / f"{name}.py"
        self.script.write_text(SESSION if name == "play" else PROGRAM)

    def start(self, out):
        words = [*COMMANDS[self.name], "--out", str(out)]
        if self.name == "train" and (out / "config.json").exists():
            words = ["train", "--resume", "--out", str(out)]
        return subprocess.Popen(
            [sys.executable, str(self.script), *words],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def finish(self, out, code=0):
        process = self.start(out)
        _, told = process.communicate(timeout=600)
        assert process.returncode == code, told
        return told

    def files(self, out):
        """What a folder holds, but for what a clock says and the learner's own files."""
        found = {}
        for path in sorted(out.rglob("*")):
            name = str(path.relative_to(out))
            if path.is_dir() or name.startswith("checkpoints") or name in _NOT_COMPARED:
                continue
            found[name] = path.read_bytes()
        for name in ("metrics.jsonl", "summary.json"):
            if name in found:
                clock = rb'"(time/\w+|wall_s|compile_s|steps_per_s)": [0-9.]+'
                found[name] = re.sub(clock, b"", found[name])
        if self.name != "play":
            return found
        columns = [np.load(path) for path in sorted((out / "recording").glob("*.npz"))]
        names = [name for name in columns[0].files if name != "next_episode"]
        whole = {name: np.concatenate([part[name] for part in columns]) for name in names}
        kept = {name: whole[name].tobytes() for name in names}  # in whatever pieces
        rest = {name: data for name, data in found.items() if not name.startswith("recording")}
        return kept | {name: rest[name] for name in ("evaluation.csv", "policy.npz")}


_NOT_COMPARED = (".lock", "workers.log", "sweep.json", "config.json")


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_killed_at_twenty_moments_all_ends_whole(name, tmp_path):
    rng, command = np.random.default_rng(sum(map(ord, name))), Command(name, tmp_path)
    command.finish(tmp_path / "warm")  # what is compiled now is not compiled again
    began = time.monotonic()
    command.finish(tmp_path / "whole")
    lasts, whole = time.monotonic() - began, command.files(tmp_path / "whole")
    cuts = folders = 0
    while cuts < CUTS:
        folders += 1
        out = tmp_path / f"cut-{folders}"
        while cuts < CUTS:
            process = command.start(out)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(rng.uniform(0.2, 1.0) * lasts)
            if process.poll() is not None:
                _, told = process.communicate()
                assert process.returncode == 0, told
                break  # it came to its end: another folder
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            cuts += 1
        command.finish(out)
        assert command.files(out) == whole
    print(f"{name}: {cuts} cuts in {folders} folders, all whole; uncut it lasts {lasts:.0f} s")


@contextlib.contextmanager
def small_disk(place, size):
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    if subprocess.run(words, capture_output=True).returncode:
        pytest.skip("a small disk cannot be mounted here (needs root)")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_that_fills_costs_nothing_that_was_saved(name, tmp_path):
    command, disk = Command(name, tmp_path), tmp_path / "disk"
    command.finish(tmp_path / "whole")
    with small_disk(disk, "8m"):
        out = disk / "out"
        process = command.start(out)
        first = {"train": "policy.npz", "play": "policy.npz"}.get(name, "results.csv")
        while not (out / first).is_file() and process.poll() is None:
            time.sleep(0.01)
        filler = open(disk / "filler", "wb", buffering=0)  # noqa: SIM115 - closed below
        with filler, contextlib.suppress(OSError):
            while process.poll() is None:
                filler.write(bytes(4096))
        _, told = process.communicate(timeout=300)
        if name != "play":  # the page tells a person; here it is a traceback of the script
            lines = [line for line in told.splitlines() if line.startswith("error: ")]
            assert process.returncode == 1, told
            assert len(lines) == 1, told
            assert "no space left on device" in lines[0].lower()
        assert process.returncode
        kept = {path for path in out.rglob("*") if path.is_file()}
        (disk / "filler").unlink()
        command.finish(out)
        assert kept
        assert command.files(out) == command.files(tmp_path / "whole")
