"""Ambient visibility: closed forms, neutral cases, borders, bad numbers, and what it must not touch.

Hard cases A1 to A4 and P11 for `gtao` and `gtao_half`; test_ambient_visibility_rungs.py has the other rungs and
compares all with the reference.
"""

import numpy as np
import pytest
from builders import Spy, assert_same, box, gallery, grid, images, room, sphere, tilt
from test_views import cut, run_views
from visibility_scenes import MATERIAL, crease_closed_form, crease_profile, plane_scene, render, visibility

import warp_deferred as wd
from warp_deferred.errors import Error, InputError
from warp_deferred.images import read_image
from warp_deferred.views import ViewSize

SCREEN = ("gtao", "gtao_half")


@pytest.mark.parametrize("rung", SCREEN)
@pytest.mark.parametrize("tilt_deg", [0.0, 40.0, 70.0, 85.0])
@pytest.mark.parametrize("distance", [0.1, 10.0, 1e5])
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a2_a_plane_blocks_nothing(rung, tilt_deg, distance, projection, device):
    scene = plane_scene(tilt_deg, distance, projection)
    for share in (0.05, 0.5, 20.0):
        v = visibility(scene, f"rung={rung}", f"radius_m={share * distance}", device=device)
        # Bands would show as steps between neighbours.
        assert v.min() >= 0.98, share
        assert np.abs(np.diff(v, axis=0)).max() <= 0.01 and np.abs(np.diff(v, axis=1)).max() <= 0.01


def test_a2_an_off_centre_plane_with_oblong_pixels_blocks_nothing(device):
    scene = plane_scene(60.0, 2.0)
    camera = scene.camera.replace(intrinsics=(140.0, 60.0, -30.0, 90.0), image_size=(97, 71))
    for rung in SCREEN:
        assert visibility(scene, f"rung={rung}", "radius_m=0.5", camera=camera, device=device).min() >= 0.98


@pytest.mark.parametrize("rung", SCREEN)
def test_a1_sky_is_open_and_leaves_no_halo(rung, device):
    scene = wd.Scene()
    scene.add(grid(1, 1.0), transform=tilt(0.0, 0.0, (1.0, 8.0, 1.0), (0.0, 0.0, -3.0)), material=MATERIAL)
    scene.camera = wd.Camera()
    image = render(scene, f"rung={rung}", "radius_m=1", device=device, outputs=("ambient_visibility", "instance_id"))
    sky, v = image["instance_id"] < 0, image["ambient_visibility"]
    assert 0.2 < sky.mean() < 0.9
    assert np.all(v[sky] == 1.0)
    assert v[~sky].min() >= 1.0 - 1e-3


@pytest.mark.parametrize("rung", SCREEN)
@pytest.mark.parametrize("radius", [0.25, 0.6])
def test_a3_a_crease_follows_the_closed_form(rung, radius, device):
    distance, v = crease_profile(rung, f"radius_m={radius}", device=device)
    expected = crease_closed_form(distance, radius)
    assert np.abs(v - expected).max() <= 0.1
    # Both walls together: monotone, and 1 from the end of the ball on that samples are taken from.
    outwards = (v[::-1] + v)[len(v) // 2 :] / 2.0
    assert abs(outwards[0] - 0.5) <= 0.1
    assert np.diff(outwards).min() >= -0.005
    assert np.all(v[distance >= 1.5 * radius] == 1.0)


@pytest.mark.parametrize("rung", SCREEN)
@pytest.mark.parametrize("build", [gallery, room])
def test_a4_visibility_stays_in_range(rung, build, device):
    scene = build()
    for radius in (1e-6, 0.3, 50.0, 1e30):
        v = visibility(scene, f"rung={rung}", f"radius_m={radius}", device=device)
        assert np.isfinite(v).all() and v.min() >= 0.0 and v.max() <= 1.0, radius
    assert v.min() < 0.9
    assert np.all(visibility(scene, f"rung={rung}", "radius_m=0", device=device) == 1.0)


@pytest.mark.parametrize("rung", SCREEN)
@pytest.mark.parametrize("size", [(1, 1), (1, 130), (3, 2), (17, 33), (129, 9)])
def test_a4_any_size(rung, size, device):
    v = visibility(room(), f"rung={rung}", "radius_m=0.5", size=size, device=device)
    assert v.shape == size[::-1] and np.isfinite(v).all() and v.min() >= 0.0 and v.max() <= 1.0


@pytest.mark.parametrize("rung", SCREEN)
def test_a4_surfaces_at_the_near_plane_stay_finite(rung, device):
    scene = room()
    camera = scene.camera.replace(near=1e-4, position=(0.0, 0.001, 2.0))
    v = visibility(scene, f"rung={rung}", camera=camera, device=device)
    assert np.isfinite(v).all() and v.min() >= 0.0 and v.max() <= 1.0


BAD = np.array([0.0, -0.0, -1.0, 1e-45, 1e-30, 1e30, 3e38, np.inf, -np.inf, np.nan], np.float32)


@pytest.mark.parametrize("rung", SCREEN)
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_nothing_non_finite_comes_out_whatever_goes_in(rung, projection, device, rng):
    settings = wd.Settings().with_values(["gbuffer.rung=full", f"ambient_visibility.rung={rung}"])
    scene = plane_scene(30.0, 1.0, projection)
    renderer = wd.Renderer(
        scene, width=64, height=48, device=device, outputs=("ambient_visibility",), settings=settings,
        share_memory=False,
    )  # fmt: skip
    renderer.render()
    resources = renderer.plan.resources
    section = next(s for s in resources.program.sections if s.name == "ambient_visibility")
    count = resources.channels["depth"].size
    depth = np.where(rng.random(count) < 0.5, rng.choice(BAD, count), rng.random(count).astype(np.float32))
    normal = np.where(rng.random((count, 4)) < 0.5, rng.choice(BAD, (count, 4)), rng.normal(size=(count, 4)))
    resources.channels["depth"].assign(depth.astype(np.float32))
    resources.channels["gbuffer_full_normal"].assign(normal.astype(np.float32))
    resources.program.run_section(section)
    v = resources.channels["ambient_visibility"].numpy()
    assert np.isfinite(v).all() and v.min() >= 0.0 and v.max() <= 1.0
    assert np.all(v[~np.isfinite(depth)] == 1.0)


@pytest.mark.parametrize("rung", SCREEN)
def test_p11_power_0_is_neutral_to_the_bit(rung, device):
    scene = room()
    outputs = ("color", "diffuse", "specular", "display")
    plain = render(scene, "rung=off", outputs=outputs, device=device)
    assert_same(plain, render(scene, f"rung={rung}", "power=0", outputs=outputs, device=device))
    assert_same(plain, render(scene, f"rung={rung}", "radius_m=0", outputs=outputs, device=device))
    darker = render(scene, f"rung={rung}", outputs=outputs, device=device)
    assert_same(plain, darker, ("diffuse", "specular"))
    assert darker["color"].sum() < plain["color"].sum()


def test_p11_always_is_neutral_without_ambient_light(device):
    scene = room()
    scene.environment = wd.Environment(background=(0.1, 0.2, 0.3))
    outputs = ("color", "display")
    settings = wd.Settings().with_values(["ambient_visibility.when=always"])
    renderer = wd.Renderer(scene, width=97, height=71, device=device, outputs=outputs, settings=settings)
    always = images(renderer.render())
    assert "ambient_visibility" in [p.name for p in renderer.plan.passes]
    assert_same(render(scene, "rung=off", outputs=outputs, device=device), always)


def test_ambient_light_alone_is_what_visibility_dims(device):
    """In a scene of ambient light only, colour is exactly the unblocked colour times visibility."""
    scene = gallery(lights=False)
    for instance in scene.instances:
        instance.material = instance.material.replace(emissive=(0.0, 0.0, 0.0))
    plain = render(scene, "rung=off", outputs=("color",), device=device)["color"]
    image = render(scene, outputs=("color", "ambient_visibility", "instance_id"), device=device)
    seen = image["instance_id"] >= 0
    expected = plain * image["ambient_visibility"][..., None]
    assert np.abs(image["color"] - expected)[seen].max() <= 1e-7
    assert image["ambient_visibility"].min() < 0.8


@pytest.mark.parametrize("rung", ["ssao", "gtao_half", "gtao", "ray_traced"])
def test_a_coarse_ball_does_not_block_itself(rung, device):
    """Facets lie below the smooth normals that shading sees, by up to 8 degrees here: hardly any light may be lost."""
    scene = wd.Scene()
    scene.add(sphere(12, 1.0), material=MATERIAL)
    scene.camera = wd.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0))
    assert visibility(scene, f"rung={rung}", size=(48, 48), device=device).min() >= 0.98


def passes(renderer):
    renderer.prepare()
    return [p.name for p in renderer.plan.passes]


def test_it_runs_only_where_it_is_called_for(device):
    scene = gallery()
    plans = {}
    for outputs, sets, ambient in (
        (("display",), (), True), (("color",), (), True), (("ambient_visibility",), (), False),
        (("display",), ("when=always",), False), (("display",), ("rung=off",), True), (("display",), (), False),
        (("depth",), ("when=always",), True), (("diffuse", "specular"), (), True),
    ):  # fmt: skip
        scene.environment = wd.Environment(ambient=(0.1, 0.1, 0.1) if ambient else (0.0, 0.0, 0.0))
        settings = wd.Settings().with_values([f"ambient_visibility.{s}" for s in sets])
        renderer = wd.Renderer(scene, width=16, height=16, device=device, outputs=outputs, settings=settings)
        plans[outputs, sets, ambient] = "ambient_visibility" in passes(renderer)
        if "ambient_visibility" not in passes(renderer):
            keys = {kernel.key for kernel, _ in renderer.plan.resources.program.kernels}
            assert not any("visibility" in k or "blur" in k or "pyramid" in k for k in keys)
            assert not any("visibility" in n for n in renderer.plan.memory)
    assert list(plans.values()) == [True] * 4 + [False] * 4


def test_only_what_it_needs_runs_for_its_output_alone(device):
    renderer = wd.Renderer(gallery(), width=16, height=16, device=device, outputs=("ambient_visibility",))
    assert passes(renderer) == ["clusters", "raster", "resolve", "ambient_visibility"]


def test_explain_says_why(device):
    scene = gallery()
    for sets, ambient, word in (
        ((), 0.1, "ambient light is not zero"), ((), 0.0, "ambient light is zero"), (("rung=off",), 0.1, "rung is off"),
    ):  # fmt: skip
        scene.environment = wd.Environment(ambient=(ambient,) * 3)
        settings = wd.Settings().with_values([f"ambient_visibility.{s}" for s in sets])
        rows = wd.Renderer(scene, width=8, height=8, device=device, settings=settings).explain(measure=False).rows
        assert word in next(r.reason for r in rows if r.name == "ambient_visibility")


def test_off_and_asked_for_is_an_error():
    with pytest.raises(Error, match="ambient_visibility"):
        render(gallery(), "rung=off")
    for bad in ("radius_m=-0.1", "power=-1", "slices=0", "rung=best", "when=never", "steps=99"):
        with pytest.raises(InputError, match=f"AmbientVisibilitySettings.{bad.partition('=')[0]}"):
            render(gallery(), bad)


@pytest.mark.parametrize("rung", SCREEN)
def test_views_of_several_sizes_give_the_bits_of_single_ones(rung, device):
    scene = room()
    sizes = [ViewSize(64, 48), ViewSize(17, 33), ViewSize(33, 16), ViewSize(1, 1), ViewSize(100, 7, depth_only=True)]
    eyes = [(0.6, 1.9, 4.6), (0.4, 0.8, 1.9), (-2.0, 1.5, 3.0), (0.0, 1.0, 3.0), (0.0, 1.0, 3.0)]
    cameras = [wd.Camera.look_at(eye, (0.0, 0.4, 0.0)) for eye in eyes]
    names = ("color", "ambient_visibility")
    settings = wd.Settings().with_values([f"ambient_visibility.rung={rung}", "ambient_visibility.radius_m=0.5"])
    plan, arrays = run_views(scene, cameras, sizes, device, names=names, settings=settings, fill=7.0)
    for k, size in enumerate(sizes[:4]):
        alone = wd.Renderer(
            scene, width=size.width, height=size.height, device=device, outputs=names, settings=settings
        )
        assert_same(images(alone.render(cameras[k])), cut(arrays, plan, k, names))


@pytest.mark.parametrize("rung", SCREEN)
def test_host_threads_change_nothing(rung):
    scene = room()
    one = render(scene, f"rung={rung}", threads=1)
    for threads in (2, 3):
        assert_same(one, render(scene, f"rung={rung}", threads=threads))


@pytest.mark.parametrize("rung", SCREEN)
@pytest.mark.parametrize("power", [-6, 5])
def test_p8_scaling_by_a_power_of_two_changes_nothing(rung, power, device):
    def scaled(scale):
        scene = wd.Scene()
        for k in range(4):
            place = scale * np.array([0.6 * k - 1.0, 0.25, 0.3 * k])
            scene.add(box(1.0), transform=tilt(90.0 * k, 0.0, 0.5 * scale, place), material=MATERIAL)
        scene.add(grid(3, 4.0), transform=tilt(-90.0, 0.0, scale), material=MATERIAL)
        eye = wd.Camera.look_at((1.0, 1.5, 3.0), (0.0, 0.25, 0.0))
        scene.camera = eye.replace(position=tuple(scale * np.array(eye.position)), near=2.0**-5 * scale)
        return scene

    one, two = (render(scaled(s), f"rung={rung}", device=device) for s in (1.0, 2.0**power))
    assert one["ambient_visibility"].min() < 0.7
    assert_same(one, two)


def test_a_second_frame_makes_nothing_new(device):
    scene = gallery()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=("color",))
    renderer.render()
    with Spy() as spy:
        scene.instances[1].transform = tilt(0.0, 10.0, 1.0, (0.0, 0.6, 0.0))
        renderer.render(scene.camera.replace(position=(0.5, 2.0, 4.0)))
    spy.assert_nothing()


def test_the_output_is_kept_in_exr_files(tmp_path, device):
    renderer = wd.Renderer(gallery(), width=16, height=16, device=device, outputs=("ambient_visibility",))
    frame = renderer.render()
    frame.save(tmp_path / "v.exr")
    part = read_image(tmp_path / "v.exr")[0]
    assert np.array_equal(part["ambient_visibility.V"], frame.numpy("ambient_visibility")[0])


@pytest.mark.gpu
@pytest.mark.parametrize("rung", SCREEN)
@pytest.mark.parametrize("build", [gallery, room])
def test_cpu_and_cuda_agree_to_the_bit(rung, build, cuda_device):
    scene = build()
    assert_same(*(render(scene, f"rung={rung}", device=d) for d in ("cpu", cuda_device)))
