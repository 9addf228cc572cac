"""The plan of a run: its pieces between two returns to the host, and where it is evaluated."""

from __future__ import annotations

import dataclasses

from ppl_jax.config import TrainConfig
from ppl_jax.training import Phase, phases


@dataclasses.dataclass(frozen=True)
class Chunk:
    """A piece of a run between two returns to the host.

    Attributes:
        phase: Phase of the loop.
        length: Steps (updates in phase "fit").
        end: Steps and offline updates of the run by then: what progress and checkpoints count.
        step: Environment steps of the run by then.
        evaluate: Whether the policy is evaluated then.
    """

    phase: Phase
    length: int
    end: int
    step: int
    evaluate: bool


def plan(config: TrainConfig, evaluate_every: int) -> list[Chunk]:
    """The chunks of a run; those of a phase are alike, its last may be shorter.

    It is evaluated after offline learning, then every `evaluate_every` steps, and at its end.
    """
    chunks: list[Chunk] = []
    end = step = 0
    for phase, length in phases(config):
        interact = phase == "interact"
        size = evaluate_every if interact else _part(length, config.decision_interval)
        left = length
        while left:
            piece = min(size, left)
            left, end = left - piece, end + piece
            step += 0 if phase == "fit" else piece
            # what demonstrations alone teach is seen once, when they are learnt
            evaluate = interact or (phase == "fit" and not left)
            chunks.append(Chunk(phase, piece, end=end, step=step, evaluate=evaluate))
    if not chunks[-1].evaluate:  # demonstrations that nothing is learnt from
        chunks[-1] = dataclasses.replace(chunks[-1], evaluate=True)
    return chunks


def evaluation_steps(config: TrainConfig, evaluate_every: int) -> list[int]:
    """Environment steps at which a run is evaluated."""
    return [chunk.step for chunk in plan(config, evaluate_every) if chunk.evaluate]


def _part(length: int, interval: int) -> int:
    """A tenth of a long phase, in whole blocks."""
    blocks = length // interval
    parts = max(n for n in range(1, 11) if blocks % n == 0) if length >= 5000 else 1
    return length // parts
