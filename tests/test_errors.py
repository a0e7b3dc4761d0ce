"""What cannot be rendered is refused in the package's own words, before memory is spent; what can be extreme, works."""

import types
from functools import partial

import numpy as np
import pytest
from builders import FULL, Spy, assert_same, box, gallery, grid, images, tilt

import warp_deferred as wd
from warp_deferred import device_scene, light_store, memory
from warp_deferred import plan as plan_module
from warp_deferred.plan import PASSES

NAN = float("nan")


def simple(lights=1):
    scene = wd.Scene()
    scene.add(box(1.0), material=wd.Material(model="lambert"))
    for k in range(lights):
        scene.lights.add(wd.PointLight(position=(1.0, 1.0, 2.0 + k), intensity=5.0, range=6.0))
    scene.camera = wd.Camera.look_at((0.5, 0.7, 3.0), (0.0, 0.0, 0.0))
    return scene


@pytest.mark.parametrize("bad", [0, -1, 16385, 1.5, True, "64", None])
@pytest.mark.parametrize("side", ["width", "height"])
def test_e5_sizes_that_cannot_be_are_refused(side, bad):
    with pytest.raises(wd.InputError, match=rf"Renderer\.{side}: expected a whole number from 1 to 16384, got .*; "):
        wd.Renderer(simple(), device="cpu", **{side: bad})


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"outputs": ("colour",)}, r"Renderer\.outputs: .*did you mean 'color'"),
        ({"outputs": "depth"}, r"outputs=\('depth',\)"),
        ({"outputs": ()}, r"Renderer\.outputs: expected at least one name"),
        ({"settings": {"gbuffer.rung": "full"}}, r"Renderer\.settings: expected a Settings object, got 'dict'"),
        ({"threads": 0}, r"Renderer\.threads: expected a whole number from 1"),
        ({"threads": 1.0}, r"Renderer\.threads"),
    ],
)
def test_arguments_that_do_not_fit_are_named(fields, words):
    with pytest.raises(wd.InputError, match=words):
        wd.Renderer(simple(), width=8, height=8, device="cpu", **fields)


@pytest.mark.parametrize("bad", ["cuda:99", "gpu", "tpu:0", 7])
def test_devices_that_are_not_there_are_named(bad):
    with pytest.raises(wd.DeviceError, match=r"device: expected one of cpu.*, got .*; leave it out for the default"):
        wd.Renderer(simple(), width=8, height=8, device=bad)


@pytest.mark.parametrize("bad", [None, "truck.glb", 3])
def test_something_else_than_a_scene_is_refused(bad):
    with pytest.raises(wd.InputError, match=r"Renderer\.scene: expected a Scene"):
        wd.Renderer(bad, device="cpu")


def test_a_missing_camera_is_named():
    scene = wd.Scene()
    scene.add(box(1.0))
    renderer = wd.Renderer(scene, width=8, height=8, device="cpu", outputs=("depth",))
    with pytest.raises(wd.InputError, match=r"render\.camera: expected a Camera, got None; .*scene\.camera"):
        renderer.render()
    assert renderer.render(wd.Camera()).width == 8


@pytest.mark.parametrize("bad", [[], [None], ["front"], [wd.Camera(), 1], 5, "camera", np.eye(4)])
def test_something_else_than_cameras_is_refused(bad):
    renderer = wd.Renderer(simple(), width=8, height=8, device="cpu", outputs=("depth",))
    with pytest.raises(wd.InputError, match=r"render\.camera: expected a Camera"):
        renderer.render(bad)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gbuffer.rung=ful", "expected 'compact' or 'full', got 'ful'"),
        ("gbufer.rung=full", "did you mean 'gbuffer'"),
        ("gbuffer.rungs=full", "did you mean 'rung'"),
        ("light_culling.tile_size=12", r"LightCullingSettings\.tile_size"),
        ("raster.bin_capacity=-1", r"RasterSettings\.bin_capacity: expected a value >= 0"),
        ("raster.bin_capacity=many", "whole number"),
        ("gbuffer.rung", "stage.field=value"),
        ("=", "stage.field=value"),
    ],
)
def test_settings_that_do_not_exist_are_named(text, words):
    with pytest.raises(wd.InputError, match=words):
        wd.Settings().with_values([text])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: wd.Camera.look_at((1, 2, 3), (1, 2, 3)), r"look_at\.target"),
        (lambda: wd.Camera.look_at((NAN, 0, 0), (0, 0, 1)), r"look_at\.eye"),
        (lambda: wd.Camera(vertical_fov=0.0), r"Camera\.vertical_fov"),
        (lambda: wd.Camera(vertical_fov=np.pi), r"Camera\.vertical_fov"),
        (lambda: wd.Camera(near=0.0), r"Camera\.near"),
        (lambda: wd.Camera(projection="orthographic", near=2.0, far=2.0), r"Camera\.far"),
        (lambda: wd.Camera(position=(0.0, NAN, 0.0)), r"Camera\.position"),
        (lambda: wd.Camera(rotation=(1.0,) * 9), r"Camera\.rotation"),
        (lambda: wd.Camera.from_intrinsics(np.zeros((3, 3)), 8, 8), r"from_intrinsics\.K|Camera\.intrinsics"),
        (lambda: wd.Camera.from_intrinsics(np.eye(3), 8, 8, k1=0.1), "distortion"),
    ],
)
def test_t7_cameras_that_see_nothing_are_refused(make, words):
    with pytest.raises(wd.InputError, match=words):
        make()


def test_t7_up_along_the_view_has_a_fallback():
    camera = wd.Camera.look_at((0.0, 5.0, 0.0), (0.0, 0.0, 0.0))
    matrix = np.array(camera.rotation).reshape(3, 3)
    assert np.allclose(matrix @ matrix.T, np.eye(3)) and np.allclose(matrix[2], (0.0, 1.0, 0.0))


def test_more_pixels_than_indices_are_refused_before_their_memory_is_taken(device):
    scene = simple()
    renderer = wd.Renderer(scene, width=16384, height=16384, device=device, outputs=("depth",))
    with (
        Spy() as spy,
        pytest.raises(wd.CapacityError, match=r"views: expected at most 2147483647 pixels .*; render fewer"),
    ):
        renderer.render([scene.camera] * 8)
    assert sum(size for _, size in spy.allocated) < 100_000, "only the scene and the lights"


def test_more_lights_than_indices_are_refused(device, monkeypatch):
    monkeypatch.setattr(light_store, "MAX_STAGED", 63)
    scene = simple()
    renderer = wd.Renderer(scene, width=8, height=8, device=device, outputs=("color",), settings=FULL)
    renderer.render()
    with pytest.raises(wd.CapacityError, match="lights: expected lights x views of at most 63, got 32 x 2"):
        renderer.render([scene.camera] * 2)
    assert np.isfinite(renderer.render().numpy("color")).all(), "the refusal should leave the renderer usable"


@pytest.mark.parametrize(("name", "at"), [("MAX_BLOCKS", 3), ("MAX_ELEMENTS", 16)])
def test_e7_scenes_at_a_limit_work_and_past_it_are_refused(name, at, device, monkeypatch):
    scene = wd.Scene()
    scene.camera = wd.Camera.look_at((0.5, 0.7, 3.0), (0.0, 0.0, 0.0))
    # Two instances of 12 triangles take one block of ids each, 16 vertices in two meshes; the third is one too many.
    for k in range(3 if name == "MAX_BLOCKS" else 2):
        scene.add(box(1.0) if name == "MAX_ELEMENTS" else scene.instances[0].mesh if k else box(1.0))
    monkeypatch.setattr(device_scene, name, at)
    renderer = wd.Renderer(scene, width=16, height=16, device=device, outputs=("instance_id",))
    assert (renderer.render().numpy("instance_id") >= 0).any()
    scene.add(box(1.0))
    with Spy() as spy, pytest.raises(wd.CapacityError, match=rf"Scene: expected at most {at} .*; split the scene"):
        renderer.render()
    assert not spy.allocated


def test_a_frame_drawn_over_is_refused_and_a_copy_stays(device):
    scene = simple()
    renderer = wd.Renderer(scene, width=16, height=16, device=device, outputs=("color", "depth"), settings=FULL)
    old = renderer.render()
    kept, expected = old.copy(), images(old)
    new = renderer.render(wd.Camera.look_at((3.0, 1.0, 0.0), (0.0, 0.0, 0.0)))
    with pytest.raises(wd.Error, match=r"Frame\['color'\]: expected a frame that is still valid.*frame\.copy\(\)"):
        old["color"]
    with pytest.raises(wd.Error, match="still valid"):
        old.numpy("depth")
    assert_same(expected, images(kept))
    assert not np.array_equal(images(new)["depth"], expected["depth"], equal_nan=True)
    with pytest.raises(wd.InputError, match=r"outputs=\('color', 'depth', 'normal'\)"):
        new["normal"]


@pytest.mark.parametrize("missing", ["ClustersPass", "RasterPass", "LightsPass", "LightCullingPass"])
def test_a_plan_with_a_pass_missing_is_refused(missing, monkeypatch):
    monkeypatch.setattr(plan_module, "PASSES", tuple(p for p in PASSES if p.__name__ != missing))
    renderer = wd.Renderer(simple(), width=16, height=16, device="cpu", outputs=("color",))
    with Spy() as spy, pytest.raises(wd.Error, match=r"\w+Pass reads '\w+': expected an earlier pass .*; add the pass"):
        renderer._load_scene()
        before = len(spy.allocated)
        renderer.render()
    assert before and not spy.kernels and not spy.loaded


def test_a_plan_without_the_pass_that_writes_an_output_is_refused(monkeypatch):
    monkeypatch.setattr(plan_module, "PASSES", tuple(p for p in PASSES if p.__name__ != "DisplayPass"))
    with pytest.raises(wd.Error, match=r"outputs: expected names some pass writes, got \['display'\]"):
        wd.Renderer(simple(), width=16, height=16, device="cpu", outputs=("display",)).render()


def test_a_failed_frame_leaves_the_renderer_usable(device):
    scene = simple()
    renderer = wd.Renderer(scene, width=16, height=16, device=device, outputs=("color", "depth"), settings=FULL)
    expected = images(renderer.render())
    for bad in ([], "nothing", [wd.Camera(), None]):
        with pytest.raises(wd.InputError):
            renderer.render(bad)
    assert_same(expected, images(renderer.render()))


@pytest.mark.parametrize("size", [(16384, 1), (1, 16384)])
def test_e5_the_longest_images_are_rendered(size, device):
    scene = simple()
    camera = scene.camera.replace(intrinsics=(16384.0, 16384.0, size[0] / 2, size[1] / 2), image_size=size)
    names = ("color", "depth", "instance_id", "normal")
    whole = wd.Renderer(scene, width=size[0], height=size[1], device=device, outputs=names, settings=FULL)
    image = images(whole.render(camera))
    assert image["depth"].shape == (size[1], size[0])
    line = image["instance_id"].reshape(-1) >= 0
    steps = np.flatnonzero(np.diff(line.astype(int)))
    assert len(steps) == 2 and 0.2 < line.mean() < 0.6, "one stretch of box, sky on both sides"
    assert np.isfinite(image["color"]).all() and image["color"].max() > 0.0
    # A small window around a border of the box, as its own image: the same bits.
    start = int(steps[0]) - 20
    shift = (start, 0) if size[1] == 1 else (0, start)
    small = (50, 1) if size[1] == 1 else (1, 50)
    fx, fy, cx, cy = camera.intrinsics
    window = camera.replace(intrinsics=(fx, fy, cx - shift[0], cy - shift[1]), image_size=small)
    part = wd.Renderer(scene, width=small[0], height=small[1], device=device, outputs=names, settings=FULL)
    expected = {n: a[shift[1] : shift[1] + small[1], shift[0] : shift[0] + small[0]] for n, a in image.items()}
    actual = images(part.render(window))
    assert np.array_equal(actual["instance_id"], expected["instance_id"])


def test_t2_vertices_on_the_near_plane_and_in_the_eye_stay_finite(device):
    scene = gallery()
    eye = np.array(scene.camera.position)
    triangles = np.array([[0, 1, 2], [0, 2, 3], [3, 1, 0]])
    back = np.array(scene.camera.rotation).reshape(3, 3)[2]
    points = np.stack([eye, eye - 0.05 * back, eye + np.array([0.3, 0.1, 0.0]), eye - back + (0.2, -0.4, 0.0)])
    material = wd.Material(model="lambert", two_sided=True)
    scene.add(wd.Mesh(points, triangles), material=material)
    scene.add(grid(1, 8.0), transform=tilt(0.0, 0.0, 1.0, eye - (0.0, 0.0, 0.05)), material=material)
    names = ("color", "normal", "position", "albedo", "depth", "instance_id")
    for camera in (scene.camera, wd.Camera(position=tuple(eye))):
        image = images(wd.Renderer(scene, width=33, height=17, device=device, outputs=names).render(camera))
        assert all(np.isfinite(image[n]).all() for n in names if n != "depth")
        seen = image["instance_id"] >= 0
        assert (
            seen.any() and np.isfinite(image["depth"][seen]).all() and image["depth"][seen].min() >= 0.05 * (1 - 1e-6)
        )


def test_e7_a_buffer_past_what_an_array_holds_is_refused_before_memory_is_spent(monkeypatch):
    scene = simple()
    renderer = wd.Renderer(scene, width=8, height=8, device="cpu", outputs=("depth",))
    renderer.prepare()
    monkeypatch.setattr(plan_module, "MAX_ELEMENTS", 127)
    with (
        Spy() as spy,
        pytest.raises(wd.CapacityError, match=r"expected at most 127 elements of 'keys', got 128; render"),
    ):
        renderer.render([scene.camera, scene.camera])
    assert not spy.allocated


def fitting(views, share):
    request = types.SimpleNamespace(cameras=views)
    layout = types.SimpleNamespace(sizes=[types.SimpleNamespace(width=8, height=8)])
    return plan_module.Plan._fitting(types.SimpleNamespace(request=request, layout=layout), share)


def test_memory_that_runs_out_is_told_with_what_was_wanted(monkeypatch):
    scene = simple()
    renderer = wd.Renderer(scene, width=8, height=8, device="cpu", outputs=("depth",))
    before = renderer.render().numpy("depth")

    def refuse(*arguments, **fields):
        raise RuntimeError("Failed to allocate 1 bytes on device 'cpu'")

    with monkeypatch.context() as patch:
        patch.setattr(plan_module.wp, "zeros", refuse)
        with pytest.raises(wd.CapacityError, match=r"frame: expected 0\.\d\d GB of memory on cpu, got .*; render"):
            renderer.render([scene.camera, scene.camera])
        # Where it is known that less is free than the frame takes, the message says what would fit.
        for share, views, words in (
            (0.7, 3, r"2 of these 3 views would about fit"),
            (0.05, 4, r"one view of 3x3 would about fit"),
        ):
            size = renderer.plan.bytes * views
            patch.setattr(memory, "_free_bytes", lambda device, free=share * size / 0.9: int(free))
            with pytest.raises(wd.CapacityError, match=rf"GB free; {words}: render smaller"):
                with memory.enough_memory("frame", size, renderer.device, "render smaller", partial(fitting, views)):
                    refuse()
    assert np.array_equal(renderer.render().numpy("depth"), before), "the renderer stays usable"
