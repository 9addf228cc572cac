"""What a page may say, and how it is checked. Nothing else of a message is believed."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

LONGEST = 4096  # bytes of a message
PER_SECOND, BURST = 100, 200  # messages that are read; the rest are dropped and counted
ORDERS = (
    "start",  # from the questions before, or after a pause
    "pause",
    "restart",  # leave the episode
    "practice",  # drive without teaching
    "save",
    "quit",
    "control",  # take the controls, where nobody has them
)


class Input(NamedTuple):
    """What the person's hands do.

    Attributes:
        seen: Number of the newest frame that the page has shown.
        takeover: Holding the controls.
        action: Each in [-1, 1].
    """

    seen: int
    takeover: bool
    action: tuple[float, ...]


class Order(NamedTuple):
    """Something to do, one of `ORDERS`."""

    order: str


class Consent(NamedTuple):
    """Whether the person agrees to the text that was shown."""

    agreed: bool


class Answers(NamedTuple):
    """Answers to the questions after an episode, by the questions' names."""

    answers: dict[str, str | float]


class Seek(NamedTuple):
    """Go to a step of a recording."""

    step: int


Message = Input | Order | Consent | Answers | Seek


class Malformed(ValueError):
    """A message that is not understood; says why in one line."""


def parse(text: str | bytes, action_size: int) -> Message:
    """A message of a page.

    Args:
        text: As it came.
        action_size: A of the world.

    Raises:
        Malformed: If it is not exactly one of the messages above.
    """
    if len(text) > LONGEST:
        raise Malformed(f"longer than {LONGEST} bytes")
    try:
        content = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise Malformed("not JSON") from error
    if not isinstance(content, dict):
        raise Malformed("not an object")
    kind = content.get("kind")
    if kind == "input":
        _only(content, {"kind", "seen", "takeover", "action"})
        return Input(
            _whole(content.get("seen")),
            _flag(content.get("takeover"), "takeover"),
            _action(content.get("action"), action_size),
        )
    if kind == "order":
        _only(content, {"kind", "order"})
        order = content.get("order")
        if not isinstance(order, str) or order not in ORDERS:
            raise Malformed(f"order must be one of {', '.join(ORDERS)}")
        return Order(order)
    if kind == "consent":
        _only(content, {"kind", "agreed"})
        return Consent(_flag(content.get("agreed"), "agreed"))
    if kind == "answers":
        _only(content, {"kind", "answers"})
        return Answers(_answers(content.get("answers")))
    if kind == "seek":
        _only(content, {"kind", "step"})
        return Seek(_whole(content.get("step")))
    raise Malformed("kind must be input, order, consent, answers or seek")


def _no_constant(name: str) -> float:
    raise ValueError(name)


def _only(content: dict[str, Any], fields: set[str]) -> None:
    if set(content) != fields:
        raise Malformed(f"needs the fields {', '.join(sorted(fields))} and no other")


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**31:
        raise Malformed("seen and step must be numbers of a frame")
    return value


def _flag(value: Any, name: str) -> bool:
    if not isinstance(value, bool):
        raise Malformed(f"{name} must be true or false")
    return value


def _number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value) if isinstance(value, float) else abs(value) < 2**31


def _action(value: Any, size: int) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != size or not all(map(_number, value)):
        raise Malformed(f"action must be {size} numbers")
    return tuple(min(1.0, max(-1.0, float(part))) for part in value)


def _answers(value: Any) -> dict[str, str | float]:
    if not isinstance(value, dict) or len(value) > 100:
        raise Malformed("answers must be an object")
    for name, answer in value.items():
        if len(name) > 64 or not (isinstance(answer, str) or _number(answer)):
            raise Malformed("an answer must be a text or a number")
        if isinstance(answer, str) and len(answer) > 2000:
            raise Malformed("an answer must not be longer than 2000 letters")
    return value


class Allowance:
    """How many messages a page may still send: `PER_SECOND`, in bursts up to `BURST`."""

    def __init__(self, now: float):
        self.left, self.then = float(BURST), now

    def take(self, now: float) -> bool:
        """Whether one more is read."""
        self.left = min(BURST, self.left + PER_SECOND * (now - self.then))
        self.then = now
        if self.left < 1.0:
            return False
        self.left -= 1.0
        return True
