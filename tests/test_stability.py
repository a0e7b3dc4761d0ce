"""The page of hard cases and their mutations: every row has both, and the page says what tests and results say."""

from __future__ import annotations

import dataclasses
import json
import platform
from types import SimpleNamespace

import pytest
import sanitize
import stability_page
import warp as wp
from mutations import Mutation, mutations, try_mutation
from sanitize import MOST_TESTS, Outcome, jobs, outcome, read_logs, read_tests, read_times
from stability_page import ROOT, Proof, main, proofs, row_ids, rows


def test_every_hard_case_has_a_test_or_names_what_is_missing():
    proved = {row for proof in proofs() for row in proof.ids}
    apart = [row for row in rows() if row.missing]
    assert len(apart) <= 8 and all("." in row.missing for row in apart)
    assert [row.id for row in rows() if not row.missing and row.id not in proved] == []
    assert not proved - {row.id for row in rows() if not row.missing}, "tests named after rows that are not there"


def test_rows_are_read_from_names():
    assert row_ids("test_l2_l4_ply_bad_faces") == ("L2", "L4") and row_ids("test_p13_cut_in_4") == ("P13",)
    assert row_ids("test_a_plane_of_4_pixels") == () and row_ids("test_s1") == ()


def test_the_page_is_up_to_date():
    assert main(["--check"]) == 0, "run python -m tests.stability_page"


JUNIT = """<testsuites><testsuite>
<properties><property name="warp" value="9.9"/><property name="device.cpu" value="a CPU"/></properties>
<testcase classname="tests.passes.test_x" name="test_r3_x[cpu-1]"/>
<testcase classname="tests.passes.test_x" name="test_r3_x[cpu-2]"><failure/></testcase>
<testcase classname="tests.passes.test_x" name="test_r3_x[cuda:0-1]"><skipped/></testcase>
<testcase classname="tests.test_y" name="test_y"><properties><property name="device.cuda" value="a GPU"/></properties>
</testcase>
<testcase classname="tests.passes.test_x" name="test_e9_y"><skipped/></testcase>
<testcase classname="tests.passes.test_x" name="test_other[cpu]"/>
</testsuite></testsuites>"""


def test_results_are_taken_in_and_failures_show(tmp_path, monkeypatch):
    both = Proof("passes/test_x.py", "test_r3_x", ("R3",), ("cpu", "cuda"))
    far = Proof("passes/test_x.py", "test_e9_y", ("E9",), ("cuda",))
    monkeypatch.setattr(stability_page, "proofs", lambda: [both, far])
    for name in ("RESULTS", "PAGE"):
        monkeypatch.setattr(stability_page, name, tmp_path / name)
    (tmp_path / "run.xml").write_text(JUNIT)
    assert main(["--results", str(tmp_path / "run.xml")]) == 0
    text = (tmp_path / "PAGE").read_text()
    assert "- CPU: a CPU, Warp 9.9" in text and "- CUDA: no run recorded" in text
    line = next(line for line in text.splitlines() if line.startswith("| R3 |"))
    assert "| 1 passed, **1 failed** | not run | [`test_r3_x`](../tests/passes/test_x.py) |" in line
    # What ran on the GPU replaces nothing of the CPU.
    (tmp_path / "run.xml").write_text(JUNIT.replace("cpu-", "cuda:0-").replace("<skipped/>", ""))
    assert main(["--results", str(tmp_path / "run.xml")]) == 0
    text = (tmp_path / "PAGE").read_text()
    assert "| 1 passed, **1 failed** | 2 passed, **1 failed** |" in text and "- CUDA: a GPU, Warp 9.9" in text
    assert next(line for line in text.splitlines() if line.startswith("| E9 |")).count("| - | 1 passed |") == 1


def test_what_a_sanitizer_and_the_guards_said_shows(tmp_path, monkeypatch):
    log = "========= COMPUTE-SANITIZER\n========= Invalid __global__ read of size 4 bytes\n=========     at x\n"
    (tmp_path / "1.log").write_text(f"{log}========= ERROR SUMMARY: 2 errors\n")
    (tmp_path / "2.log").write_text("========= RACECHECK SUMMARY: 1 hazard displayed (1 error, 0 warnings)\n")
    (tmp_path / "3.log").write_text("")
    (tmp_path / "4.log").write_text(log)
    assert read_logs(tmp_path) == (4, 2, ("Invalid __global__ read of size 4 bytes",))
    (tmp_path / "run.xml").write_text(JUNIT)
    assert read_tests(tmp_path / "run.xml") == (3, 1, 2) and read_tests(tmp_path / "none.xml") == (0, 0, 0)
    good = Outcome("memcheck", 0, 3, 5, 0, 0, 1.0, ())
    assert good.clean
    for bad in ({"found": 1}, {"failed": 1}, {"passed": 0}, {"processes": 0}, {"unseen": 1}):
        assert not dataclasses.replace(good, **bad).clean
    tools = {"memcheck": dataclasses.asdict(dataclasses.replace(good, found=7, kinds=("a | b",))) | {"looks_for": "x"}}
    head = {"device": "a GPU", "warp": "9.9", "date": "today", "commit": "c", "left_out": {"f.py": "slow"}}
    (tmp_path / "run.json").write_text(json.dumps(head | {"tools": tools, "jobs": [{"tests": ["t"]}]}))
    row = {"title": "a frame", "guarded.ms": 1.01, "bare.ms": 1.0, "guards.percent": 1.0, "differing_bytes": 0}
    (tmp_path / "GUARDS").write_text(json.dumps({"device": "a GPU", "commit": "c", "rows": [row]}))
    for name in ("RESULTS", "PAGE", "GUARDS"):
        monkeypatch.setattr(stability_page, name, tmp_path / name)
    assert main(["--sanitizer", str(tmp_path / "run.json")]) == 0
    text = (tmp_path / "PAGE").read_text()
    assert "| memcheck | x | 7 | 5 | 0 | 0 |" in text and "- memcheck: a \\| b" in text and "`f.py` (slow)" in text
    assert "jobs" not in json.loads((tmp_path / "RESULTS").read_text())["sanitizer"]
    assert "| a frame | 1.0100 ms | 1.0000 ms | +1.0 % | 0 |" in text


def test_jobs_of_a_sanitizer_are_of_one_file_and_what_was_not_seen_counts(tmp_path):
    few, many = [f"tests/a.py::t[{k}]" for k in range(3)], [f"tests/b.py::t[{k}]" for k in range(MOST_TESTS + 2)]
    quick = dict.fromkeys(few + many, 0.01)
    assert jobs(few + many, quick) == [tuple(few), tuple(many[:MOST_TESTS]), tuple(many[MOST_TESTS:])]
    assert jobs(few, quick | {few[1]: 9.0}) == [(few[0],), (few[1],), (few[2],)]
    (tmp_path / "run.xml").write_text(JUNIT.replace('name="test_y"', 'name="test_y" time="2.5"'))
    times = read_times(tmp_path / "run.xml")
    assert times["tests/test_y.py::test_y"] == 2.5 and times["tests/passes/test_x.py::test_r3_x[cpu-1]"] == 0.0
    seen = {"tool": "memcheck", "tests": few, "found": 0, "processes": 1, "passed": 2, "failed": 0, "unseen": 0,
            "seconds": 2.0, "kinds": []}  # fmt: skip
    bad = seen | {"tests": many[:3], "found": 2, "kinds": ["Invalid read"], "unseen": 1}
    other = seen | {"tool": "racecheck"}
    whole = outcome("memcheck", [seen, bad, other], 5)
    assert whole == Outcome("memcheck", 2, 2, 4, 0, 6, 4.0, (f"Invalid read ({many[0]})",)) and not whole.clean
    assert outcome("racecheck", [seen, bad, other], 0).clean


def test_a_run_under_a_sanitizer_goes_on_with_what_was_not_seen(tmp_path, monkeypatch):
    asked, names = [], [f"tests/a.py::t[{k}]" for k in range(3)]

    def watch(tool, job, timeout):
        asked.append(job)
        bad = int(names[1] in job and len(asked) < 3)
        return {"tool": tool, "tests": list(job), "found": bad, "processes": 1, "passed": len(job), "failed": 0,
                "unseen": 0, "seconds": 1.0, "kinds": ["Invalid read"] * bad, "words": [], "commit": "c"}  # fmt: skip

    monkeypatch.setattr(sanitize, "watch", watch)
    monkeypatch.setattr(sanitize, "MOST_TESTS", 1)
    monkeypatch.setattr(wp, "get_device", lambda name: SimpleNamespace(name="a GPU"))
    path = tmp_path / "out.json"
    options = SimpleNamespace(timeout=9.0, job_timeout=9.0, resume=None, times=None, processes=1, json=path)
    first = sanitize.run(["memcheck"], names[:2], options)[0]
    assert (first.passed, first.found, first.unseen) == (2, 1, 0) and not first.clean
    options.resume = path
    # What was clean is not run again; what found something is, and so is what is new.
    second = sanitize.run(["memcheck"], names, options)[0]
    assert second.clean and second.passed == 3 and asked == [(n,) for n in (*names[:2], *names[1:])]
    options.timeout = 0.0
    options.resume = None
    assert sanitize.run(["memcheck"], names, options)[0].unseen == 3


def test_the_record_says_where_it_ran(device, record_property):
    # A property of a test, not of the suite: with several processes pytest keeps only these.
    chosen = wp.get_device(device)
    name = f"{platform.machine()} CPU" if chosen.is_cpu else chosen.name
    record_property("warp", wp.config.version)
    record_property("device.cpu" if chosen.is_cpu else "device.cuda", name)
    assert name and wp.config.version


def test_every_row_of_the_table_has_a_mutation_that_still_applies():
    table = {mutation.id: mutation for mutation in mutations()}
    # Properties of whole frames are proved by many cases each; every single case has a line that breaks it.
    assert list(table) == [row.id for row in rows() if not row.missing and row.id[0] != "P"]
    known = {f"tests/{proof.key}": proof.ids for proof in proofs()}
    for mutation in table.values():
        text = (ROOT / mutation.file).read_text()
        changed = mutation.applied(text)
        assert changed.count("\n") == text.count("\n") and changed != text
        assert mutation.id in known[mutation.test.partition("[")[0]]


def test_a_mutation_that_does_not_apply_is_named():
    mutation = Mutation("R3", "kernels/a.py", "a > b", "a < b", "tests/test_a.py::test_r3_a")
    assert mutation.applied("if a > b:\n    pass\n") == "if a < b:\n    pass\n"
    for text in ("if a >= b:", "a > b or a > b"):
        with pytest.raises(ValueError, match=r"mutation R3: expected 'a > b' once in kernels/a\.py"):
            mutation.applied(text)
    later = dataclasses.replace(mutation, after="def g")
    assert later.applied("def f: a > b\ndef g: a > b") == "def f: a > b\ndef g: a < b"


def test_a_mutation_counts_as_caught_only_where_its_test_ran_and_failed(monkeypatch):
    mutation = Mutation("R3", "kernels/projection.py", "& (PIXEL_BLOCK - 1)", "& PIXEL_BLOCK", "tests/a.py::b")
    for code, verdict in ((0, "not noticed"), (1, "caught"), (4, "pytest ended with 4"), (None, "out of time")):
        monkeypatch.setattr(
            "mutations.run_tests", lambda folder, names, timeout, code=code: (code, "E   assert 1 == 2")
        )
        assert try_mutation(mutation, 1.0).verdict == verdict
