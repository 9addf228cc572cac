"""`ppl doctor`: what this machine has, in words."""

from __future__ import annotations

import importlib.util
import os
import shutil
import time
from pathlib import Path
from typing import NamedTuple

from experiments.engine.compile_log import FILE
from experiments.engine.runtime import cache_folder, device, start_jax, versions

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


class Piece(NamedTuple):
    """Something that may be missing.

    Attributes:
        name: Name of the extra, or of the program.
        what: It is for.
        modules: That it installs, by their import names.
        programs: One of which has to be on the path, if any are named.
        command: That installs it.
    """

    name: str
    what: str
    modules: tuple[str, ...]
    programs: tuple[str, ...] = ()
    command: str = ""

    def missing(self) -> list[str]:
        """The parts that are not here."""
        lacking = [name for name in self.modules if not _installed(name)]
        if self.programs and not any(map(shutil.which, self.programs)):
            lacking.append(self.programs[0])
        return lacking

    def line(self) -> str:
        """The piece in one line, with the command that installs it where it is missing."""
        lacking = self.missing()
        state = f"missing ({', '.join(lacking)}): {self.install()}" if lacking else "ready"
        return f"{self.name:12} {self.what}: {state}"

    def install(self) -> str:
        """The command that installs it."""
        return self.command or f"pip install 'ppl-jax[{self.name}]'"


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package around it is missing
        return False


PIECES = (
    Piece(name="render", what="pictures, GIFs and MP4 films", modules=("PIL", "av")),
    Piece(name="plot", what="figures", modules=("matplotlib",)),
    Piece(name="brax", what="the brax adapter", modules=("brax",)),
    Piece(name="ray", what="sweeps on a Ray cluster", modules=("ray",)),
    Piece(
        name="ui",
        what="a person in the browser",
        modules=("starlette", "uvicorn", "websockets", "PIL"),
    ),
    Piece(name="minari", what="sessions as Minari data sets", modules=("minari", "h5py")),
    Piece(name="onnx", what="policies as .onnx", modules=("onnx",)),
    Piece(name="warp", what="MuJoCo Warp on CUDA devices", modules=("warp",)),
    Piece(name="docs", what="building the documentation", modules=("mkdocs", "mkdocstrings")),
    Piece(
        name="dev",
        what="tests, static checks and notebooks",
        modules=(
            "pytest",
            "xdist",
            "pytest_timeout",
            "hypothesis",
            "importlinter",
            "pyright",
            "nbclient",
            "ipykernel",
            "playwright",
            "ruff",
        ),
    ),
    Piece(
        name="chromium",
        what="tests in the browser",
        modules=(),
        programs=BROWSERS,
        command="apt-get install -y chromium",
    ),
)


def doctor() -> None:
    """Print versions, devices, cache and extras, and what to do about what is missing."""
    print("Versions")
    for name, version in versions().items():
        print(f"  {name:18} {version}")
    print("\nCompute")
    _compute()
    print("\nCompilation cache")
    _cache(cache_folder())
    print("\nExtras")
    for piece in PIECES:
        print(f"  {piece.line()}")


def _compute() -> None:
    start_jax()
    import jax

    found = device()
    print(
        f"  JAX computes on {found['count']} {found['platform']} device ({found['kind']}), "
        f"with {found['cores']} processor cores."
    )
    if found["platform"] == "cpu":
        print("  That is enough for every default here. For an NVIDIA GPU install jax[cuda12].")
    began = time.perf_counter()
    jax.jit(lambda x: x @ x)(jax.numpy.ones((256, 256))).block_until_ready()
    print(f"  A first small program took {time.perf_counter() - began:.2f} s to compile and run.")


def _cache(folder: Path) -> None:
    if not os.access(folder, os.W_OK):
        print(
            f"  {folder} cannot be written: every run will compile again. Set PPL_JAX_CACHE to "
            "a folder that can."
        )
        return
    files = [file for file in folder.glob("*") if file.name != FILE]
    size = sum(file.stat().st_size for file in files) / 1e6
    print(
        f"  {folder}: {len(files)} files, {size:.0f} MB. The first run of a program compiles for "
        "some seconds; later ones load it from here."
    )
