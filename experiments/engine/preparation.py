"""What a worker process needs to know of the process that starts it.

Nothing of how the parent was started: it may be `ppl`, a script, `python -c`, a notebook or a
frozen program. A worker gets the parent's search path, imports the modules that registered
environments and methods there, and runs the parent's script, as `multiprocessing` does, only where
the script itself registered some.
"""

from __future__ import annotations

import os
import sys
from multiprocessing import spawn
from typing import Any

from ppl_jax import plugins

SERVE = "sweep-worker"  # the hidden command of a frozen program, which has no interpreter to start
_CONFIG = ("jax_enable_x64", "jax_default_matmul_precision")  # settings of JAX that results have
_MAIN = ("init_main_from_name", "init_main_from_path")

Preparation = dict[str, Any]


class Prepared(BaseException):
    """Raised where a script that a worker runs for its registrations begins the study anew."""


_preparing = False


def stop_if_preparing() -> None:
    """End the script here, in a worker that runs it for what it has registered until now.

    Raises:
        Prepared: In such a worker.
    """
    if _preparing:
        raise Prepared


def words() -> list[str]:
    """The command that starts a worker."""
    if getattr(sys, "frozen", False):
        return [sys.executable, SERVE]
    path = [os.getcwd() if place == "" else place for place in sys.path]
    code = f"import sys; sys.path[:] = {path!r}; from experiments.engine import worker"
    return [sys.executable, "-c", f"{code}; worker.serve()"]


def preparation() -> Preparation:
    """This process, as `prepare` needs it; JSON."""
    import jax

    modules = [*plugins.named(), *plugins.noted()]
    found = spawn.get_preparation_data("worker")
    kept = ["sys_path", *(_MAIN if plugins.MAIN in modules else ())]
    return {
        "modules": [name for name in modules if name != plugins.MAIN],
        "main": plugins.MAIN in modules,
        "process": {name: found[name] for name in kept if name in found},
        "config": {name: getattr(jax.config, name) for name in _CONFIG},
    }


def prepare(data: Preparation) -> list[str]:
    """Make this process know what its parent knows.

    Returns:
        A line for each module that could not be imported: it matters only where a name is missing.
    """
    global _preparing
    import jax

    for name, value in data["config"].items():
        jax.config.update(name, value)
    wrong = []
    if data["main"] and not data["process"].keys() & set(_MAIN):
        wrong.append(
            "what was registered in a notebook cell, a prompt or python -c is known in that "
            f"process alone: put it into a module and name it in {plugins.VARIABLE}=MODULE"
        )
    _preparing = True
    try:
        spawn.prepare(data["process"])
    except Prepared:
        pass  # a script without `if __name__ == "__main__"`: it has come as far as is needed
    finally:
        _preparing = False
    for name in data["modules"]:
        try:
            plugins.import_modules([name])
        except ValueError as error:
            wrong.append(str(error))
    return wrong
