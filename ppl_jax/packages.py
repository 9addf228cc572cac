"""The packages `envs` and `experiments`, also in a project that has folders of these names.

Their names are given, and most research repositories have folders called so. Where a project's own
come first on the path, both share one package: its own `__init__` runs, and submodules are looked
up here first and there second. Only a submodule that both have can then not be told apart.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

PACKAGES = ("envs", "experiments")
_ROOT = Path(__file__).resolve().parent.parent


def own_packages() -> None:
    """Make `envs` and `experiments` hold what this library has under these names.

    Raises:
        ImportError: If the project has imported a submodule of a name that this library has too.
    """
    for name in PACKAGES:
        _share(name, _ROOT / name)


def _share(name: str, folder: Path) -> None:
    package = sys.modules.get(name)
    if package is None:
        found = importlib.util.find_spec(name)
        places = [] if found is None else list(found.submodule_search_locations or [])
        if found is None or (places and Path(places[0]).resolve() == folder):
            return  # ours, or none: then an import of it says so
        package = importlib.import_module(name)
    places = list(package.__path__)
    if Path(places[0]).resolve() == folder:
        return
    for loaded, module in list(sys.modules.items()):
        if loaded.startswith(f"{name}."):
            own = folder.joinpath(*loaded.split(".")[1:])
            if own.is_dir() or own.with_suffix(".py").is_file():
                raise ImportError(
                    f"module {loaded} of this project ({getattr(module, '__file__', '?')}) has the "
                    f"name of one of ppl_jax: call it otherwise, or import ppl_jax first"
                )
    package.__path__ = [str(folder), *places]
