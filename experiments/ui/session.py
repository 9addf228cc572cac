"""A sitting with a person: who has control, when the clock runs, what is asked and what is kept.

The server owns the clock: in every tick the newest hands count, whatever came before them is gone.
Nothing here knows of the web; a test can be the person.
"""

from __future__ import annotations

import dataclasses
import json
import queue
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.ui.protocol import Answers, Consent, Input, Message, Order
from experiments.ui.trainer import InteractiveTrainer
from experiments.ui.views import Shown, View
from ppl_jax.interaction import Learner
from ppl_jax.types import Interaction

STALE = 0.5  # s without a word from the page after which its hands count as off the controls
ANSWERS, CONSENT = "answers.jsonl", "consent.json"

Publish = Callable[[dict[str, Any]], None]
"""`publish(message)`: to every page."""


@dataclasses.dataclass(frozen=True)
class Question:
    """Something to ask after an episode.

    Attributes:
        name: Of its answers.
        text: As shown.
        choices: To choose from; any text where empty.
    """

    name: str
    text: str
    choices: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class SessionConfig:
    """How a session goes.

    Attributes:
        rate: Steps per second.
        participant: Who it is, as in the study's list; may be empty.
        consent: Text to agree to before anything starts, or None.
        familiarisation: Successes in a row, driving alone, before it counts.
        questions: Asked after every episode.
        evaluate: Play the held-out scenarios at the end.
    """

    rate: float
    participant: str = ""
    consent: str | None = None
    familiarisation: int = 0
    questions: tuple[Question, ...] = ()
    evaluate: bool = True


class Clock:
    """Ticks of a fixed length; one that comes too late is counted, and not made up for.

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
    """The sitting itself; `run` it in a thread of its own.

    Attributes:
        stage: "preparing", "consent", "ready", "practice", "running", "paused", "questions",
            "finished", "stopped" or "failed".
        late: Ticks for which no word had come from the page since the last one.
    """

    def __init__(
        self,
        trainee: InteractiveTrainer,
        view: View,
        sitting: SessionConfig,
        publish: Publish,
        tell: Callable[[str], None] = print,
    ):
        self.trainee, self.view, self.sitting = trainee, view, sitting
        self.publish, self.tell = publish, tell
        self.clock, self.stage, self.note = Clock(sitting.rate), "preparing", ""
        self.late = self.frames = 0
        self.in_a_row = 0
        self._inbox: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._hands: tuple[Input, float] | None = None
        self._fresh = False
        self._sent: dict[int, float] = {}
        self._spare: Learner | None = None
        self._agreed = sitting.consent is None
        self._tick_ms = 0.0

    @property
    def lingers(self) -> bool:
        """Its result is still to be read when it is over."""
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

    # the sitting

    def run(self) -> None:
        """Prepare, then go on until it is complete or the person has had enough."""
        try:
            self.trainee.prepare(self._preparing)
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
            self.trainee.close()
            self.view.close()

    def _preparing(self, what: str) -> None:
        self.tell(what)
        self._go("preparing", what)

    def _go(self, stage: str, note: str = "") -> None:
        self.stage, self.note = stage, note
        self.publish(self.status())

    def status(self) -> dict[str, Any]:
        """What a page has to know to show the stage."""
        sitting = self.sitting
        more: dict[str, Any] = {}
        if self.stage == "consent":
            more["text"] = sitting.consent
        if self.stage == "questions":
            more["questions"] = [dataclasses.asdict(question) for question in sitting.questions]
        return {
            "kind": "status",
            "stage": self.stage,
            "note": self.note,
            "in_a_row": self.in_a_row,
            "familiarisation": sitting.familiarisation,
            **more,
        }

    def about(self) -> dict[str, Any]:
        """What a page has to know first."""
        settings = self.trainee.settings
        return {
            "kind": "about",
            "env": settings.env,
            "algorithm": settings.algorithm,
            "rate": self.sitting.rate,
            "total": settings.config.total_steps,
            "horizon": settings.config.prediction_horizon,
            "actions": self.trainee.env.spec.action_size,
            "azimuth": self.view.azimuth,
            "participant": self.sitting.participant,
        }

    def _ready(self) -> None:
        if not self._agreed:
            self._go("consent")
        elif self.trainee.complete:
            self._finish()
        elif self.in_a_row < self.sitting.familiarisation and self.trainee.steps == 0:
            self._practise()
        else:
            self._show(self.trainee.learner)
            self._go("ready")

    def _practise(self) -> None:
        self._spare = self.trainee.spare()
        self._show(self._spare)
        self.clock.start()
        self._go("practice")

    def _orders(self) -> None:
        """Do what was asked; where the clock stands, wait for something."""
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
            self.trainee.restart()
            self._show(self.trainee.learner)
        elif order == "save" and stage in ("ready", "running", "paused"):
            self.trainee.save()
            self._go(stage, "saved")

    def _start(self) -> None:
        if self.stage == "practice" and self.in_a_row < self.sitting.familiarisation:
            return  # not yet
        if self._spare is not None and self.stage == "paused" and self._to_practise():
            self._practise()
            return
        self._spare = None
        self._show(self.trainee.learner)
        self.clock.start()
        self._go("running")

    def _to_practise(self) -> bool:
        return self.in_a_row < self.sitting.familiarisation and self.trainee.steps == 0

    def _consent(self, agreed: bool) -> None:
        self._write(CONSENT, {"participant": self.sitting.participant, "agreed": agreed})
        if not agreed:
            self._stop()
            return
        self._agreed = True
        self._ready()

    def _answered(self, answers: dict[str, str | float]) -> None:
        known = {question.name for question in self.sitting.questions}
        kept = {name: answer for name, answer in answers.items() if name in known}
        counters = self.trainee.learner.counters
        self._write(
            ANSWERS,
            {"step": self.trainee.steps, "episodes": int(counters.episodes), "answers": kept},
        )
        self.clock.start()
        self._go("running")

    def _write(self, name: str, row: dict[str, Any]) -> None:
        with open(self.trainee.folder.path / name, "a") as file:
            file.write(json.dumps(row | {"time": round(time.time(), 3)}) + "\n")

    # a tick

    def _take(self) -> tuple[bool, np.ndarray, dict[str, Any]]:
        """The person's hands now: in control, action, and how fresh that is."""
        size, now = self.trainee.env.spec.action_size, time.monotonic()
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
        trainee = self.trainee
        takeover = takeover or trainee.manual
        mine = trainee.predict_path(trainee.learner, action).path if takeover else None
        step = trainee.step(takeover, action, about)
        self._show(trainee.learner, step, takeover, mine)
        if trainee.fits_next:
            self._go("preparing", "learning from what you have shown")
            trainee.learn()
            self._go("running")
            self.clock.start()
        else:
            trainee.learn()
        if trainee.complete:
            self._finish()
        elif (step.terminated | step.truncated) and self.sitting.questions:
            self._go("questions")

    def _practice_tick(self, action: np.ndarray) -> None:
        assert self._spare is not None
        mine = self.trainee.predict_path(self._spare, action).path
        self._spare, step = self.trainee.practise(self._spare, True, action)
        done = bool(step.terminated | step.truncated)
        self._show(self._spare, step, True, mine)
        if not done:
            return
        self.in_a_row = self.in_a_row + 1 if bool(step.success) else 0
        if self.sitting.familiarisation and self.in_a_row == self.sitting.familiarisation:
            self._go("paused", f"{self.in_a_row} in a row: well done, now it counts")
        else:
            self._go("practice")

    def _show(
        self,
        learner: Learner,
        step: Interaction | None = None,
        takeover: bool = False,
        mine: np.ndarray | None = None,
    ) -> None:
        """Publish a frame, with the scene where it is another one."""
        state, counters = learner.env_state, learner.counters
        done = step is not None and bool(step.terminated | step.truncated)
        if done or step is None:
            mine = None
            self.publish({"kind": "scene"} | self.view.scene(state))
        novice = None if self.stage == "practice" else self.trainee.ahead
        shown = Shown(
            None if novice is None else novice.path, novice is not None and novice.fails, mine
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
            "losses": {name: round(value, 4) for name, value in self.trainee.losses.items()},
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
            "participant": self.sitting.participant,
            "ticks": self.clock.ticks,
            "missed_ticks": self.clock.missed,
            "missed_share": round(self.clock.missed / ticks, 5),
            "late_inputs": self.late,
        }

    def _finish(self) -> None:
        self._go("finished", "evaluating what it has learnt")
        self.trainee.close()
        scores = self.trainee.evaluate() if self.sitting.evaluate else {}
        self.trainee.summary(scores, self._figures())
        note = "complete"
        if scores:
            note = (
                f"complete: without you it succeeds in {scores['success_rate']:.0%} of "
                f"{int(scores['episodes'])} new scenarios"
            )
        self._go("finished", note)
        self.tell(note)

    def _stop(self) -> None:
        self.trainee.close()
        if self.trainee.steps:
            self.trainee.summary({}, self._figures())
        self._go("stopped", "saved: go on with --resume")
