"""Compile every kernel and every listed variant to CUDA binaries; needs no GPU.

Run from the repository's root: `python -m tests.compile_kernels [--arch 90 ...] [--jobs 2] [FILE ...]`.
A kernel file is compiled as one Warp module if it has kernels at module level; a file with a factory
(`make_..._kernel` or `make_..._kernels`) lists in VARIANTS the arguments to compile it with. Each line tells what a
binary costs: its size, and the most registers and stack a thread of one of its kernels takes. Exit code 1 if anything
fails to compile.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import importlib
import io
import multiprocessing
import pkgutil
import struct
import sys
import tempfile
import time
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import ModuleType

import warp as wp

ARCHITECTURES = (80, 90, 100)
PACKAGE = "warp_deferred.kernels"


@dataclasses.dataclass(frozen=True)
class Task:
    """One thing to compile: the module-level kernels of a file, or one variant of its factory."""

    file: str
    variant: int | None = None


@dataclasses.dataclass(frozen=True)
class Result:
    """What came of a task: a line per Warp module, or the text of the failure."""

    label: str
    lines: tuple[str, ...]
    seconds: float
    failure: str = ""


def kernel_files() -> list[str]:
    """Names of all kernel files, without the package."""
    package = importlib.import_module(PACKAGE)
    return sorted(info.name for info in pkgutil.iter_modules(package.__path__))


def load(file: str) -> ModuleType:
    """Import a kernel file."""
    return importlib.import_module(f"{PACKAGE}.{file}")


def factories(module: ModuleType) -> list[str]:
    """Names of the functions of a file that make kernels."""
    return [
        name
        for name, value in vars(module).items()
        if name.startswith("make_")
        and name.endswith(("_kernel", "_kernels"))
        and getattr(value, "__module__", "") == module.__name__
    ]


def tasks(files: list[str]) -> list[Task]:
    """Everything to compile, the longest ones not last.

    Raises:
        ValueError: If a file has a factory without variants, variants without a factory, or two factories.
    """
    found: list[Task] = []
    for file in files:
        module = load(file)
        if any(
            isinstance(value, wp.Kernel) and value.module.name == module.__name__ for value in vars(module).values()
        ):
            found.append(Task(file))
        makers, variants = factories(module), getattr(module, "VARIANTS", [])
        if len(makers) > 1 or bool(makers) != bool(variants):
            raise ValueError(
                f"kernels/{file}.py: expected one factory with VARIANTS or neither, "
                f"got {makers or 'no factory'} and {len(variants)} variants; list what is to be compiled"
            )
        found += [Task(file, index) for index in range(len(variants))]
    return found


def warp_modules(task: Task) -> list[wp.Module]:
    """The Warp modules of a task, set to the block size they are launched with."""
    module = load(task.file)
    if task.variant is None:
        made = [wp.get_module(module.__name__)]
    else:
        kernels = getattr(module, factories(module)[0])(*module.VARIANTS[task.variant])
        made = [k.module for k in (kernels if isinstance(kernels, tuple) else (kernels,))]
    for item in made:
        item.options["block_dim"] = module.BLOCK_DIM
    return made


def resources(binary: Path) -> tuple[int, int]:
    """Most registers and most stack bytes a thread over a CUDA binary's kernels.

    The section `.nv.info` of the ELF file holds records (format, attribute, size or value); those of format 4 carry
    `size` bytes more: attribute 0x2F (symbol, registers), 0x12 (symbol, stack bytes).
    """
    data = binary.read_bytes()
    table, size, count, names = *struct.unpack_from("<Q", data, 0x28), *struct.unpack_from("<3H", data, 0x3A)
    headers = [struct.unpack_from("<2I4Q", data, table + k * size) for k in range(count)]
    found = {0x2F: 0, 0x12: 0}
    for name, _, _, _, offset, length in headers:
        start = headers[names][4] + name
        if data[start : data.index(b"\0", start)] != b".nv.info":
            continue
        at = offset
        while at < offset + length:
            form, attribute, extra = struct.unpack_from("<BBH", data, at)
            if form == 4 and attribute in found:
                found[attribute] = max(found[attribute], struct.unpack_from("<I", data, at + 8)[0])
            at += 4 + (extra if form == 4 else 0)
    return found[0x2F], found[0x12]


def compile_task(task: Task, architectures: tuple[int, ...]) -> Result:
    """Compile one task for all architectures into a folder that is thrown away."""
    start, lines, log = time.perf_counter(), [], io.StringIO()
    label = f"kernels/{task.file}.py"
    try:
        if task.variant is not None:
            label += f" {load(task.file).VARIANTS[task.variant]}"
        with tempfile.TemporaryDirectory() as folder, redirect_stdout(log), redirect_stderr(log):
            for module in warp_modules(task):
                paths = wp.compile_aot_module(module, arch=architectures, module_dir=folder, use_ptx=False)
                facts = "; ".join(
                    "sm_{} {:.0f} KiB, {} registers, {} B stack".format(
                        arch, path.stat().st_size / 1024, *resources(path)
                    )
                    for arch, path in zip(architectures, paths, strict=True)
                )
                names = ", ".join(sorted(key.rpartition("__locals__")[2] for key in module.kernels))
                lines.append(f"{names}: {facts}")
    except Exception:
        return Result(label, tuple(lines), time.perf_counter() - start, log.getvalue() + traceback.format_exc())
    return Result(label, tuple(lines), time.perf_counter() - start)


def _quiet() -> None:
    wp.config.log_level = wp.LOG_WARNING


def main() -> int:
    """Compile, report, and return the exit code."""
    parser = argparse.ArgumentParser(description="Compile every kernel and variant to CUDA binaries, without a GPU.")
    parser.add_argument("files", nargs="*", help="kernel files to compile, such as raster; all if left out")
    parser.add_argument("--arch", type=int, nargs="+", default=ARCHITECTURES, help="compute capabilities times 10")
    parser.add_argument("--jobs", type=int, default=2, help="processes side by side")
    options = parser.parse_args()
    start = time.perf_counter()
    known = kernel_files()
    unknown = sorted(set(options.files) - set(known))
    if unknown:
        parser.error(f"no such kernel file: {', '.join(unknown)}; known: {', '.join(known)}")
    todo, failures, modules = tasks(options.files or known), 0, 0
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.jobs, mp_context=context, initializer=_quiet) as pool:
        pending = [pool.submit(compile_task, task, tuple(options.arch)) for task in todo]
        for future in concurrent.futures.as_completed(pending):
            result = future.result()
            modules += len(result.lines)
            print(f"{'FAILED' if result.failure else 'ok':6} {result.seconds:5.1f} s  {result.label}", flush=True)
            for line in result.lines:
                print(f"{'':16} {line}")
            if result.failure:
                failures += 1
                print(result.failure, file=sys.stderr, flush=True)
    names = ", ".join(f"sm_{arch}" for arch in options.arch)
    print(f"{modules} modules for {names} in {time.perf_counter() - start:.0f} s, {failures} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
