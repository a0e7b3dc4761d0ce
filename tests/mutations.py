"""Makes the mutations of mutations.toml, each in a copy of the sources, and tells whether its test notices.

Run from the repository's root: `python -m tests.mutations [ID ...] [--jobs 2] [--timeout 300] [--record]`. First every
test runs on an unchanged copy, where it must pass. Then each mutation is made in a copy of its own, and its test must
fail there. Prints a table; exit code 1 if a test fails without a mutation, or one with it passes, cannot be run or
takes too long. `--record` keeps the outcomes for docs/stability.md. Changed kernels are compiled, about 20 s each; they
go into Warp's cache under names of their own, so nothing that is cached changes.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE, RESULTS = ROOT / "tests/mutations.toml", ROOT / "tests/hard_cases_results.json"
#: Where the parts of the package lie in a copy, as they do once installed.
PLACES = {"warp_deferred": "warp_deferred", "kernels": "warp_deferred/kernels", "scenes": "warp_deferred/scenes"}


@dataclasses.dataclass(frozen=True)
class Mutation:
    """A change of one line that a test must notice."""

    id: str
    file: str
    old: str
    new: str
    test: str
    #: Text behind which `old` stands, where it stands in the file more than once.
    after: str = ""

    def applied(self, text: str) -> str:
        """Text of the file with the line changed.

        Raises:
            ValueError: If the line is not there, is there twice, or would become several.
        """
        start = text.find(self.after)
        count = text.count(self.old, max(start, 0))
        if start < 0 or count != 1 or "\n" in self.old + self.new or self.old == self.new:
            raise ValueError(f"mutation {self.id}: expected {self.old!r} once in {self.file}, got {count}; adapt it")
        return text[:start] + text[start:].replace(self.old, self.new)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of a mutation: `caught` or what went wrong, in words; what the test said, and how long it took."""

    id: str
    verdict: str
    words: str
    seconds: float


def mutations() -> list[Mutation]:
    """All mutations in the table's order."""
    return [Mutation(key, **fields) for key, fields in tomllib.loads(TABLE.read_text())["mutations"].items()]


def copy_sources(folder: Path) -> None:
    """Copy package and tests, laid out so that `warp_deferred` is found in the folder before the installed one."""
    skip = shutil.ignore_patterns("__pycache__", "failures", "images")
    for source, place in PLACES.items():
        shutil.copytree(ROOT / source, folder / place, ignore=skip, dirs_exist_ok=True)
        if not (folder / source).exists():
            (folder / source).symlink_to(folder / place)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=skip)
    shutil.copy(ROOT / "pyproject.toml", folder)


def run_tests(folder: Path, names: list[str], timeout: float) -> tuple[int | None, str]:
    """Run tests of a copy on the CPU; returns pytest's exit code, None where time ran out, and what it printed."""
    command = [sys.executable, "-m", "pytest", "-q", "--tb=line", "-p", "no:cacheprovider", "-m", "not gpu", *names]
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        start_new_session=True,
    )  # fmt: skip
    try:
        words, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return None, ""
    return process.returncode, words


def check_copy(folder: Path) -> None:
    """Make sure that tests of a copy import that copy.

    Raises:
        RuntimeError: If they would import another package of the name.
    """
    code = "import warp_deferred, warp_deferred.kernels as k; print(warp_deferred.__file__); print(k.__file__)"
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    found = [Path(line).resolve() for line in done.stdout.split()]
    if len(found) != 2 or not all(path.is_relative_to(folder.resolve()) for path in found):
        raise RuntimeError(f"expected warp_deferred from {folder}, got {done.stdout or done.stderr}")


def try_mutation(mutation: Mutation, timeout: float) -> Outcome:
    """Make a mutation in a copy and run its test there."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        copy_sources(folder)
        path = folder / mutation.file
        path.write_text(mutation.applied(path.read_text()))
        code, words = run_tests(folder, ["-x", mutation.test], timeout)
    said = [line for line in words.splitlines() if line.startswith(("E ", "FAILED", "ERROR")) or ": " in line]
    verdict = {0: "not noticed", 1: "caught", None: "out of time"}.get(code, f"pytest ended with {code}")
    return Outcome(mutation.id, verdict, said[0].rpartition("tests/")[2] if said else "", time.monotonic() - start)


def try_unchanged(chosen: list[Mutation], timeout: float) -> bool:
    """Run all tests on an unchanged copy; tells whether all passed."""
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        copy_sources(folder)
        check_copy(folder)
        code, words = run_tests(folder, sorted({m.test for m in chosen}), timeout * max(4, len(chosen)))
    print(words.strip().splitlines()[-1] if words.strip() else "the unchanged tests ran out of time", flush=True)
    if code != 0:
        print(words, file=sys.stderr)
    return code == 0


def record(outcomes: list[Outcome]) -> None:
    """Keep outcomes for the page of hard cases."""
    kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    kept["mutations"] = kept.get("mutations", {}) | {o.id: o.verdict for o in outcomes}
    from tests.stability_page import write_results

    write_results(kept)


def main(arguments: list[str] | None = None) -> int:
    """Try mutations, print the table, and return the exit code."""
    parser = argparse.ArgumentParser(description="Tell whether the tests of hard cases notice mutations of the code.")
    parser.add_argument("ids", nargs="*", help="ids of hard cases, such as R3; all if left out")
    parser.add_argument("--jobs", type=int, default=2, help="mutations side by side")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds a test may take")
    parser.add_argument("--record", action="store_true", help="keep the outcomes for docs/stability.md")
    options = parser.parse_args(arguments)
    known = {m.id: m for m in mutations()}
    unknown = sorted(set(options.ids) - set(known))
    if unknown:
        parser.error(f"ids: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    chosen = [m for m in known.values() if not options.ids or m.id in options.ids]
    for mutation in chosen:
        mutation.applied((ROOT / mutation.file).read_text())
    if not try_unchanged(chosen, options.timeout):
        return 1
    outcomes = []
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        for outcome in pool.map(lambda m: try_mutation(m, options.timeout), chosen):
            outcomes.append(outcome)
            print(f"{outcome.id:4} {outcome.verdict:12} {outcome.seconds:5.0f} s  {outcome.words[:140]}", flush=True)
    if options.record:
        record(outcomes)
    missed = [o.id for o in outcomes if o.verdict != "caught"]
    print(
        f"{len(outcomes) - len(missed)} of {len(outcomes)} mutations were noticed" + f"; not: {missed}" * bool(missed)
    )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
