"""The benches run through their command line; results round-trip, and reports say what results hold."""

import importlib
import json
import re
import sys

import bench_package  # noqa: F401
import pytest
import warp as wp

from bench import cases, frame, record, report, tables, targets, tiles
from bench.__main__ import main
from warp_deferred.errors import Error, LoadError

BENCHES = ("frame", "host", "lights", "tiles", "triangles")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Folder with a quick CPU result of every bench, made through the command line, laid out as a repository."""
    root = tmp_path_factory.mktemp("bench")
    for name in BENCHES:
        path = root / "bench" / "results" / f"{name}.json"
        assert main([name, "--device", "cpu", "--quick", "--json", str(path)]) == 0
    return root


# ---- results


def test_quick_results_are_whole(results):
    for name in BENCHES:
        result = record.read(results / "bench" / "results" / f"{name}.json")
        assert result["bench"] == name and result["quick"] is True and result["rows"]
        assert result["warp"] == wp.config.version and result["device"].startswith("CPU")
        for row in result["rows"]:
            times = {k: v for k, v in row.items() if re.search(r"\.(ms|us)(_p5|_p95)?$", k)}
            assert times and all(value >= 0.0 for value in times.values())
            for key in (k for k in row if k.endswith(".ms") and f"{k}_p5" in row):
                assert row[f"{key}_p5"] <= row[key] <= row[f"{key}_p95"] and row[f"{key[:-3]}.repeats"] >= 3


def test_frame_floor_is_bytes_over_bandwidth(results):
    result = record.read(results / "bench" / "results" / "frame.json")
    row = result["rows"][0]
    names = frame.pass_names(row)
    assert names == ["clusters", "raster", "resolve", "lights", "light_culling", "shade", "display"]
    assert row["frame.bytes"] == sum(row[f"pass.{name}.bytes"] for name in names)
    assert row["frame.floor_ms"] == pytest.approx(row["frame.bytes"] / result["copy_bytes_per_s"] * 1e3, abs=2e-6)
    assert row["frame.times_floor"] == pytest.approx(row["frame.ms"] / row["frame.floor_ms"], rel=1e-2)
    assert row["passes.sum_ms"] == pytest.approx(sum(row[f"pass.{name}.ms"] for name in names), abs=1e-4)


def test_lights_have_the_mean_they_state(results):
    rows = record.read(results / "bench" / "results" / "lights.json")["rows"]
    assert [row["lights"] for row in rows] == [1, 20]
    for row in rows:
        assert row["lit.mean"] == pytest.approx(row["mean"], rel=0.15)
        assert row["lit.max"] <= row["lights"]


def test_heat_map_agrees_with_its_row(results):
    result = record.read(results / "bench" / "results" / "tiles.json")
    counts, case = tiles.read_heat_map(result), result["heat_map"]
    (row,) = [r for r in result["rows"] if (r["lights"], r["tile_size"]) == (case["lights"], case["tile_size"])]
    assert counts.mean() == pytest.approx(row["tile.lights_mean"], abs=1e-3)
    assert counts.max() == row["tile.lights_max"]


def test_results_read_back_as_written(tmp_path):
    result = record.header("host", wp.get_device("cpu"), quick=True, settings=["a.b=1"])
    result |= {"rows": [{"x": 1.5, "text": "µs"}, {"x": 2}]}
    path = record.write(tmp_path / "deep" / "a.json", result)
    assert record.read(path) == result
    assert path.read_text().count("\n") < 20 and [p.name for p in path.parent.iterdir()] == ["a.json"]
    # A failed write leaves the old file and nothing beside it.
    with pytest.raises(ValueError, match="JSON compliant"):
        record.write(path, result | {"rows": [{"x": float("nan")}]})
    assert record.read(path) == result and [p.name for p in path.parent.iterdir()] == ["a.json"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"bench": "host"}'])
def test_results_that_are_none_are_named(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(LoadError, match=r"a\.json: expected .*; run the bench again"):
        record.read(path)


def test_results_with_numbers_that_are_not_finite_are_named(results, tmp_path):
    result = json.loads((results / "bench" / "results" / "host.json").read_text())
    result["rows"][1]["host.us"] = float("inf")
    (tmp_path / "a.json").write_text(json.dumps(result))
    with pytest.raises(LoadError, match=r"rows\[1\]\.host\.us"):
        record.read(tmp_path / "a.json")


def test_commit_comes_from_the_environment_where_there_is_no_repository(monkeypatch):
    def fail(*arguments):
        raise OSError("no git")

    monkeypatch.setattr(record, "_git", fail)
    monkeypatch.setenv("WD_COMMIT", "abc123")
    assert record.header("host", wp.get_device("cpu"), quick=True, settings=[])["commit"] == "abc123"


# ---- tables and report


@pytest.mark.parametrize(
    "value, text",
    [
        (0.0, "0"),
        (0.1366, "0.137"),
        (14.83, "14.8"),
        (0.0999951, "0.100"),
        (1234.5, "1,234"),
        (2e-6, "0.000002"),
        (0.99951, "1.00"),
    ],
)
def test_milliseconds_have_three_digits(value, text):
    assert tables.milliseconds(value) == text


def cells(table):
    """Rows of the first Markdown table of a text, without bold and code marks."""
    lines = [line for line in table.splitlines() if line.startswith("|")]
    return [[cell.strip(" *`") for cell in line.strip("|").split("|")] for line in lines]


def test_tables_agree_with_the_results(results):
    read = {name: record.read(results / "bench" / "results" / f"{name}.json") for name in BENCHES}
    rows = read["triangles"]["rows"]
    table = cells(tables.full_table(read["triangles"]))
    assert [line[0] for line in table[2:]] == [row["title"] for row in rows]
    assert [line[1] for line in table[2:]] == [tables.milliseconds(row["total.ms"]) for row in rows]
    assert [line[8] for line in table[2:]] == [f"{q.nvdiffrast:g}" for q in targets.TRIANGLE_QUOTES.values()]
    table = cells(tables.full_table(read["lights"]))
    assert [line[2] for line in table[2:]] == [f"{row['lit.mean']:.1f}" for row in read["lights"]["rows"]]
    row = read["frame"]["rows"][0]
    passes = cells(tables.full_table(read["frame"]).split("picture covered)")[1])[2:-2]
    assert [line[:2] for line in passes] == [
        [name, tables.milliseconds(row[f"pass.{name}.ms"])] for name in frame.pass_names(row)
    ]
    table = cells(tables.full_table(read["host"]))
    assert [line[1] for line in table[2:]] == [f"{row['host.us']:,.1f}" for row in read["host"]["rows"]]


def test_limits_are_judged_only_where_they_are_stated():
    row = {"text": "t", "figure": "render", "host.us": 70.0, "host.us_p5": 60.0, "host.us_p95": 90.0}
    result = {"bench": "host", "device": "NVIDIA H200", "quick": False, "rows": [row]}
    assert "≤ 80 ✓" in tables.full_table(result)
    assert "≤ 80 ✗" in tables.full_table(result | {"rows": [row | {"host.us": 81.0}]})
    other = tables.full_table(result | {"device": "some card"})
    assert "≤ 80" in other and "✓" not in other
    assert "≤ 80" not in tables.full_table(result | {"device": "CPU, 2 cores"})


def test_report_is_the_same_twice_and_fills_the_readme(results, capsys):
    pytest.importorskip("matplotlib")
    readme, page = results / "README.md", results / "docs" / "benchmarks.md"
    readme.write_text("# x\n\n<!-- bench:host -->\nold words\n<!-- /bench -->\n\nafter\n")
    assert main(["report", "--check", "--root", str(results)]) == 1
    assert not page.exists() and "old words" in readme.read_text()
    assert main(["report", "--root", str(results)]) == 0
    files = {p: p.read_bytes() for p in [readme, page, *(results / "docs" / "images").glob("*.png")]}
    assert len(files) == 2 + len(BENCHES)
    text = readme.read_text()
    host = record.read(results / "bench" / "results" / "host.json")
    assert "old words" not in text and text.startswith("# x\n") and text.endswith("<!-- /bench -->\n\nafter\n")
    assert f"**{host['rows'][0]['host.us']:,.1f}**" in text and host["commit"] in text
    for image in re.findall(r"\]\((images/\S+)\)", page.read_text()):
        assert (page.parent / image).stat().st_size > 5000
    capsys.readouterr()
    assert main(["report", "--root", str(results)]) == 0
    assert capsys.readouterr().out == ""
    assert {p: p.read_bytes() for p in files} == files
    assert main(["report", "--check", "--root", str(results)]) == 0


def test_markers_that_name_nothing_are_errors(results):
    records = {"host": record.read(results / "bench" / "results" / "host.json")}
    with pytest.raises(LoadError, match=r"bench:hots: expected one of the results host"):
        report.fill("<!-- bench:hots -->\n<!-- /bench -->", records, "README.md")
    with pytest.raises(LoadError, match="bench:host: expected a closing"):
        report.fill("<!-- bench:host -->\n", records, "README.md")
    assert report.fill("no marker", records, "README.md") == "no marker"


def test_plots_need_a_png_name_and_say_so_before_measuring(capsys):
    pytest.importorskip("matplotlib")
    assert main(["tiles", "--device", "cpu", "--plot", "a.jpg"]) == 2
    assert capsys.readouterr().err == "error: a.jpg: expected a name that ends in .png, got '.jpg'; rename it\n"


def test_missing_matplotlib_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.delitem(sys.modules, "bench.plots", raising=False)
    with pytest.raises(Error, match=r"pip install -e '\.\[dev\]'"):
        importlib.import_module("bench.plots")


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["triangles", "--device", "tpu"], "--device: expected one of"),
        (["triangles", "--device", "cpu", "--only", "quadss"], "did you mean 'quads'"),
        (["frame", "--device", "cpu", "--set", "raster.bin=1"], "Settings.raster"),
        (["report", "--root", "no/such/folder"], "expected results"),
        (["nothing"], "No such command"),
    ],
)
def test_errors_are_one_line(arguments, words, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("error:") == 1 and "Traceback" not in error


def test_preview_writes_every_case(tmp_path, capsys):
    assert main(["preview", "--device", "cpu", "--quick", "--out", str(tmp_path)]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {f"triangles_{case.name}.png" for case in cases.TRIANGLE_CASES} < names
    assert {"frame_quick.png", "lights_10.png"} < names
    assert capsys.readouterr().out.count("wrote ") == len(names)


@pytest.mark.parametrize("name", ["lights", "triangles", "frame"])
def test_an_interrupted_bench_leaves_its_finished_rows(tmp_path, monkeypatch, name):
    module, seen = importlib.import_module(f"bench.{name}"), []

    def row(*arguments):
        if seen:
            raise KeyboardInterrupt
        seen.append({"row": len(seen)})
        return seen[-1]

    monkeypatch.setattr(module, "frame_row" if name == "frame" else "_row", row)
    if name == "frame":
        case = cases.frame_cases(False, quick=True)[0]
        monkeypatch.setattr(module, "frame_cases", lambda *arguments, **options: [case, case])
    path = tmp_path / "part.json"
    assert main([name, "--device", "cpu", "--quick", "--json", str(path)]) not in (0, 1)
    result = record.read(path)
    assert result["rows"] == seen and seen and result["bench"] == name
