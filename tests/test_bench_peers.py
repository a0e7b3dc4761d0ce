"""The bench of peers: the same inputs for all, who is missing is named, ratios and agreement are what they say."""

import contextlib
import importlib.util
import sys
import types

import bench_package  # noqa: F401
import numpy as np
import pytest
import warp as wp

from bench import layout, peer_tables, performance_page, record, targets
from bench.__main__ import main
from bench.peers import base, cases, measure, newton, nvdiffrast, opengl
from bench.peers.mujoco_warp import MuJoCoWarp
from bench.peers.newton import SensorCamera, SensorTiledCamera
from bench.peers.nvdiffrast import NvDiffRast
from bench.peers.opengl import OpenGL
from bench.peers.ours import OURS
from bench.peers.pygfx import PyGfx
from bench.timing import Timing
from warp_deferred import Renderer, Settings

CPU = wp.get_device("cpu")
WORDS = ("name", "title", "computes", "method")


class Pretender:
    """A peer of known speed whose depth is a little off at known pixels."""

    name, title, kinds = "pretender", "Pretender", ("gbuffer", "lit")
    computes, leaves_out, method, wins = "depth", "all else", "nothing", "It always wins."
    note = ""

    def __init__(self, fails=()):
        self.fails = fails

    def available(self, device):
        return None

    def version(self):
        return "pretender 1"

    def open(self, case, scene, cameras, device):
        if case.kind in self.fails:
            raise RuntimeError(f"no {case.kind} today\nsecond line")
        self.reference = measure._reference(case, scene, cameras, device)
        return self

    def time(self, repeats):
        return Timing(1e-6, 1e-6, 1e-6, repeats)

    def depth(self):
        depth = self.reference.copy()
        depth[0, -1, :8] *= 1.01
        depth[0, 0, 0] = 1.0
        return depth

    def picture(self):
        return None

    def close(self):
        pass


def run(monkeypatch, *peers, only="gbuffer_quick", keep=None):
    monkeypatch.setattr(measure, "PEERS", peers)
    return measure.run(CPU, quick=True, settings=Settings(), note=lambda _: None, only=only, keep=keep)


# ---- inputs


def test_clip_space_of_peers_is_the_cameras_own():
    case = cases.peer_cases(False, quick=True)[1]
    camera = case.cameras(case.build())[2]
    points = np.array([[0.0, 0.0, 0.0], [3.0, -0.5, 1.0], [-2.0, 0.5, -4.0]])
    seen = np.concatenate([points, np.ones((3, 1))], axis=1) @ base.view_matrix(camera).T
    clip = seen @ base.perspective(camera, 96, 64, 60.0).T
    fx, fy, cx, cy = camera.pixel_projection(96, 64)
    assert (seen[:, 2] < 0.0).all() and np.allclose(clip[:, 3], -seen[:, 2])
    np.testing.assert_allclose((clip[:, 0] / clip[:, 3] * 0.5 + 0.5) * 96, fx * seen[:, 0] / -seen[:, 2] + cx)
    np.testing.assert_allclose((0.5 - clip[:, 1] / clip[:, 3] * 0.5) * 64, cy - fy * seen[:, 1] / -seen[:, 2])
    ends = np.array([[0.0, 0.0, -camera.near, 1.0], [0.0, 0.0, -60.0, 1.0]])
    clip = ends @ base.perspective(camera, 96, 64, 60.0).T
    np.testing.assert_allclose(clip[:, 2] / clip[:, 3], (-1.0, 1.0))


def test_lights_of_peers_are_the_scenes():
    case = cases.PeerCase("c", "frame", "c", 96, 64, 800, lights=3, shadowed=4)
    scene = case.build()
    table = base.light_table(scene)
    assert len(table) == 7 and table.casts.tolist() == [False] * 3 + [True] * 4
    np.testing.assert_array_equal(table.position[:3], scene.lights.point.position.astype(np.float32))
    np.testing.assert_allclose(table.cosines[3:], np.tile(cases.COSINES, (4, 1)), atol=1e-6)
    assert (table.cosines[:3].max(axis=1) < -1.0).all()
    # Where the beams meet the ground: the middles of four cells, whose corners are inside the cones and the ranges.
    foot = table.position[3:] - table.direction[3:] * (table.position[3:, 1:2] / table.direction[3:, 1:2])
    half = cases.HALF_SIDE / 2.0
    assert {tuple(p) for p in np.round(foot[:, [0, 2]], 4).tolist()} == {
        (x, z) for x in (-half, half) for z in (-half, half)
    }
    corners = foot[:, None] + np.array([[x, 0.0, z] for x in (-half, half) for z in (-half, half)])
    rays = corners - table.position[3:, None]
    distance = np.linalg.norm(rays, axis=-1)
    axis = table.direction[3:] / np.linalg.norm(table.direction[3:], axis=-1, keepdims=True)
    assert (np.einsum("nkj,nj->nk", rays, axis) / distance > cases.COSINES[1]).all()
    assert (distance < table.range[3:, None]).all()


def test_cases_cover_what_was_asked_for():
    full = {case.name: case for case in cases.peer_cases(True)}
    assert {case.kind for case in full.values()} == set(cases.KINDS)
    assert all(case.triangles == 500_000 for case in full.values())
    assert [c.lights for c in full.values() if c.kind == "lit"] == [1, 16, 200, 1000]
    assert [c.shadowed for c in full.values() if c.kind == "shadowed"] == [1, 4, 16]
    assert full["gbuffer_views_64"].views == 64 and full["frame_4k"].width == 3840
    assert {case for case, _ in targets.PEER_TARGETS} <= set(full)
    small = cases.peer_cases(False)
    assert {case.kind for case in small} == set(cases.KINDS) and max(case.width for case in small) == 640
    assert {peer for _, peer in targets.PEER_TARGETS} <= {peer.name for peer in measure.PEERS}


def test_what_moved_is_no_input():
    scene = cases.peer_cases(False, quick=True)[0].build()
    scene.instances[0].transform = np.diag([2.0, 1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="not moved"):
        base.geometry_of(scene)


# ---- who runs


def test_every_peer_says_what_it_is():
    names = [peer.name for peer in measure.PEERS]
    assert names == ["newton", "newton_sensor_camera", "opengl", "nvdiffrast", "mujoco_warp", "pygfx"]
    for peer in (*OURS, *measure.PEERS):
        assert all(getattr(peer, word) for word in WORDS) and set(peer.kinds) <= set(cases.KINDS)
    for peer in measure.PEERS:
        assert peer.leaves_out and peer.wins.endswith(".")


def test_peers_that_are_missing_are_named(monkeypatch):
    found = importlib.util.find_spec
    gone = ("newton", "moderngl", "glcontext", "nvdiffrast", "torch", "mujoco", "mujoco_warp", "pygfx")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name in gone else found(name, *a))
    monkeypatch.setattr(opengl, "_context", opengl._context.__wrapped__)
    result = run(monkeypatch, SensorTiledCamera(), OpenGL(), NvDiffRast(), MuJoCoWarp(), PyGfx())
    assert [text.split(":")[0] for text in result["skipped"]] == [
        "Newton SensorTiledCamera",
        "OpenGL (moderngl, EGL)",
        "nvdiffrast (CUDA)",
        "MuJoCo Warp",
        "pygfx (WebGPU)",
    ]
    assert all("no module" in text or "no CPU path" in text for text in result["skipped"])
    assert [row["peer"] for row in result["rows"]] == ["ours", "ours_layers"]
    assert result["rows"][0]["ratio"] == 1.0 and result["rows"][1]["depth.agrees"] == 1.0


def test_failures_are_named_and_finished_rows_kept(monkeypatch):
    kept = []
    peer = Pretender(fails=("gbuffer",))
    result = run(monkeypatch, peer, only="gbuffer", keep=lambda part: kept.append(len(part["rows"])))
    assert "gbuffer_quick, Pretender: RuntimeError: no gbuffer today" in result["skipped"]
    assert kept == [2, 4] and len(result["rows"]) == 4


def test_agreement_counts_pixels(monkeypatch):
    result = run(monkeypatch, Pretender())
    row = result["rows"][-1]
    # Eight pixels one per cent off, and a background pixel that shows something.
    assert row["peer"] == "pretender" and row["depth.agrees"] == pytest.approx(1.0 - 9 / (96 * 64), abs=1e-6)
    base_ms = result["rows"][0]["time.ms"]
    assert row["ratio"] == pytest.approx(row["time.ms"] / base_ms, abs=1e-4)


def test_agreement_takes_the_tolerance_both_ways():
    reference = np.array([[[2.0, 2.0, 2.0, np.inf, np.inf, 2.0]]], np.float32)
    depth = np.array([[[2.0019, 1.9981, 2.0021, np.inf, 5.0, np.nan]]], np.float32)
    assert measure.agreement(depth, reference) == pytest.approx(3 / 6)
    with pytest.raises(ValueError, match=r"expected the shape \(1, 1, 6\)"):
        measure.agreement(depth[..., :5], reference)


def test_a_case_that_is_none_is_refused(capsys):
    assert main(["peers", "--device", "cpu", "--quick", "--only", "moon"]) == 2
    assert "--only: expected a part of one of gbuffer_quick" in capsys.readouterr().err


# ---- peers that are installed


def test_nvdiffrast_depth_is_made_of_z_over_w(monkeypatch):
    """Its rasterizer stood in for: it hands back our own depth as it would, in clip space with row 0 at the bottom."""
    case = cases.peer_cases(False, quick=True)[1]
    scene = case.build()
    cameras = case.cameras(scene)
    reference = measure._reference(case, scene, cameras, CPU)
    handed = {}

    class Tensor:
        def __init__(self, array):
            self.array = array

        def __getitem__(self, key):
            return Tensor(self.array[key])

        def cpu(self):
            return self

        def numpy(self):
            return self.array

    def rasterize(context, clip, triangles, size, grad_db):
        handed.update(clip=clip.array, size=size)
        surface = np.isfinite(reference)
        end = np.array([[0.0, 0.0, -1.0, 1.0]]) * np.where(surface, reference, 1.0)[..., None]
        end[..., 3] = 1.0
        projected = end @ base.perspective(cameras[0], *size[::-1], nvdiffrast.FAR).T
        out = np.zeros((*reference.shape, 4), np.float32)
        out[..., 2] = np.where(surface, projected[..., 2] / projected[..., 3], 0.0)
        out[..., 3] = surface
        return Tensor(out[:, ::-1]), None

    fake = types.SimpleNamespace(
        device=lambda *_: "cuda", as_tensor=lambda array, device: Tensor(array), no_grad=contextlib.nullcontext
    )
    rast = types.ModuleType("nvdiffrast.torch")
    rast.RasterizeCudaContext, rast.rasterize = lambda device: None, rasterize
    rast.interpolate = lambda *_: (None, None)
    parent = types.ModuleType("nvdiffrast")
    parent.torch = rast
    for name, module in (("torch", fake), ("nvdiffrast", parent), ("nvdiffrast.torch", rast)):
        monkeypatch.setitem(sys.modules, name, module)
    device = types.SimpleNamespace(ordinal=0)
    depth = NvDiffRast().open(case, scene, cameras, device).depth()
    assert measure.agreement(depth, reference) == 1.0
    assert handed["clip"].shape == (3, len(scene.instances[0].mesh.positions), 4) and handed["size"] == (32, 32)


@pytest.mark.parametrize("peer", [SensorTiledCamera(), SensorCamera(), OpenGL(), MuJoCoWarp()], ids=lambda p: p.name)
def test_installed_peers_see_the_same_surface(peer):
    if why := peer.available(CPU):
        pytest.skip(why)
    for case in cases.peer_cases(False, quick=True)[:2]:
        scene = case.build()
        cameras = case.cameras(scene)
        session = peer.open(case, scene, cameras, CPU)
        try:
            depth = session.depth()
            assert session.time(3).median > 0.0
        finally:
            session.close()
        reference = Renderer(scene, width=case.width, height=case.height, device="cpu", outputs=("depth",))
        assert measure.agreement(depth, reference.render(cameras).numpy("depth")) > 0.995


@pytest.mark.skipif(SensorCamera().available(CPU) is not None, reason="no Newton")
def test_newton_gets_the_tree_that_is_searched_fastest(monkeypatch):
    built = []

    def timed(session, device, run, repeats):
        run()
        constructor = [key[2] for key in newton._kept][-1]
        built.append(constructor)
        if constructor == "cubql":
            raise RuntimeError("no such tree")
        return Timing(1.0 if constructor == "sah" else 2.0, 1.0, 1.0, repeats)

    monkeypatch.setattr(newton, "_kept", {})
    monkeypatch.setattr(newton, "_fastest", {})
    monkeypatch.setattr(newton, "_constructors", lambda device: newton.CONSTRUCTORS)
    monkeypatch.setattr(newton, "time_warp", timed)
    case = cases.peer_cases(False, quick=True)[0]
    scene = case.build()
    for _ in range(2):
        session = SensorCamera().open(case, scene, case.cameras(scene), CPU)
        assert session.model is newton._kept[base.geometry_of(scene).digest, "cpu", "sah"]
    assert built == [None, "sah", "cubql"] and "sah tree on cpu" in SensorCamera().version()


@pytest.mark.skipif(OpenGL().available(CPU) is not None, reason="no OpenGL on the CPU")
def test_opengl_lights_as_we_do():
    """Where nothing is tone mapped away, forward shading and ours are the same picture but for rounding."""
    case = next(c for c in cases.peer_cases(False, quick=True) if c.kind == "frame")
    scene = case.build()
    scene.lights.point.intensity = 0.05 * scene.lights.point.intensity
    scene.lights.spot.intensity = 0.05 * scene.lights.spot.intensity
    scene.settings = Settings().with_values(["ambient_visibility.rung=off", "shadow.spot_size=128"])
    session = OpenGL().open(case, scene, case.cameras(scene), CPU)
    theirs = session.picture().astype(float)
    session.close()
    color = Renderer(scene, width=case.width, height=case.height, device="cpu", outputs=("color",)).render()
    ours = base.srgb(color.numpy("color")[0]).astype(float)
    difference = np.abs(ours - theirs).max(axis=-1)
    # Edges of shadows are filtered in two ways.
    assert np.median(difference) <= 1.0 and (difference > 6.0).mean() < 0.05


# ---- tables


def made(**changes):
    """A result of two renderers on one case."""
    row = {
        "case": "lit_1000", "kind": "lit", "title": "terrain", "width": 8, "height": 8, "views": 1, "triangles": 2,
        "lights": 1000, "shadowed": 0, "time.ms_p5": 0.1, "time.ms_p95": 9.0, "time.repeats": 50,
    }  # fmt: skip
    words = {"computes": "a", "leaves_out": "b", "method": "c", "wins": "Why.", "version": "1"}
    result = {
        "bench": "peers", "device": "NVIDIA H200", "quick": False, "skipped": ["pygfx: no module pygfx"],
        "peers": [{"name": n, "title": t} | words for n, t in (("ours", "ours"), ("newton", "Newton"))],
        "rows": [
            row | {"peer": "ours", "peer_title": "ours", "time.ms": 0.4, "ratio": 1.0},
            row | {"peer": "newton", "peer_title": "Newton", "time.ms": 8.4, "ratio": 21.0, "depth.agrees": 0.999},
        ],
    }  # fmt: skip
    result["rows"][1] |= changes
    return result


def test_tables_say_who_wins_and_what_must_be_reached():
    text = peer_tables.peers_table(made())
    assert "| Newton | 8.40 | 0.100 to 9.00 | 21.0 x | ≥ 20 x ✓ | 99.900% |" in text
    assert "faster than ours here: nowhere. Why." in text and "- pygfx: no module pygfx" in text
    # Nearly all pixels are not all.
    assert "| 99.999% |" in peer_tables.peers_table(made(**{"depth.agrees": 0.999999}))
    assert "| everywhere |" in peer_tables.peers_table(made(**{"depth.agrees": 1.0}))
    lost = peer_tables.peers_table(made(ratio=0.5))
    assert "0.500 x, faster | ≥ 20 x ✗" in lost and "faster than ours here: terrain (0.500 x). Why." in lost
    assert "| terrain | **0.400** | 8.40 (21.0 x), ≥ 20 x ✓ |" in peer_tables.peers_overview(made())
    # A verdict belongs to the card it is stated for.
    other = peer_tables.peers_overview(made() | {"device": "NVIDIA H100"})
    assert "≥ 20 x" in other and "✓" not in other
    assert layout.times(2.0) == "2.00 x"


def test_results_come_back_and_make_a_page(tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "PEERS", (Pretender(),))
    path = tmp_path / "peers.json"
    images = tmp_path / "images"
    arguments = ["peers", "--device", "cpu", "--quick", "--only", "gbuffer_quick"]
    assert main([*arguments, "--json", str(path), "--preview", str(images)]) == 0
    result = record.read(path)
    assert [row["peer"] for row in result["rows"]] == ["ours", "ours_layers", "pretender"]
    assert {p.name for p in images.iterdir()} == {
        "peers_gbuffer_quick_ours_layers.png",
        "peers_gbuffer_quick_pretender.png",
    }
    page = performance_page.performance_page({"peers": result}, images)
    assert page.startswith("# Performance") and "Pretender" in page and "(images/bench_peers.png)" in page


def test_launches_that_cannot_be_captured_are_timed_and_told(monkeypatch):
    calls = []

    def launches(device, run, *, repeats, captured=True):
        calls.append(captured)
        if captured:
            raise RuntimeError("capture failed\nmore")
        return Timing(1.0, 1.0, 1.0, repeats)

    monkeypatch.setattr(base, "time_launches", launches)
    peer = Pretender()
    assert base.time_warp(peer, CPU, lambda: None, 5).repeats == 5 and calls == [True, False]
    assert peer.note == "not captured: capture failed"
    noted = made(note=peer.note)
    assert "| Newton (not captured: capture failed) |" in peer_tables.peers_table(noted)
