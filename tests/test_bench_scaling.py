"""The bench of growth: fits find what they are given, points that cannot run are named, tiles make up the number."""

import bench_package  # noqa: F401
import numpy as np
import pytest
import warp as wp

from bench import record, report, scaling, scaling_tables
from bench.__main__ import main
from warp_deferred import Settings
from warp_deferred.errors import CapacityError

# ---- fits


def test_fit_finds_exponent_and_model():
    counts = [10.0**k for k in range(1, 7)]
    power = scaling.fit(counts, [3.0 * n**0.7 for n in counts])
    assert power["exponent"] == pytest.approx(0.7) and power["from_n"] == 1e4
    line = scaling.fit(counts, [0.25 + 2e-6 * n for n in counts])
    assert line["fixed"] == pytest.approx(0.25) and line["each"] == pytest.approx(2e-6)
    assert line["error"] < 1e-5 < power["error"]


def test_exponent_is_of_the_upper_half():
    counts = [1.0, 10.0, 100.0, 1e3, 1e4, 1e5]
    # A fixed cost hides the growth below, and only below.
    values = [5.0, 5.0, 5.0, 1e3, 1e4, 1e5]
    assert scaling.fit(counts, values)["exponent"] == pytest.approx(1.0)
    assert scaling.fit(counts[3:], values[3:])["from_n"] == 1e3


def test_model_has_no_cost_below_zero():
    counts = [1.0, 2.0, 4.0, 8.0]
    steep = scaling.fit(counts, [n**1.5 for n in counts])
    assert steep["fixed"] == 0.0 and 1.0 < steep["each"] < 8.0**0.5
    falling = scaling.fit(counts, [4.0, 3.0, 2.5, 2.0])
    assert falling["each"] == 0.0 and 2.0 < falling["fixed"] < 4.0 and falling["exponent"] < 0.0
    # Of all prices alone, this one has the least squares.
    errors = [
        sum((price * n / n**1.5 - 1.0) ** 2 for n in counts) for price in np.linspace(0.9, 1.1, 21) * steep["each"]
    ]
    assert int(np.argmin(errors)) == 10


def points(axis, counts, **more):
    rows = []
    for n in counts:
        row = {"axis": axis, "n": n, "triangles": n, "stored_triangles": n, "width": 4, "height": 4, "views": 1}
        row |= {"frame.ms": 2.0 * n, "frame.ms_p5": n, "frame.ms_p95": 3.0 * n, "pass.shade.ms": 1.0 + n}
        rows.append(row | {"memory.bytes": 10, "scene.bytes": 100 * n, "build.s": 0.5} | more)
    return rows


def test_fits_are_of_every_pass_and_of_memory_that_is_held():
    rows = points("triangles", (10, 100, 1000, 10_000))
    rows[-1] |= {"stored_triangles": 1000, "scene.bytes": 100_000}
    found = {(f["axis"], f["figure"]): f for f in scaling.fits([*rows, *points("views", (1, 2))])}
    assert set(found) == {("triangles", name) for name in ("frame.ms", "pass.shade.ms", "bytes")}
    assert found["triangles", "frame.ms"]["each"] == pytest.approx(2.0)
    # Triangles that instances share would flatten it.
    assert found["triangles", "bytes"]["each"] == pytest.approx(100.0)


# ---- points


def test_tiles_make_up_the_number(monkeypatch):
    monkeypatch.setattr(scaling, "WHOLE_TRIANGLES", 300)
    monkeypatch.setattr(scaling, "TILE_TRIANGLES", 200)
    assert len(scaling.tiled_terrain(300).instances) == 1
    scene = scaling.tiled_terrain(1800)
    assert len(scene.instances) == 9 and scene.triangle_count == 1800
    assert len({id(i.mesh) for i in scene.instances}) == 1
    low, high = scene.bounds()
    np.testing.assert_allclose((low[[0, 2]], high[[0, 2]]), ((-10.0, -10.0), (10.0, 10.0)))


def test_axes_reach_as_far_as_is_promised():
    ends = {axis.name: (axis.counts["cuda"][0], axis.counts["cuda"][-1]) for axis in scaling.AXES}
    assert ends == {
        "triangles": (10**3, 10**8),
        "lights": (1, 10**5),
        "pixels": (64**2, 16384**2),
        "views": (1, 1024),
    }
    assert set(ends) == set(scaling_tables.REMARKS)
    for axis in scaling.AXES:
        for counts in axis.counts.values():
            assert list(counts) == sorted(set(counts)) and len(counts) >= scaling.FEWEST


def test_points_that_cannot_run_are_named(monkeypatch):
    def point(axis, count, *rest):
        if count == 800:
            raise CapacityError("scene: expected 9 GB of memory, got 1; split the scene")
        return points("triangles", (count,))[0]

    monkeypatch.setattr(scaling, "_point", point)
    kept = []
    result = scaling.run(
        wp.get_device("cpu"), quick=True, settings=Settings(), note=lambda _: None, only="triangles",
        keep=lambda part: kept.append(len(part["rows"])),
    )  # fmt: skip
    assert result["skipped"] == ["800 triangles: scene: expected 9 GB of memory, got 1; split the scene"]
    assert [row["n"] for row in result["rows"]] == [200, 3200] and kept == [1, 1, 2] and not result["fits"]


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A quick CPU result, made through the command line, laid out as a repository."""
    root = tmp_path_factory.mktemp("scaling")
    path = root / "bench" / "results" / "scaling_cpu.json"
    assert main(["scaling", "--device", "cpu", "--quick", "--json", str(path)]) == 0
    return root, record.read(path)


def test_quick_run_varies_what_it_says(result):
    rows = result[1]["rows"]
    assert not result[1]["skipped"] and len(rows) == 12 and len(result[1]["axes"]) == 4
    of = {axis: [row for row in rows if row["axis"] == axis] for axis in ("triangles", "lights", "pixels", "views")}
    assert all(row["triangles"] == pytest.approx(row["n"], rel=0.05) for row in of["triangles"])
    assert [row["lights"] for row in of["lights"]] == [1, 10, 100]
    assert all(row["width"] * row["height"] == row["n"] for row in of["pixels"])
    assert [row["views"] for row in of["views"]] == [1, 2, 4]
    for row in rows:
        assert row["frame.ms"] > 0.0 and row["pass.raster.ms"] > 0.0 and row["memory.bytes"] > 0
    assert {f["axis"] for f in result[1]["fits"]} == set(of)
    assert of["views"][2]["memory.bytes"] > of["views"][0]["memory.bytes"]


def test_report_shows_the_growth(result):
    root, made = result
    page = report.run(root)
    assert {path.name for path in page} == {"benchmarks.md", "performance.md", "bench_scaling_cpu.png"}
    text = (root / "docs" / "performance.md").read_text()
    fit = scaling_tables.fit_of(made, "pixels", "frame.ms")
    assert f"n^{fit['exponent']:.2f}" in text and "Growth (cpu)" in text
    assert not report.run(root, check=True)


# ---- words


@pytest.mark.parametrize(
    "count, text", [(1, "1"), (800, "800"), (3200, "3 200"), (16_384, "16.4 k"), (10**6, "1 M"), (10**8, "100 M")]
)
def test_numbers_are_short(count, text):
    assert scaling_tables.power(count) == text


def test_tables_tell_growth_and_what_was_skipped():
    rows = points("triangles", (10, 100, 1000))
    made = {
        "axes": [{"axis": "triangles", "fixed": "one view"}], "rows": rows, "fits": scaling.fits(rows),
        "skipped": ["10 triangles: why"],
    }  # fmt: skip
    text = scaling_tables.scaling_table(made)
    assert "| triangles | 10 | 1 000 | 20.0 to 2,000 | n^1.00 from 10 on |" in text
    assert (
        "By pass: `shade` n^" in text
        and "- 10 triangles: why" in text
        and "**triangles**: one view. Passes after" in text
    )
