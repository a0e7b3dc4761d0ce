"""Debug views: each buffer's colours against the buffer itself, what is run for them, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from typing import get_args

import numpy as np
import pytest
import reference
import warp as wp
from builders import gallery, images, spied
from warp_deferred.kernels import debug_view as kernels
from warp_deferred.kernels import structs
from warp_deferred.kernels.image import Image

import warp_deferred as wd
from warp_deferred.debug_views import DEBUG_VIEWS
from warp_deferred.settings import DisplaySettings

MADE = [name for name in DEBUG_VIEWS if name != "shadow_atlas"]
SIZE = {"width": 72, "height": 50}


def settings(view, *more):
    return wd.Settings().with_values([f"display.view={view}", *more])


def renderer_of(view, device, scene=None, outputs=("display",), **fields):
    size = SIZE | {k: fields.pop(k) for k in ("width", "height") if k in fields}
    scene = gallery() if scene is None else scene
    return wd.Renderer(scene, device=device, outputs=outputs, settings=settings(view), **size, **fields)


def shown(view, device, **fields):
    """Red, green and blue codes of a view, (height, width, 3)."""
    picture = renderer_of(view, device, **fields).render().numpy("display")[0]
    assert (picture[..., 3] == 255).all()
    return picture[..., :3].astype(int)


def buffers(device, *names, scene=None):
    return images(wd.Renderer(scene or gallery(), device=device, outputs=names, **SIZE).render())


def heat(share):
    """Twin of Turbo's polynomials."""
    factors = (
        (0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943),
        (0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604),
        (0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973),
    )
    t = np.clip(share, 0.0, 1.0)
    return np.stack([np.clip(np.polyval(f[::-1], t), 0.0, 1.0) for f in factors], axis=-1) * 255.0


def heat_of_count(count):
    scale = heat((1.0 + np.log2(np.maximum(count, 1))) / 7.0)
    return np.where((count > 0)[..., None], scale, 0.0)


def test_settings_and_table_list_the_same_views():
    assert get_args(DisplaySettings.model_fields["view"].annotation) == ("picture", *DEBUG_VIEWS)
    assert {view.kind for view in DEBUG_VIEWS.values()} == set(kernels.KINDS)


def test_vectors_and_shares_are_shown_by_their_numbers(device):
    data = buffers(device, "normal", "position", "albedo", "alpha", "diffuse", "ambient_visibility")
    seen = (data["alpha"] > 0)[..., None]
    expected = {
        "normal": np.where(seen, data["normal"] * 127.5 + 127.5, 0.0),
        "position": np.where(seen, np.abs(2 * np.mod(data["position"].astype(float) / 2, 1.0) - 1) * 255, 0.0),
        "albedo": reference.srgb_encode(data["albedo"]) * 255.0,
        "alpha": np.repeat(data["alpha"][..., None], 3, axis=2) * 255.0,
        "ambient_visibility": np.repeat(data["ambient_visibility"][..., None], 3, axis=2) * 255.0,
        "diffuse": reference.srgb_encode(reference.tone_pbr_neutral(data["diffuse"])) * 255.0,
    }
    for view, codes in expected.items():
        # Half a code of rounding and what float32 adds to it.
        assert np.abs(shown(view, device) - codes).max() < 0.51, view
        assert codes.max() > 150, view


@pytest.mark.parametrize("view", ["instance_id", "semantic_id", "material_id", "triangle_id"])
def test_ids_have_a_colour_each(view, device):
    ids = buffers(device, view)[view].reshape(-1)
    colors = shown(view, device).reshape(-1, 3)
    assert (colors[ids < 0] == 0).all() and colors[ids >= 0].max(axis=1).min() > 100
    pairs = np.unique(np.concatenate([ids[:, None], colors], axis=1), axis=0)
    assert len(pairs) == len(np.unique(ids)) == len(np.unique(colors, axis=0)) > 2


def test_counts_are_heat_by_doublings(device):
    count = buffers(device, "light_count")["light_count"]
    picture = shown("light_count", device)
    assert np.abs(picture - heat_of_count(count)).max() < 1.01
    assert len(np.unique(count)) > 2
    # The legend: blue for 1, green for 4, red for 32.
    dominant = heat_of_count(np.array([1, 4, 32])).argmax(axis=1)
    assert dominant.tolist() == [2, 1, 0]


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_depth_runs_from_red_to_blue(projection, device):
    scene = gallery()
    if projection == "orthographic":
        # Its near plane may lie behind the eye: depths of both signs.
        scene.camera = scene.camera.replace(projection=projection, vertical_extent=4.0, near=-5.0, far=40.0)
        scene.camera = scene.camera.replace(position=(0.0, 0.7, 0.0))
    depth = buffers(device, "depth", scene=scene)["depth"].astype(float)
    seen = np.isfinite(depth)
    assert seen.any() and (projection == "perspective" or depth[seen].min() < 0 < depth[seen].max())
    scaled = np.log(depth[seen]) if projection == "perspective" else depth[seen]
    share = 1.0 - (scaled - scaled.min()) / np.ptp(scaled)
    picture = shown("depth", device, scene=scene)
    assert np.abs(picture[seen] - heat(share)).max() < 1.01
    assert (picture[~seen] == 0).all() and (~seen).any()


def test_views_of_a_batch_have_their_own_range(device):
    scene = gallery()
    far = scene.camera.replace(position=(2.0, 6.0, 15.0))
    renderer = renderer_of("depth", device, scene)
    both = renderer.render([scene.camera, far]).numpy("display")
    for camera, picture in zip([scene.camera, far], both, strict=True):
        assert np.array_equal(renderer.render(camera).numpy("display")[0], picture)


def test_tiles_show_their_masks(device):
    renderer = renderer_of("tiles", device, share_memory=False)
    picture = renderer.render().numpy("display")[0][..., :3].astype(int)
    plan = renderer.plan
    words = plan.resources.channels["mask_words"].numpy().reshape(len(plan.layout.tiles), -1)
    count = np.array([sum(int(w).bit_count() for w in row) for row in words])
    assert len(np.unique(count)) > 1
    for (_, x, y, _), n in zip(plan.layout.tiles, count, strict=True):
        tile = picture[y : y + 16, x : x + 16][1:, 1:].reshape(-1, 3)
        # Between half and all of the heat, by how the surface faces the eye.
        whole = heat_of_count(np.array(n))
        assert (tile <= whole + 1.01).all() and (tile >= 0.5 * whole - 1.01).all()


def test_clusters_are_those_of_the_meshes(device):
    scene = gallery()
    data = buffers(device, "instance_id", "triangle_id", scene=scene)
    renderer = renderer_of("clusters", device, scene, share_memory=False)
    picture = renderer.render().numpy("display")[0][..., :3].astype(int)
    table = renderer.plan.passes[-1].shown[0].clusters.numpy()
    geometry = renderer._device_scene.geometry
    named, clusters = geometry.cluster_triangles.numpy(), geometry.clusters.numpy()
    for k, mesh in enumerate(renderer._device_scene.meshes):
        first = renderer._device_scene.first_triangle[id(mesh)]
        for c in range(*(lambda r: (r[0], r[0] + r[1]))(renderer._device_scene.cluster_range[id(mesh)])):
            cluster = clusters[c]
            own = named[cluster["first"] : cluster["first"] + cluster["count"], 3]
            assert (table[first + own] == c).all(), (k, c)
    seen = data["instance_id"] >= 0
    assert (picture[~seen] == 0).all() and (picture[seen].max(axis=1) > 50).all()


def test_wireframe_draws_edges_and_leaves_the_middle(device):
    scene = wd.Scene()
    mesh = wd.Mesh([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], [(0, 1, 2), (0, 2, 3)])
    scene.add(mesh)
    scene.camera = wd.Camera.look_at((0, 0, 4), (0, 0, 0), vertical_fov_deg=40.0)
    picture = shown("wireframe", device, scene=scene, width=120, height=120)
    orange = (picture[..., 0] > 1.5 * picture[..., 2]) & (picture[..., 0] > 100)
    covered = picture.max(axis=2) > 0
    rows, columns = np.nonzero(covered)
    low, high = rows.min(), rows.max()
    assert orange[low, columns.min() : columns.max()].all() and orange[high, columns.min() : columns.max()].all()
    # The diagonal from the lower left to the upper right.
    for k in range(low + 3, high - 3):
        assert orange[k, low + high - k], k
    middle = picture[low + (high - low) // 4, columns.min() + (columns.max() - columns.min()) // 4]
    assert np.ptp(middle) == 0 and 0.03 < orange.mean() / covered.mean() < 0.2


@wp.kernel
def spoil_kernel(image: wp.array[wp.vec3], out_image: wp.array[wp.vec3]):
    i = wp.tid()
    value = image[i]
    if i % 7 == 0:
        value = wp.vec3(value[0], wp.nan, value[2])
    elif i % 7 == 1:
        value = wp.vec3(value[0], value[1], wp.inf)
    out_image[i] = value


class Spoil(wd.Pass):
    name = "spoil"
    image = "turn"

    def run(self, resources):
        c = resources.channels
        resources.program.launch(spoil_kernel, self.layout.pixels, [c[self.source]], [c[self.target]], block_dim=64)


def test_invalid_numbers_are_marked(device, unchecked):
    clean, spoiled = shown("invalid", device), shown("invalid", device, passes=[Spoil])
    flat, base = spoiled.reshape(-1, 3), clean.reshape(-1, 3)
    assert (flat[::7] == (255, 0, 0)).all() and (flat[1::7] == (0, 255, 0)).all()
    assert np.array_equal(np.ptp(base, axis=1), np.zeros(len(base))) and 20 < base.max() < 160
    # Half and float32 images differ by a code at most.
    assert np.abs(flat[2::7] - base[2::7]).max() <= 1
    assert (spoiled[..., 0] != spoiled[..., 1]).sum() == len(flat[::7]) + len(flat[1::7])


@pytest.mark.parametrize("view", MADE)
def test_what_a_view_does_not_need_is_not_run(view, device):
    renderer = renderer_of(view, device, outputs=("display", "depth"))
    frame = renderer.render()
    assert frame.outputs == ("display", "depth")
    names = [stage.name for stage in renderer.plan.passes]
    assert names[-1] == "debug_view" and "display" not in names
    shaded = view in ("diffuse", "specular", "light_count", "invalid")
    assert ("shade" in names) == shaded and ("light_culling" in names) == (shaded or view == "tiles")
    assert ("ambient_visibility" in names) == (view in ("ambient_visibility", "invalid"))
    first = images(frame)
    assert np.array_equal(first["depth"], buffers(device, "depth")["depth"])
    second = images(spied(renderer))
    assert np.array_equal(first["display"], second["display"])
    report = str(renderer.explain(measure=False))
    assert f"display.view is {view}" in report.replace("\n", " ")


@pytest.mark.parametrize("view", ["normal", "wireframe", "tiles", "invalid"])
def test_an_empty_scene_has_views(view, device):
    scene = wd.Scene()
    scene.camera = wd.Camera()
    if view == "tiles":
        scene.lights.add(wd.PointLight(position=(0, 1, 0), intensity=5.0, range=3.0))
    assert np.ptp(shown(view, device, scene=scene).reshape(-1, 3), axis=0).max() <= 1


@pytest.mark.parametrize("view", ["normal", "clusters", "invalid"])
def test_views_stand_where_samples_are_averaged(view, device):
    once = shown(view, device)
    many = wd.Renderer(
        gallery(), device=device, settings=settings(view, "anti_aliasing.rung=samples_4"), **SIZE
    ).render()
    if view == "invalid":
        assert np.abs(many.numpy("display")[0][..., :3].astype(int) - once).mean() < 6
    else:
        assert np.array_equal(many.numpy("display")[0][..., :3], once)


@pytest.mark.parametrize("view", ["normal", "invalid"])
def test_a_view_is_without_bloom(view, device):
    scene = gallery()
    plain = shown(view, device, scene=scene)
    scene.camera = scene.camera.replace(bloom=0.5)
    assert np.array_equal(shown(view, device, scene=scene), plain)


def test_what_is_missing_is_named(device):
    with pytest.raises(wd.Error, match=r"view=ambient_visibility: no pass finds it while .*rung is off"):
        off = settings("ambient_visibility", "ambient_visibility.rung=off")
        wd.Renderer(gallery(), device=device, settings=off, **SIZE).render()
    with pytest.raises(wd.Error, match=r"'depth_keys'.*shadow_atlas: no pass .* needs a light that casts shadows"):
        shown("shadow_atlas", device)
    with pytest.raises(wd.Error, match=r"'mask_words'.*display.view=tiles: light masks are made for scenes with"):
        shown("tiles", device, scene=gallery(lights=False))
    with pytest.raises(wd.InputError, match=r"view.*'normal'"):
        wd.Settings().with_values(["display.view=normals"])


@pytest.mark.parametrize("rung", ["tiles", "tiles_depth", "brute_force"])
@pytest.mark.parametrize("samples", ["off", "samples_4"])
def test_tiles_are_shown_in_bands_as_in_one(rung, samples, device):
    frames = []
    for budget in (1, 2**28):
        values = [f"light_culling.mask_budget_bytes={budget}", f"light_culling.rung={rung}"]
        several = settings("tiles", f"anti_aliasing.rung={samples}", *values)
        renderer = wd.Renderer(gallery(), device=device, settings=several, width=64, height=300, outputs=("display",))
        renderer.render()
        frames.append(renderer.render().numpy("display")[0])
        shade = next(stage for stage in renderer.plan.passes if stage.name == "light_culling")
        assert (len(shade.bands) > 1) == (budget == 1)
    assert np.array_equal(*frames) and frames[0][..., :3].std() > 10.0


def test_shadow_maps_lie_side_by_side(device):
    maps = [(0.25, 5, 4), (1.0, 8, 8), (0.0, 2, 3)]
    views = np.zeros(4, np.dtype(structs.View.numpy_dtype()))
    views["width"], views["height"] = [40, *(m[1] for m in maps)], [20, *(m[2] for m in maps)]
    views["row_pitch"] = views["width"]
    views["pixel_offset"][1:] = np.cumsum([0, *(m[1] * m[2] for m in maps)])[:-1]
    keys = np.concatenate([np.full(w * h, z, np.float32) for z, w, h in maps]).view(np.uint32)
    data = kernels.Shown()
    data.depth_keys = wp.array(keys, dtype=wp.uint32, device=device)
    data.image = Image()
    data.maps = wp.vec4i(1, 3, 2, 2)
    y, x = np.mgrid[0:24:8, 0:40:8].reshape(2, -1)
    blocks = np.stack([np.zeros_like(x), x, y, np.zeros_like(x)], axis=1).astype(np.int32)
    out = wp.zeros(800, dtype=wp.uint32, device=device)
    inputs = [
        wp.array(views, dtype=structs.View, device=device),
        wp.array(blocks, dtype=wp.vec4i, device=device),
        data,
        0,
    ]
    kernel = kernels.make_debug_view_kernel("shadow_atlas", "off", False)
    wp.launch(kernel, len(blocks) * 64, inputs, [out], block_dim=64, device=device)
    codes = out.numpy().reshape(20, 40) & 255
    expected = np.zeros((20, 40), int)
    expected[:10, :20], expected[:10, 20:], expected[10:, 20:] = 180, 255, 38
    assert np.array_equal(codes, expected)


def test_a_picture_imports_no_debug_view():
    code = (
        "import sys, warp_deferred as wd\n"
        "wd.Renderer(wd.load('lambert_plane'), width=16, height=16, device='cpu').render()\n"
        "bad = [m for m in sys.modules if 'debug_view' in m and not m.endswith('debug_views')]\n"
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_the_shadow_atlas_shows_what_a_light_sees(device):
    scene = gallery()
    scene.lights.add(wd.SpotLight(position=(0.0, 6.0, 0.0), direction=(0.0, -1.0, 0.01), range=20.0, casts_shadow=True))
    picture = shown("shadow_atlas", device, scene=scene)
    # One map fills the picture: the floor and what stands on it, at several depths.
    assert len(np.unique(picture[..., 0])) > 8
