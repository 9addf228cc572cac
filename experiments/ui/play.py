"""`ppl play`: a session from settings to summary; `ppl replay`: looking at one again."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

from experiments.engine.run import build_world, open_folder
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings, check
from experiments.ui.session import Question, Session, SessionConfig
from experiments.ui.views import RATES

PARTICIPANT = re.compile(r"[A-Za-z0-9_-]{0,32}")
LONGEST_TEXT = 20_000  # letters of a consent text


def play(
    settings: RunSettings,
    out: Path,
    resume: bool,
    sitting: SessionConfig,
    manual_episodes: int = 0,
    host: str = "127.0.0.1",
    port: int = 8765,
    exposed: bool = False,
) -> None:
    """Serve a session until it is complete or the person has had enough.

    Raises:
        UserError: If settings, folder or address cannot be used.
    """
    server = web()
    check(settings)
    if settings.env not in RATES:
        raise UserError(f"env: {settings.env} cannot be shown, choose {', '.join(RATES)}")
    for name, value in (
        ("familiarisation", sitting.familiarisation),
        ("manual_episodes", manual_episodes),
    ):
        if value < 0:
            raise UserError(f"{name} must not be negative, got {value}")
    if not PARTICIPANT.fullmatch(sitting.participant):
        raise UserError(
            f"participant must be at most 32 letters, digits, - and _, got {sitting.participant!r}"
        )
    from experiments.ui.trainer import InteractiveTrainer
    from experiments.ui.views import make_view

    served = server.listen(host, port, exposed)
    with served:
        env = build_world(settings)
        hub = server.Hub(env.spec.action_size)
        view = make_view(env, hub.picture)
        try:
            folder = RunFolder(out)
            trainee = InteractiveTrainer(settings, folder, env, view.place, manual_episodes)
            about = {"participant": sitting.participant, "manual_episodes": manual_episodes}
            open_folder(folder, settings.as_json() | about, resume)
        except ValueError as error:
            view.close()
            raise UserError(str(error)) from error
        except BaseException:
            view.close()
            raise
        if exposed:
            print(
                "warning: others on the network can reach this page; nothing is encrypted",
                file=sys.stderr,
            )
        server.serve(hub, Session(trainee, view, sitting, hub.publish), served, exposed)
    print(f"the session is in {out}")


def web() -> Any:
    """The web server, which the ui extra brings.

    Raises:
        UserError: If it is not installed.
    """
    try:
        from experiments.ui import server
    except ImportError as error:
        raise UserError(
            f"the human interface needs the package {error.name}: pip install 'ppl-jax[ui]'"
        ) from error
    return server


def read_consent(path: Path) -> str:
    """The text to agree to.

    Raises:
        UserError: If it cannot be read.
    """
    try:
        text = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"consent: cannot read {str(path)!r} ({error})") from error
    if not 0 < len(text) <= LONGEST_TEXT:
        raise UserError(f"consent must have 1 to {LONGEST_TEXT} letters, got {len(text)}")
    return text


def read_questions(path: Path) -> tuple[Question, ...]:
    """Questions: a JSON list of {"name", "text", and "choices" where it has any}.

    Raises:
        UserError: If it cannot be read, or is something else.
    """
    try:
        content = json.loads(path.read_text())
        questions = tuple(
            Question(str(one["name"]), str(one["text"]), tuple(map(str, one.get("choices", []))))
            for one in content
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"questions: {str(path)!r} is no JSON list of objects with name, text and (if any) "
            f"choices ({type(error).__name__}: {error})"
        ) from error
    names = [question.name for question in questions]
    if not questions or len(set(names)) != len(names) or max(map(len, names)) > 64:
        raise UserError("questions: each needs a name of its own of at most 64 letters")
    return questions
