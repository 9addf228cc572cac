"""Looking at a recorded session again, in the same page."""

from __future__ import annotations

import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.engine import recording
from experiments.engine.evaluate import make_env, run_physics
from experiments.engine.runtime import UserError
from experiments.ui.config import participant_of
from experiments.ui.play import web
from experiments.ui.protocol import Message, Order, Seek
from experiments.ui.session import Clock
from experiments.ui.views import Shown, View, display_of, make_view
from ppl_jax.types import Env


class Replay:
    """A recording as a `SessionBackend`.

    Attributes:
        stage: "ready", "running", "paused" or "stopped".
        at: The step to show next.
    """

    lingers = False

    def __init__(
        self,
        env: Env,
        columns: recording.Columns,
        config: dict[str, Any],
        *,
        view: View,
        publish: Callable[[dict[str, Any]], None],
        rate: float,
    ):
        like = jax.eval_shape(lambda key: env.reset(key, env.default_params)[1], jax.random.key(0))
        self.states = recording.states(columns, like)
        self.columns, self.config = columns, config
        self.view, self.publish, self.rate = view, publish, rate
        self.length = len(columns[recording.EPISODE])
        self.stage, self.at, self.frames = "ready", 0, 0
        self._episode: int | None = None
        self._inbox: queue.SimpleQueue[Message] = queue.SimpleQueue()
        columns_of = {"human": "is_intervention", "takeovers": "takeover_start", "cost": "cost"}
        self._sums = {name: np.cumsum(columns[column]) for name, column in columns_of.items()}
        ends = columns["terminated"] | columns["truncated"]
        self._sums |= {"episodes": np.cumsum(ends), "successes": np.cumsum(columns["success"])}

    def receive(self, message: Message) -> None:
        """Take a message of the page that has the controls."""
        self._inbox.put(message)

    def left(self) -> None:
        """No page is open."""
        self._inbox.put(Order("pause"))

    def stop(self) -> None:
        """End."""
        self._inbox.put(Order("quit"))

    def about(self) -> dict[str, Any]:
        """The first message to a page."""
        return {
            "kind": "about",
            "env": self.config["env"],
            "algorithm": self.config.get("algorithm", ""),
            "rate": self.rate,
            "total": self.length,
            "actions": self.columns["executed_action"].shape[1],
            "drawing": self.view.drawing,
            "azimuth": self.view.azimuth,
            "participant": participant_of(self.config),
            "replay": True,
        }

    def status(self) -> dict[str, Any]:
        """The message that shows the stage on a page."""
        return {"kind": "status", "stage": self.stage, "note": "", "in_a_row": 0} | {
            "familiarisation": 0
        }

    def _go(self, stage: str) -> None:
        self.stage = stage
        self.publish(self.status())

    def run(self) -> None:
        """Show the recording until a page quits."""
        clock = Clock(self.rate)
        clock.start()
        self._show()
        try:
            while self.stage != "stopped":
                self._orders()
                if self.stage != "running":
                    clock.start()
                    continue
                self._show()
                self.at += 1
                if self.at >= self.length:
                    self.at = self.length - 1
                    self._go("paused")
                clock.wait()
        finally:
            self.view.close()

    def _orders(self) -> None:
        wait = self.stage != "running"
        while True:
            try:
                message = self._inbox.get(timeout=0.2) if wait else self._inbox.get_nowait()
            except queue.Empty:
                return
            wait = False
            if isinstance(message, Seek):
                self.at = min(message.step, self.length - 1)
                self._show()
            elif message == Order("start") and self.stage != "running":
                self.at = 0 if self.at == self.length - 1 else self.at
                self._go("running")
            elif message == Order("pause") and self.stage == "running":
                self._go("paused")
            elif message == Order("restart"):
                self.at = 0
                self._show()
            elif message == Order("quit"):
                self._go("stopped")

    def _show(self) -> None:
        t, columns = self.at, self.columns
        state = jax.tree.map(lambda leaf: leaf[t], self.states)
        episode = int(columns[recording.EPISODE][t])
        if episode != self._episode:
            self._episode = episode
            self.publish({"kind": "scene"} | self.view.scene(state))
        shown = Shown(novice=columns[recording.AHEAD][t], fails=bool(columns[recording.FAILS][t]))
        self.frames += 1
        ended = None
        if columns["terminated"][t] | columns["truncated"][t]:
            ended = "success" if columns["success"][t] else "failure"
        frame = {
            "kind": "frame",
            "number": self.frames,
            "takeover": bool(columns["is_intervention"][t]),
            "step": t,
            "missed": 0,
            "ticks": 0,
            "late": 0,
            "losses": {},
            "ended": ended,
        }
        frame |= {name: round(float(sums[t]), 2) for name, sums in self._sums.items()}
        self.publish(frame | self.view.frame(state, shown))
        self.view.picture(self.frames, state, shown)


def replay(path: Path, host: str, port: int, exposed: bool = False) -> None:
    """Serve a recording until a page quits.

    Raises:
        UserError: If there is none, or the address is not available.
    """
    server = web()
    columns, config = recording.load(path)
    for column in (recording.AHEAD, recording.FAILS):
        if column not in columns:
            raise UserError(
                f"recording {str(path)!r} cannot be shown: it has no column {column!r}, which ppl "
                "play writes"
            )
    name = str(config.get("env"))
    try:
        rate = display_of(name).control_rate
    except UserError as error:
        raise UserError(f"recording {str(path)!r} cannot be shown: {error}") from error
    names = ("scenarios", "held_out_scenarios")
    options = {key: v for key in names if (v := config.get(key)) is not None}
    env = make_env(name, {"physics": run_physics(config), **options})
    with server.listen(host, port, exposed) as served:
        hub = server.Hub(env.spec.action_size)
        view = make_view(env, hub.picture)
        try:
            shown = Replay(env, columns, config, view=view, publish=hub.publish, rate=rate)
        except UserError as error:
            view.close()
            raise UserError(f"recording {str(path)!r} cannot be shown: {error}") from error
        server.serve(hub, shown, served, exposed=exposed)
