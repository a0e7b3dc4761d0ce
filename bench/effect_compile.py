"""How long the kernels of an effect take to compile, measured in a process of its own with an empty cache.

The process prepares the effect's frames with the cache of whoever asks, so that nothing else is compiled; then, with
an empty cache for each rung, it compiles what that rung's frame launches and the frame without the effect does not.
"""

from __future__ import annotations

import concurrent.futures
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_deferred import Settings
from warp_deferred.errors import Error

from .effect_cases import EFFECT_CASES, QUICK_SIZE, EffectCase
from .record import ROOT

__all__ = ["compile_all", "compile_times"]

#: Kernels do not depend on the size of the picture.
SIZE = QUICK_SIZE
LIMIT_S = 300


def compile_all(
    cases: Sequence[EffectCase], device: str, settings: Settings, note: Any, skip: Any
) -> dict[tuple[str, str], dict[str, float]]:
    """Compile the kernels of every rung of every case, several cases at a time; each compile is one thread's work.

    It also fills the kernel cache of whoever asks, which spares the frames that come after one compile after the other.

    Args:
        cases: Cases, with a rung or more each.
        device: Name of the device.
        settings: Settings of all cases, but for the rung at hand.
        note: Function of a text that tells how far it is.
        skip: Function of a text that names what failed, and why.

    Returns:
        What `compile_times` says, by case and rung.
    """
    # Half of the cores, so that times are of cores that do little else.
    workers = max(1, min(len(cases), (os.cpu_count() or 1) // 2))
    found = {}
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        waiting = {}
        for case in cases:
            chosen = settings.with_values(list(case.settings))
            waiting[pool.submit(compile_times, case.name, device, list(case.rungs()[1:]), chosen)] = case
        for done in concurrent.futures.as_completed(waiting):
            name = waiting[done].name
            try:
                found |= {(name, rung): times for rung, times in done.result().items()}
                note(f"{name}, kernels compiled anew")
            except Exception as error:
                skip(f"{name}, compile times: {error}")
    return found


def compile_times(name: str, device: str, rungs: list[str], settings: Settings) -> dict[str, dict[str, float]]:
    """Compile the kernels of each rung anew.

    Args:
        name: Name of a case.
        device: Name of the device.
        rungs: Rungs but for the first.
        settings: Settings but for the rung.

    Returns:
        For each rung `compile.kernels`, how many kernels only its frame has; `compile.s`, seconds they take to compile
        and load; `compile.replaced_s`, seconds of those that only the frame without the effect has, in whose
        place some of them stand.

    Raises:
        Error: If the process fails; with the last line it wrote.
    """
    asked = json.dumps({"case": name, "device": device, "rungs": rungs, "settings": settings.model_dump()})
    # The driver keeps a cache of its own for what it compiles.
    environment = os.environ | {"CUDA_CACHE_DISABLE": "1"}
    command = [sys.executable, "-m", __spec__.name]
    done = subprocess.run(
        command, input=asked, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=LIMIT_S
    )
    if done.returncode != 0:
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise Error(f"compiling the kernels of {name}: expected times, got {last!r}; run {' '.join(command)}")
    return json.loads(done.stdout.splitlines()[-1])


def _modules(renderer: Any) -> dict[Any, int]:
    """Modules of the kernels that the renderer's plan launches, with the block size each is loaded for."""
    program = renderer.plan.resources.program
    whole = program.device.is_cpu and not wp.config.enable_cpu_blocks
    return {kernel.module: 1 if whole else block for kernel, block in program.kernels}


def _seconds(modules: dict[Any, int], device: wp.Device) -> float:
    """Compile and load modules with an empty cache."""
    with tempfile.TemporaryDirectory() as folder:
        # Warp reads this where it compiles; the process has no other use for its kernels.
        wp.config.kernel_cache_dir = folder
        started = time.perf_counter()
        for module, block in modules.items():
            module.unload()
            module.load(device, block)
        return time.perf_counter() - started


def main() -> None:
    """Read what is asked from standard input and write the times to standard output, as JSON."""
    from .effects import open_case

    asked = json.loads(sys.stdin.read())
    wp.config.log_level = wp.LOG_WARNING
    device, case = wp.get_device(asked["device"]), EFFECT_CASES[asked["case"]]
    settings = Settings(**asked["settings"])
    off = case.rungs()[0]
    found = {}
    for rung in (off, *asked["rungs"]):
        renderer = open_case(case, SIZE, device, rung=rung)
        renderer.scene.settings = case.at(settings, rung)
        renderer.prepare()
        found[rung] = _modules(renderer)
    plain = found.pop(off)
    times = {}
    # The compiler's own start belongs to no effect: any kernel takes it.
    _seconds(dict([next(iter(plain.items()))]), device)
    for rung, modules in found.items():
        new = {m: block for m, block in modules.items() if m not in plain}
        old = {m: block for m, block in plain.items() if m not in modules}
        times[rung] = {
            "compile.kernels": sum(len(m.kernels) for m in new),
            "compile.s": round(_seconds(new, device), 3),
            "compile.replaced_s": round(_seconds(old, device), 3),
        }
    print(json.dumps(times))


if __name__ == "__main__":
    main()
