"""Runs the GPU tests under NVIDIA's compute-sanitizer: memcheck, racecheck, initcheck.

Run from the repository's root on a machine with a GPU and CUDA's toolkit, where the tests ran once before, so that
kernels are compiled (`pytest -m gpu --junitxml RUN.xml`):
`python -m tests.sanitize [--tools memcheck ...] [--processes 14] [--times RUN.xml] [--json OUT.json] [TESTS ...]`.
The tests marked `gpu`, but for those of LEFT_OUT, are cut into jobs of a few each, and every job runs under every tool
in a process of its own: workers of pytest-xdist under one sanitizer do not all report, and a device that one test broke
is broken for the rest of its process. Prints what each tool found; exit code 1 if one found anything, a test failed, or
time ran out. OUT.json is written job by job, and `--resume OUT.json` goes on with what it lacks: tests/sanitizer.json
is what is known so far. `python -m tests.stability_page --sanitizer OUT.json` puts it on the page.

Warp's memory pools are off, so that every array is an allocation of its own: an access just past one is then seen, and
memory that another array wrote is not taken for written. It also keeps memcheck from calling accesses of conditional
graph nodes to pooled memory invalid, which they are not (NVIDIA/warp, issue 1406).
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import datetime
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TOOLS = {
    "memcheck": "accesses outside of what is allocated, misaligned ones, errors of API calls",
    "racecheck": "lanes of a block that read and write the same shared memory without waiting for each other",
    "initcheck": "reads of global memory that nothing wrote",
}
#: Files and tests that would show no kernel more.
LEFT_OUT = {
    "tests/test_fit.py": "times frames",
    "tests/test_fit_clock.py": "times frames",
    "tests/test_bench_accuracy.py": "times frames",
    "tests/test_long_runs.py": "thousands of frames, and memory counted",
    "tests/test_determinism.py::test_e8_processes_and_an_empty_kernel_cache_agree": "compiles every kernel anew",
}
#: Tests of a job, and how long they may take without a sanitizer, which may make a hundred times that of it [s].
MOST_TESTS, MOST_SECONDS = 10, 4.0
SUMMARY = re.compile(r"(?:ERROR SUMMARY: (\d+) error)|(?:RACECHECK SUMMARY: (\d+) hazard)")
FINDING = re.compile(
    r"^========= ((?:Invalid|Error|Warning|Uninitialized|Misaligned|Program hit|Race|Out-of|Leaked|Host API|Internal)"
    r".+)$",
    re.MULTILINE,
)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a tool saw.

    Attributes:
        tool: Its name.
        found: Errors or hazards, all processes together.
        processes: Processes that reported.
        passed: Tests that passed under it.
        failed: Tests that failed.
        unseen: Tests that did not run to their end, or whose process did not report.
        seconds: Time of all processes together [s].
        kinds: The different things found, in the tool's words, with the first test of the job that showed it.
    """

    tool: str
    found: int
    processes: int
    passed: int
    failed: int
    unseen: int
    seconds: float
    kinds: tuple[str, ...]

    @property
    def clean(self) -> bool:
        """Whether nothing was found, and all that should run ran."""
        return not self.found and not self.failed and not self.unseen and self.passed > 0 and self.processes > 0


def read_logs(folder: Path) -> tuple[int, int, tuple[str, ...]]:
    """What the logs of a tool's processes say: findings, processes that reported, kinds of findings."""
    found, processes, kinds = 0, 0, []
    for path in sorted(folder.glob("*.log")):
        text = path.read_text(errors="replace")
        counts, lines = [int(a or b) for a, b in SUMMARY.findall(text)], FINDING.findall(text)
        # A process that was killed has no summary: what it printed counts.
        found, processes = found + (sum(counts) if counts else len(lines)), processes + bool(counts)
        kinds += [line for line in lines if line not in kinds]
    return found, processes, tuple(kinds[:20])


def read_tests(path: Path) -> tuple[int, int, int]:
    """Tests of a JUnit file that passed, failed, and were skipped."""
    if not path.exists():
        return 0, 0, 0
    cases = ElementTree.parse(path).getroot().findall("testsuite/testcase")
    failed = sum(case.find("failure") is not None or case.find("error") is not None for case in cases)
    skipped = sum(case.find("skipped") is not None for case in cases)
    return len(cases) - failed - skipped, failed, skipped


def collect(more: list[str]) -> list[str]:
    """Names of the tests to run."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", "gpu", "-p", "no:cacheprovider", *more]
    words = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=False).stdout
    names = [line for line in words.splitlines() if line.startswith("tests/") and "::" in line]
    return [name for name in names if not any(name.startswith(left) for left in LEFT_OUT)]


def jobs(names: Iterable[str], times: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Cut tests into jobs, each of one file.

    Args:
        names: The tests, file by file.
        times: Test -> how long it takes without a sanitizer [s]; half a second where it is not known.
    """
    result: list[list[str]] = []
    taken, last = 0.0, ""
    for name in names:
        file, seconds = name.partition("::")[0], times.get(name, 0.5)
        if file != last or len(result[-1]) == MOST_TESTS or taken + seconds > MOST_SECONDS:
            result.append([])
            taken, last = 0.0, file
        result[-1].append(name)
        taken += seconds
    return [tuple(job) for job in result]


def read_times(path: Path) -> dict[str, float]:
    """How long each test of a JUnit file took [s], by the name that pytest takes."""
    cases = ElementTree.parse(path).getroot().findall("testsuite/testcase")
    return {
        f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}": float(case.get("time", 0.0))
        for case in cases
    }


def watch(tool: str, names: tuple[str, ...], timeout: float) -> dict[str, Any]:
    """Run a job under a tool: what came of it, as it is stored."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=f"{tool}-") as name:
        folder = Path(name)
        command = ["compute-sanitizer", "--tool", tool, "--target-processes", "all", "--print-limit", "20"]
        command += ["--show-backtrace", "device", "--log-file", str(folder / "%p.log")]
        command += [sys.executable, "-m", "pytest", "-q", "--require-cuda", "--tb=line", "-p", "no:cacheprovider"]
        # A few draws of each property reach the kernels that many do.
        command += ["--hypothesis-profile=few", f"--junitxml={folder / 'tests.xml'}", *names]
        process = subprocess.Popen(
            command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
            env=os.environ | {"WARP_ENABLE_MEMPOOLS_AT_INIT": "0"},
        )  # fmt: skip
        try:
            words, _ = process.communicate(timeout=max(timeout, 0.1))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            words, _ = process.communicate()
        found, processes, kinds = read_logs(folder)
        passed, failed, skipped = read_tests(folder / "tests.xml")
    seen = processes > 0 and passed + failed + skipped >= len(names)
    lines = [line for line in words.splitlines() if line.startswith(("FAILED", "ERROR")) or "Error" in line]
    return {
        "tool": tool, "tests": list(names), "found": found, "processes": processes, "passed": passed, "failed": failed,
        "unseen": 0 if seen else len(names) - passed - failed - skipped or len(names), "kinds": list(kinds),
        "words": lines[:10] if failed or not seen else [], "seconds": round(time.monotonic() - start, 1),
        "commit": os.environ.get("WD_COMMIT", ""),
    }  # fmt: skip


def outcome(tool: str, done: list[dict[str, Any]], left: int) -> Outcome:
    """Add up what the jobs of a tool came to; `left` tests were not begun."""
    mine = [job for job in done if job["tool"] == tool]
    kinds: dict[str, str] = {}
    for job in mine:
        for kind in job["kinds"]:
            kinds.setdefault(kind, job["tests"][0])
    total = {key: sum(job[key] for job in mine) for key in ("found", "processes", "passed", "failed", "unseen")}
    total["unseen"] += left
    seconds = round(sum(job["seconds"] for job in mine), 1)
    return Outcome(tool, **total, seconds=seconds, kinds=tuple(f"{k} ({t})" for k, t in list(kinds.items())[:20]))


def record(path: Path, tools: list[str], names: list[str], done: list[dict[str, Any]]) -> list[Outcome]:
    """Write what is known so far, and return it."""
    import warp as wp

    outcomes = []
    for tool in tools:
        begun = sum(len(job["tests"]) for job in done if job["tool"] == tool)
        outcomes.append(outcome(tool, done, len(names) - begun))
    head = {
        "device": wp.get_device("cuda:0").name, "warp": wp.config.version,
        "date": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}",
        "commit": ", ".join(sorted({job["commit"] for job in done})),
    }  # fmt: skip
    by_tool = {o.tool: dataclasses.asdict(o) | {"looks_for": TOOLS[o.tool], "clean": o.clean} for o in outcomes}
    text = json.dumps(head | {"left_out": LEFT_OUT, "tools": by_tool}, indent=1).removesuffix("\n}")
    lines = ",\n  ".join(json.dumps(job) for job in done)
    path.with_suffix(".part").write_text(f'{text},\n "jobs": [\n  {lines}\n ]\n}}\n')
    path.with_suffix(".part").replace(path)
    return outcomes


def run(tools: list[str], names: list[str], options: argparse.Namespace) -> list[Outcome]:
    """Run what has not been seen yet, every job under every tool, until the time is over."""
    ends = time.monotonic() + options.timeout
    done = json.loads(options.resume.read_text())["jobs"] if options.resume else []
    # What found or failed something is run again: it may be mended.
    done = [job for job in done if job["tool"] in tools and set(job["tests"]) <= set(names)
            and not (job["found"] or job["failed"] or job["unseen"])]  # fmt: skip
    seen = {(job["tool"], name) for job in done for name in job["tests"]}
    times = read_times(options.times) if options.times else {}
    waiting = [(t, job) for t in tools for job in jobs((n for n in names if (t, n) not in seen), times)]
    # What takes longest comes first, for it would end last.
    waiting.sort(key=lambda pair: -sum(times.get(name, 0.5) for name in pair[1]))
    lock = threading.Lock()
    outcomes = record(options.json, tools, names, done)

    def one(tool: str, job: tuple[str, ...]) -> None:
        nonlocal outcomes
        if (left := ends - time.monotonic()) <= 0.0:
            return
        result = watch(tool, job, min(left, options.job_timeout))
        with lock:
            done.append(result)
            outcomes = record(options.json, tools, names, done)
            if result["found"] or result["failed"] or result["unseen"]:
                print(f"{tool} {job[0]}: found {result['found']}, failed {result['failed']}, unseen "
                      f"{result['unseen']} of {len(job)}", *result["kinds"][:5], *result["words"][:5],
                      sep="\n    ", flush=True)  # fmt: skip

    with concurrent.futures.ThreadPoolExecutor(options.processes) as pool:
        list(pool.map(lambda pair: one(*pair), waiting))
    return outcomes


def main(arguments: list[str] | None = None) -> int:
    """Run the tools, print the table, and return the exit code."""
    parser = argparse.ArgumentParser(description="Run the GPU tests under compute-sanitizer.")
    parser.add_argument("--tools", nargs="+", choices=list(TOOLS), default=list(TOOLS), help="tools to run")
    parser.add_argument("--processes", type=int, default=1, help="jobs at a time")
    parser.add_argument("--timeout", type=float, default=3600.0, help="seconds in all")
    parser.add_argument("--job-timeout", type=float, default=300.0, help="seconds a job may take")
    parser.add_argument("--json", type=Path, default=Path("sanitizer.json"), help="write the outcomes here")
    parser.add_argument("--times", type=Path, help="JUnit file of a run without sanitizer: slow tests then come first")
    parser.add_argument("--resume", type=Path, help="outcomes of a run to go on with")
    options, more = parser.parse_known_args(arguments)
    if shutil.which("compute-sanitizer") is None:
        parser.error(
            "compute-sanitizer: not found; it comes with NVIDIA's CUDA toolkit, whose bin folder must be on PATH"
        )
    names = collect(more)
    if not names:
        parser.error(f"no tests marked gpu in {' '.join(more) or 'tests'}")
    outcomes = run(options.tools, names, options)
    for o in outcomes:
        print(
            f"{o.tool:10} {'clean' if o.clean else 'NOT CLEAN':9} found {o.found}, {o.passed} tests passed, {o.failed} "
            f"failed, {o.unseen} unseen, {o.processes} processes, {o.seconds:.0f} s"
        )
    return 0 if all(o.clean for o in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
