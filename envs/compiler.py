"""XLA settings under which these environments run fast on a CPU."""

from __future__ import annotations

import os

# A loop whose body touches less than so many bytes is compiled as one function instead of one
# kernel per fusion (XLA's own limit is 1 kB): seven times faster for one robot arm, twice for a
# predicted car. Large products must stay out: in such a loop they are plain C loops.
SMALL_LOOP = 1_000_000
_FLAGS = {
    "--xla_cpu_experimental_ynn_fusion_type": "",  # its kernels keep a loop from being one function
    "--xla_backend_extra_options": f"xla_cpu_small_while_loop_byte_threshold={SMALL_LOOP}",
}


def set_xla_flags() -> None:
    """Add the settings to `XLA_FLAGS`; call before JAX is used. What a user set is kept."""
    given = os.environ.get("XLA_FLAGS", "")
    flags = [f"{name}={value}" for name, value in _FLAGS.items() if name not in given]
    os.environ["XLA_FLAGS"] = " ".join([given, *flags]).strip()
