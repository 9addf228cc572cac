"""A session with a person: control, clock, questions and records.

The server owns the clock: in every tick the newest input counts, earlier ones are discarded.
Nothing here depends on the web; a test can play the person.
"""

from __future__ import annotations

import dataclasses
import queue
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.engine.files import as_json
from experiments.ui.config import SessionConfig
from experiments.ui.protocol import Answers, Consent, Input, Message, Order
from experiments.ui.trainer import InteractiveTrainer
from experiments.ui.views import Shown, View
from ppl_jax.interaction import Learner
from ppl_jax.types import Interaction

STALE = 0.5  # s without input from the page after which its hands count as off the controls
ANSWERS, CONSENT = "answers.jsonl", "consent.json"

Publish = Callable[[dict[str, Any]], None]
"""`publish(message)`: to every page."""


class Clock:
    """Ticks of a fixed length; a late one is counted, and not made up for.

    Attributes:
        ticks, missed: So far.
    """

    def __init__(self, rate: float):
        self.period, self.due = 1.0 / rate, 0.0
        self.ticks = self.missed = 0

    def start(self) -> None:
        """The first tick is now."""
        self.due = time.monotonic()

    def wait(self) -> None:
        """Sleep until the next tick."""
        self.ticks += 1
        self.due += self.period
        late = time.monotonic() - self.due
        if late > 0:
            self.missed += 1
            self.due += late
        else:
            time.sleep(-late)


class Session:
    """The session itself; `run` it in a thread of its own.

    Attributes:
        stage: "preparing", "consent", "ready", "practice", "running", "paused", "questions",
            "finished", "stopped" or "failed".
        late: Ticks for which no input had come from the page since the one before.
    """

    def __init__(
        self,
        trainer: InteractiveTrainer,
        view: View,
        session_config: SessionConfig,
        publish: Publish,
        *,
        tell: Callable[[str], None] = print,
    ):
        self.trainer, self.view, self.session_config = trainer, view, session_config
        self.publish, self.tell = publish, tell
        self.clock, self.stage, self.note = Clock(session_config.rate), "preparing", ""
        self.late = self.frames = 0
        self.in_a_row = 0
        self._inbox: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._hands: tuple[Input, float] | None = None
        self._fresh = False
        self._sent: dict[int, float] = {}
        self._spare: Learner | None = None
        self._agreed = session_config.consent is None
        self._tick_ms = 0.0

    @property
    def lingers(self) -> bool:
        """Whether the page stays open, for its result to be read."""
        return self.stage == "finished"

    # from outside, in any thread

    def receive(self, message: Message) -> None:
        """Take a message of the page that has the controls."""
        if isinstance(message, Input):
            self._hands, self._fresh = (message, time.monotonic()), True
        else:
            self._inbox.put(message)

    def left(self) -> None:
        """The page that had the controls is gone."""
        self._hands = None
        self._inbox.put(Order("pause"))

    def stop(self) -> None:
        """Save and end."""
        self._inbox.put(Order("quit"))

    # the session

    def run(self) -> None:
        """Prepare, then run until it is complete or the person quits."""
        try:
            self.trainer.prepare(self._preparing)
            self._ready()
            while self.stage not in ("stopped", "finished"):
                self._orders()
                if self.stage in ("running", "practice"):
                    self._tick()
                    self.clock.wait()
        except Exception as error:
            self._go("failed", f"{type(error).__name__}: {str(error).splitlines()[0]}")
            raise
        finally:
            self.trainer.close()
            self.view.close()

    def _preparing(self, line: str) -> None:
        self.tell(line)
        self._go("preparing", line)

    def _go(self, stage: str, note: str = "") -> None:
        self.stage, self.note = stage, note
        self.publish(self.status())

    def status(self) -> dict[str, Any]:
        """The message that shows the stage on a page."""
        config = self.session_config
        more: dict[str, Any] = {}
        if self.stage == "consent":
            more["text"] = config.consent
        if self.stage == "questions":
            more["questions"] = [dataclasses.asdict(question) for question in config.questions]
        return {
            "kind": "status",
            "stage": self.stage,
            "note": self.note,
            "in_a_row": self.in_a_row,
            "familiarisation": config.familiarisation,
            **more,
        }

    def about(self) -> dict[str, Any]:
        """The first message to a page."""
        settings = self.trainer.settings
        return {
            "kind": "about",
            "env": settings.env,
            "algorithm": settings.algorithm,
            "rate": self.session_config.rate,
            "total": settings.config.total_steps,
            "horizon": settings.config.prediction_horizon,
            "actions": self.trainer.env.spec.action_size,
            "drawing": self.view.drawing,
            "azimuth": self.view.azimuth,
            "participant": self.session_config.participant,
        }

    def _ready(self) -> None:
        if not self._agreed:
            self._go("consent")
        elif self.trainer.complete:
            self._finish()
        elif self.in_a_row < self.session_config.familiarisation and self.trainer.steps == 0:
            self._practise()
        else:
            self._show(self.trainer.learner)
            self._go("ready")

    def _practise(self) -> None:
        self._spare = self.trainer.spare()
        self._show(self._spare)
        self.clock.start()
        self._go("practice")

    def _orders(self) -> None:
        """Follow the orders so far; while the clock stands, wait for one."""
        standing = self.stage not in ("running", "practice")
        while True:
            try:
                message = self._inbox.get(timeout=0.2) if standing else self._inbox.get_nowait()
            except queue.Empty:
                return
            self._do(message)
            standing = False

    def _do(self, message: Message | None) -> None:
        stage = self.stage
        if isinstance(message, Order):
            self._obey(message.order)
        elif isinstance(message, Consent) and stage == "consent":
            self._consent(message.agreed)
        elif isinstance(message, Answers) and stage == "questions":
            self._answered(message.answers)

    def _obey(self, order: str) -> None:
        stage = self.stage
        if order == "quit":
            self._stop()
        elif order == "pause" and stage in ("running", "practice"):
            self._go("paused")
        elif order == "start" and stage in ("ready", "paused", "practice"):
            self._start()
        elif order == "practice" and stage in ("ready", "paused", "running"):
            self._practise()
        elif order == "restart" and stage in ("running", "paused"):
            self.trainer.restart()
            self._show(self.trainer.learner)
        elif order == "save" and stage in ("ready", "running", "paused"):
            self.trainer.save()
            self._go(stage, "saved")

    def _start(self) -> None:
        if self.stage == "practice" and self.in_a_row < self.session_config.familiarisation:
            return  # not yet
        if self._spare is not None and self.stage == "paused" and self._to_practise():
            self._practise()
            return
        self._spare = None
        self._show(self.trainer.learner)
        self.clock.start()
        self._go("running")

    def _to_practise(self) -> bool:
        return self.in_a_row < self.session_config.familiarisation and self.trainer.steps == 0

    def _consent(self, agreed: bool) -> None:
        self._write(CONSENT, {"participant": self.session_config.participant, "agreed": agreed})
        if not agreed:
            self._stop()
            return
        self._agreed = True
        self._ready()

    def _answered(self, answers: dict[str, str | float]) -> None:
        known = {question.name for question in self.session_config.questions}
        kept = {name: answer for name, answer in answers.items() if name in known}
        counters = self.trainer.learner.counters
        self._write(
            ANSWERS,
            {"step": self.trainer.steps, "episodes": int(counters.episodes), "answers": kept},
        )
        self.clock.start()
        self._go("running")

    def _write(self, name: str, row: dict[str, Any]) -> None:
        with open(self.trainer.folder.path / name, "a") as file:
            file.write(as_json(row | {"time": round(time.time(), 3)}) + "\n")

    # a tick

    def _take(self) -> tuple[bool, np.ndarray, dict[str, Any]]:
        """The person's input now: in control, action, and how old the input is."""
        size, now = self.trainer.env.spec.action_size, time.monotonic()
        hands, fresh = self._hands, self._fresh
        self._fresh = False
        late = not fresh
        self.late += late
        about: dict[str, Any] = {"time": round(time.time(), 3), "late": late}
        about["tick_ms"] = round(self._tick_ms, 2)
        if hands is None or now - hands[1] > STALE:
            return False, np.zeros(size, np.float32), about
        newest, at = hands
        about["age_ms"] = round(1000 * (now - at), 1)
        if newest.seen in self._sent:
            about["trip_ms"] = round(1000 * (at - self._sent[newest.seen]), 1)
        return newest.takeover, np.asarray(newest.action, np.float32), about

    def _tick(self) -> None:
        began = time.monotonic()
        takeover, action, about = self._take()
        if self.stage == "practice":
            self._practice_tick(action)
        else:
            self._training_tick(takeover, action, about)
        self._tick_ms = 1000 * (time.monotonic() - began)

    def _training_tick(self, takeover: bool, action: np.ndarray, about: dict[str, Any]) -> None:
        trainer = self.trainer
        takeover = takeover or trainer.manual
        mine = trainer.predict_path(trainer.learner, action).path if takeover else None
        step = trainer.step(takeover, action, about)
        self._show(trainer.learner, step, takeover=takeover, mine=mine)
        if trainer.fits_next:
            self._go("preparing", "learning from your demonstrations")
            trainer.learn()
            self._go("running")
            self.clock.start()
        else:
            trainer.learn()
        if trainer.complete:
            self._finish()
        elif (step.terminated | step.truncated) and self.session_config.questions:
            self._go("questions")

    def _practice_tick(self, action: np.ndarray) -> None:
        assert self._spare is not None
        mine = self.trainer.predict_path(self._spare, action).path
        self._spare, step = self.trainer.practise(self._spare, True, action)
        done = bool(step.terminated | step.truncated)
        self._show(self._spare, step, takeover=True, mine=mine)
        if not done:
            return
        self.in_a_row = self.in_a_row + 1 if bool(step.success) else 0
        if (
            self.session_config.familiarisation
            and self.in_a_row == self.session_config.familiarisation
        ):
            self._go("paused", f"{self.in_a_row} in a row, well done: from now on, steps count")
        else:
            self._go("practice")

    def _show(
        self,
        learner: Learner,
        step: Interaction | None = None,
        *,
        takeover: bool = False,
        mine: np.ndarray | None = None,
    ) -> None:
        """Publish a frame, and the scene at the start of an episode."""
        state, counters = learner.env_state, learner.counters
        done = step is not None and bool(step.terminated | step.truncated)
        if done or step is None:
            mine = None
            self.publish({"kind": "scene"} | self.view.scene(state))
        novice = None if self.stage == "practice" else self.trainer.ahead
        shown = Shown(
            novice=None if novice is None else novice.path,
            fails=novice is not None and novice.fails,
            mine=mine,
        )
        self.frames += 1
        steps, human = int(counters.steps), int(counters.human_data)
        ended = None
        if step is not None and done:
            ended = "success" if bool(step.success) else "failure"
        frame = {
            "kind": "frame",
            "number": self.frames,
            "takeover": takeover,
            "step": steps,
            "human": human,
            "takeovers": int(counters.takeovers),
            "episodes": int(counters.episodes),
            "successes": int(counters.successes),
            "cost": round(float(counters.cost), 2),
            "missed": self.clock.missed,
            "ticks": self.clock.ticks,
            "late": self.late,
            "losses": {name: round(value, 4) for name, value in self.trainer.losses.items()},
            "ended": ended,
        }
        self._sent[self.frames] = time.monotonic()
        self._sent.pop(self.frames - 100, None)
        self.publish(frame | self.view.frame(state, shown))
        self.view.picture(self.frames, state, shown)

    # the end

    def _figures(self) -> dict[str, Any]:
        ticks = max(self.clock.ticks, 1)
        return {
            "participant": self.session_config.participant,
            "ticks": self.clock.ticks,
            "missed_ticks": self.clock.missed,
            "missed_share": round(self.clock.missed / ticks, 5),
            "late_inputs": self.late,
        }

    def _finish(self) -> None:
        self._go("finished", "evaluating the policy")
        self.trainer.close()
        scores = self.trainer.evaluate() if self.session_config.evaluate else {}
        self.trainer.summary(scores, self._figures())
        note = "complete"
        if scores:
            note = (
                f"complete: without you it succeeds in {scores['success_rate']:.0%} of "
                f"{int(scores['episodes'])} new scenarios"
            )
        self._go("finished", note)
        self.tell(note)

    def _stop(self) -> None:
        self.trainer.close()
        if self.trainer.steps:
            self.trainer.summary({}, self._figures())
        self._go("stopped", "saved: continue with --resume")
