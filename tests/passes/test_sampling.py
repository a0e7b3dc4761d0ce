"""Frames of several samples a pixel: the same bits as so many frames averaged, and what stays as it was."""

import itertools
import subprocess
import sys

import bench_package  # noqa: F401
import numpy as np
import pytest
import warp as wp
from builders import LAYERS, Spy, assert_same, bits, box, gallery, grid, images, tilt
from warp_deferred.kernels import structs

import warp_deferred as wd
from bench import timing
from warp_deferred.sampling import points, sample_table

AVERAGED = ("color", "diffuse", "specular", "alpha")
DATA = tuple(name for name in LAYERS if name not in AVERAGED)
SIZE = (64, 48)
#: Numbers of samples that are rungs.
COUNTS = (2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 56, 64)


def settings_of(rung, *more):
    return wd.Settings().with_values([f"anti_aliasing.rung={rung}", *more])


def renderer_of(device, rung="samples_4", outputs=(*LAYERS, "display"), scene=None, more=(), **fields):
    size = {"width": SIZE[0], "height": SIZE[1]} | fields
    return wd.Renderer(scene or gallery(), device=device, outputs=outputs, settings=settings_of(rung, *more), **size)


def jittered_frames(scene, cameras, device, rung, outputs, look=None):
    """Render one frame of one sample a jitter of the rung, through an ordinary plan whose views are moved by hand."""
    sampled = renderer_of(device, rung, ("color",), scene)
    sampled.prepare()
    renderer = renderer_of(device, "off", outputs, scene, share_memory=False)
    renderer.render(cameras)
    plan = renderer.plan
    write, dtype = plan.packer.write, np.dtype(structs.View.numpy_dtype())
    frames = []
    for row in sample_table(sampled.plan.request, False):

        def moved(block, *rest, row=row):
            write(block, *rest)
            views = np.frombuffer(block, dtype, len(cameras))
            views["center"] = views["center"] - row[:2]

        plan.packer.write = moved
        renderer._packed = None
        frame = renderer.render(cameras)
        assert renderer.plan is plan
        frames.append(look(plan).copy() if look else {name: frame.numpy(name) for name in outputs})
    return frames


def mean(frames, name):
    """Sum in order in float32, then divide."""
    total = frames[0][name]
    for frame in frames[1:]:
        total = total + frame[name]
    return total / np.float32(len(frames))


@pytest.mark.parametrize("rung", ["samples_3", "samples_4", "samples_16"])
def test_the_image_is_the_mean_of_jittered_frames(rung, device):
    scene = gallery()
    cameras = [scene.camera, scene.camera.replace(position=(0.9, 1.7, 4.0))]
    frames = jittered_frames(scene, cameras, device, rung, AVERAGED)
    assert not np.array_equal(frames[0]["color"], frames[1]["color"])
    renderer = renderer_of(device, rung, AVERAGED, scene)
    frame = renderer.render(cameras)
    assert renderer.plan.replays == len(frames) == int(rung.split("_")[1])
    for name in AVERAGED:
        assert np.array_equal(bits(frame.numpy(name)), bits(mean(frames, name))), name
    coverage = np.unique(frame.numpy("alpha"))
    assert len(coverage) > 3 and coverage.min() == 0.0 and coverage.max() == 1.0


def test_other_outputs_are_those_of_the_centre(device):
    once = images(renderer_of(device, "off").render())
    renderer = renderer_of(device)
    many = images(renderer.render())
    assert renderer.plan.replays == 5
    assert_same(once, many, DATA)
    assert not np.array_equal(once["color"], many["color"])
    # The look at the centre adds nothing to the averages.
    alone = renderer_of(device, outputs=AVERAGED)
    assert_same(images(alone.render()), many, AVERAGED)
    assert alone.plan.replays == 4


@pytest.mark.parametrize("outputs", [("display",), ("alpha",), ("color", "depth"), (*LAYERS, "display")])
def test_shared_memory_changes_nothing(outputs, device):
    more = ("raster.bins=on",)
    shared = renderer_of(device, outputs=outputs, more=more)
    apart = renderer_of(device, outputs=outputs, more=more, share_memory=False)
    assert_same(images(shared.render()), images(apart.render()))
    assert shared.plan.bytes < apart.plan.bytes or outputs == ("alpha",)


def test_half_images_are_summed_in_float32(device):
    scene = gallery()

    def radiance(plan):
        words = plan.resources.channels["radiance"].numpy()
        return words.view(np.float16).reshape(SIZE[1], SIZE[0], 4)[..., :3]

    frames = jittered_frames(scene, [scene.camera], device, "samples_16", ("display",), radiance)
    renderer = renderer_of(device, "samples_16", ("display",), scene, share_memory=False)
    renderer.render()
    total = frames[0].astype(np.float32)
    for frame in frames[1:]:
        total = total + frame.astype(np.float32)
    expected = (total / np.float32(16)).astype(np.float16)
    assert np.array_equal(bits(radiance(renderer.plan)), bits(expected)) and expected.max() > 0.1


def test_memory_does_not_depend_on_the_number_of_samples():
    plans = []
    for rung in ("samples_4", "samples_64", "off"):
        renderer = renderer_of("cpu", rung, ("display", "alpha"))
        renderer.prepare()
        plans.append((renderer.plan.bytes, dict(renderer.plan.memory)))
    assert plans[0] == plans[1] and "sum_image" in plans[0][1]
    assert not any(name.startswith("sum_") for name in plans[2][1])


def test_a_second_frame_makes_nothing_new(device):
    scene = gallery()
    renderer = renderer_of(device, scene=scene)
    first = images(renderer.render())
    with Spy() as spy:
        for k in (1, 2):
            scene.camera = wd.Camera.look_at((0.6 - 0.3 * k, 1.9, 4.6), (0.0, 0.7, 0.0))
            scene.lights.point.intensity = scene.lights.point.intensity * 1.5
            renderer.render()
    spy.assert_nothing()
    last = images(renderer.render())
    assert not np.array_equal(first["color"], last["color"])
    assert_same(images(renderer_of(device, scene=scene).render()), last)


def test_poses_on_the_device_are_moved_like_cameras(device):
    poses = np.eye(4, dtype=np.float32)[None].copy()
    poses[0, :3, 3] = (0.0, 1.0, 5.0)
    renderer = renderer_of(device)
    result = images(renderer.render(wd.Camera(), poses=wp.array(poses, dtype=wp.mat44, device=device)))
    assert_same(images(renderer.render(wd.Camera.from_matrix(poses[0]))), result)


def test_coverage_of_an_edge_is_its_area(device):
    scene = wd.Scene()
    mesh = wd.Mesh(np.array([[-9, -9, 0], [0.3125, -9, 0], [0.3125, 9, 0], [-9, 9, 0]], float), [[0, 1, 2], [0, 2, 3]])
    scene.add(mesh, material=wd.Material(model="lambert"))
    scene.camera = wd.Camera(projection="orthographic", vertical_extent=8.0, position=(0.0, 0.0, 5.0), near=1.0)
    alpha = images(renderer_of(device, "samples_16", ("alpha",), scene, width=8, height=8).render())["alpha"]
    # One pixel is a metre; the edge lies 0.3125 m, five of its sixteenths, into the fifth one.
    assert np.array_equal(alpha, np.tile(np.float32([1, 1, 1, 1, 0.3125, 0, 0, 0]), (8, 1)))


def test_flat_light_is_not_changed(device):
    scene = wd.Scene()
    scene.environment = wd.Environment(background=(0.125, 0.75, 30.0))
    scene.camera = wd.Camera()
    for rung in ("samples_4", "samples_64"):
        color = images(renderer_of(device, rung, ("color",), scene).render())["color"]
        assert np.all(color == np.float32((0.125, 0.75, 30.0)))


def test_a_plane_keeps_its_gradient(device):
    scene = wd.Scene()
    scene.add(grid(1, 8.0), material=wd.Material(model="lambert"))
    scene.lights.add(wd.PointLight(position=(0.0, 0.0, 3.0), intensity=30.0))
    scene.camera = wd.Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    full = ("gbuffer.rung=full",)
    once, many = (
        images(renderer_of(device, rung, ("color",), scene, full).render())["color"] for rung in ("off", "samples_64")
    )
    # Points with the pixel's centre as their mean leave only the second derivative's share.
    assert np.abs(many / once - 1.0).max() < 1e-3


def test_graphs_are_the_same_as_direct_runs(device):
    renderer = renderer_of(device)
    first = images(renderer.render())
    for array in renderer.plan.outputs.values():
        array.zero_()
    renderer.plan.resources.program.run()
    assert_same(first, {name: array.numpy()[0] for name, array in renderer.plan.shown.items()})


def test_one_sample_is_one_part_and_leaves_nothing_behind(device):
    renderer = renderer_of(device, "off")
    renderer.render()
    plan = renderer.plan
    assert plan.replays == 1 and len(plan.resources.program.parts) == 1
    assert plan.resources.frame.views is plan.resources.frame.uploaded
    core = ["clusters", "raster", "resolve", "ambient_visibility", "lights", "light_culling", "shade", "display"]
    assert [stage.name for stage in plan.passes] == core


def test_a_depth_alone_is_not_sampled(device):
    renderer = renderer_of(device, outputs=("depth", "instance_id"))
    result = images(renderer.render())
    assert renderer.plan.replays == 1 and "accumulate" not in [s.name for s in renderer.plan.passes]
    assert_same(result, images(renderer_of(device, "off", ("depth", "instance_id")).render()))


SCRIPT = """
import sys
import numpy as np
import warp as wp
wp.config.log_level = wp.LOG_WARNING
if {blocked}:
    sys.modules.update(dict.fromkeys({names}))
import warp_deferred as wd
renderer = wd.Renderer(wd.load("lambert_plane"), width=32, height=24, device="cpu", outputs=("color", "display"))
np.save({file!r}, renderer.render().numpy("color"))
loaded = [name for name in {names} if sys.modules.get(name) is not None]
assert not loaded, loaded
"""


@pytest.mark.parametrize("blocked", [False, True])
def test_modules_are_not_imported_where_they_are_not_called_for(blocked, tmp_path):
    names = ["warp_deferred.passes.sampling", "warp_deferred.kernels.sampling"]
    file = str(tmp_path / "color.npy")
    script = SCRIPT.format(names=names, blocked=blocked, file=file)
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)
    renderer = wd.Renderer(wd.load("lambert_plane"), width=32, height=24, device="cpu", outputs=("color", "display"))
    assert np.array_equal(np.load(file), renderer.render().numpy("color"))


def test_explain_tells_of_samples(device):
    renderer = renderer_of(device, outputs=("display", "depth"))
    expected = images(renderer.render())["display"]
    told = renderer.explain()
    rows = {row.name: row for row in told.rows}
    assert rows["accumulate"].rung == "4 samples" and rows["accumulate"].reason == "anti_aliasing.rung=samples_4"
    assert any("run 5 times" in note for note in told.notes)
    once = {row.name: row for row in renderer_of(device, "off", ("display", "depth")).explain().rows}
    assert rows["resolve"].bytes == 5 * once["resolve"].bytes and rows["display"].bytes == once["display"].bytes
    assert not once["accumulate"].runs and once["accumulate"].reason == "no rung takes several samples a pixel"
    assert "average" not in once and "begin_sample" not in once
    # Measuring leaves a whole frame behind.
    assert np.array_equal(renderer.plan.shown["display"].numpy()[0], expected)


def test_timing_knows_samples_from_frames():
    renderer = renderer_of("cpu", outputs=("display",))
    expected = images(renderer.render())["display"]
    program = renderer.plan.resources.program
    names = timing.sample_sections(program)
    assert names[0] == "begin_sample" and names[-1] == "accumulate" and "lights" not in names
    whole, sample = timing.time_program(program, repeats=3), timing.time_program(program, names, repeats=3)
    assert whole.median > 2.0 * sample.median > 0.0
    with pytest.raises(wd.InputError, match="all run once a frame or all once a sample"):
        timing.time_program(program, ("accumulate", "average"))
    assert list(timing.time_passes(program, repeats=3)) == [s.name for s in renderer.plan.passes]
    assert np.array_equal(images(renderer.render())["display"], expected)


@wp.kernel
def darken_kernel(image: wp.array[wp.vec3], depth: wp.array[wp.float32], out_image: wp.array[wp.vec3]):
    i = wp.tid()
    out_image[i] = image[i] * wp.exp(-depth[i])


class Darken(wd.Pass):
    image = "rewrite"

    def __init__(self, scope):
        self.name, self.scope = f"darken_{scope}", scope

    def reads(self):
        return ("depth",)

    def run(self, resources):
        c = resources.channels
        inputs = [c[self.source], c["depth"]]
        resources.program.launch(darken_kernel, self.layout.pixels, inputs, [c[self.target]], block_dim=64)


def test_a_pass_of_ones_own_runs_in_its_scope(device):
    scene = gallery()
    scene.add(box(30.0), material=wd.Material(model="lambert", two_sided=True), transform=tilt(5.0, 9.0))
    plain = images(renderer_of(device, outputs=("color", "depth"), scene=scene).render())
    late = renderer_of(device, outputs=("color",), scene=scene, passes=[Darken("frame_end")])
    result = images(late.render())["color"]
    # After the samples there is one depth, the centre's: one more look, taken for the pass alone.
    assert late.plan.replays == 5 and [s.name for s in late.plan.passes][-2:] == ["average", "darken_frame_end"]
    assert np.allclose(result, plain["color"] * np.exp(-plain["depth"])[..., None], rtol=1e-5)
    each = renderer_of(device, outputs=("color",), scene=scene, passes=[Darken("sample")])
    inner = images(each.render())["color"]
    assert not np.array_equal(inner, result) and np.abs(inner - result).max() < 0.1
    assert_same({"color": inner}, images(each.render()))


def test_points_are_spread_over_pixels_lenses_and_shutters():
    for count in (*COUNTS, 256):
        p = points(count)
        assert p.shape == (count, 5) and np.array_equal(p, points(count))
        for axis in range(5):
            middles = (np.arange(count) + 0.5) / count
            assert np.abs(np.sort(p[:, axis]) - middles).max() <= (1 / 512 if axis < 2 else 1e-9)
            assert p[:, axis].mean() == pytest.approx(0.5, abs=1e-12)
        if count & (count - 1):
            continue
        # Every rectangle of area 1/n with sides of powers of a half holds one point of the pixel's.
        for k in range(count.bit_length()):
            cells = np.floor(p[:, 0] * 2**k) * count + np.floor(p[:, 1] * (count >> k))
            assert len(np.unique(cells)) == count, (count, k)


def test_jitters_lie_on_the_grid_that_vertices_are_snapped_to():
    for count in COUNTS:
        steps = (points(count)[:, :2] - 0.5) * 256.0
        assert np.array_equal(steps, np.round(steps))


def test_more_points_leave_less_of_an_edge():
    def error(count):
        # Coverage of half planes of any slope through a pixel, against the exact one.
        grid = (np.arange(64) + 0.5) / 64 - 0.5
        places = np.linspace(-0.7, 0.7, 71)
        sums = []
        for angle in np.linspace(0.003, np.pi, 40):
            axis = np.array([np.cos(angle), np.sin(angle)])
            exact = np.searchsorted(np.sort(np.add.outer(grid * axis[0], grid * axis[1]).ravel()), places) / 4096
            own = ((points(count)[:, :2] - 0.5) @ axis < places[:, None]).mean(axis=1)
            sums.append(np.mean((own - exact) ** 2))
        return np.sqrt(np.mean(sums))

    counts = (1, *COUNTS)
    found = [error(count) for count in counts]
    # All but the step from 16 to 20, where the permutation that was chosen is the better one.
    assert all(b < 1.1 * a for a, b in itertools.pairwise(found))
    assert all(e <= 1.25 * found[0] * n**-0.6 for n, e in zip(counts, found, strict=True))
