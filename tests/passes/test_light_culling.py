"""Light masks in bands: the cuts, what they hold at most, and that no bit of an image tells of them."""

import itertools

import numpy as np
import pytest
from builders import FULL, Spy, assert_same, gallery, images

import warp_deferred as wd
from warp_deferred.features import Features
from warp_deferred.passes import light_culling
from warp_deferred.passes.base import Request
from warp_deferred.passes.light_culling import LightCullingPass, mask_bands, mask_words
from warp_deferred.views import ViewLayout, ViewSize

LIT = ("color", "diffuse", "specular", "light_count", "depth")
MASKS = ("mask_words", "mask_summary", "mask_coarse")
#: Odd, not a multiple of any tile, and of at least three rows of the largest coarse tiles.
SIZE = (97, 523)
VIEWS = (ViewSize(257, 300), ViewSize(1, 1), ViewSize(90, 700, depth_only=True), ViewSize(33, 517), ViewSize(600, 64))


def crowd(lights=70):
    """Return the gallery under small lights all over a tall image: three mask words, other sets in every band."""
    scene = gallery()
    rng = np.random.default_rng(5)
    for _ in range(lights):
        position = rng.uniform((-3.5, 0.05, -3.0), (3.5, 2.5, 4.5))
        scene.lights.add(
            wd.PointLight(position=tuple(position), range=float(rng.uniform(0.3, 1.5)), intensity=0.5),
        )
    return scene


def render(scene, budget, *changes, device="cpu", outputs=LIT, base=FULL, **fields):
    settings = base.with_values([f"light_culling.mask_budget_bytes={budget}", *changes])
    renderer = wd.Renderer(
        scene, width=SIZE[0], height=SIZE[1], device=device, outputs=outputs, settings=settings, **fields
    )
    return renderer, images(renderer.render())


def request_of(sizes, budget, lights, *changes):
    """Return what a plan would be asked for, without a scene on a device."""
    scene = wd.Scene()
    scene.lights.extend("point", lights, position=(0.0, 1.0, 0.0), range=1.0)
    settings = wd.Settings().with_values([f"light_culling.mask_budget_bytes={budget}", *changes])
    return Request(frozenset({"display"}), tuple(sizes), settings, Features.of(scene), 1, 1, 1, 1, 0, 0)


def culling_of(renderer):
    return next(stage for stage in renderer.plan.passes if stage.name == "light_culling")


def bands_of(renderer):
    return culling_of(renderer).bands


def mask_bytes(stage):
    """Return the bytes of a pass's mask buffers, before they are padded."""
    writes = stage.writes()
    return sum(4 * writes[name].count for name in MASKS if name in writes)


# ---- images


@pytest.mark.parametrize("tile", [8, 16, 32, 64])
@pytest.mark.parametrize("rung", ["tiles_depth", "tiles", "brute_force"])
def test_bands_change_no_bit(rung, tile, device):
    scene, changes = crowd(), (f"light_culling.rung={rung}", f"light_culling.tile_size={tile}")
    one, expected = render(scene, 1 << 28, *changes, device=device)
    assert len(bands_of(one)) == 1 and expected["light_count"].max() > 3
    whole = mask_bytes(culling_of(one))
    rows = -(-SIZE[1] // (tile << one.plan.layout.coarse_shift))
    counts = set()
    for budget in (whole * 4 // 5, 1):
        renderer, image = render(scene, budget, *changes, device=device)
        counts.add(len(bands_of(renderer)))
        assert_same(expected, image)
        assert mask_bytes(culling_of(renderer)) < whole
    assert counts == {2, rows} and rows >= 3


@pytest.mark.parametrize("rung", ["tiles_depth", "tiles"])
def test_pictures_in_shared_memory_are_the_same_in_bands(rung, device):
    # Radiance lies where buffers that have died may have been: those that later bands read must not be among them.
    scene, changes = crowd(), (f"light_culling.rung={rung}",)
    fields = {"device": device, "outputs": ("display",), "base": wd.Settings()}
    expected = render(scene, 1 << 28, *changes, **fields)[1]
    renderer, image = render(scene, 1, *changes, **fields)
    assert len(bands_of(renderer)) == 5 and "radiance" in renderer.plan.memory
    assert_same(expected, image)


@pytest.mark.parametrize("rung", ["tiles_depth", "tiles"])
def test_the_last_band_s_masks_are_the_end_of_all_masks(rung, device):
    scene, change = crowd(), f"light_culling.rung={rung}"
    one, cut = (render(scene, b, change, device=device, share_memory=False)[0] for b in (1 << 28, 1))
    band, words = bands_of(cut)[-1], mask_words(cut.plan.request)[0]
    counts = (band.tile_count * words, band.tile_count, band.coarse_count * words)
    for name, count in zip(MASKS, counts, strict=True):
        whole, last = (renderer.plan.resources.channels[name].numpy() for renderer in (one, cut))
        assert whole.any() and np.array_equal(whole[-count:], last[:count]), name


def test_host_threads_and_bands_change_no_bit():
    scene = crowd()
    for rung in ("tiles_depth", "brute_force"):
        expected = render(scene, 1 << 28, f"light_culling.rung={rung}", threads=1)[1]
        for threads in (1, 2, 3):
            renderer, image = render(scene, 1, f"light_culling.rung={rung}", threads=threads)
            assert len(bands_of(renderer)) == 5
            assert_same(expected, image)


def test_bands_across_views_of_a_batch_change_no_bit(device):
    scene = crowd()
    cameras = [scene.camera, wd.Camera.look_at((-2.0, 1.5, 3.0), (0.0, 0.4, 0.0)), scene.camera.replace(exposure=1.0)]
    frames = []
    for budget in (1 << 28, 2200, 1):
        settings = FULL.with_values([f"light_culling.mask_budget_bytes={budget}"])
        renderer = wd.Renderer(scene, width=71, height=201, device=device, outputs=LIT, settings=settings)
        frame = renderer.render(cameras)
        frames.append([images(frame, k) for k in range(3)])
        if budget == 2200:
            starts = {band.tiles.start for band in bands_of(renderer)}
            per_view = len(renderer.plan.layout.tiles) // 3
            assert len(starts) > 1 and not {per_view, 2 * per_view} <= starts, "some band should span two views"
    for other in frames[1:]:
        for a, b in zip(frames[0], other, strict=True):
            assert_same(a, b)


def test_moving_on_band_by_band_makes_nothing_new(device):
    scene = crowd()
    renderer, first = render(scene, 1, device=device)
    plain = render(scene, 1 << 28, device=device)[0]
    for k in (1, 2):
        for _, group in scene.lights.groups():
            group.intensity = group.intensity * 1.5
        scene.camera = wd.Camera.look_at((0.6 - 0.3 * k, 1.9, 4.6), (0.0, 0.7, 0.0))
        with Spy() as spy:
            renderer.render()
        spy.assert_nothing()
    last = images(renderer.render())
    assert not np.array_equal(first["color"], last["color"])
    assert_same(images(plain.render()), last)
    assert "bands" in str(renderer.explain(measure=True))
    assert_same(last, images(renderer.render()))


def test_without_lights_or_lit_outputs_nothing_is_cut(device):
    for scene, outputs in ((gallery(lights=False), LIT), (crowd(), ("depth", "normal"))):
        images_of = [render(scene, b, device=device, outputs=outputs)[1] for b in (1 << 28, 1)]
        assert_same(*images_of)
        renderer = render(scene, 1, device=device, outputs=outputs)[0]
        assert not any(name in renderer.plan.memory for name in MASKS) and not renderer.memory_report().mask_bands
        launched = [kernel.key for kernel, _ in renderer.plan.resources.program.kernels]
        assert sum("shade" in key for key in launched) == (outputs == LIT)


def test_one_band_costs_no_launch(unchecked):
    sections = {}
    for budget in (1 << 28, 1):
        renderer = render(crowd(), budget)[0]
        sections[budget] = {s.name: len(s.steps) for s in renderer.plan.resources.program.sections}
    assert (sections[1 << 28]["light_culling"], sections[1 << 28]["shade"]) == (6, 1)
    assert (sections[1]["light_culling"], sections[1]["shade"]) == (2, 5 * 5)


# ---- cuts


@pytest.mark.parametrize("tile", [8, 16, 32, 64])
@pytest.mark.parametrize("budget", [1, 700, 3000, 20_000, 1 << 28])
def test_bands_cover_the_tables_in_order_and_fit_the_budget(budget, tile):
    request = request_of(VIEWS, budget, 100, f"light_culling.tile_size={tile}")
    layout = ViewLayout(request.sizes, tile)
    bands, (words, summary) = mask_bands(request, layout), mask_words(request)
    side = tile << layout.coarse_shift
    for name, table in (("tiles", layout.tiles), ("coarse", layout.coarse_tiles), ("blocks", layout.blocks)):
        edges = [getattr(band, name) for band in bands]
        assert edges[0].start == 0 and edges[-1].stop == len(table)
        assert all(a.stop == b.start < b.stop for a, b in itertools.pairwise(edges))
    held = []
    for band in bands:
        parents = layout.tiles[band.tiles, 3]
        assert parents.min() == band.coarse.start and parents.max() == band.coarse.stop - 1
        coarse = layout.coarse_tiles[band.coarse]
        rows = {(v, y // side) for v, y in coarse[:, [0, 2]].tolist()}
        blocks = layout.blocks[band.blocks]
        assert rows == {(v, y // side) for v, y in blocks[:, [0, 2]].tolist()}
        held.append(4 * (band.tile_count * (words + summary) + band.coarse_count * words))
        assert held[-1] <= budget or len(rows) == 1
    # Each band is filled as far as it goes: not even the next one's first row would have fitted.
    for k, band in enumerate(bands[1:]):
        first = layout.coarse_tiles[band.coarse][0]
        row = layout.coarse_tiles[:, [0, 2]] == first[[0, 2]]
        coarse_row = np.flatnonzero(row.all(axis=1))
        tiles = np.isin(layout.tiles[:, 3], coarse_row).sum()
        assert held[k] + 4 * (tiles * (words + summary) + len(coarse_row) * words) > budget
    assert (len(bands) == 1) == (sum(held) <= budget)


@pytest.mark.parametrize("tile", [8, 16, 32, 64])
@pytest.mark.parametrize("rung", ["tiles_depth", "brute_force"])
def test_masks_of_the_largest_image_stay_within_the_default_budget(rung, tile):
    budget = wd.Settings().light_culling.mask_budget_bytes
    assert budget == 256 * 2**20
    request = request_of(
        [ViewSize(16384, 16384)], budget, 10_000, f"light_culling.rung={rung}", f"light_culling.tile_size={tile}"
    )
    stage = LightCullingPass().bound(request, ViewLayout(request.sizes, tile))
    held = mask_bytes(stage)
    whole = 4 * (16384 // tile) ** 2 * mask_words(request)[0]
    assert 0.75 * min(budget, whole) < held <= budget
    # 10 000 lights are kept as 16 384: of rows of coarse tiles, 256, 128, 128 and 64, a band holds 7, 15, 60 and all.
    assert len(stage.bands) == {8: 37, 16: 9, 32: 3, 64: 1}[tile]


def test_only_a_row_past_all_ids_is_refused(device, monkeypatch):
    scene = crowd()
    monkeypatch.setattr(light_culling, "MAX_WORDS", 7 * 8 * 4 - 1)
    render(scene, 1, "light_culling.tile_size=32", device=device)
    renderer = wd.Renderer(
        scene, width=SIZE[0], height=SIZE[1], device=device, outputs=LIT,
        settings=FULL.with_values(["light_culling.mask_budget_bytes=1"]),
    )  # fmt: skip
    renderer._load_scene()
    with Spy() as spy, pytest.raises(wd.CapacityError, match=r"light masks: expected .* got 56 x 4; use larger light"):
        renderer.render()
    assert not spy.allocated or max(size for _, size in spy.allocated) < 100_000, "only the scene and the lights"


# ---- reports


def test_reports_tell_of_the_bands(device):
    scene = crowd()
    texts, bands, moved = [], [], []
    for budget in (1 << 28, 1):
        renderer = render(scene, budget, device=device)[0]
        explanation, memory = renderer.explain(measure=False), renderer.memory_report()
        texts.append((str(explanation), str(memory)))
        bands.append((memory.mask_bands, memory.to_dict()["mask_bands"]))
        moved.append(sum(row.bytes for row in explanation.rows if row.runs))
    assert bands == [(1, 1), (5, 5)]
    assert "bands" not in texts[0][0] + texts[0][1]
    assert "tiles_depth, 16 px, 5 bands" in texts[1][0] and "masks come in 5 bands of tiles" in texts[1][0]
    assert "mask_words, 1 of 5 bands" in texts[1][1]
    assert moved[0] == moved[1], "bands move no more than whole masks do"


@pytest.mark.parametrize("bad", [0, -1, -(1 << 28), 1 << 33, 1.5, "plenty"])
def test_budgets_that_cannot_be_are_refused(bad):
    with pytest.raises(wd.InputError, match=r"LightCullingSettings\.mask_budget_bytes: expected "):
        wd.Settings().light_culling.replace(mask_budget_bytes=bad)
    with pytest.raises(wd.InputError, match=r"mask_budget_bytes: expected "):
        wd.Settings().with_values([f"light_culling.mask_budget_bytes={bad}"])
