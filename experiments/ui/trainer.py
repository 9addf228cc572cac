"""A policy that a person trains step by step, with a log from which a crash can be undone.

Every step a person makes is a line of session.jsonl before its effect is shown. A session that was
killed is restored from its last checkpoint and the lines since, through the same programs: it
continues as if it had never stopped.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine.evaluate import (
    evaluate_policy,
    physics_of,
    read_evaluation,
    summarise_episodes,
)
from experiments.engine.files import as_json
from experiments.engine.policy_file import save_policy
from experiments.engine.recording import PredictedPath, Recorder
from experiments.engine.run import algorithm_factory, restore_learner, saved_policy
from experiments.engine.run_folder import EVALUATION, POLICY, SUMMARY, RunFolder, whole_lines
from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings
from ppl_jax import checkpoint
from ppl_jax.interaction import Learner, summarise
from ppl_jax.live import make_live
from ppl_jax.types import Env, Interaction, Trajectory

LOG = "session.jsonl"
SAVE_EVERY = 500  # steps between checkpoints: the most that a resumed session has to repeat
METRICS_EVERY = 100  # steps

Report = Callable[[str], None]
"""`report(line)`: a line about the work in progress."""


class InteractiveTrainer:
    """A session's learner with its programs, its log and its files.

    Attributes:
        env: The environment.
        learner: The whole state of the run.
        events, steps: Lines of the log and steps so far.
        losses: Losses of a recent update (every tenth is read).
        ahead: The novice's last predicted path, renewed every K steps; None before the first.
    """

    def __init__(
        self,
        settings: RunSettings,
        folder: RunFolder,
        env: Env,
        place: Callable[[Any], jax.Array],
        *,
        manual_episodes: int = 0,
    ):
        """Build, but compile nothing.

        Args:
            settings: The run's settings.
            folder: Its folder, open already.
            env: Its environment.
            place: `place(state) -> position [P]`.
            manual_episodes: Number of episodes at the start in which the person makes every step.

        Raises:
            ValueError: If the method does not support a human.
        """
        self.settings, self.folder, self.env = settings, folder, env
        self.manual_episodes = manual_episodes
        self.functions = make_live(
            env, algorithm_factory(settings, env), settings.config, place=place
        )
        if not self.functions.algorithm.supports_human:
            raise ValueError(
                f"algorithm {settings.algorithm} asks nobody when to take over: choose ppl, pvp, "
                "hg_dagger, iwr, eil or haco"
            )
        self.events = self.steps = 0
        self.losses: dict[str, float] = {}
        self.ahead: PredictedPath | None = None
        self._since = 0  # steps since the episode began
        self.recorder = Recorder(folder.path)
        self._file: Any = None
        self._writer: threading.Thread | None = None
        self._failure: BaseException | None = None  # of the writer
        self._saved = 0
        self._began = time.perf_counter()

    def prepare(self, report: Report) -> None:
        """Compile, and restore the session that the folder already holds."""
        fns, config = self.functions, self.settings.config
        report("building the environment")
        learner = jax.jit(fns.init)(jax.random.key(self.settings.seed), self.settings.hparams)
        action = jnp.zeros(self.env.spec.action_size)
        yes = jnp.ones((), bool)

        def compiled(function: Callable, *arguments: Any, donate: bool = True) -> Callable:
            jitted = jax.jit(function, donate_argnums=0 if donate else ())
            return jitted.lower(*arguments).compile()

        report("compiling the prediction")
        self._predict_path = compiled(fns.predict_path, learner, action, yes, donate=False)
        report("compiling the step")
        self._play = compiled(fns.play, learner, yes, action)
        self._restart = compiled(fns.restart, learner)
        report("compiling the update")
        self._learn = compiled(fns.learn, learner)
        self._fit: Callable | None = None
        if config.offline_updates:
            updates = config.offline_updates
            self._fit = compiled(lambda learner: fns.fit(learner, updates), learner)
        self.learner = learner
        self._resume(report)
        self._before = jax.tree.map(np.asarray, self.learner.counters)
        self._file = open(self.folder.path / LOG, "a", buffering=1)  # noqa: SIM115 - open all along

    def _resume(self, report: Report) -> None:
        """Restore the last checkpoint and repeat the steps since."""
        lines = _session_lines(self.folder.path / LOG)
        done, self.learner = restore_learner(self.folder, self.learner, repeats=True)
        self.events = self._saved = done
        self.steps = int(self.learner.counters.steps)
        self._since, self.ahead = self.recorder.rewind(done)
        if len(lines) > done:
            report(f"repeating {len(lines) - done} steps")
        for line in lines[done:]:
            self._apply(line)
        self.folder.rewind(self.steps, self.steps)

    def _apply(self, line: dict[str, Any]) -> None:
        if line["do"] == "restart":
            self._make_restart()
        else:
            self._make_step(line["takeover"], np.asarray(line["action"], np.float32))
            self._make_update()
        self.events += 1

    # used by a session

    @property
    def complete(self) -> bool:
        """The run has all of its steps."""
        return self.steps >= self.settings.config.total_steps

    @property
    def manual(self) -> bool:
        """The person makes every step at present."""
        return (
            self.steps < self.settings.config.demonstrations
            or int(self.learner.counters.episodes) < self.manual_episodes
        )

    @property
    def fits_next(self) -> bool:
        """The next `learn` makes the offline updates on the demonstrations: it takes seconds."""
        return self._fit is not None and self.steps == self.settings.config.demonstrations

    def predict_path(self, learner: Learner, action: np.ndarray) -> PredictedPath:
        """Where `action` leads if held."""
        return predicted_path(self._predict_path(learner, jnp.asarray(action), jnp.ones((), bool)))

    def _look_ahead(self) -> None:
        if self._since % self.settings.config.decision_interval == 0:
            nothing = jnp.zeros(self.env.spec.action_size)
            self.ahead = predicted_path(
                self._predict_path(self.learner, nothing, jnp.zeros((), bool))
            )

    def step(self, takeover: bool, action: np.ndarray, about: dict[str, Any]) -> Interaction:
        """Log a step, then make it. Call `learn` after it.

        Args:
            takeover: The person is in control; always so while `manual`.
            action: [A] the person's action.
            about: Further fields for the log, such as times.
        """
        takeover = takeover or self.manual
        action = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        row = {"do": "step", "takeover": takeover, "action": action.tolist()}
        self._file.write(as_json(row | about) + "\n")
        step = self._make_step(takeover, action)
        self.events += 1
        return step

    def _make_step(self, takeover: bool, action: np.ndarray) -> Interaction:
        self._look_ahead()
        # a copy: the program is given its memory
        state = jax.tree.map(np.array, self.learner.env_state)
        self.learner, step = self._play(self.learner, jnp.asarray(takeover), jnp.asarray(action))
        step = jax.tree.map(np.asarray, step)
        assert self.ahead is not None
        self.recorder.add(step, state, self.ahead)
        self._since, self.steps = self._since + 1, self.steps + 1
        if step.terminated | step.truncated:
            self._since, self.ahead = 0, None
        return step

    def learn(self) -> None:
        """The update that follows a step; after the demonstrations, the offline updates."""
        self._make_update()
        if self.steps % METRICS_EVERY == 0:
            self._log_metrics()
        if self.events - self._saved >= SAVE_EVERY:
            self.save()

    def _make_update(self) -> None:
        steps, config = self.steps, self.settings.config
        if steps > config.demonstrations:
            self.learner, metrics = self._learn(self.learner)
        elif self._fit is not None and steps == config.demonstrations:
            self.learner, metrics = self._fit(self.learner)
        else:
            return
        if steps % 10 == 0:
            self.losses = {name: float(np.mean(value)) for name, value in metrics.items()}

    def restart(self) -> None:
        """Leave the episode unfinished and start the next."""
        self._file.write(as_json({"do": "restart"}) + "\n")
        self._make_restart()
        self.events += 1

    def _make_restart(self) -> None:
        self.learner = self._restart(self.learner)
        self.recorder.restart()
        self._since, self.ahead = 0, None

    def _log_metrics(self) -> None:
        now = jax.tree.map(np.asarray, self.learner.counters)
        metrics = summarise({}, self._before, now)
        self._before, steps = now, int(now.steps)
        row = {"step": steps, "done": steps, "phase": "interact"}
        row |= {name: float(value) for name, value in metrics.items()}
        row |= {f"train/{name}": value for name, value in self.losses.items()}
        self.folder.append_metrics(row | {"train/diverged": bool(self.learner.diverged)})

    def spare(self) -> Learner:
        """A copy of the learner to practise with."""
        return jax.tree.map(_copy, self.learner)

    def practise(
        self, learner: Learner, takeover: bool, action: np.ndarray
    ) -> tuple[Learner, Interaction]:
        """A step that teaches nothing and is not recorded."""
        return self._play(learner, jnp.asarray(takeover), jnp.asarray(action, jnp.float32))

    # files

    def save(self, wait: bool = False) -> None:
        """Write a checkpoint, the policy and the recording, while the session continues.

        Raises:
            OSError: If the save before this one failed; the log still has every step.
        """
        self._join()
        self._saved = self.events
        learner, events, rows = jax.tree.map(_copy, self.learner), self.events, self.recorder.take()

        def write() -> None:
            try:
                self.recorder.write(rows, events)
                about = {"env": self.settings.env, "algorithm": self.settings.algorithm}
                about |= {"seed": self.settings.seed, "step": int(learner.counters.steps)}
                save_policy(self.folder.path / POLICY, self._policy(learner), about)
                checkpoint.save(self.folder.checkpoints, events, learner)
            except BaseException as error:
                self._failure = error

        self._writer = threading.Thread(target=write)
        self._writer.start()
        if wait:
            self._join()

    def _join(self) -> None:
        """Wait for the writer, and raise the error that ended it."""
        if self._writer is not None:
            self._writer.join()
            self._writer = None
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def _policy(self, learner: Learner) -> Any:
        return saved_policy(self.env, self.functions.algorithm.policy(learner.algorithm))

    def close(self) -> None:
        """Save the steps that are not saved yet and close the log."""
        if self._file is None:
            return
        self._file.close()
        self._file = None
        if self.events > self._saved:
            self.save(wait=True)
        self._join()

    def evaluate(self) -> dict[str, float]:
        """Play every held-out scenario once without the person, and write the rows."""
        steps, human = self.steps, int(self.learner.counters.human_data)
        if steps not in {row.step for row in self._evaluated()}:
            policy, hparams = self._policy(self.learner), self.settings.hparams
            rows = evaluate_policy(self.env, policy, steps, hparams=hparams)
            self.folder.append_evaluation([r._asdict() | {"human_data_usage": human} for r in rows])
        return summarise_episodes([row for row in self._evaluated() if row.step == steps])

    def _evaluated(self) -> list[Any]:
        run = self.folder.path
        return read_evaluation(run) if (run / EVALUATION).exists() else []

    def summary(self, scores: dict[str, float], more: dict[str, Any]) -> dict[str, Any]:
        """Write and return summary.json."""
        counters, steps = self.learner.counters, max(self.steps, 1)
        human = int(counters.human_data)
        content = {
            "env": self.settings.env,
            "algorithm": self.settings.algorithm,
            "seed": self.settings.seed,
            "total_steps": self.steps,
            "human_data_usage": human,
            "intervention_rate": human / steps,
            **scores,
            "takeovers": int(counters.takeovers),
            "training_episodes": int(counters.episodes),
            "training_successes": int(counters.successes),
            "training_cost": float(counters.cost),
            "physics_diverged_episodes": int(counters.physics_diverged),
            "diverged": bool(self.learner.diverged),
            **physics_of(self.env),
            "wall_s": round(time.perf_counter() - self._began, 1),
            **more,
        }
        self.folder.write_json(SUMMARY, content)
        return content


def predicted_path(ahead: Trajectory) -> PredictedPath:
    """The part of a prediction that is shown."""
    bad = np.asarray(ahead.unsafe) | (np.asarray(ahead.terminated) & ~np.asarray(ahead.success))
    return PredictedPath(path=np.asarray(ahead.position), fails=bool(bad.any()))


def _copy(leaf: jax.Array) -> jax.Array:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.copy(jax.random.key_data(leaf)))
    return jnp.copy(leaf)


def _session_lines(path: Path) -> list[dict[str, Any]]:
    """The log's lines; an incomplete last one is removed from the file.

    Raises:
        UserError: If another one is no line of a session: nothing is removed.
    """
    lines = []
    for number, line in whole_lines(path):
        try:
            row = json.loads(line)
            if row["do"] != "restart" and not {"takeover", "action"} <= row.keys():
                raise KeyError("action")
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise UserError(f"{str(path)!r}, line {number} is no line of a session") from error
        lines.append(row)
    if path.exists():
        content = path.read_bytes()
        kept = content.rfind(b"\n") + 1
        if kept < len(content):
            with open(path, "rb+") as file:
                file.truncate(kept)
    return lines
