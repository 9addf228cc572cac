"""A real browser plays a session: keys, a gamepad, a lost connection."""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from experiments.engine import recording

ROOT = Path(__file__).parent.parent.parent

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install chromium")
playwright = pytest.importorskip("playwright.sync_api")

# a pad of the Xbox layout whose levers the test moves
PAD = """
window.pad = { id: "Test pad", connected: true, mapping: "standard", axes: [0, 0, 0, 0],
  buttons: Array.from({ length: 17 }, () => ({ pressed: false, value: 0 })) };
window.press = (button, value) => { pad.buttons[button] = { pressed: value > 0, value }; };
navigator.getGamepads = () => [window.plugged ? window.pad : null];
"""


@contextmanager
def playing(out, *words):
    """A session in a process of its own, and its page; ended if the test did not."""
    command = [sys.executable, "-m", "experiments.cli", *words, "--port", "0"]
    if out is not None:
        command += ["--out", str(out)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    try:
        address = next(
            m[0] for line in process.stdout or () if (m := re.search(r"http://\S+", line))
        )
        with playwright.sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            page.set_default_timeout(240_000)
            page.add_init_script(PAD)
            page.mistakes = []
            page.on("pageerror", lambda error: page.mistakes.append(str(error)))
            page.on("console", lambda line: page.mistakes.append(line.text))
            page.goto(address)
            yield page, process
            browser.close()
    finally:
        if process.poll() is None:
            process.terminate()
        process.communicate(timeout=60)


def stage(page, heading):
    page.wait_for_selector(f"#panel h2:text-is('{heading}')")


def figure(page, name):
    return page.inner_text(f"#figures div:has(dt:text-is('{name}')) dd")


def number(page, name):
    found = re.match(r"[-\d.]+", figure(page, name))
    assert found is not None
    return float(found[0])


def until(page, name, least):
    page.wait_for_function(
        """([name, least]) => [...document.querySelectorAll("#figures div")].some((cell) =>
            cell.querySelector("dt").textContent === name &&
            parseFloat(cell.querySelector("dd").textContent) >= least)""",
        arg=[name, least],
    )


def test_a_person_drives_with_keys_and_a_gamepad(tmp_path):
    out = tmp_path / "run"
    words = ["play", "driving", "--total-steps", "240", "--no-evaluate", "--participant", "p1"]
    with playing(out, *words) as (page, process):
        stage(page, "Ready")
        assert "p1" in page.inner_text("#title")
        page.keyboard.press("Enter")
        until(page, "step", 5)
        assert page.inner_text("#who") == "the novice is in control"
        page.keyboard.down("Space")
        page.keyboard.down("ArrowUp")
        until(page, "speed", 15)  # the car reacts
        assert page.inner_text("#who") == "YOU are in control"
        page.keyboard.up("ArrowUp")
        page.keyboard.up("Space")
        page.wait_for_function(
            "() => document.getElementById('who').textContent.includes('novice')"
        )
        assert number(page, "takeovers") >= 1
        page.wait_for_function(
            "() => document.getElementById('lossnote').textContent.includes(':')"
        )

        # the connection is lost: the clock stands, and nothing is lost with it
        page.reload()
        stage(page, "Paused")
        before = number(page, "step")
        page.wait_for_timeout(500)
        assert number(page, "step") == before
        page.keyboard.press("Enter")

        # a gamepad, held by its right shoulder button, steering hard to the right
        page.evaluate("window.plugged = true; press(5, 1); pad.axes[0] = 1; press(7, 0.5)")
        page.wait_for_function("() => document.getElementById('who').textContent.includes('YOU')")
        page.wait_for_timeout(1500)
        page.evaluate("press(5, 0); pad.axes[0] = 0; press(7, 0)")
        page.wait_for_selector("#mapping button")  # its layout is shown, to be changed
        page.screenshot(path=tmp_path / "pad.png")
        page.keyboard.press("KeyP")
        stage(page, "Paused")
        page.click("#mapping button >> nth=1")
        page.evaluate("press(3, 1)")
        page.wait_for_selector("#mapping button:text-is('button 3')")
        page.evaluate("press(3, 0)")

        # the button that pauses continues again
        page.evaluate("press(9, 1)")
        page.wait_for_selector("#panel", state="hidden")
        page.evaluate("press(9, 0)")
        page.wait_for_timeout(300)
        page.evaluate("press(9, 1)")
        stage(page, "Paused")
        page.evaluate("press(9, 0)")
        page.keyboard.press("Enter")
        stage(page, "Done")
        assert not page.mistakes
        page.keyboard.press("KeyQ")
        assert process.wait(60) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["total_steps"] == 240
    assert summary["participant"] == "p1"
    columns, _ = recording.load(out)
    mine = columns["is_intervention"]
    assert 20 < mine.sum() == summary["human_data_usage"] < 240
    assert columns["executed_action"][mine][:, 1].max() == 1.0  # the key's full throttle
    assert columns["executed_action"][mine][:, 0].min() < -0.9  # the stick, hard to the right
    lines = [json.loads(line) for line in (out / "session.jsonl").read_text().splitlines()]
    trips = [line["trip_ms"] for line in lines if "trip_ms" in line]
    assert 0 < np.median(trips) < 200
    assert (out / "policy.npz").is_file()


def test_the_arm_is_shown_and_a_recording_replayed(tmp_path):
    out = tmp_path / "run"
    words = ["play", "table_wiping", "--total-steps", "80", "--no-evaluate"]
    with playing(out, *words) as (page, process):
        stage(page, "Ready")
        page.keyboard.press("Enter")
        page.keyboard.down("Space")
        page.keyboard.down("KeyF")
        page.wait_for_function("() => document.getElementById('picture').naturalWidth === 640")
        stage(page, "Done")
        assert not page.mistakes
        page.keyboard.press("KeyQ")
        assert process.wait(60) == 0
    with playing(None, "replay", str(out)) as (page, process):
        page.wait_for_function("() => document.getElementById('picture').naturalWidth === 640")
        page.keyboard.press("Enter")
        until(page, "step", 5)
        page.keyboard.press("KeyP")
        page.fill("#seek", "60")
        until(page, "step", 60)
        assert number(page, "step") == 60
        page.keyboard.press("KeyQ")
        assert process.wait(60) == 0
        assert not page.mistakes


@pytest.mark.slow
@pytest.mark.parametrize(("world", "steps"), [("driving", 6000), ("table_wiping", 12_000)])
def test_the_clock_holds_for_ten_minutes_of_learning(tmp_path, world, steps):
    out = tmp_path / "run"
    words = ["play", world, "--total-steps", str(steps), "--no-evaluate"]
    with playing(out, *words) as (page, process):
        stage(page, "Ready")
        page.keyboard.press("Enter")
        while page.is_hidden("#panel h2:text-is('Done')"):
            for key in ("Space", "ArrowUp"):
                page.keyboard.down(key)
            page.wait_for_timeout(2000)
            for key in ("Space", "ArrowUp"):
                page.keyboard.up(key)
            page.wait_for_timeout(4000)
        page.keyboard.press("KeyQ")
        assert process.wait(60) == 0
        assert not page.mistakes
    summary = json.loads((out / "summary.json").read_text())
    print({name: summary[name] for name in ("missed_share", "late_inputs", "human_data_usage")})
    assert summary["total_steps"] == steps
    assert summary["missed_share"] < 0.01
