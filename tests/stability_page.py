"""Writes docs/stability.md: every hard case with its tests, their results on CPU and CUDA, and mutations they notice.

Run from the repository's root: `python -m tests.stability_page [--results FILE.xml ...] [--check]`. The rows are those
of hard_cases.toml. A test proves a row if its name begins with the row's id, as test_r3_... or test_l2_l4_... do;
tests of the float64 reference (test_reference*.py) prove the oracle, not the renderer, and do not count. Results come
from `pytest --junitxml=FILE.xml`, are kept in hard_cases_results.json and stay until newer ones of the same tests and
device come in. `--check` writes nothing and fails where the page is not up to date.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import json
import re
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE, RESULTS, PAGE = (
    ROOT / "tests/hard_cases.toml",
    ROOT / "tests/hard_cases_results.json",
    ROOT / "docs/stability.md",
)
MUTATIONS = ROOT / "tests/mutations.toml"
GUARDS = ROOT / "bench/results/guards.json"
DEVICES = ("cpu", "cuda")
#: Ids at the beginning of a test's name.
IDS = re.compile(r"test_((?:[a-z]\d+_)+)")

INTRODUCTION = """# Stability

Made by `python -m tests.stability_page`; edit `tests/hard_cases.toml`, not this page.

What makes renderers fail, and what must come out here. A test's name begins with the id of its case. Numbers are those
of test cases that passed in the last recorded run on a device; tests that need no device count as CPU.

"""


@dataclasses.dataclass(frozen=True)
class Row:
    """A hard case."""

    id: str
    case: str
    expected: str
    #: The interface without which it cannot apply.
    missing: str = ""


@dataclasses.dataclass(frozen=True)
class Proof:
    """A test function that proves rows."""

    path: str
    name: str
    ids: tuple[str, ...]
    #: Devices it runs on.
    devices: tuple[str, ...]

    @property
    def key(self) -> str:
        """What results are stored under."""
        return f"{self.path}::{self.name}"


def rows() -> list[Row]:
    """All hard cases in the table's order."""
    return [Row(key, **fields) for key, fields in tomllib.loads(TABLE.read_text())["rows"].items()]


def sections() -> dict[str, str]:
    """Letter -> heading."""
    return tomllib.loads(TABLE.read_text())["sections"]


def row_ids(name: str) -> tuple[str, ...]:
    """Ids that a test's name begins with."""
    match = IDS.match(name)
    return tuple(match[1].rstrip("_").upper().split("_")) if match else ()


def proofs() -> list[Proof]:
    """All tests whose name begins with the id of a row, by file and line."""
    found = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        if path.name.startswith("test_reference"):
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and row_ids(node.name):
                names = {a.arg for a in node.args.args}
                devices = ("cuda",) if "cuda_device" in names else DEVICES if "device" in names else ("cpu",)
                place = path.relative_to(ROOT / "tests").as_posix()
                found.append(Proof(place, node.name, row_ids(node.name), devices))
    return found


def results() -> dict:
    """What runs have left: device -> {"on": words, "tests": {key: [passed, failed]}}; and of mutations."""
    empty = {name: {"on": "", "tests": {}} for name in DEVICES}
    return empty | (json.loads(RESULTS.read_text()) if RESULTS.exists() else {})


def take_in(files: Iterable[Path]) -> None:
    """Put the results of JUnit files into the stored ones.

    Raises:
        ValueError: If a file holds no results of pytest.
    """
    known, kept = {p.key: p.devices for p in proofs()}, results()
    for file in files:
        suites = ElementTree.parse(file).getroot().findall("testsuite")
        if not suites:
            raise ValueError(f"{file}: expected a file that pytest --junitxml wrote, got one without a test suite")
        for suite in suites:
            on = {p.get("name"): p.get("value") for p in suite.iter("property")}
            counts = _counts(suite, known)
            for device in DEVICES:
                new = {key: count for (key, d), count in counts.items() if d == device and sum(count)}
                if new:
                    kept[device]["on"] = f"{on.get(f'device.{device}', device)}, Warp {on.get('warp', 'unknown')}"
                    kept[device]["tests"] |= new
    for device in DEVICES:
        kept[device]["tests"] = {k: v for k, v in sorted(kept[device]["tests"].items()) if k in known}
    write_results(kept)


def write_results(kept: dict) -> None:
    """Store results, one test a line."""
    text = json.dumps(kept, indent=1, sort_keys=True)
    RESULTS.write_text(re.sub(r"\[\s+(\d+),\s+(\d+)\s+\]", r"[\1, \2]", text) + "\n")


def _counts(suite: ElementTree.Element, known: dict[str, tuple[str, ...]]) -> dict[tuple[str, str], list[int]]:
    """(Key of a test, device) -> how many of its cases passed and failed; what was skipped counts as neither."""
    counts: dict[tuple[str, str], list[int]] = {}
    for case in suite.findall("testcase"):
        name, _, parameters = case.get("name", "").partition("[")
        key = f"{case.get('classname', '').removeprefix('tests.').replace('.', '/')}.py::{name}"
        if key in known and case.find("skipped") is None:
            device = "cuda" if known[key] == ("cuda",) or "cuda:0" in parameters else "cpu"
            failed = case.find("failure") is not None or case.find("error") is not None
            counts.setdefault((key, device), [0, 0])[failed] += 1
    return counts


def _result(tests: list[Proof], device: str, stored: dict) -> str:
    """What the tests of a row came to on a device, in words."""
    mine = [p for p in tests if device in p.devices]
    if not mine:
        return "-"
    found = [stored[device]["tests"].get(p.key) for p in mine]
    passed, failed = (sum(f[k] for f in found if f) for k in (0, 1))
    words = [f"{passed} passed"] * (passed > 0) + [f"**{failed} failed**"] * (failed > 0)
    missing = sum(f is None for f in found)
    if missing:
        words.append("not run" if missing == len(found) else f"{missing} not run")
    return ", ".join(words)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _code(text: str) -> str:
    return f"`{_cell(text.strip())}`"


def page() -> str:
    """The whole page."""
    stored, tests, names = results(), proofs(), sections()
    lines = [INTRODUCTION + tomllib.loads(TABLE.read_text())["introduction"]]
    lines += ["## Cases", ""]
    lines += [f"- {d.upper()}: {stored[d]['on'] or 'no run recorded'}" for d in DEVICES]
    listed = rows()
    apart = [r for r in listed if r.missing]
    lines += ["", f"{len(listed) - len(apart)} cases apply; {len(apart)} do not, each for want of an interface."]
    for letter, heading in names.items():
        lines += ["", f"## {letter}: {heading}", "", "| id | case | must come out | CPU | CUDA | tests |"]
        lines.append("|---|---|---|---|---|---|")
        for row in (r for r in listed if r.id[0] == letter):
            if row.missing:
                lines.append(
                    f"| {row.id} | {_cell(row.case)} | {_cell(row.expected)} | | | does not apply: {row.missing} |"
                )
                continue
            mine = [p for p in tests if row.id in p.ids]
            links = "<br>".join(f"[`{p.name}`](../tests/{p.path})" for p in mine)
            outcome = " | ".join(_result(mine, d, stored) for d in DEVICES)
            lines.append(f"| {row.id} | {_cell(row.case)} | {_cell(row.expected)} | {outcome} | {links} |")
    return "\n".join(lines + _mutations(stored) + _sanitizer(stored) + _guards()) + "\n"


def _mutations(stored: dict) -> list[str]:
    """The section on mutations; nothing while there are none."""
    if not MUTATIONS.exists():
        return []
    table, outcome = tomllib.loads(MUTATIONS.read_text())["mutations"], stored.get("mutations", {})
    caught = sum(outcome.get(row) == "caught" for row in table)
    lines = ["", "## Mutations", ""]
    lines.append(
        "For each case a change of one line that its test must notice: `python -m tests.mutations` makes each in a "
        f"copy of the sources and runs the test there. In the last recorded runs {caught} of {len(table)} were noticed."
    )
    lines += ["", "| id | file | line | becomes | test | noticed |", "|---|---|---|---|---|---|"]
    for row, m in table.items():
        noticed = {"caught": "yes", "": "not run"}.get(outcome.get(row, ""), "no")
        name = m["test"].split("::")[1].split("[")[0]
        lines.append(f"| {row} | {m['file']} | {_code(m['old'])} | {_code(m['new'])} | `{name}` | {noticed} |")
    return lines


def _sanitizer(stored: dict) -> list[str]:
    """The section on compute-sanitizer; nothing while it has not run."""
    if "sanitizer" not in stored:
        return []
    run = stored["sanitizer"]
    left = "; ".join(f"`{path}` ({why})" for path, why in run["left_out"].items())
    lines = ["", "## compute-sanitizer", ""]
    lines.append(
        f"`python -m tests.sanitize` on {run['device']}, Warp {run['warp']}, {run['date']}, commit {run['commit']}: "
        f"the tests that are marked `gpu`, but for {left}."
    )
    lines += ["", "| tool | looks for | found | tests passed | failed | not seen |", "|---|---|---|---|---|---|"]
    for tool, o in run["tools"].items():
        lines.append(f"| {tool} | {o['looks_for']} | {o['found']} | {o['passed']} | {o['failed']} | {o['unseen']} |")
    kinds = [f"- {tool}: {_cell(kind)}" for tool, o in run["tools"].items() for kind in o["kinds"]]
    return lines + [""] * bool(kinds) + kinds


def _guards() -> list[str]:
    """The section on what guards cost; nothing where it was not measured."""
    if not GUARDS.exists():
        return []
    run = json.loads(GUARDS.read_text())
    lines = ["", "## What the guards cost", ""]
    lines.append(
        "Tests and clamps against bad input are always on. `python -m bench guards` renders the same frames with them "
        f"and with a copy of the package that has none, in turns; on {run['device']}, commit {run['commit']}:"
    )
    lines += ["", "| frame | with | without | cost | bytes of the picture that differ |", "|---|---|---|---|---|"]
    for row in run["rows"]:
        times = f"{row['guarded.ms']:.4f} ms | {row['bare.ms']:.4f} ms"
        lines.append(f"| {row['title']} | {times} | {row['guards.percent']:+.1f} % | {row['differing_bytes']:,} |")
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Take results in, write or check the page, and return the exit code."""
    parser = argparse.ArgumentParser(
        description="Write docs/stability.md from the hard cases, their tests and results."
    )
    parser.add_argument("--results", nargs="+", type=Path, default=[], help="JUnit files of pytest to take in first")
    parser.add_argument("--check", action="store_true", help="write nothing; fail where the page is not up to date")
    parser.add_argument("--sanitizer", type=Path, help="outcomes that python -m tests.sanitize --json wrote")
    options = parser.parse_args(arguments)
    if options.results:
        take_in(options.results)
    if options.sanitizer:
        run = json.loads(options.sanitizer.read_text())
        run.pop("jobs", None)  # which tests ran together: for going on with a run
        write_results(results() | {"sanitizer": run})
    text = page()
    if not options.check:
        PAGE.write_text(text)
    elif not PAGE.exists() or PAGE.read_text() != text:
        print(f"{PAGE.relative_to(ROOT)} is not up to date: run python -m tests.stability_page", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
