"""Settings of a session beside those of its run; config.json holds them under "session"."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any

from experiments.engine.fields import read_fields
from experiments.engine.runtime import UserError
from ppl_jax.config import did_you_mean


@dataclasses.dataclass(frozen=True)
class Question:
    """Something to ask after an episode.

    Attributes:
        name: Key of its answers.
        text: As shown.
        choices: To choose from; any text where empty.
    """

    name: str
    text: str
    choices: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class SessionConfig:
    """How a session runs.

    Attributes:
        rate: Steps per second.
        participant: The person's name in the study's list; may be empty.
        consent: Text to agree to before anything starts, or None.
        familiarisation: Successes in a row, driving alone, before steps count.
        questions: Asked after every episode.
        evaluate: Play the held-out scenarios at the end.
        manual_episodes: Number of episodes at the start in which the person makes every step.
    """

    rate: float
    participant: str = ""
    consent: str | None = None
    familiarisation: int = 0
    questions: tuple[Question, ...] = ()
    evaluate: bool = True
    manual_episodes: int = 0

    def as_json(self) -> dict[str, Any]:
        """For config.json."""
        return {"session": dataclasses.asdict(self)}


def read_session(content: Mapping[str, Any], rate: float, where: str) -> SessionConfig:
    """The settings of a session in a config.json; what it lacks and has a default is that.

    Args:
        content: Content of config.json. One without "session" is of version 0.1, which wrote two of
            them at the top; the others had their defaults or were not kept.
        rate: Where the file has none, steps per second.
        where: The file, for messages.

    Raises:
        UserError: One line naming file and field.
    """
    kinds = _KINDS | {"questions": list}
    if "session" not in content:
        return SessionConfig(rate=rate, **read_fields(content, _OLD, where))
    where = f"{where}, session"
    found = read_fields(content["session"], kinds, where)
    if unknown := sorted(set(content["session"]) - set(kinds)):
        raise UserError(f"{where}: unknown setting {unknown[0]!r}{did_you_mean(unknown[0], kinds)}")
    found["questions"] = read_questions_in(found.get("questions", []), where)
    found.setdefault("rate", rate)
    return SessionConfig(**found)


def read_questions_in(content: list[Any], where: str) -> tuple[Question, ...]:
    """Questions from a JSON list of {"name", "text", and "choices" where it has any}.

    Raises:
        UserError: One line naming the question and its field.
    """
    kinds = {"name": str, "text": str, "choices": tuple[str | int | float, ...]}
    questions = []
    for i, one in enumerate(content, 1):
        found = read_fields(one, kinds, f"{where}, question {i}", needed=("name", "text"))
        found["choices"] = tuple(map(str, found.get("choices", ())))
        questions.append(Question(**found))
    return tuple(questions)


_KINDS = typing.get_type_hints(SessionConfig)
_OLD = {"participant": str, "manual_episodes": int}


def participant_of(content: Mapping[str, Any]) -> str:
    """The participant that a config.json names, or ""."""
    return content.get("session", content).get("participant", "")
