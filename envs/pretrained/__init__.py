"""The shipped neural experts: ENV.npz, and how each was trained in ENV.json."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).parent


def policy_path(name: str) -> Path:
    """File of the neural expert of environment `name`.

    Raises:
        ValueError: If none is shipped.
    """
    path = _FOLDER / f"{name}.npz"
    if not path.is_file():
        there = ", ".join(sorted(file.stem for file in _FOLDER.glob("*.npz")))
        raise ValueError(
            f"no neural expert is shipped for {name!r} (there are: {there}): train one by "
            f"`ppl expert train {name}` and give its run folder"
        )
    return path
