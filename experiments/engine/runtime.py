"""Work of every command before JAX starts, and the error that reports a user's mistake."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from envs.compiler import set_xla_flags

CACHE_VARIABLE = "PPL_JAX_CACHE"
LOG_VARIABLE = "TF_CPP_MIN_LOG_LEVEL"
_PACKAGES = ("ppl-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


class UserError(Exception):
    """A mistake in what was asked for: one line, exit code 2."""


def need(module: str, extra: str, what: str) -> Any:
    """Import a module that only an extra installs.

    Raises:
        UserError: One line with the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UserError(f"{what} needs {module}: pip install 'ppl-jax[{extra}]'") from error


def hide_compiler_logs() -> None:
    """Keep XLA's own log, its slow-compile alarms among them, off the terminal.

    JAX's exceptions and Python's warnings are not affected. Call before JAX is imported; processes
    started later inherit it. A `TF_CPP_MIN_LOG_LEVEL` that the user set is kept: 0 shows all.
    """
    os.environ.setdefault(LOG_VARIABLE, "3")  # the alarms are logged as errors, which is level 2


def cache_folder() -> Path:
    """Where compiled programs are kept: `PPL_JAX_CACHE`, or the user's cache folder."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "ppl_jax" / "xla"


def start_jax() -> None:
    """Set compiler flags, hide XLA's log, turn the compilation cache on. Call before using JAX."""
    set_xla_flags()
    hide_compiler_logs()
    import jax

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"note: no compilation cache ({error})", file=sys.stderr)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    found = {"python": sys.version.split()[0]}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def revision() -> str:
    """Git revision of the source tree, or "unknown"."""
    root = Path(__file__).resolve().parent.parent.parent
    try:
        out = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty"],
            capture_output=True,
            text=True,
            check=True,
            timeout=5,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return out.stdout.strip()


def device() -> dict[str, Any]:
    """The device that JAX computes on."""
    import jax

    devices = jax.devices()
    return {
        "platform": devices[0].platform,
        "kind": devices[0].device_kind,
        "count": len(devices),
        "cores": os.cpu_count(),
    }
