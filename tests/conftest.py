import os
from pathlib import Path

import pytest

from envs.compiler import set_xla_flags

# Before JAX starts: tests run the programs that users run, but for LLVM's optimiser, which is a
# third of what they take to compile. XLA_FLAGS=--xla_backend_optimization_level=3 has it as in use.
LEVEL = "--xla_backend_optimization_level"
if LEVEL not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {LEVEL}=0".strip()
set_xla_flags()

import jax  # noqa: E402

TESTS = Path(__file__).parent
TIERS = ("unit", "learning", "worlds", "system", "browser")
CACHE = TESTS.parent / ".pytest_cache" / "xla"
DATA = TESTS.parent.parent / "shared" / "data"
RECORDINGS = DATA / "metadrive"


def pytest_configure(config):
    for tier in TIERS:
        config.addinivalue_line("markers", f"{tier}: every test in tests/{tier}")
    CACHE.mkdir(parents=True, exist_ok=True)
    os.environ["PPL_JAX_CACHE"] = str(CACHE)
    jax.config.update("jax_compilation_cache_dir", str(CACHE))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def pytest_collection_modifyitems(config, items):
    """Mark each test with its tier; leave slow ones out unless they are asked for."""
    for item in items:
        tier = item.path.relative_to(TESTS).parts[0]
        if tier in TIERS:
            item.add_marker(tier)
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(3600))
    if "slow" not in config.option.markexpr:
        slow = [item for item in items if item.get_closest_marker("slow")]
        if slow:
            config.hook.pytest_deselected(items=slow)
            items[:] = [item for item in items if item not in slow]


@pytest.fixture(scope="session")
def recordings():
    """Folder of recorded MetaDrive scenarios; tests that need it skip without it."""
    if not RECORDINGS.is_dir():
        pytest.skip("the MetaDrive recordings (../shared/data/metadrive) are not here")
    return RECORDINGS


@pytest.fixture(scope="session")
def robosuite_recordings():
    """Folder of recorded robosuite traces; tests that need it skip without it."""
    folder = DATA / "robosuite"
    if not folder.is_dir():
        pytest.skip("the robosuite recordings (../shared/data/robosuite) are not here")
    return folder


@pytest.fixture(scope="session")
def world():
    """A small driving world that tests share, so that compiled functions are shared too."""
    from envs.driving.make import make_driving

    return make_driving(training=range(100, 106), held_out=range(1000, 1006))
