"""The reference's attributes, textures, masks, ids and worlds, and the bridge that feeds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference as ref
import reference_bridge
from reference import loose as soup
from reference import scene_of, translation
from reference import view_of as camera

import warp_deferred as wd


def wd_rotation(backward):
    return np.array(wd.Camera.look_at(backward, (0, 0, 0)).rotation).reshape(3, 3)


def tilted_quad(**fields):
    points = np.array([[-1.2, -0.9, -1.3], [1.1, -1.0, -0.8], [0.9, 0.5, -2.6], [-1.4, 1.2, -2.0]])
    return ref.Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), **fields)


def test_i2_constant_attributes_stay_exactly_constant():
    color = (0.3, 0.1, 0.7, 1.0)
    out = ref.render(scene_of(tilted_quad(colors=np.tile(color, (4, 1)))), camera(cull="none"))
    hit = out["alpha"] > 0
    assert hit.sum() > 300 and (out["albedo"][hit] == color[:3]).all()


def test_i3_attributes_stay_within_their_corners():
    colors = np.array([[0, 0.2, 1, 1], [1, 0.4, 0, 1], [0.5, 0.9, 0.25, 1], [0, 1, 0.5, 1.0]])
    out = ref.render(scene_of(tilted_quad(colors=colors)), camera(cull="none"))
    for k in range(2):
        hit = out["triangle_id"] == k
        corners = colors[[[0, 1, 2], [0, 2, 3]][k], :3]
        assert hit.any()
        assert (out["albedo"][hit] >= corners.min(axis=0) - 1e-15).all()
        assert (out["albedo"][hit] <= corners.max(axis=0) + 1e-15).all()


@pytest.mark.parametrize("orthographic", [False, True])
def test_i1_positions_lie_on_their_pixel_ray_and_plane(orthographic):
    mesh = tilted_quad()
    view = camera(cull="none", orthographic=orthographic, near=0.1, far=9.0, focal=14.0)
    out = ref.render(scene_of(mesh), view)
    y, x = np.nonzero((out["edge_distance"] > 1) & (out["alpha"] > 0))
    clip = ref.project(out["position"][y, x], view)
    pixel = clip[:, :2] / clip[:, 3:]
    assert len(y) > 60
    assert np.allclose(pixel, np.stack([x + 0.5, y + 0.5], axis=1), atol=1e-9)
    corners = mesh.positions[mesh.triangles[out["triangle_id"][y, x]]]
    plane = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.abs(((out["position"][y, x] - corners[:, 0]) * plane).sum(axis=1)).max() < 1e-9
    # Depth is interpolated from snapped vertices: within a sub-pixel of the plane.
    assert np.allclose(out["depth"][y, x], -out["position"][y, x, 2], rtol=2e-3)


@pytest.mark.parametrize("orthographic", [False, True])
def test_z6_points_from_depth_lie_on_their_ray_near_the_surface(orthographic):
    view = camera(cull="none", orthographic=orthographic, near=0.1, far=9.0, focal=14.0, eye=(0.1, 0.2, 0.3))
    view = replace(view, rotation=wd_rotation((0.3, 0.2, 1.0)))
    exact, rebuilt = (ref.render(scene_of(tilted_quad()), view, point_from=kind) for kind in ("surface", "depth"))
    y, x = np.nonzero(exact["alpha"] > 0)
    assert len(y) > 60
    clip = ref.project(rebuilt["position"][y, x], view)
    assert np.allclose(clip[:, :2] / clip[:, 3:], np.stack([x + 0.5, y + 0.5], axis=1), atol=1e-9)
    local = (rebuilt["position"][y, x] - view.eye) @ view.rotation.T
    assert np.allclose(-local[:, 2], rebuilt["depth"][y, x], rtol=1e-12)
    step = np.linalg.norm(rebuilt["position"] - exact["position"], axis=-1)[y, x]
    assert 0 < step.max() < 2e-2


@pytest.mark.parametrize("shift", [1, 2])
def test_p5_rotating_vertex_indices_changes_rounding_only(shift):
    mesh = tilted_quad(colors=np.random.default_rng(0).random((4, 4)))
    turned = replace(mesh, triangles=np.roll(mesh.triangles, shift, axis=1))
    a, b = (ref.render(scene_of(m), camera(cull="none")) for m in (mesh, turned))
    assert np.array_equal(a["triangle_id"], b["triangle_id"])
    assert np.allclose(a["albedo"], b["albedo"], atol=1e-13) and np.allclose(a["z"], b["z"], atol=1e-14)
    assert np.allclose(a["normal"], b["normal"], atol=1e-14)


def test_barycentric_slopes_are_the_differences_between_pixels():
    clip = ref.project(tilted_quad().positions[[0, 1, 2]], camera())[None].repeat(3, axis=0)
    x, y = np.array([34.0, 34.0 + 1e-4, 34.0]), np.array([38.0, 38.0, 38.0 + 1e-4])
    weights, slope_x, slope_y = ref.barycentrics(clip, x, y)
    assert (weights > 0.05).all() and np.allclose(weights.sum(axis=1), 1.0)
    assert np.allclose((weights[1] - weights[0]) / 1e-4, slope_x[0], atol=1e-5)
    assert np.allclose((weights[2] - weights[0]) / 1e-4, slope_y[0], atol=1e-5)


def test_i3_weights_outside_the_triangle_are_clamped_and_renormalised():
    clip = np.array([[[10.0, 10, 0.1, 1], [60, 20, 0.1, 2], [30, 90, 0.1, 3]]])
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-20, 60.0, 3), np.arange(-20, 60.0, 3)))
    for corners in (clip, clip[:, [0, 2, 1]]):
        weights = ref.barycentrics(corners.repeat(len(x), axis=0), x, y)[0]
        assert (weights >= 0).all() and np.allclose(weights.sum(axis=1), 1.0)
        assert (weights == 0).any(axis=1).mean() > 0.5 and (weights > 0).all(axis=1).any()


def facing_quad(depth=2.0, half_width=1.0, half_height=1.0, repeat=1.0, **fields):
    """A quad that faces the view, its uv 0 at the top left and `repeat` at the bottom right."""
    w, h, d, r = half_width, half_height, depth, repeat
    points = np.array([[-w, -h, -d], [w, -h, -d], [w, h, -d], [-w, h, -d]])
    uvs = np.array([[0, r], [r, r], [r, 0], [0, 0.0]])
    return ref.Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), uvs=uvs, **fields)


def checker(side):
    i, j = np.meshgrid(np.arange(side), np.arange(side))
    return (((i + j) % 2) * 255).astype(np.uint8)[..., None]


def textured(texture, repeat=1.0, size=8, **fields):
    """Render a texture so that uv 0 to `repeat` fills a square of `size` pixels exactly."""
    material = ref.Material(model="lambert", base_color_texture=texture, **fields)
    scene = scene_of(facing_quad(repeat=repeat), material=material)
    return ref.render(scene, camera(size, size, focal=float(size)))


@pytest.mark.parametrize("srgb", [False, True])
def test_texel_centres_show_their_texels(srgb):
    pixels = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    expected = ref.srgb_decode(pixels / 255.0) if srgb else pixels / 255.0
    out = textured(ref.Texture(pixels, srgb))
    assert np.allclose(out["albedo"], expected, atol=1e-9)
    assert np.allclose(textured(ref.Texture(pixels, srgb, linear_filter=False))["albedo"], expected, atol=1e-12)


@pytest.mark.parametrize("levels", [0, 1, 2, 3])
def test_lod_is_the_logarithm_of_texels_per_pixel(levels):
    # 2^levels texels a pixel: the level whose texels lie exactly on the pixels.
    pixels = np.random.default_rng(1).integers(0, 256, (8 << levels, 8 << levels, 3), dtype=np.uint8)
    k = 1 << levels
    expected = ref.srgb_decode(pixels / 255.0).reshape(8, k, 8, k, 3).mean(axis=(1, 3))
    assert np.allclose(textured(ref.Texture(pixels))["albedo"], expected, atol=1e-9)


def test_a_texture_far_away_becomes_its_linear_mean():
    pixels = checker(32)
    out = textured(ref.Texture(pixels), repeat=8.0)
    assert np.allclose(out["albedo"], 0.5, atol=1e-9)


def test_wrap_modes_read_the_texels_they_should():
    index = np.arange(-9, 10)
    assert ref.wrap_index(index, 3, "repeat").tolist() == [0, 1, 2] * 6 + [0]
    assert ref.wrap_index(index, 3, "clamp").tolist() == [0] * 10 + [1] + [2] * 8
    mirrored = [0, 1, 2, 2, 1, 0] * 4
    assert ref.wrap_index(index, 3, "mirror").tolist() == mirrored[3:22]
    pixels = np.array([[[0], [100], [200]]], np.uint8)
    texture = ref.Texture(pixels, False, ("mirror", "clamp"))
    got = ref.nearest(texture, np.array([[-0.1, 5.0], [0.5, -3.0], [1.1, 0.0], [1.9, 0.5]]))[:, 0] * 255
    assert np.allclose(got, [0, 100, 200, 0])


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_e1_channels_become_rgba_as_pillow_converts(channels):
    image = pytest.importorskip("PIL.Image")
    pixels = np.random.default_rng(2).integers(0, 256, (3, 5, channels), dtype=np.uint8)
    mode = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}[channels]
    raw = image.frombytes(mode, (5, 3), pixels.tobytes())
    expected = np.asarray(raw.convert("RGBA")) / 255.0
    assert np.allclose(ref.mip_chain(ref.Texture(pixels, srgb=False))[0], expected)


def test_mips_of_odd_sizes_keep_the_mean():
    pixels = np.random.default_rng(3).integers(0, 256, (7, 5, 4), dtype=np.uint8)
    chain = ref.mip_chain(ref.Texture(pixels, srgb=False))
    assert [level.shape[:2] for level in chain] == [(7, 5), (3, 2), (1, 1)]
    for level in chain:
        assert np.allclose(level.mean(axis=(0, 1)), pixels.mean(axis=(0, 1)) / 255.0)


def test_material_textures_multiply_their_factors():
    rough_metal = ref.Texture(np.full((1, 1, 3), (9, 128, 64), np.uint8), srgb=False)
    half = ref.Texture(np.full((1, 1, 1), 128, np.uint8), srgb=False)
    glow = ref.Texture(np.full((1, 1, 3), 128, np.uint8))
    base = {"base_color": (0.8, 0.6, 0.4, 1.0), "metallic": 0.5, "roughness": 0.9, "emissive": (2.0, 1.0, 0.0)}
    maps = {"metallic_roughness_texture": rough_metal, "emissive_texture": glow, "occlusion_texture": half}
    light = ref.Light("directional", (3.0, 3.0, 3.0), direction=(0.3, 0.1, -1.0))
    fields = {"lights": (light,), "ambient": (0.5, 0.5, 0.5)}
    mapped = scene_of(facing_quad(), material=ref.Material(**base, **maps, occlusion_strength=0.5), **fields)
    metallic, roughness = 0.5 * 64 / 255, 0.9 * 128 / 255
    glowing = tuple(e * float(ref.srgb_decode(128 / 255)) for e in base["emissive"])
    plain = ref.Material(base_color=base["base_color"], metallic=metallic, roughness=roughness, emissive=glowing)
    dimmed = tuple(0.5 * (1 + 0.5 * (128 / 255 - 1)) for _ in range(3))
    expected = scene_of(facing_quad(), material=plain, lights=(light,), ambient=dimmed)
    a, b = ref.render(mapped, camera()), ref.render(expected, camera())
    for name in ("color", "diffuse", "specular"):
        assert np.allclose(a[name], b[name], rtol=1e-12)
    assert a["specular"].max() > 0


def test_x5_alpha_at_the_cutoff_stays_and_nan_goes():
    def drawn(alpha, cutoff=0.5):
        colors = np.ones((4, 4))
        colors[:, 3] = alpha
        material = ref.Material(alpha_cutoff=cutoff)
        return ref.render(scene_of(facing_quad(colors=colors), material=material), camera())["alpha"].any()

    assert drawn(0.5) and drawn(1.0) and not drawn(np.nextafter(0.5, 0)) and not drawn(np.nan)


def test_x5_masks_take_exact_texels_and_show_what_is_behind():
    pixels = np.full((8, 8, 4), 255, np.uint8)
    pixels[..., 3] = checker(8)[..., 0]
    material = ref.Material(base_color_texture=ref.Texture(pixels), alpha_cutoff=0.5)
    behind = facing_quad(depth=3.0, half_width=2.0, half_height=2.0)
    scene = ref.Scene((ref.Instance(facing_quad(), 1), ref.Instance(behind, 0)), (ref.Material(), material))
    out = ref.render(scene, camera(8, 8, focal=8.0))
    kept = checker(8)[..., 0] > 0
    assert np.array_equal(out["instance_id"], np.where(kept, 0, 1))
    # The first instance is the first to use a material: it gets number 0.
    assert np.array_equal(out["material_id"], np.where(kept, 0, 1))
    assert np.array_equal(out["fragments"], np.where(kept, 2, 1))
    assert np.allclose(out["alpha_margin"], 0.5)


def test_worlds_part_instances_and_lights():
    light = ref.Light("directional", (1, 1, 1), direction=(0, 0, -1))
    instances = tuple(ref.Instance(facing_quad(2.0 - w), 0, np.eye(4), w, 10 + w) for w in (-1, 0, 1))
    lights = tuple(replace(light, world=w) for w in (-1, 0, 1))
    scene = ref.Scene(instances, (ref.Material(),), lights)
    for world, nearest, count, layers in ((-1, 2, 3, 3), (0, 1, 2, 2), (1, 2, 2, 2), (7, 0, 1, 1)):
        out = ref.render(scene, camera(world=world))
        middle = tuple(out[name][16, 24] for name in ("instance_id", "semantic_id", "light_count", "fragments"))
        assert middle == (nearest, 9 + nearest, count, layers)


def test_bridge_carries_a_whole_scene():
    mesh = wd.Mesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]])
    scene = wd.Scene()
    shared = wd.Material(model="phong", alpha_mode="mask", two_sided=True)
    scene.add(mesh, material=wd.Material(model="lambert"), transform=translation(0, 0, -2), label=4)
    scene.add(mesh, material=shared, world=3)
    scene.add(mesh, material=shared)
    scene.environment = wd.Environment(ambient=(0.1, 0.2, 0.3), background=(1, 2, 3))
    scene.lights.add(
        wd.DirectionalLight(intensity=2.0),
        wd.SpotLight(position=(1, 2, 3), inner_angle=0.25, outer_angle=0.5, range=4.0),
        wd.PointLight(color=(1, 0.5, 0), intensity=8.0, attenuation="polynomial", coefficients=(1, 2, 3), world=5),
    )
    plain = reference_bridge.reference_scene(scene)
    assert [i.material for i in plain.instances] == [0, 1, 1] and plain.instances[0].mesh is plain.instances[2].mesh
    assert [m.model for m in plain.materials] == ["lambert", "phong"]
    assert [m.alpha_cutoff for m in plain.materials] == [None, 0.5]
    assert plain.instances[1].world == 3 and plain.instances[0].label == 4 and plain.instances[0].transform[2, 3] == -2
    assert [light.kind for light in plain.lights] == ["point", "spot", "directional"]
    point, spot, sun = plain.lights
    assert point.radiance == (8, 4, 0) and point.coefficients == (1, 2, 3) and point.world == 5
    assert spot.position == (1, 2, 3) and (spot.inner_angle, spot.outer_angle, spot.range) == (0.25, 0.5, 4.0)
    assert spot.coefficients is None and sun.radiance == (2, 2, 2) and np.isinf(point.range)
    assert plain.ambient == (0.1, 0.2, 0.3) and plain.background == (1, 2, 3)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_bridge_camera_agrees_with_a_look_at(projection):
    view_fields = {"vertical_fov": 0.8} if projection == "perspective" else {"vertical_extent": 2.0}
    wd_camera = wd.Camera.look_at((3, 2, 4), (0.5, 0, -1), projection=projection, near=0.1, far=20.0, **view_fields)
    view = reference_bridge.reference_view(wd_camera, 48, 32)
    target = ref.project(np.array([0.5, 0, -1.0]), view)
    right_of_it = ref.project(np.array([0.5, 0, -1.0]) + np.array(wd_camera.rotation[:3]) * 0.1, view)
    above_it = ref.project(np.array([0.5, 0.1, -1.0]), view)
    assert np.allclose(target[:2] / target[3], (24, 16))
    assert right_of_it[0] / right_of_it[3] > 24 and above_it[1] / above_it[3] < 16
    distance = np.sqrt(2.5**2 + 2**2 + 5**2)
    depth = ref.linear_depth(target[2] / target[3], near=0.1, far=20.0, orthographic=projection != "perspective")
    assert np.isclose(depth, distance)


def test_bridge_smooths_normals_and_reads_bound_transforms():
    wp = pytest.importorskip("warp")
    ball = ref.sphere(1.0, 10, 14)
    scene = wd.Scene()
    scene.add(wd.Mesh(ball.positions, ball.triangles, smooth=True))
    turned = np.array([[0.2, 0.0, -3.0, 0.0, np.sin(0.4), 0.0, np.cos(0.4)]], np.float32)
    scene.bind_transforms(wp.array(turned, dtype=wp.float32, device="cpu"))
    plain = reference_bridge.reference_scene(scene).instances[0]
    expected = translation(0.2, 0, -3)
    c, s = np.cos(0.8), np.sin(0.8)
    expected[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    assert np.allclose(plain.transform, expected, atol=1e-6)
    assert (plain.mesh.normals * ball.positions).sum(axis=1).min() > 0.995


def test_bridge_keeps_far_meshes_in_their_place():
    triangle = np.array([[-1, -1, -2.0], [1, -1, -2], [0, 1, -2]]) + 1e6
    scene = wd.Scene()
    scene.add(wd.Mesh(triangle, [[0, 1, 2]]))
    out = reference_bridge.render_reference(scene, wd.Camera(position=(1e6, 1e6, 1e6)), 48, 32)
    near = ref.render(scene_of(soup([triangle - 1e6])), reference_bridge.reference_view(wd.Camera(), 48, 32))
    assert near["alpha"].any() and np.array_equal(out["alpha"], near["alpha"])
    assert np.allclose(out["position"][out["alpha"] > 0] - 1e6, near["position"][near["alpha"] > 0], atol=1e-8)
