"""Settings of a session beside those of its run; config.json holds them under "session"."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any


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

    @staticmethod
    def from_json(content: Mapping[str, Any], rate: float) -> SessionConfig:
        """The settings in a config.json.

        Args:
            content: Content of config.json. One without "session" is of version 0.1, which wrote
                two of them at the top; the others had their defaults or were not kept.
            rate: Where the file has none, steps per second.
        """
        if "session" not in content:
            old = {name: content[name] for name in _OLD if name in content}
            return SessionConfig(rate=rate, **old)
        found = dict(content["session"])
        asked = [one | {"choices": tuple(one["choices"])} for one in found.pop("questions")]
        return SessionConfig(**found, questions=tuple(Question(**one) for one in asked))


_OLD = ("participant", "manual_episodes")


def participant_of(content: Mapping[str, Any]) -> str:
    """The participant that a config.json names, or ""."""
    return content.get("session", content).get("participant", "")
