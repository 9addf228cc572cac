"""What every command does before JAX starts, and how a user's mistake is told."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

CACHE_VARIABLE = "PPL_JAX_CACHE"
_PACKAGES = ("ppl-jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


class UserError(Exception):
    """A mistake in what was asked for: one line, exit code 2."""


def cache_folder() -> Path:
    """Where compiled programs are kept: `PPL_JAX_CACHE`, or the user's cache folder."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "ppl_jax" / "xla"


# A loop whose body touches less than so many bytes is compiled as one function instead of one
# kernel per fusion (XLA's own limit is 1 kB): seven times faster for one robot arm, twice for a
# predicted car. Large products must stay out: in such a loop they are plain C loops.
_SMALL_LOOP = 2_000_000
_XLA_FLAGS = {
    "--xla_cpu_experimental_ynn_fusion_type": "",  # its kernels keep a loop from being one function
    "--xla_backend_extra_options": f"xla_cpu_small_while_loop_byte_threshold={_SMALL_LOOP}",
}


def set_xla_flags() -> None:
    """Compile small loops well on a CPU. Call before JAX is used; what a user set is kept."""
    given = os.environ.get("XLA_FLAGS", "")
    flags = [f"{name}={value}" for name, value in _XLA_FLAGS.items() if name not in given]
    os.environ["XLA_FLAGS"] = " ".join([given, *flags]).strip()


def start_jax() -> None:
    """Set compiler flags and turn the persistent compilation cache on. Call before JAX is used."""
    set_xla_flags()
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
    root = Path(__file__).resolve().parent.parent
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
    """What JAX computes on."""
    import jax

    devices = jax.devices()
    return {
        "platform": devices[0].platform,
        "kind": devices[0].device_kind,
        "count": len(devices),
        "cores": os.cpu_count(),
    }
