"""Runs the GPU tests under NVIDIA's compute-sanitizer: memcheck, racecheck, initcheck.

Run from the repository's root on a machine with a GPU and CUDA's toolkit:
`python -m tests.sanitize [--tools memcheck racecheck initcheck] [--processes 5] [--timeout 600] [--json OUT.json]`.
The tools run side by side, each over all tests marked `gpu` but those of LEFT_OUT, in several processes where
pytest-xdist is installed. Run the tests once before, so that kernels are compiled. Prints what each tool found; exit
code 1 if one found anything, a test failed, or time ran out. `python -m tests.stability_page --sanitizer OUT.json`
records it.
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
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOOLS = {
    "memcheck": "accesses outside of what is allocated, misaligned ones, errors of API calls",
    "racecheck": "lanes of a block that read and write the same shared memory without waiting for each other",
    "initcheck": "reads of global memory that nothing wrote",
}
#: Files that measure time or memory, or draw thousands of frames of one plan: they would show no kernel more.
LEFT_OUT = {
    "tests/test_fit.py": "times frames",
    "tests/test_fit_clock.py": "times frames",
    "tests/test_bench_accuracy.py": "times frames",
    "tests/test_long_runs.py": "thousands of frames, and memory counted",
}
SUMMARY = re.compile(r"(?:ERROR SUMMARY: (\d+) error)|(?:RACECHECK SUMMARY: (\d+) hazard)")
FINDING = re.compile(
    r"^========= ((?:Invalid|Error|Warning|Uninitialized|Misaligned|Program hit|Race|Out-of|Leaked).+)$", re.MULTILINE
)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a tool saw.

    Attributes:
        tool: Its name.
        found: Errors or hazards, all processes together.
        processes: Processes it watched.
        passed: Tests that passed under it.
        failed: Tests that failed.
        finished: Whether the tests came to their end in time.
        seconds: How long it took [s].
        kinds: The different things found, in the tool's words, a few of each.
    """

    tool: str
    found: int
    processes: int
    passed: int
    failed: int
    finished: bool
    seconds: float
    kinds: tuple[str, ...]

    @property
    def clean(self) -> bool:
        """Whether nothing was found, and all that should run ran."""
        return self.finished and not self.found and not self.failed and self.passed > 0 and self.processes > 0


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


def read_tests(path: Path) -> tuple[int, int]:
    """Tests of a JUnit file that passed and failed."""
    if not path.exists():
        return 0, 0
    cases = ElementTree.parse(path).getroot().findall("testsuite/testcase")
    failed = sum(case.find("failure") is not None or case.find("error") is not None for case in cases)
    return len(cases) - failed - sum(case.find("skipped") is not None for case in cases), failed


def watch(tool: str, processes: int, timeout: float, more: list[str]) -> Outcome:
    """Run the tests under a tool."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=f"{tool}-") as name:
        folder = Path(name)
        command = ["compute-sanitizer", "--tool", tool, "--target-processes", "all", "--print-limit", "20"]
        command += ["--log-file", str(folder / "%p.log"), sys.executable, "-m", "pytest", "-q", "-m", "gpu"]
        command += ["--require-cuda", "--tb=line", "-p", "no:cacheprovider", f"--junitxml={folder / 'tests.xml'}"]
        command += [f"--ignore={path}" for path in LEFT_OUT] + (["-n", str(processes)] if processes > 1 else []) + more
        process = subprocess.Popen(
            command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            words, _ = process.communicate(timeout=timeout)
            finished = process.returncode is not None and (folder / "tests.xml").exists()
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            words, finished = process.communicate()[0], False
        failures = [line for line in words.splitlines() if line.startswith(("FAILED", "ERROR"))]
        print(f"{tool}: {words.strip().splitlines()[-1] if words.strip() else 'no output'}", *failures[:20], sep="\n  ")
        found, watched, kinds = read_logs(folder)
        passed, failed = read_tests(folder / "tests.xml")
    return Outcome(tool, found, watched, passed, failed, finished, round(time.monotonic() - start, 1), kinds)


def main(arguments: list[str] | None = None) -> int:
    """Run the tools, print the table, and return the exit code."""
    parser = argparse.ArgumentParser(description="Run the GPU tests under compute-sanitizer.")
    parser.add_argument("--tools", nargs="+", choices=list(TOOLS), default=list(TOOLS), help="tools to run")
    parser.add_argument("--processes", type=int, default=1, help="test processes under each tool (pytest-xdist)")
    parser.add_argument("--timeout", type=float, default=3600.0, help="seconds a tool may take")
    parser.add_argument("--json", type=Path, help="write the outcomes here")
    options, more = parser.parse_known_args(arguments)
    if shutil.which("compute-sanitizer") is None:
        parser.error(
            "compute-sanitizer: not found; it comes with NVIDIA's CUDA toolkit, whose bin folder must be on PATH"
        )
    import warp as wp

    with concurrent.futures.ThreadPoolExecutor(len(options.tools)) as pool:
        outcomes = list(pool.map(lambda t: watch(t, options.processes, options.timeout, more), options.tools))
    for o in outcomes:
        print(
            f"{o.tool:10} {'clean' if o.clean else 'NOT CLEAN':9} found {o.found}, {o.passed} tests passed, "
            f"{o.failed} failed, {o.processes} processes, {o.seconds:.0f} s{'' if o.finished else ', NOT FINISHED'}"
        )
        for kind in o.kinds:
            print(f"    {kind}")
    if options.json:
        head = {
            "device": wp.get_device("cuda:0").name, "warp": wp.config.version,
            "date": f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}", "commit": os.environ.get("WD_COMMIT", ""),
        }  # fmt: skip
        tools = {o.tool: dataclasses.asdict(o) | {"looks_for": TOOLS[o.tool], "clean": o.clean} for o in outcomes}
        options.json.write_text(json.dumps(head | {"left_out": LEFT_OUT, "tools": tools}, indent=1) + "\n")
    return 0 if all(o.clean for o in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
