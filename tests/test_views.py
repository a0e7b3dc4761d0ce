"""Views of several sizes in one set of launches, some of depth only, and nothing written outside a view."""

import dataclasses

import numpy as np
import pytest
from builders import FULL, assert_same, bits, gallery, grid, images, room, tilt
from reference_bridge import render_reference

import warp_deferred as wd
from warp_deferred import plan as plan_module
from warp_deferred.features import Features
from warp_deferred.light_store import LightStore
from warp_deferred.plan import Plan
from warp_deferred.renderer import VALUES
from warp_deferred.views import ViewLayout, ViewSize

NAMES = ("color", "diffuse", "specular", "depth", "normal", "instance_id", "triangle_id", "light_count")
SIZES = ((64, 48), (256, 256), (17, 33))


def run_views(scene, cameras, sizes, device, *, names=NAMES, settings=FULL, depth_clamp=False, fill=None):
    """Render views of any sizes through a plan made by hand; return it with its arrays of the flat arena."""
    renderer = wd.Renderer(scene, width=8, height=8, device=device, outputs=names, settings=settings)
    renderer._load_scene()
    renderer._features = Features.of(scene)
    depth_only = any(s.depth_only for s in sizes)
    outputs = frozenset(names if any(not s.depth_only for s in sizes) else ()) | {"keys"}
    outputs |= {"depth_keys"} if depth_only else set()
    request = dataclasses.replace(renderer._request(cameras)[0], sizes=tuple(sizes), outputs=outputs)
    lights = LightStore(request.features.light_capacity, len(sizes), renderer.device)
    plan = renderer._plan = Plan(request, renderer._device_scene, lambda: lights)
    if fill is not None:
        for name in names:
            plan.outputs[name].fill_(fill)
    renderer._update()
    block = plan.resources.frame.begin()
    plan.packer.write(
        block[plan.resources.frame.views_offset :], cameras, renderer._ranges([c.world for c in cameras]), depth_clamp
    )
    environment = scene.environment
    VALUES.pack_into(
        block, plan.resources.frame.values_offset, *environment.ambient, len(scene.lights), *environment.background,
        len(cameras),
    )  # fmt: skip
    plan.resources.frame.upload()
    plan.replay()
    return plan, {name: array.numpy() for name, array in plan.outputs.items()}


def cut(arrays, plan, view, names=NAMES):
    """Cut one view out of the flat arrays."""
    offset, pitch = plan.layout.fields[view][:2]
    size = plan.layout.sizes[view]
    place = offset + np.arange(size.height)[:, None] * pitch + np.arange(size.width)[None, :]
    return {name: arrays[name].reshape(-1, *arrays[name].shape[1:])[place] for name in names}


def linear_depth(keys, camera):
    z = keys.view(np.float32)
    if camera.projection == "orthographic":
        return np.float32(camera.far) - z * np.float32(np.float32(camera.far) - np.float32(camera.near))
    with np.errstate(divide="ignore"):
        return np.float32(camera.near) / z


def cameras_of(scene):
    return [
        scene.camera,
        wd.Camera.look_at((0.4, 0.8, 1.9), (0.0, 0.4, -1.0), vertical_fov_deg=80.0),
        wd.Camera.look_at((-2.0, 1.5, 3.0), (0.0, 0.4, 0.0)),
    ]


@pytest.mark.parametrize("bins", ["off", "on"])
@pytest.mark.parametrize("depth_view", [0, 1, 2])
def test_mixed_views_give_the_bits_of_single_ones(depth_view, bins, device):
    scene = room()
    cameras = cameras_of(scene)
    sizes = [ViewSize(*size, depth_only=k == depth_view) for k, size in enumerate(SIZES)]
    settings = FULL.with_values([f"raster.bins={bins}"])
    plan, arrays = run_views(scene, cameras, sizes, device, settings=settings)
    for k, (camera, size) in enumerate(zip(cameras, SIZES, strict=True)):
        alone = wd.Renderer(scene, width=size[0], height=size[1], device=device, outputs=NAMES, settings=FULL)
        expected = images(alone.render(camera))
        if k != depth_view:
            assert_same(expected, cut(arrays, plan, k))
            continue
        keys = cut(arrays, plan, k, ("depth_keys",))["depth_keys"]
        assert (keys > 0).mean() > 0.9
        assert np.array_equal(bits(linear_depth(keys, camera)), bits(expected["depth"]))


@pytest.mark.parametrize("tile", [8, 64])
@pytest.mark.parametrize("rung", ["tiles_depth", "brute_force"])
def test_bands_of_masks_change_no_bit_of_mixed_views(rung, tile, device):
    scene, frames = gallery(), []
    sizes = [ViewSize(*size, depth_only=k == 1) for k, size in enumerate([(64, 300), (40, 90), (257, 333)])]
    for budget in (1 << 28, 1 << 11, 1):
        changes = [f"light_culling.{n}={v}" for n, v in (("rung", rung), ("tile_size", tile))]
        settings = FULL.with_values([*changes, f"light_culling.mask_budget_bytes={budget}"])
        plan, arrays = run_views(scene, cameras_of(scene), sizes, device, settings=settings)
        frames.append([cut(arrays, plan, k) for k in (0, 2)])
        bands = next(stage.bands for stage in plan.passes if stage.name == "light_culling")
        assert len(bands) == {1 << 28: 1, 1: 11 if tile == 8 else 4}.get(budget, len(bands))
    for other in frames[1:]:
        for one, two in zip(frames[0], other, strict=True):
            assert_same(one, two)


def test_depth_views_alone_need_no_attributes(device):
    scene = gallery()
    sizes = [ViewSize(40, 30, depth_only=True), ViewSize(9, 50, depth_only=True)]
    plan, arrays = run_views(scene, cameras_of(scene)[:2], sizes, device)
    assert [p.name for p in plan.passes] == ["clusters", "raster"]
    for k, size in enumerate([(40, 30), (9, 50)]):
        alone = wd.Renderer(scene, width=size[0], height=size[1], device=device, outputs=("depth",))
        keys = cut(arrays, plan, k, ("depth_keys",))["depth_keys"]
        camera = cameras_of(scene)[k]
        expected = images(alone.render(camera))["depth"]
        seen = keys > 0
        assert np.array_equal(seen, np.isfinite(expected))
        assert np.array_equal(linear_depth(keys, camera)[seen], expected[seen])


class PaddedLayout(ViewLayout):
    """Leaves a border around each view and a gap after each row, so that stray writes land where they show."""

    BORDER, GAP = 300, 7

    def __init__(self, sizes, tile_size):
        super().__init__(sizes, tile_size)
        totals = {False: self.BORDER, True: self.BORDER}
        for k, size in enumerate(sizes):
            pitch = size.width + self.GAP
            self.fields[k] = (totals[size.depth_only], pitch, *self.fields[k][2:])
            totals[size.depth_only] += pitch * size.height + self.BORDER
        self.pixels, self.depth_pixels = totals[False], totals[True]


@pytest.mark.parametrize("bins", ["off", "on"])
def test_r9_nothing_is_written_outside_a_view(bins, device, monkeypatch):
    monkeypatch.setattr(plan_module, "ViewLayout", PaddedLayout)
    scene = room()
    cameras = cameras_of(scene)
    sizes = [ViewSize(*size, depth_only=k == 1) for k, size in enumerate(SIZES)]
    settings = FULL.with_values([f"raster.bins={bins}"])
    plan, arrays = run_views(scene, cameras, sizes, device, settings=settings, fill=77)
    inside = {kind: np.zeros(n, bool) for kind, n in ((0, plan.layout.pixels), (1, plan.layout.depth_pixels))}
    for k, size in enumerate(sizes):
        place = {"place": np.arange(len(inside[size.depth_only]))}
        inside[size.depth_only][cut(place, plan, k, ("place",))["place"]] = True
    assert np.all(arrays["keys"][~inside[0]] == 0) and np.all(arrays["depth_keys"][~inside[1]] == 0)
    assert np.all(arrays["depth_keys"][inside[1]] > 0), "the room should fill the view up to its borders"
    for name in NAMES:
        assert np.all(arrays[name][~inside[0]] == 77), name
    monkeypatch.undo()
    for k in (0, 2):
        alone = wd.Renderer(scene, width=SIZES[k][0], height=SIZES[k][1], device=device, outputs=NAMES, settings=FULL)
        assert_same(images(alone.render(cameras[k])), cut(arrays, plan, k))


@pytest.mark.parametrize("clamp", [False, True])
def test_t6_orthographic_depth_is_clipped_or_clamped(clamp, device):
    scene = wd.Scene()
    depths = (-1.0, -0.5, 0.0, 0.25, 0.75, 1.0, 1.5, 2.0)
    for k, z in enumerate(depths):
        scene.add(grid(1, 1.0), transform=tilt(0.0, 0.0, 1.0, (k - 3.5, 0.0, z - 1.0)))
    # z in the key is 1 at the near plane and 0 at the far one: with the eye at 0 and far 1 it is the quad's z.
    camera = wd.Camera(projection="orthographic", vertical_extent=1.0, near=0.0, far=1.0)
    sizes = [ViewSize(64, 8, depth_only=True)]
    plan, arrays = run_views(scene, [camera], sizes, device, depth_clamp=clamp)
    z = cut(arrays, plan, 0, ("depth_keys",))["depth_keys"].view(np.float32)[4, 4::8]
    expected = np.clip(depths, 0.0, 1.0) if clamp else np.where(np.abs(np.array(depths) - 0.5) <= 0.5, depths, 0.0)
    assert np.abs(z - expected).max() <= 1e-5
    reference = render_reference(scene, camera, 64, 8, depth_clamp=clamp)
    assert np.abs(reference["z"][4, 4::8] - expected).max() <= 1e-12
