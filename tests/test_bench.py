"""The benches' cases, clocks and probes. No figure is judged here: times belong to the machine."""

import ast
import importlib.util
import shutil

import bench_package
import numpy as np
import pytest
import warp as wp

from bench import cases, guards, preview, probe, tables, targets, timing
from warp_deferred import PointLight, Renderer, Settings
from warp_deferred.errors import Error, InputError

SHARED = bench_package.ROOT.parent / "shared" / "cases" / "triangles.py"


def small_plan(outputs=("light_count",), settings=None, size=(90, 50)):
    scene = cases.terrain_scene(21)
    for x in np.linspace(-4.0, 4.0, 9):
        scene.lights.add(PointLight(position=(x, 1.5, 3.0 + 0.3 * x), intensity=5.0, range=3.0 + 0.2 * x))
    renderer = probe.open_scene(scene, size, wp.get_device("cpu"), outputs)
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
    assert result.metrics("a.b") == {"a.b.ms": 50.0, "a.b.ms_p5": 5.0, "a.b.ms_p95": 95.0, "a.b.repeats": 101}
    assert result.times(3) == timing.Timing(150.0, 15.0, 285.0, 101)


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


@pytest.mark.parametrize("rung", ["tiles_depth", "brute_force"])
def test_lights_per_tile_are_the_same_in_bands(rung):
    counts, bands = [], []
    for budget in (1 << 28, 1):
        culling = Settings().light_culling.replace(rung=rung, tile_size=8, mask_budget_bytes=budget)
        settings = Settings().replace(light_culling=culling)
        renderer, plan = small_plan(("color",), settings, (90, 150))
        before = renderer.render().copy()
        counts.append(probe.lights_per_tile(plan))
        bands.append(renderer.memory_report().mask_bands)
        assert np.array_equal(before.numpy("color"), renderer.render().numpy("color")), "a probe leaves no trace"
    assert bands == [1, 3] and counts[0].any()
    assert np.array_equal(*counts)


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


# ---- guards


def test_every_guard_is_in_the_kernels_and_comes_out(tmp_path):
    shutil.copytree(bench_package.ROOT / "kernels", tmp_path / "kernels")
    guards.without_guards(tmp_path / "kernels")
    for name in {guard.file for guard in guards.GUARDS}:
        text = (tmp_path / "kernels" / name).read_text()
        ast.parse(text)
        assert text != (bench_package.ROOT / "kernels" / name).read_text()
    with pytest.raises(Error, match=r"guard of kernels/clusters.py: expected .* once, got it 0 times; adapt it"):
        guards.without_guards(tmp_path / "kernels")


def test_guards_are_timed_in_copies_that_take_turns(monkeypatch):
    places, settings = [], Settings()

    def render(folder, device, quick, given):
        assert given is settings and (folder / "warp_deferred/kernels/image.py").is_file()
        text = (folder / "warp_deferred/kernels/image.py").read_text()
        bare = folder.name == "bare"
        assert bare != any(guard.line in text for guard in guards.GUARDS if guard.file == "image.py")
        places.append(folder.name)
        (folder / "x.bytes").write_bytes(bytes([1, 2, 3 + bare]))
        times = {"guarded": [1.1, 1.0, 1.2], "bare": [1.0, 1.1, 0.9]}[folder.name]
        about = {"case": "x", "title": "a frame", "width": 1, "height": 1, "picture": str(folder / "x.bytes")}
        return [about | {"ms": times[places.count(folder.name) - 1]}]

    monkeypatch.setattr(guards, "_render", render)
    found = guards.run(wp.get_device("cpu"), quick=False, settings=settings, note=lambda text: None)
    assert places == ["guarded", "bare"] * 3
    (row,) = found["rows"]
    assert (row["guarded.ms"], row["bare.ms"], row["bare.ms_p5"], row["bare.ms_p95"]) == (1.1, 1.0, 0.91, 1.09)
    assert row["guards.percent"] == 10.0 and row["differing_bytes"] == 1
    text = tables.full_table(found | {"bench": "guards", "device": "CPU, 2 cores", "quick": False})
    assert "**+10.0 %**" in text and "≤ 3 ✗" in text
