"""The whole pipeline against the float64 reference: every output, every feature, several cameras.

Bounds are (usual error, share of pixels that may exceed it, worst error); what each is relative to, `builders.py` says.
A vertex whose float32 position lies within a rounding error of a snapping border takes the other 1/256 px step. Its
triangle then has another slope: this is what the shares are for. Light is compared at the point that the stored
depth gives, which is all a deferred renderer knows.
"""

import numpy as np
import pytest
from builders import FULL, LAYERS, assert_matches, box, gallery, grid, images, room, sphere, tilt
from reference_bridge import render_reference

import warp_deferred as wd

SIZE = (96, 72)
#: float32 from end to end; textures hold 16-bit linear texels.
BOUNDS = {
    "depth": (2e-6, 0.005, 1e-3),
    "position": (2e-5, 0.005, 5e-3),
    "normal": (1e-5, 0.0, 1e-5),
    "albedo": (2e-5, 0.0, 2e-5),
    "color": (3e-5, 0.001, 1e-3),
    "diffuse": (3e-5, 0.001, 1e-3),
    "specular": (3e-5, 0.001, 1e-3),
    "light_count": (0.0, 0.001, 1.0),
}
#: Near-clipped triangles have vertices on the guard band, where float32 itself is 1/256 px coarse: their depth and
#: what follows from it are as if they were turned by that much.
CLIPPED = BOUNDS | {
    "depth": (2e-6, 0.2, 1e-3),
    "position": (2e-5, 0.2, 5e-3),
    "color": (3e-5, 0.1, 5e-3),
    "diffuse": (3e-5, 0.1, 5e-3),
    "specular": (3e-5, 0.01, 5e-3),
}
#: 24-bit octahedral normals (0.06 degrees), 8-bit square roots of albedo and 8-bit roughness.
COMPACT = BOUNDS | {
    "color": (0.02, 0.01, 0.2),
    "diffuse": (0.02, 0.01, 0.2),
    "specular": (0.02, 0.02, 0.5),
    "light_count": (0.0, 0.005, 1.0),
}
#: CUDA's hardware filter rounds its weights to 1/256: up to some 1e-3 of the contrast between texels, and of what
#: light makes of it. Where nothing is textured, test_invariance compares CUDA with the CPU closely.
HARDWARE_FILTER = {
    "albedo": (4e-3, 0.01, 2e-2),
    "color": (4e-3, 0.01, 5e-2),
    "diffuse": (4e-3, 0.01, 5e-2),
    "specular": (4e-3, 0.01, 5e-2),
}


def bounds_on(device: str, bounds: dict) -> dict:
    """Return the bounds that hold on a device for scenes with textures."""
    if device == "cpu":
        return bounds
    return {n: tuple(map(max, b, HARDWARE_FILTER.get(n, (0.0,) * 3))) for n, b in bounds.items()}


def orthographic() -> wd.Camera:
    return wd.Camera.look_at(
        (1.5, 2.5, 4.0), (0.0, 0.7, 0.0), projection="orthographic", vertical_extent=4.2, near=0.5, far=9.0
    )


def calibrated() -> wd.Camera:
    pose = np.linalg.inv(np.array([[1, 0, 0, -0.5], [0, -1, 0, 1.4], [0, 0, -1, 4.4], [0, 0, 0, 1.0]]))
    return wd.Camera.from_intrinsics([[88.0, 0, 20.0], [0, 70.0, 50.0], [0, 0, 1]], *SIZE, pose)


def camera_in_a_world() -> tuple[wd.Scene, wd.Camera]:
    scene = gallery()
    scene.add(box(0.8), transform=tilt(30.0, 30.0, 1.0, (-0.4, 1.0, 1.0)), world=0, label=20)
    scene.add(sphere(5, 0.5), transform=tilt(0.0, 0.0, 1.0, (0.6, 1.0, 1.4)), world=1, label=21)
    scene.lights.add(
        wd.PointLight(position=(0.0, 2.0, 2.5), intensity=5.0, range=4.0, color=(1, 0, 0), world=0),
        wd.PointLight(position=(0.0, 2.0, 2.5), intensity=5.0, range=4.0, color=(0, 1, 0), world=1),
    )
    return scene, scene.camera.replace(world=1)


CASES = {
    "perspective": lambda: (gallery(), None, BOUNDS),
    "orthographic": lambda: (gallery(), orthographic(), BOUNDS),
    "off_centre": lambda: (gallery(), calibrated(), BOUNDS),
    "near_clipped_t1": lambda: (room(), None, CLIPPED),
    "world": lambda: (*camera_in_a_world(), BOUNDS),
}


@pytest.mark.parametrize("case", CASES)
def test_pipeline_matches_the_reference(case, device):
    scene, camera, bounds = CASES[case]()
    renderer = wd.Renderer(scene, width=SIZE[0], height=SIZE[1], device=device, outputs=LAYERS, settings=FULL)
    actual = images(renderer.render(camera))
    reference = render_reference(scene, camera, *SIZE, point_from="depth")
    assert len(np.unique(actual["instance_id"])) > 5, "the scene should show what it holds"
    assert_matches(actual, reference, bounds_on(device, bounds))


def test_compact_gbuffer_matches_within_its_codecs(device):
    scene = gallery()
    renderer = wd.Renderer(scene, width=SIZE[0], height=SIZE[1], device=device, outputs=LAYERS)
    reference = render_reference(scene, None, *SIZE, point_from="depth")
    assert_matches(images(renderer.render()), reference, bounds_on(device, COMPACT))


def test_plain_scene_matches_on_its_specialised_kernels(device):
    scene = wd.Scene()
    for k in range(6):
        scene.add(
            box(0.7), transform=tilt(20.0 * k, 50.0 * k, 1.0, (k % 3 - 1.0, k // 3 - 0.5, 0.0)), label=k,
            material=wd.Material(model="lambert", base_color=(0.2 * (k % 3) + 0.3, 0.5, 0.1 * k + 0.2, 1.0)),
        )  # fmt: skip
    scene.lights.add(wd.PointLight(position=(1.0, 1.5, 2.0), intensity=6.0, range=4.0))
    scene.lights.add(wd.PointLight(position=(-1.5, 0.5, 1.5), intensity=2.0, range=2.5, color=(1.0, 0.2, 0.1)))
    scene.camera = wd.Camera.look_at((0.3, 0.8, 3.5), (0.0, 0.0, 0.0))
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    assert_matches(images(renderer.render()), render_reference(scene, None, 64, 48, point_from="depth"), BOUNDS)


@pytest.mark.parametrize("cull", ["back", "none", "front"])
def test_r7_cull_modes_match_the_reference(cull, device):
    scene = wd.Scene()
    material = wd.Material(model="lambert", base_color=(0.8, 0.8, 0.8, 1.0))
    scene.add(box(1.0), transform=tilt(30.0, 40.0), material=material)
    scene.add(grid(2, 1.5), transform=tilt(0.0, 150.0, (-1.0, 1.0, 1.0), (1.2, 0.0, 0.0)), material=material)
    scene.add(grid(2, 1.5), transform=tilt(0.0, 150.0, 1.0, (-1.2, 0.0, 0.0)), material=material)
    scene.camera = wd.Camera.look_at((0.0, 0.5, 4.0), (0.0, 0.0, 0.0))
    layers = ("depth", "normal", "instance_id", "triangle_id", "alpha", "semantic_id", "material_id")
    settings = wd.Settings().with_values([f"raster.cull={cull}"])
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=layers, settings=settings)
    reference = render_reference(scene, None, 64, 48, cull=cull)
    bounds = {name: BOUNDS[name] for name in ("depth", "normal")}
    assert_matches(images(renderer.render()), reference, bounds)


def test_l1_empty_scenes_show_the_background(device):
    scene = wd.Scene()
    scene.environment = wd.Environment(background=(0.25, 0.5, 1.0))
    scene.camera = wd.Camera()
    renderer = wd.Renderer(scene, width=17, height=9, device=device, outputs=LAYERS)
    for meshes in (0, 1):
        for _ in range(meshes):
            scene.add(wd.Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
            scene.add(wd.Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)))
        image = images(renderer.render())
        assert np.all(image["color"] == np.float32((0.25, 0.5, 1.0)))
        assert np.all(image["instance_id"] == -1) and np.all(np.isinf(image["depth"])) and not image["alpha"].any()


def test_l7_degenerate_faces_change_nothing(device):
    good = box(1.0)
    extra = np.array([[0, 0, 1], [2, 2, 2], [0, 1, 0]])
    sizes, results = (64, 48), []
    for triangles in (good.triangles, np.concatenate([good.triangles, extra])):
        scene = wd.Scene()
        scene.add(wd.Mesh(good.positions, triangles), transform=tilt(20.0, 30.0), material=wd.Material(model="lambert"))
        scene.lights.add(wd.PointLight(position=(1.0, 1.5, 2.0), intensity=6.0, range=4.0))
        scene.camera = wd.Camera.look_at((0.3, 0.8, 3.5), (0.0, 0.0, 0.0))
        renderer = wd.Renderer(scene, width=sizes[0], height=sizes[1], device=device, outputs=LAYERS, settings=FULL)
        results.append(images(renderer.render()))
    for name in LAYERS:
        assert np.array_equal(results[0][name], results[1][name], equal_nan=True), name


def test_b5_flat_plane_under_a_directional_light_is_the_closed_form(device):
    scene = wd.Scene()
    scene.add(grid(1, 4.0), material=wd.Material(model="lambert", base_color=(0.5, 0.25, 1.0, 1.0)))
    direction = np.array([0.3, -0.2, -1.0])
    scene.lights.add(wd.DirectionalLight(direction=tuple(direction), intensity=3.0))
    scene.camera = wd.Camera.look_at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))
    renderer = wd.Renderer(scene, width=32, height=32, device=device, outputs=("color",), settings=FULL)
    expected = np.array([0.5, 0.25, 1.0]) / np.pi * 3.0 * (1.0 / np.linalg.norm(direction))
    assert np.abs(renderer.render().numpy("color")[0] / expected - 1.0).max() <= 1e-6


#: Error that a normal codec leaves in the colour, relative to colour + 0.05: 99 % of the pixels, and all of them.
CODECS = {
    "rgb8": (0.02, 0.12),
    "oct16": (0.04, 0.25),
    "oct24": (2.5e-3, 0.02),
    "xy16": (2e-4, 2e-3),
    "oct32": (2e-4, 2e-3),
}


def test_g1_normal_codecs_keep_the_colour_within_their_angles(device):
    scene = gallery()

    def color(codec):
        settings = wd.Settings().with_values([f"gbuffer.normal={codec}"])
        renderer = wd.Renderer(
            scene, width=SIZE[0], height=SIZE[1], device=device, outputs=("color",), settings=settings
        )
        return images(renderer.render())["color"].astype(float)

    exact, worst = color("float32"), []
    for codec, (most, every) in CODECS.items():
        error = (np.abs(color(codec) - exact) / (exact + 0.05)).max(axis=2)
        assert np.quantile(error, 0.99) <= most and error.max() <= every, codec
        worst.append(error.max())
    assert worst[1] > worst[0] > worst[2] > max(worst[3:]) > 0.0, "finer codecs should err less"
