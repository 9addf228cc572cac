"""Messages that a page may send, and how they are checked. Nothing else of a message is used."""

from __future__ import annotations

import re
from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta

LONGEST = 4096  # bytes of a message
PER_SECOND, BURST = 100, 200  # messages that are read; the rest are dropped and counted

OrderName = Literal[
    "start",  # from the questions before, or after a pause
    "pause",
    "restart",  # leave the episode
    "practice",  # drive without teaching
    "save",
    "quit",
    "control",  # take the controls, where nobody has them
]
ORDERS: tuple[str, ...] = get_args(OrderName)

FrameNumber = Annotated[int, Meta(ge=0, lt=2**31)]
Name = Annotated[str, Meta(max_length=64)]
Answer = Annotated[str, Meta(max_length=2000)] | int | float


class _Message(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag=str.lower
):
    """A JSON object whose "kind" is the name of its class in small letters."""


class Input(_Message, frozen=True):
    """State of the person's controls.

    Attributes:
        seen: Number of the newest frame that the page has shown.
        takeover: Holding the controls.
        action: Each in [-1, 1].
    """

    seen: FrameNumber
    takeover: bool
    action: tuple[float, ...]


class Order(_Message, frozen=True):
    """Something to do, one of `ORDERS`."""

    order: OrderName


class Consent(_Message, frozen=True):
    """Whether the person agrees to the text that was shown."""

    agreed: bool


class Answers(_Message, frozen=True):
    """Answers to the questions after an episode, by the questions' names."""

    answers: Annotated[dict[Name, Answer], Meta(max_length=100)]


class Seek(_Message, frozen=True):
    """Go to a step of a recording."""

    step: FrameNumber


Message = Input | Order | Consent | Answers | Seek

_DECODER = msgspec.json.Decoder(Message)
_ALLOWED = {
    "kind": "input, order, consent, answers or seek",
    "seen": "the number of a frame",
    "step": "the number of a step",
    "takeover": "true or false",
    "agreed": "true or false",
    "action": "a list of finite numbers",
    "order": f"one of {', '.join(ORDERS)}",
    "answers": "an object of at most 100 texts (of at most 2000 letters) or numbers",
}
_FIELD = re.compile(r"`\$\.(\w+)")


class Malformed(ValueError):
    """A message that is not understood; says why in one line."""


def parse(text: str | bytes, action_size: int) -> Message:
    """A message of a page.

    Args:
        text: As it came.
        action_size: A of the env.

    Raises:
        Malformed: If it is not exactly one of the messages above.
    """
    if len(text) > LONGEST:
        raise Malformed(f"longer than {LONGEST} bytes")
    try:
        message = _DECODER.decode(text)
    except msgspec.ValidationError as error:
        raise Malformed(_reason(error)) from error
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise Malformed("not JSON") from error
    if not isinstance(message, Input):
        return message
    if len(message.action) != action_size:
        raise Malformed(f"action must be {action_size} numbers, got {len(message.action)}")
    action = tuple(min(1.0, max(-1.0, part)) for part in message.action)
    return msgspec.structs.replace(message, action=action)


def _reason(error: msgspec.ValidationError) -> str:
    """The field and the values it may have; the library's own line where no field is wrong."""
    found = _FIELD.search(str(error))
    if found is None or found[1] not in _ALLOWED:
        return str(error)
    return f"{found[1]} must be {_ALLOWED[found[1]]}"


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
