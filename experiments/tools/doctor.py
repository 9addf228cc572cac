"""`ppl doctor`: what this machine has, in words."""

from __future__ import annotations

import importlib.util
import os
import time

from experiments.engine.runtime import cache_folder, device, start_jax, versions


def doctor() -> None:
    """Print devices, versions, rendering and cache, and what to do about what is missing."""
    print("Versions")
    for name, version in versions().items():
        print(f"  {name:18} {version}")
    print("\nCompute")
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
    print("\nCompilation cache")
    folder = cache_folder()
    if os.access(folder, os.W_OK):
        files = list(folder.glob("*"))
        size = sum(file.stat().st_size for file in files) / 1e6
        print(
            f"  {folder}: {len(files)} programs, {size:.0f} MB. The first run of a program "
            "compiles for some seconds; later ones load it from here."
        )
    else:
        print(
            f"  {folder} cannot be written: every run will compile again. Set PPL_JAX_CACHE to "
            "a folder that can."
        )
    print("\nExtras")
    for module, extra, what in (
        ("PIL", "render", "pictures and GIFs"),
        ("av", "render", "MP4 films"),
        ("matplotlib", "plot", "figures"),
        ("mujoco", "manipulation", "pictures of the UR5e worlds, and their C MuJoCo twin"),
        ("brax", "brax", "the brax adapter"),
    ):
        if importlib.util.find_spec(module) is not None:
            print(f"  {what}: ready")
        else:
            print(f"  {what}: missing; pip install 'ppl-jax[{extra}]'")
