"""Depth of field: what must not change does not, rungs agree with the reference, the lens is data and not a plan."""

import numpy as np
import pytest
import warp as wp
from builders import assert_same, bits, gallery, grid, images, spied, tilt
from warp_deferred.scenes import focus

import warp_deferred as wd

BLURS = ("plane_lerp", "gather")
SIZE = (64, 48)


def settings_of(rung, *more):
    return wd.Settings().with_values([f"depth_of_field.rung={rung}", *more])


def renderer_of(device, rung="gather", outputs=("color", "display"), scene=None, more=(), **fields):
    size = {"width": SIZE[0], "height": SIZE[1]} | fields
    return wd.Renderer(scene or gallery(), device=device, outputs=outputs, settings=settings_of(rung, *more), **size)


def lens_of(scene, **fields):
    return scene.camera.replace(**{"aperture": 0.4, "focus_distance": 4.0} | fields)


# ---- what must not change


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("rung", BLURS)
def test_f1_a_pinhole_changes_no_bit(rung, half, device):
    scene = gallery()
    outputs = ("display",) if half else ("color", "display")
    plain = images(renderer_of(device, "off", outputs, scene).render())
    # Forced on without a lens, and a pinhole beside a camera with one.
    forced = renderer_of(device, rung, outputs, scene, ["depth_of_field.when=always"])
    assert_same(images(forced.render()), plain)
    assert "depth_of_field" in [stage.name for stage in forced.plan.passes]
    both = renderer_of(device, rung, outputs, scene).render([scene.camera, lens_of(scene)])
    assert_same(images(both, 0), plain)
    assert not np.array_equal(images(both, 1)["display"], plain["display"])


@pytest.mark.parametrize("rung", BLURS)
def test_f1_what_is_in_focus_changes_no_bit(rung, device):
    scene = wd.Scene()
    scene.add(grid(6, 12.0), transform=tilt(move=(0.0, 0.0, -3.0)), material=wd.Material(model="lambert"))
    scene.lights.add(wd.PointLight(position=(0.5, 0.5, -2.0), intensity=9.0))
    scene.camera = wd.Camera()
    plain = images(renderer_of(device, "off", scene=scene).render())
    sharp = images(renderer_of(device, rung, scene=scene).render(scene.camera.replace(aperture=0.5, focus_distance=3)))
    assert_same(sharp, plain)
    soft = renderer_of(device, rung, scene=scene).render(scene.camera.replace(aperture=0.5, focus_distance=1.0))
    assert not np.array_equal(images(soft)["color"], plain["color"])


@pytest.mark.parametrize("value", [(1.0, 0.3, 1e-3), (3e4, 7.0, 0.1)])
@pytest.mark.parametrize("rung", [*BLURS, "lens_samples"])
def test_f2_one_colour_stays_one_colour(rung, value, device):
    scene = gallery(lights=False)
    for k, instance in enumerate(scene.instances):
        instance.material = wd.Material(model="lambert", base_color=(0.0, 0.0, 0.0, 1.0), emissive=value, name=str(k))
    scene.environment = wd.Environment(background=value)
    result = images(renderer_of(device, rung, ("color", "depth"), scene).render(lens_of(scene)))
    assert np.isinf(result["depth"]).any() and result["depth"].min() < 4.0
    assert np.abs(result["color"] / np.float32(value) - 1.0).max() < 1e-6


@pytest.mark.parametrize("rung", BLURS)
def test_p11_any_image_gives_a_finite_one(rung, device, rng):
    scene = gallery()
    renderer = renderer_of(device, rung, ("color", "depth"), scene, share_memory=False)
    renderer.render(lens_of(scene))
    plan = renderer.plan
    stage = next(s for s in plan.passes if s.name == "depth_of_field")
    source, color = plan.resources.channels[stage.source], plan.resources.channels["color"]
    shape = (SIZE[0] * SIZE[1], 3)
    special = np.float32([0.0, 1e-45, 1.2e-38, 65504.0, 1e30, 3.4e38])
    for given in (rng.choice(special, shape), np.float32(10.0 ** rng.uniform(-30, 30, shape))):
        source.assign(np.float32(given))
        program = plan.resources.program
        program.run_section(next(s for s in program.sections if s.name == "depth_of_field"))
        found = color.numpy()
        assert np.isfinite(found).all() and (found >= 0.0).all() and found.max() > 0.0


def test_a_bright_point_becomes_a_disc_of_its_own_light(device):
    scene = wd.Scene()
    glow = wd.Material(model="lambert", base_color=(0.0, 0.0, 0.0, 1.0), emissive=(50.0, 50.0, 50.0))
    scene.environment = wd.Environment(background=(0.0, 0.0, 0.0))
    camera = scene.camera = wd.Camera(aperture=0.6, focus_distance=2.0)
    # Eight pixels wide.
    square = grid(1, 80.0 / camera.pixel_projection(96, 96)[0])
    scene.add(square, transform=tilt(move=(0.0, 0.0, -10.0)), material=glow)
    plain = images(renderer_of(device, "off", ("color",), scene, width=96, height=96).render())["color"][..., 0]
    # Before a black wall at the same depth, so that all of the light has somewhere to go.
    wall = wd.Material(model="lambert", base_color=(0.0, 0.0, 0.0, 1.0))
    scene.add(grid(1, 60.0), transform=tilt(move=(0.0, 0.0, -10.01)), material=wall)
    radius = 0.5 * 0.6 * camera.pixel_projection(96, 96)[0] * (1 / 2 - 1 / 10)
    y, x = np.mgrid[0:96, 0:96] - 47.5
    distance = np.hypot(x, y)
    for rung, tolerance in (("gather", 0.1), ("lens_samples", 0.02)):
        image = images(renderer_of(device, rung, ("color",), scene, width=96, height=96).render())["color"][..., 0]
        assert abs(image.sum() / plain.sum() - 1.0) < tolerance
        assert image[distance > radius + 8.0].max() == 0.0 and image[distance < radius - 6.0].min() > 0.0


def wall_and_square(square_depth, wall_depth):
    """A red square before a blue wall, neither of them lit, and a camera with a wide lens."""
    scene = wd.Scene()
    for color, depth, size in (((4.0, 0.0, 0.0), square_depth, 0.5), ((0.0, 0.0, 1.0), wall_depth, 12.0)):
        glow = wd.Material(model="lambert", base_color=(0.0, 0.0, 0.0, 1.0), emissive=color)
        scene.add(grid(1, size * depth), transform=tilt(move=(0.0, 0.0, -depth)), material=glow)
    scene.camera = wd.Camera()
    return scene


def test_a_sharp_silhouette_stays_sharp_before_what_is_blurred(device):
    scene = wall_and_square(3.0, 30.0)
    fields = {"outputs": ("color", "depth"), "scene": scene, "width": 96, "height": 72}
    plain = images(renderer_of(device, "off", **fields).render())
    square = plain["depth"] < 4.0
    assert 0.1 < square.mean() < 0.9
    for aperture in (0.05, 0.4):
        camera = scene.camera.replace(aperture=aperture, focus_distance=3.0)
        blurred = images(renderer_of(device, "gather", **fields).render(camera))["color"]
        # Not a bit of it changes, and nothing of it is seen beside it.
        assert np.array_equal(bits(blurred[square]), bits(plain["color"][square]))
        assert np.array_equal(blurred[~square][:, 0], np.zeros((~square).sum()))


@pytest.mark.parametrize("radius", [1.2, 2.2, 4.0, 9.0, 20.0])
def test_what_lies_before_covers_softly(radius, device):
    """Across a straight edge coverage follows the share of a disc beyond a chord, for circles of all levels."""
    scene = wall_and_square(3.0, 30.0)
    fields = {"outputs": ("color", "depth"), "scene": scene, "width": 192, "height": 144}
    plain = images(renderer_of(device, "off", **fields).render())
    pixels = scene.camera.pixel_projection(192, 144)[0]
    camera = scene.camera.replace(aperture=radius / (0.5 * pixels * (1 / 3 - 1 / 30)), focus_distance=30.0)
    row = images(renderer_of(device, "gather", **fields).render(camera))["color"][72, :, 0] / 4.0
    edge = np.flatnonzero(plain["depth"][72] < 4.0)[-1] + 1
    x = np.arange(192) + 0.5 - edge

    def exact(x):
        t = np.clip(x / radius, -1.0, 1.0)
        return (np.arccos(t) - t * np.sqrt(1.0 - t * t)) / np.pi

    right = slice(96, None)
    assert (np.diff(row[right]) <= 1e-6).all()
    # The edge lies within a pixel of its place.
    assert (row <= exact(x - 1.0) + 0.1)[right].all() and (row >= exact(x + 1.0) - 0.1)[right].all()


def test_a_shift_by_a_pixel_moves_the_picture_and_little_else(device):
    """Levels and layers are fixed to the view: what that shows is less than the error `gather` may have."""
    scene = focus.build()
    fields = {"outputs": ("color", "depth"), "scene": scene, "width": 320, "height": 180, "share_memory": False}
    renderer = renderer_of(device, "gather", **fields)
    renderer.render()
    plan = renderer.plan
    stage = next(s for s in plan.passes if s.name == "depth_of_field")
    channels, program = plan.resources.channels, plan.resources.program
    given = [channels[name].numpy().reshape(180, 320, -1).copy() for name in (stage.source, "depth")]
    seen = []
    for shift in ((0, 0), (0, 1), (1, 0), (3, 5)):
        for name, image in zip((stage.source, "depth"), given, strict=True):
            channels[name].assign(np.roll(image, shift, (0, 1)).reshape(channels[name].numpy().shape))
        program.run_section(next(s for s in program.sections if s.name == "depth_of_field"))
        color = channels["color"].numpy().reshape(180, 320, 3)
        seen.append(tone(np.roll(color, (-shift[0], -shift[1]), (0, 1)))[40:-40, 40:-40])
    for other in seen[1:]:
        assert np.sqrt(np.square(other - seen[0]).mean()) < 0.025


# ---- against the reference


def tone(color):
    return color / (1.0 + color)


def errors(scene, camera, device, rungs, size=(160, 90)):
    """Root mean square difference of x / (1 + x) from the reference, by rung, of pictures without jagged edges."""
    fields = {"outputs": ("color",), "scene": scene, "width": size[0], "height": size[1]}
    fields["more"] = ("anti_aliasing.rung=samples_64", "depth_of_field.samples=256")
    reference = tone(images(renderer_of(device, "lens_samples", **fields).render(camera))["color"])
    found = {}
    for rung in rungs:
        image = tone(images(renderer_of(device, rung, **fields).render(camera))["color"])
        found[rung] = float(np.sqrt(np.mean((image - reference) ** 2)))
    return found


@pytest.mark.parametrize("name", ["focus", "gallery"])
def test_rungs_hold_the_errors_their_settings_state(name, device):
    scene = focus.build() if name == "focus" else gallery()
    camera = scene.camera if name == "focus" else lens_of(scene)
    found = errors(scene, camera, device, ("off", "plane_lerp", "gather"), (320, 180) if name == "focus" else (160, 90))
    assert found["gather"] <= 0.025 and found["gather"] <= 0.5 * found["off"], found
    assert found["plane_lerp"] <= 0.05 and found["plane_lerp"] < found["off"], found


def test_more_points_of_the_lens_agree_better(device):
    scene = gallery()
    few, some, many = (
        images(
            renderer_of(device, "lens_samples", ("color",), scene, [f"depth_of_field.samples={n}"]).render(
                lens_of(scene)
            )
        )["color"]
        for n in (16, 64, 256)
    )
    assert np.square(tone(some) - tone(many)).mean() < 0.5 * np.square(tone(few) - tone(many)).mean()


def test_the_reference_moves_light_with_the_eye(device):
    """Lights are staged relative to each point of the lens: a flat lit plane in focus keeps its radiance."""
    scene = wd.Scene()
    scene.add(grid(1, 30.0), transform=tilt(move=(0.0, 0.0, -3.0)), material=wd.Material(model="lambert"))
    scene.lights.add(wd.PointLight(position=(0.5, 0.5, -1.0), intensity=9.0))
    scene.camera = wd.Camera(aperture=1.0, focus_distance=3.0)
    full = ("gbuffer.rung=full",)
    plain = images(renderer_of(device, "off", ("color",), scene, full).render())["color"]
    seen = images(renderer_of(device, "lens_samples", ("color",), scene, full).render())["color"]
    assert np.abs(seen / plain - 1.0).max() < 1e-4


# ---- the lens is data


@pytest.mark.parametrize("rung", [*BLURS, "lens_samples"])
def test_pulling_focus_makes_nothing_new(rung, device):
    scene = focus.build()
    renderer = renderer_of(device, rung, scene=scene)
    seen = [images(renderer.render())]
    for time in (0.7, 6.0):
        focus.animate(scene, time)
        seen.append(images(spied(renderer)))
    spied(renderer, scene.camera.replace(aperture=0.02))
    assert not np.array_equal(seen[0]["color"], seen[1]["color"])
    assert not np.array_equal(seen[1]["color"], seen[2]["color"])
    assert_same(images(renderer_of(device, rung, scene=scene).render()), seen[2])
    focus.animate(scene, focus.PERIOD)
    assert np.isclose(scene.camera.focus_distance, focus.build().camera.focus_distance)


def test_views_have_lenses_of_their_own(device):
    scene = gallery()
    cameras = [lens_of(scene), lens_of(scene, focus_distance=2.0), scene.camera.replace(aperture=0.05)]
    for rung in (*BLURS, "lens_samples"):
        batch = renderer_of(device, rung, scene=scene, width=53, height=35).render(cameras)
        for k, camera in enumerate(cameras):
            alone = images(renderer_of(device, rung, scene=scene, width=53, height=35).render(camera))
            assert_same(images(batch, k), alone)


@pytest.mark.parametrize("rung", BLURS)
def test_shared_memory_threads_and_graphs_change_nothing(rung, device):
    scene = gallery()
    renderer = renderer_of(device, rung, scene=scene)
    first = images(renderer.render(lens_of(scene)))
    for fields in ({"share_memory": False}, {"threads": 1}, {"threads": 3}):
        assert_same(images(renderer_of(device, rung, scene=scene, **fields).render(lens_of(scene))), first)
    renderer.plan.resources.program.run()
    assert_same(first, {name: array.numpy()[0] for name, array in renderer.plan.shown.items()})


def test_half_images_agree_with_float_ones(device):
    scene = gallery()
    for rung in BLURS:
        half = images(renderer_of(device, rung, ("display",), scene).render(lens_of(scene)))["display"]
        full = images(renderer_of(device, rung, scene=scene).render(lens_of(scene)))["display"]
        assert np.abs(half.astype(int) - full).max() <= 2


def test_it_is_run_only_where_it_is_called_for(device):
    scene = gallery()
    told = renderer_of(device, scene=scene).explain(measure=False)
    row = {r.name: r for r in told.rows}["depth_of_field"]
    assert not row.runs and row.reason == "no camera has an aperture"
    rows = {}
    for rung in (*BLURS, "lens_samples", "off"):
        renderer = renderer_of(device, rung, ("color", "depth"), scene)
        renderer.render(lens_of(scene))
        rows[rung] = {r.name: r for r in renderer.explain(measure=False).rows}
        assert ("lens_taps" in renderer.plan.memory) == (rung == "gather")
        assert ("lens_rows" in renderer.plan.memory) == (rung == "plane_lerp")
    assert rows["gather"]["depth_of_field"].rung == "gather" and rows["gather"]["depth_of_field"].runs
    assert rows["off"]["depth_of_field"].reason == "depth_of_field.rung is off"
    assert rows["lens_samples"]["depth_of_field"].reason == "lens_samples moves the views instead"
    assert rows["lens_samples"]["lens_samples"].rung == "64 samples"
    assert "depth_of_field.rung=lens_samples" in rows["lens_samples"]["accumulate"].reason
    # Depth stays that of the pinhole.
    plain = images(renderer_of(device, "off", ("depth",), scene).render())["depth"]
    assert np.array_equal(bits(images(renderer.render(lens_of(scene)))["depth"]), bits(plain))


def test_samples_of_pixel_and_lens_are_taken_together(device):
    scene = gallery()
    more = ("anti_aliasing.rung=samples_4", "depth_of_field.samples=16")
    renderer = renderer_of(device, "lens_samples", ("color", "depth"), scene, more)
    depth = images(renderer.render(lens_of(scene)))["depth"]
    assert renderer.plan.replays == 17
    assert np.array_equal(bits(depth), bits(images(renderer_of(device, "off", ("depth",), scene).render())["depth"]))
    # Samples of the pixel alone: blurred once, after they are averaged.
    late = renderer_of(device, "gather", ("color",), scene, more)
    late.render(lens_of(scene))
    assert [s.name for s in late.plan.passes][-2:] == ["average", "depth_of_field"] and late.plan.replays == 5


def test_always_takes_no_samples_of_a_pinhole():
    scene = gallery()
    more = ("depth_of_field.when=always",)
    renderer = renderer_of("cpu", "lens_samples", scene=scene, more=more)
    assert_same(images(renderer.render()), images(renderer_of("cpu", "off", scene=scene).render()))
    assert renderer.plan.replays == 1


def test_poses_on_the_device_keep_their_lens(device):
    camera = wd.Camera(aperture=0.4, focus_distance=4.0)
    pose = np.eye(4, dtype=np.float32)[None].copy()
    pose[0, :3, 3] = (0.0, 1.0, 5.0)
    for rung in ("gather", "lens_samples"):
        renderer = renderer_of(device, rung)
        result = images(renderer.render(camera, poses=wp.array(pose, dtype=wp.mat44, device=device)))
        assert_same(images(renderer.render(camera.replace(position=(0.0, 1.0, 5.0)))), result)


@pytest.mark.gpu
@pytest.mark.parametrize("rung", [*BLURS, "lens_samples"])
def test_devices_agree(rung, cuda_device):
    scene = focus.build()
    cpu, cuda = (images(renderer_of(d, rung, ("color",), scene).render())["color"] for d in ("cpu", cuda_device))
    difference = np.abs(tone(cpu) - tone(cuda)).max(axis=2)
    assert np.quantile(difference, 0.99) < 1e-4 and difference.max() < 0.05


@pytest.mark.parametrize(
    ("text", "message"),
    [("max_radius_px=0", "max_radius_px"), ("texels=9", "texels"), ("samples=65", "samples"), ("power=-1", "power")],
)
def test_settings_are_checked(text, message):
    with pytest.raises(wd.InputError, match=message):
        settings_of("gather", f"depth_of_field.{text}")
