"""The benches: cases are the stated ones, timing leaves a frame as it was, reports say what results hold.

No figure is judged here: times belong to the machine.
"""

import importlib.util
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_deferred import PointLight, Renderer, Settings
from warp_deferred.errors import Error, InputError, LoadError

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "cases" / "triangles.py"


def load_package(name, path):
    """Import a folder without putting the root on the path, where it would hide the installed package."""
    spec = importlib.util.spec_from_file_location(name, path, submodule_search_locations=[str(path.parent)])
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


load_package("bench", ROOT / "bench" / "__init__.py")
from bench import cases, frame, preview, probe, record, report, tables, targets, tiles, timing  # noqa: E402
from bench.__main__ import main  # noqa: E402

BENCHES = ("frame", "host", "lights", "tiles", "triangles")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Folder with a quick CPU result of every bench, made through the command line, laid out as a repository."""
    root = tmp_path_factory.mktemp("bench")
    for name in BENCHES:
        path = root / "bench" / "results" / f"{name}.json"
        assert main([name, "--device", "cpu", "--quick", "--json", str(path)]) == 0
    return root


def small_plan(outputs=("light_count",), settings=None):
    scene = cases.terrain_scene(21)
    for x in np.linspace(-4.0, 4.0, 9):
        scene.lights.add(PointLight(position=(x, 1.5, 3.0 + 0.3 * x), intensity=5.0, range=3.0 + 0.2 * x))
    renderer = probe.open_scene(scene, (90, 50), wp.get_device("cpu"), outputs)
    return renderer, probe.plan_of(renderer, settings or Settings())


# ---- cases


@pytest.mark.skipif(not SHARED.is_file(), reason="no folder ../shared/cases beside the repository")
@pytest.mark.parametrize("name, count", [("quads", 7), ("slivers", 50), ("mixed", 60), ("pile", 70), ("terrain", 31)])
def test_cases_equal_the_stated_definitions(name, count):
    spec = importlib.util.spec_from_file_location("shared_triangles", SHARED)
    shared = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(shared)
    for given in (count, None):
        # The whole pile and mix are as quick to make as part of them.
        arguments = () if given is None else (given,)
        for ours, theirs in zip(getattr(cases, name)(*arguments), getattr(shared, name)(*arguments), strict=True):
            assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
            np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-12)


def test_rows_have_the_stated_numbers_of_triangles():
    counts = {case.name: case for case in cases.TRIANGLE_CASES}
    assert list(counts) == list(targets.TRIANGLE_QUOTES)
    for side, triangles in ((501, 500_000), (2237, 9_999_392)):
        assert 2 * (side - 1) ** 2 == triangles
    assert len(cases.quads()[1]) == 200 and len(cases.slivers()[1]) == 10_000
    assert len(cases.mixed()[1]) == 100_000 and len(cases.pile()[1]) == 1_000_000


def test_terrain_faces_up_and_its_normals_follow_it():
    positions, triangles, normals = cases.terrain(501)
    a, b, c = (positions[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    assert (face[:, 1] > 0.0).all()
    smooth = normals[triangles].mean(axis=1)
    smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
    assert (face * smooth).sum(axis=1).min() > 0.97
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)


def test_flat_scene_maps_the_square_to_the_image_and_z_to_reversed_depth():
    # Left half at z 0.3, behind it all at z 0.2; the upper right corner at z 0.8, wound the other way.
    corners = [(-1, -1, 0.3), (0, -1, 0.3), (0, 1, 0.3), (-1, -1, 0.3), (0, 1, 0.3), (-1, 1, 0.3)]
    corners += [(-3, -3, 0.2), (9, -3, 0.2), (-3, 9, 0.2)]
    corners += [(0.5, 0.5, 0.8), (0.5, 1.5, 0.8), (1.5, 0.5, 0.8)]
    triangles = np.arange(len(corners)).reshape(-1, 3)
    scene = cases.flat_scene(np.array(corners, float), triangles)
    frame_ = Renderer(scene, width=64, height=24, device="cpu", outputs=("triangle_id", "depth")).render()
    ids, depth = frame_.numpy("triangle_id")[0], frame_.numpy("depth")[0]
    y, x = np.mgrid[0:24, 0:64]
    u, v = (x + 0.5) / 32.0 - 1.0, 1.0 - (y + 0.5) / 12.0
    corner = (u > 0.5) & (v > 0.5) & (u + v < 2.0)
    expected = np.where(corner, 0.8, np.where(u < 0.0, 0.3, 0.2))
    np.testing.assert_allclose(depth, 1.0 - expected, atol=1e-6)
    assert ((ids == 3) == corner).all() and ((ids == 2) == ((u > 0.0) & ~corner)).all()


def test_nearest_of_the_quads_is_all_that_is_seen():
    positions, triangles = cases.quads(12)
    scene = cases.flat_scene(positions, triangles)
    frame_ = Renderer(scene, width=40, height=30, device="cpu", outputs=("triangle_id",)).render()
    nearest = int(positions[::4, 2].argmax())
    assert set(np.unique(frame_.numpy("triangle_id"))) == {2 * nearest, 2 * nearest + 1}


def test_reachable_mean_is_kept_or_cut():
    assert cases.reachable_mean(1000, 5) == 5.0 and cases.reachable_mean(1, 80) == 0.5


# ---- timing


def test_spread_of_known_values():
    result = timing.Timing.of(range(101))
    assert (result.median, result.p5, result.p95, result.repeats) == (50.0, 5.0, 95.0, 101)
    assert result.metrics("a.b") == {"a.b.ms": 50.0, "a.b.ms_p5": 5.0, "a.b.ms_p95": 95.0}


@pytest.mark.parametrize(
    "sections",
    [None, ("clusters", "raster"), ("clusters", "raster", "resolve"), ("lights", "light_culling", "shade"), ("shade",)],
)
def test_timing_leaves_the_frame_as_it_was(sections):
    renderer, plan = small_plan(("light_count", "display", "depth"))
    before = {name: renderer.render().numpy(name) for name in renderer.outputs}
    result = timing.time_program(plan.resources.program, sections, repeats=3)
    assert 0.0 < result.p5 <= result.median <= result.p95 and result.repeats == 3
    # What follows the passes timed must find their results as if they had run once.
    names = [section.name for section in plan.resources.program.sections]
    last = names[-1] if sections is None else sections[-1]
    for section in plan.resources.program.sections[names.index(last) + 1 :]:
        plan.resources.program.run_section(section)
    assert before["light_count"].max() > 2
    for name, array in before.items():
        assert np.array_equal(plan.outputs[name].numpy(), array), name


def test_timing_refuses_passes_that_are_not_there_or_not_side_by_side():
    program = small_plan()[1].resources.program
    with pytest.raises(InputError, match="side by side"):
        timing.time_program(program, ("raster", "lights"))
    with pytest.raises(InputError, match="side by side"):
        timing.time_program(program, ("raster", "clusters"))
    with pytest.raises(InputError, match="did you mean 'raster'"):
        timing.time_program(program, ("rster",))
    with pytest.raises(InputError, match="at least one"):
        timing.time_program(program, ())
    with pytest.raises(InputError, match="repeats"):
        timing.time_program(program, repeats=0)


def test_every_pass_is_timed(device):
    scene = cases.terrain_scene(21)
    renderer = probe.open_scene(scene, (90, 50), wp.get_device(device), ("display",))
    plan = probe.plan_of(renderer, Settings())
    times = timing.time_passes(plan.resources.program, repeats=4)
    assert list(times) == [stage.name for stage in plan.passes]
    assert all(t.repeats == 4 and t.median >= 0.0 for t in times.values())
    assert times["raster"].median > 0.0
    assert timing.time_program(plan.resources.program, repeats=4).median > 0.0


def test_host_calls_are_all_made_in_order():
    seen = []
    result = timing.time_calls(wp.get_device("cpu"), seen.append, 7, ahead=3)
    assert seen == list(range(7)) and result.repeats == 7


def test_copy_bandwidth_is_plausible():
    # A CPU copies somewhere between an old disk's rate and a cache's.
    assert 1e8 < timing.copy_bandwidth(wp.get_device("cpu"), repeats=3, size=1 << 22) < 1e13


# ---- probes


@pytest.mark.parametrize("tile", [8, 16, 32, 64])
def test_lights_per_tile_bounds_what_lights_a_pixel(tile):
    culling = Settings().light_culling.replace(tile_size=tile)
    renderer, plan = small_plan(settings=Settings().replace(light_culling=culling))
    lit = renderer.render().numpy("light_count")[0]
    counts = probe.lights_per_tile(plan)
    assert counts.shape == (-(-50 // tile), -(-90 // tile))
    for (y, x), count in np.ndenumerate(counts):
        assert lit[y * tile : (y + 1) * tile, x * tile : (x + 1) * tile].max() <= count <= 9
    assert lit.max() > 2


def test_brute_force_considers_every_light():
    culling = Settings().light_culling.replace(rung="brute_force")
    counts = probe.lights_per_tile(small_plan(settings=Settings().replace(light_culling=culling))[1])
    assert (counts == 9).all()


def test_mean_of_lit_lights_leaves_the_background_out():
    lights, surface = np.array([[4, 0], [1, 9]]), np.array([[True, True], [True, False]])
    assert probe.count_lights(lights, surface) == {"lit.mean": 1.6667, "lit.max": 4, "coverage": 0.75}
    assert probe.count_lights(lights, np.zeros((2, 2), bool)) == {"lit.mean": 0.0, "lit.max": 0, "coverage": 0.0}


def test_raster_counts_are_those_of_explain():
    raster = Settings().raster.replace(bins="on")
    scene = cases.flat_scene(*cases.quads(5))
    renderer = probe.open_scene(scene, (64, 64), wp.get_device("cpu"), ("depth",))
    plan = probe.plan_of(renderer, Settings().replace(raster=raster))
    counts = probe.raster_counts(plan)
    text = " ".join(plan.counters())
    assert counts["raster.large_triangles"] == 10
    assert f"{counts['raster.large_triangles']:,} large triangles" in text
    assert f"{counts['raster.bin_entries']:,} bin entries" in text


def test_preview_colours_ids_apart_and_the_background_black():
    picture = preview.by_number(np.arange(-1, 999, dtype=np.int32).reshape(10, 100))
    assert picture.shape == (10, 100, 4) and picture[0, 0].tolist() == [0, 0, 0, 255]
    colors = picture.reshape(-1, 4)[1:, :3]
    assert colors.min() >= 48 and len(np.unique(colors, axis=0)) > 990


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
                assert row[f"{key}_p5"] <= row[key] <= row[f"{key}_p95"]


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
