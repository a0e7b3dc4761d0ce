"""The ladder of ambient visibility: each rung against rays, and rays against closed forms.

Errors are over all pixels of the scene `corner`, which has what depth cannot show: gaps behind crates, thin rings, the
room beyond the picture. What a rung promises there is in its settings; here the promises are held, and printed with -s.
"""

import numpy as np
import pytest
from builders import assert_same, bits, box, gallery, grid, images, tilt
from test_views import cut, run_views
from visibility_scenes import MATERIAL, crease_closed_form, crease_profile, render, visibility

import warp_deferred as wd
from warp_deferred.effect_settings import AmbientVisibilitySettings
from warp_deferred.views import ViewSize

#: Rung -> root mean square error that its settings promise on `corner`.
BOUNDS = {"ssao": 0.17, "gtao_half": 0.12, "gtao": 0.11}
SIZE = (256, 144)


def rms(a, b):
    return float(np.sqrt(np.mean((a.astype(float) - b.astype(float)) ** 2)))


@pytest.fixture(scope="module")
def corner():
    scene = wd.load("corner")
    return scene, visibility(scene, "rung=ray_traced", size=SIZE)


def test_every_rung_keeps_its_promise(corner, device):
    scene, reference = corner
    text = AmbientVisibilitySettings.model_fields["rung"].description
    errors = {}
    for rung, bound in BOUNDS.items():
        assert f"{rung} {bound:.2f}" in text.replace("\n", " "), "the settings state another bound"
        v = visibility(scene, f"rung={rung}", size=SIZE, device=device)
        errors[rung] = rms(v, reference)
        worst = np.abs(v - reference).max()
        print(f"{rung:10} rms {errors[rung]:.4f}  mean {(v - reference).mean():+.4f}  max {worst:.3f}")
        assert errors[rung] <= bound
    assert errors["ssao"] > errors["gtao_half"] > errors["gtao"]


def test_rays_err_by_less_than_a_quarter_of_the_best_rung(corner):
    scene, reference = corner
    coarse = visibility(scene, "rung=gtao", size=SIZE)
    small = (96, 54)
    usual, many = (visibility(scene, "rung=ray_traced", f"rays={n}", size=small) for n in (256, 2048))
    assert AmbientVisibilitySettings().rays == 256
    error = rms(usual, many)
    print(f"256 rays: rms {error:.4f} against 2048")
    assert 0.0 < error <= rms(coarse, reference) / 4.0


def test_rays_do_not_start_behind_what_is_near(device):
    """A chamfer that overhangs a floor by 4 mm: rays that start 5 mm off its surface would start below the floor."""
    scene = wd.Scene()
    chamfer, floor = ((0.0, 1.0, 1.0), 0.004 * np.sqrt(2.0), 0.002), ((0.0, 0.0, -1.0), 4.0, 0.0)
    for along, length, middle in (chamfer, floor):
        up = np.array(along) / np.linalg.norm(along)
        matrix = np.eye(4)
        matrix[:3, :3] = np.column_stack([(4.0, 0.0, 0.0), length * up, np.cross((1.0, 0.0, 0.0), up)])
        matrix[:3, 3] = 0.0, middle, middle
        scene.add(grid(1, 1.0), transform=matrix, material=MATERIAL)
    middle = np.array([0.0, 0.0022, 0.0022])
    scene.camera = wd.Camera.look_at(
        middle + np.array([0.0, 0.2, 1.0]), middle, projection="orthographic", vertical_extent=0.002, near=0.0, far=2.0
    )
    v = visibility(scene, "rung=ray_traced", "radius_m=0.5", "bias=0.01", "rays=1024", size=(16, 36), device=device)
    # What rises above the floor's plane, of a hemisphere about a normal 45 degrees below it.
    assert np.abs(v - (1.0 - np.sqrt(0.5)) / 2.0).max() <= 0.02


@pytest.mark.parametrize("radius", [0.25, 0.6])
def test_a3_rays_follow_the_closed_form_of_a_crease(radius, device):
    distance, v = crease_profile("ray_traced", f"radius_m={radius}", "bias=0.001", device=device)
    assert np.abs(v - crease_closed_form(distance, radius)).max() <= 0.02


@pytest.mark.parametrize("radius", [0.25, 0.6])
def test_a3_ssao_darkens_a_crease(radius, device):
    """The cheapest rung promises less: darkest at the crease, open beyond its reach."""
    distance, v = crease_profile("ssao", f"radius_m={radius}", device=device)
    assert 0.4 <= v[distance < 0.05 * radius].mean() <= 0.75
    assert np.all(v[distance > 1.6 * radius] == 1.0)
    assert np.abs(v - crease_closed_form(distance, radius)).max() <= 0.25


@pytest.mark.parametrize("rung", ["ssao", "ray_traced"])
@pytest.mark.parametrize("tilt_deg", [0.0, 70.0, 85.0])
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a2_a_plane_blocks_nothing(rung, tilt_deg, projection, device):
    scene = wd.Scene()
    scene.add(grid(1, 200.0), transform=tilt(-tilt_deg, 0.0, 1.0, (0.0, 0.0, -10.0)), material=MATERIAL)
    scene.camera = wd.Camera(projection=projection, vertical_extent=10.0, far=1000.0, vertical_fov=0.7)
    for radius in (0.5, 5.0):
        v = visibility(scene, f"rung={rung}", f"radius_m={radius}", "rays=64", size=(64, 48), device=device)
        assert v.min() >= 0.98


@pytest.mark.parametrize("rung", ["ssao", "ray_traced"])
def test_a4_p11_range_neutral_settings_and_sky(rung, device):
    scene = gallery()
    outputs = ("color", "ambient_visibility", "instance_id")
    common = {"outputs": outputs, "device": device, "size": (33, 21)}
    image = render(scene, f"rung={rung}", "radius_m=0.5", "rays=32", **common)
    v = image["ambient_visibility"]
    assert np.isfinite(v).all() and v.min() >= 0.0 and v.max() == 1.0 and v.min() < 0.8
    assert np.all(v[image["instance_id"] < 0] == 1.0)
    plain = render(scene, "rung=off", outputs=("color",), device=device, size=(33, 21))
    for neutral in ("power=0", "radius_m=0"):
        assert_same(plain, render(scene, f"rung={rung}", neutral, **common), ("color",))
    for size in ((1, 1), (3, 130)):
        v = visibility(scene, f"rung={rung}", "rays=8", size=size, device=device)
        assert np.isfinite(v).all() and v.min() >= 0.0 and v.max() <= 1.0


@pytest.mark.parametrize("rung", ["ssao", "ray_traced"])
def test_threads_and_views_of_several_sizes_change_nothing(rung):
    scene = gallery()
    settings = wd.Settings().with_values(
        [f"ambient_visibility.rung={rung}", "ambient_visibility.radius_m=0.5", "ambient_visibility.rays=16"]
    )
    sizes = [ViewSize(40, 24), ViewSize(17, 33)]
    cameras = [scene.camera, wd.Camera.look_at((0.4, 0.8, 1.9), (0.0, 0.4, -1.0))]
    names = ("ambient_visibility",)
    plan, arrays = run_views(scene, cameras, sizes, "cpu", names=names, settings=settings, fill=7.0)
    for k, size in enumerate(sizes):
        for threads in (1, 2, 3):
            alone = wd.Renderer(
                scene, width=size.width, height=size.height, device="cpu", outputs=names, settings=settings,
                threads=threads,
            )  # fmt: skip
            assert_same(images(alone.render(cameras[k])), cut(arrays, plan, k, names))


def boxes_in_worlds():
    scene = wd.Scene()
    scene.add(grid(1, 8.0), transform=tilt(-90.0), material=MATERIAL)
    for world in (0, 1):
        place = (0.8 * (2 * world - 1), 0.5, 0.0)
        scene.add(box(1.0), transform=tilt(0.0, 0.0, 1.0, place), material=MATERIAL, world=world)
    scene.camera = wd.Camera.look_at((0.0, 4.0, 4.0), (0.0, 0.0, 0.0))
    return scene


def test_rays_meet_what_the_view_sees_and_nothing_else(device):
    scene = boxes_in_worlds()
    sets = ("rung=ray_traced", "radius_m=0.5", "rays=32")
    for world in (0, 1, 7):
        lone = wd.Scene()
        for instance in scene.instances:
            if instance.world in (-1, world):
                lone.add(instance.mesh, transform=instance.transform, material=MATERIAL)
        camera = scene.camera.replace(world=world)
        # Built from fewer triangles, the tree is another; a ray along a shared edge may then tell another story.
        a = visibility(scene, *sets, camera=camera, device=device)
        b = visibility(lone, *sets, camera=scene.camera, device=device)
        assert (a != b).mean() <= 1e-3
        assert (a.min() < 0.7) == (world < 2)


def test_rays_follow_what_moves_without_a_new_plan(device):
    scene = boxes_in_worlds()
    settings = wd.Settings().with_values(
        ["ambient_visibility.rung=ray_traced", "ambient_visibility.radius_m=0.5", "ambient_visibility.rays=32"]
    )
    renderer = wd.Renderer(
        scene, width=64, height=48, device=device, outputs=("ambient_visibility",), settings=settings
    )
    before, plan = images(renderer.render()), renderer.plan
    scene.instances[1].transform = tilt(0.0, 30.0, 1.0, (1.5, 0.6, 1.0))
    moved = images(renderer.render())
    assert renderer.plan is plan and not np.array_equal(before["ambient_visibility"], moved["ambient_visibility"])
    fresh = wd.Renderer(scene, width=64, height=48, device=device, outputs=("ambient_visibility",), settings=settings)
    error = np.abs(images(fresh.render())["ambient_visibility"] - moved["ambient_visibility"])
    assert (error > 0.0).mean() <= 1e-3
    # Back again: not a trace of the detour.
    scene.instances[1].transform = tilt(0.0, 0.0, 1.0, (-0.8, 0.5, 0.0))
    assert np.array_equal(bits(images(renderer.render())["ambient_visibility"]), bits(before["ambient_visibility"]))


def test_only_the_reference_rung_builds_a_tree(device):
    scene = gallery()
    for rung in ("ssao", "gtao_half", "gtao", "ray_traced"):
        settings = wd.Settings().with_values([f"ambient_visibility.rung={rung}"])
        renderer = wd.Renderer(scene, width=16, height=16, device=device, settings=settings)
        renderer.prepare()
        assert ("ray_scene" in [p.name for p in renderer.plan.passes]) == (rung == "ray_traced")
        assert (renderer.memory_report().rays > 0) == (rung == "ray_traced")
        keys = {kernel.key.split("__")[-1] for kernel, _ in renderer.plan.resources.program.kernels}
        assert ("place_instances_kernel" in keys) == (rung == "ray_traced")
        assert any("blur" in k for k in keys) == (rung != "ray_traced")


def test_the_radius_left_out_is_a_twentieth_of_the_box(device):
    scene = boxes_in_worlds()
    low, high = scene.bounds()
    radius = float(np.linalg.norm(high - low)) / 20.0
    assert_same(
        render(scene, "rung=gtao", device=device), render(scene, "rung=gtao", f"radius_m={radius!r}", device=device)
    )


@pytest.mark.gpu
def test_ssao_agrees_to_the_bit_and_rays_by_one_ray(cuda_device):
    scene = gallery()
    one, two = (visibility(scene, "rung=ssao", device=d) for d in ("cpu", cuda_device))
    assert np.array_equal(bits(one), bits(two))
    one, two = (visibility(scene, "rung=ray_traced", "rays=64", device=d) for d in ("cpu", cuda_device))
    assert np.abs(one - two).max() <= 2.01 / 64 and (one != two).mean() <= 0.02
