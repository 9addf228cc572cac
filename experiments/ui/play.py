"""`ppl play`: a session from its settings to its summary."""

from __future__ import annotations

import dataclasses
import re
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.engine.config_file import config_path, read_config
from experiments.engine.fields import read_json, shown
from experiments.engine.ownership import owned
from experiments.engine.run import build_env, open_folder
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError, need
from experiments.engine.settings import (
    RunSettings,
    check,
    one_level,
    read_run_settings,
)
from experiments.ui.config import Question, SessionConfig, read_questions_in, read_session
from experiments.ui.views import display_of, make_view

PARTICIPANT = re.compile(r"[A-Za-z0-9_-]{0,32}")
LONGEST_TEXT = 20_000  # letters of a consent text


def play(
    settings: RunSettings,
    out: Path,
    session_config: SessionConfig,
    *,
    resume: bool = False,
    host: str = "127.0.0.1",
    port: int = 8765,
    exposed: bool = False,
) -> None:
    """Serve a session until it is complete or the person quits.

    Raises:
        UserError: If settings, folder or address cannot be used.
    """
    server = web()
    check(settings)
    display_of(settings.env)
    _check_session(session_config)
    from experiments.ui.session import Session
    from experiments.ui.trainer import InteractiveTrainer

    with server.listen(host, port, exposed) as served, owned(out):
        env = build_env(settings)
        hub = server.Hub(env.spec.action_size)
        view = make_view(env, hub.picture)
        try:
            folder = RunFolder(out)
            trainer = InteractiveTrainer(
                settings,
                folder,
                env,
                view.place,
                manual_episodes=session_config.manual_episodes,
            )
            # a folder that is resumed keeps its session settings: `resumed` has read them
            about = {} if resume else session_config.as_json()
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
        session = Session(trainer, view, session_config, hub.publish)
        server.serve(hub, session, served, exposed=exposed)
    print(f"the session is in {out}")
    if not session.trainer.complete:
        print(f"continue with: {shlex.join(('ppl', 'play', '--resume', '--out', str(out)))}")


def _check_session(session_config: SessionConfig) -> None:
    if not 0.1 <= session_config.rate <= 1000:
        raise UserError(f"rate must lie between 0.1 and 1000, got {session_config.rate}")
    for name in ("familiarisation", "manual_episodes"):
        value = getattr(session_config, name)
        if value < 0:
            raise UserError(f"{name} must not be negative, got {value}")
    if not PARTICIPANT.fullmatch(session_config.participant):
        raise UserError(
            "participant must be at most 32 letters, digits, - and _, got "
            f"{session_config.participant!r}"
        )


def new_session(env: str, given: Mapping[str, Any]) -> SessionConfig:
    """The settings of a new session.

    Args:
        env: Name of the environment, which has a control rate.
        given: Settings that the user gave, by name; those of the run among them are left out.

    Raises:
        UserError: If the environment cannot be shown.
    """
    names = {field.name for field in dataclasses.fields(SessionConfig)}
    mine: dict[str, Any] = {"rate": display_of(env).control_rate}
    mine |= {name: value for name, value in given.items() if name in names}
    return SessionConfig(**mine)


def resumed(out: Path, given: Mapping[str, Any]) -> tuple[RunSettings, SessionConfig]:
    """The settings of the session in a run folder.

    Args:
        out: The run folder.
        given: Settings of run and session that the user gave, by flat name; each must agree.

    Raises:
        UserError: If there is no session, or with one line that names each contradiction.
    """
    settings = read_run_settings(out)
    if settings.expert != "person":
        raise UserError(
            f"cannot resume {str(out)!r} with ppl play: its expert is {settings.expert!r}; use "
            "ppl train --resume"
        )
    rate = display_of(settings.env).control_rate
    session_config = read_session(read_config(out), rate, config_path(out))
    held = _held(settings.as_json()) | vars(session_config)
    wrong = [
        f"{name} is {shown(held.get(name))}, asked for {shown(value)}"
        for name, value in given.items()
        if held.get(name) != value
    ]
    if wrong:
        raise UserError(f"cannot resume {str(out)!r}: its {'; its '.join(wrong)}")
    return settings, session_config


def _held(content: Mapping[str, Any]) -> dict[str, Any]:
    """A run's config.json as one level of names; L is "auto" where it adapts."""
    flat = one_level(content)
    if flat.get("adaptive_horizon"):
        flat["preference_horizon"] = "auto"
    return flat


def web() -> Any:
    """The web server, which the ui extra brings.

    Raises:
        UserError: If it is not installed.
    """
    for module in ("msgspec", "starlette", "uvicorn", "websockets"):
        need(module, "ui", "the human interface")
    from experiments.ui import server

    return server


def read_consent(path: Path) -> str:
    """The text to agree to.

    Raises:
        UserError: If it cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8-sig").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"consent: cannot read {str(path)!r} ({error})") from error
    if not 0 < len(text) <= LONGEST_TEXT:
        raise UserError(f"consent must have 1 to {LONGEST_TEXT} letters, got {len(text)}")
    return text


def read_questions(path: Path) -> tuple[Question, ...]:
    """Questions: a JSON list of {"name", "text", and "choices" where it has any}.

    Raises:
        UserError: If it cannot be read, or is no such list.
    """
    content, where = read_json(path), f"questions {str(path)!r}"
    if not isinstance(content, list) or not content:
        raise UserError(
            f"{where} must hold a list of objects with name, text and (if any) choices, got "
            f"{shown(content)}"
        )
    questions = read_questions_in(content, where)
    names = [question.name for question in questions]
    if len(set(names)) != len(names) or not 0 < min(map(len, names)) <= max(map(len, names)) <= 64:
        raise UserError(f"{where}: each needs a name of its own of at most 64 letters")
    return questions
