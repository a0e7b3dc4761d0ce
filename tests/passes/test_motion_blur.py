"""Motion since the frame before, and the blur of what moves: exact where nothing does, near the reference elsewhere."""

import numpy as np
import pytest
import warp as wp
from builders import assert_same, bits, box, gallery, images, spied, tilt
from motion_scenes import SIZE, card, card_scene, moving_scene, renderer_of
from warp_deferred.scenes import motion as stage

import warp_deferred as wd
from warp_deferred.images import read_image

BOTH = ("velocity_gather", "shutter_samples")

# ---- motion


def test_motion_is_the_change_of_projected_points(device):
    scene = gallery()
    before = scene.camera
    now = before.replace(position=tuple(np.add(before.position, (0.11, -0.05, 0.2))))
    renderer = renderer_of(device, "off", ("motion", "position", "instance_id", "depth"), scene)
    assert not images(renderer.render(before))["motion"].any()
    old = {k: i.transform for k, i in enumerate(scene.instances)}
    scene.instances[1].transform = tilt(25.0, 50.0, 1.0, (-1.1, 0.65, 0.3))
    scene.instances[4].transform = tilt(0.0, 5.0, (1.0, 0.6, 1.0), (0.3, 0.2, 1.0))
    result = images(renderer.render(now))

    def project(camera, points):
        fx, fy, cx, cy = camera.pixel_projection(*SIZE)
        q = (points - camera.position) @ np.reshape(camera.rotation, (3, 3)).T
        return np.stack([fx * q[:, 0] / -q[:, 2] + cx, -fy * q[:, 1] / -q[:, 2] + cy], axis=1)

    seen = result["instance_id"] >= 0
    points = result["position"][seen].astype(float)
    past = points.copy()
    for k, instance in enumerate(scene.instances):
        mine = result["instance_id"][seen] == k
        change = old[k] @ np.linalg.inv(instance.transform)
        past[mine] = points[mine] @ change[:3, :3].T + change[:3, 3]
    expected = project(now, points) - project(before, past)
    assert np.abs(expected).max() > 3.0
    assert np.abs(result["motion"][seen] - expected).max() < 2e-3
    # The camera did not turn: what is infinitely far did not move.
    assert not result["motion"][~seen].any() and (~seen).any()


def test_a_turning_camera_moves_the_background(device):
    scene = wd.Scene()
    turn = np.eye(4)
    turn[:3, :3] = tilt(0.0, 2.0)[:3, :3]
    renderer = renderer_of(device, "off", ("motion",), scene)
    renderer.render(wd.Camera())
    result = images(renderer.render(wd.Camera.from_matrix(turn)))["motion"]
    fx = wd.Camera().pixel_projection(*SIZE)[0]
    middle = result[SIZE[1] // 2, SIZE[0] // 2]
    assert abs(middle[0] - fx * np.tan(np.radians(2.0))) < 0.05 and abs(middle[1]) < 0.01


def test_motion_does_not_see_the_views_of_shadow_maps(device):
    """A crash once: what was kept of the maps' views lay behind the cameras' room."""
    outputs, results = ("motion", "color"), []
    for casts in (False, True):
        scene = gallery()
        for _, group in scene.lights.groups():
            group.casts_shadow = np.full(len(group), casts)
        before = scene.camera
        turned = wd.Camera.look_at(np.add(before.position, (0.11, -0.05, 0.2)), (0.1, 0.75, 0.0), vertical_fov_deg=45.0)
        more = ("shadow.point_size=128", "shadow.spot_size=64", "shadow.directional_size=64")
        renderer = renderer_of(device, "off", outputs, scene, more)
        renderer.render(before)
        scene.instances[1].transform = tilt(25.0, 50.0, 1.0, (-1.1, 0.65, 0.3))
        results.append(images(renderer.render(turned)))
        (stage,) = (s for s in renderer.plan.passes if s.name == "motion")
        frame, section = renderer.plan.resources.frame, renderer.plan.resources.program.sections
        assert (len(frame.views) > 1) is casts and len(stage.old_views) == 1
        commands = [c for part in section if part.name == "motion" for step in part.steps for c in step]
        handed = [a for c in commands for a in (*c._arguments["inputs"], *c._arguments["outputs"])]
        lengths = [len(a) for a in handed if isinstance(a, wp.array) and a.dtype is frame.views.dtype]
        assert len(lengths) >= 5 and set(lengths) == {1}, "nothing may be written behind the cameras' views"
    assert_same(*results, ("motion",))
    assert not np.array_equal(results[0]["color"], results[1]["color"]) and np.abs(results[0]["motion"]).max() > 1.0


def test_motion_is_written_to_files(device, tmp_path):
    scene = card_scene()
    renderer = renderer_of(device, "off", ("color", "motion"), scene)
    renderer.render()
    scene.instances[0].transform = card(scene, x=0.2)
    frame = renderer.render()
    frame.save(tmp_path / "out.exr")
    part = read_image(tmp_path / "out.exr")[0]
    assert np.array_equal(np.stack([part["motion.X"], part["motion.Y"]], axis=-1), frame.numpy("motion")[0])


def test_f5_motion_is_forgotten_where_another_frame_came_between(device):
    scene = card_scene()
    renderer = renderer_of(device, "off", ("motion",), scene)
    renderer.render()
    scene.instances[0].transform = card(scene, x=0.3)
    assert images(renderer.render())["motion"].any()
    assert not images(renderer.render())["motion"].any()
    # Two views are another plan; back in the first, its old frame is not the one before.
    renderer.render([scene.camera, scene.camera])
    scene.instances[0].transform = card(scene, x=0.6)
    assert not images(renderer.render())["motion"].any()
    scene.instances[0].transform = card(scene, x=0.9)
    assert images(renderer.render())["motion"].any()
    # A scene loaded anew has no frame before either.
    scene.add(box(0.1), transform=tilt(move=(0.0, 0.0, 5.0)))
    scene.instances[0].transform = card(scene, x=0.2)
    assert not images(renderer.render())["motion"].any()


def test_bound_transforms_and_poses_move_too(device):
    scene = card_scene()
    array = wp.array(np.float32(card(scene))[None], dtype=wp.mat44, device=device)
    scene.bind_transforms(array)
    renderer = renderer_of(device, "velocity_gather", ("motion", "color"), scene)
    renderer.render()
    array.assign(np.float32(card(scene, x=0.25))[None])
    one = images(renderer.render())
    fx = scene.camera.pixel_projection(*SIZE)[0]
    assert abs(one["motion"][24, 34, 0] - 0.05 * fx) < 1e-3
    assert "come from an array" in {r.name: r for r in renderer.explain(measure=False).rows}["motion_blur"].reason
    poses = [np.eye(4, dtype=np.float32)[None].copy() for _ in range(2)]
    poses[1][0, 0, 3] = -0.25
    for pose in poses:
        moved = images(renderer.render(poses=wp.array(pose, dtype=wp.mat44, device=device)))
    assert abs(moved["motion"][24, 34, 0] - 0.05 * fx) < 1e-3


# ---- blur


@pytest.mark.parametrize("half", [False, True])
def test_f5_what_stands_still_changes_no_bit(half, device):
    outputs = ("display",) if half else ("color", "display")
    scene = moving_scene()
    plain = images(renderer_of(device, "off", outputs, scene).render())
    renderer = renderer_of(device, outputs=outputs, scene=scene)
    for _ in range(3):
        assert_same(images(renderer.render()), plain)
    assert "motion_blur" in [s.name for s in renderer.plan.passes]
    # A closed shutter, forced on, in front of something that moves.
    closed = scene.camera.replace(shutter=0.0)
    forced = renderer_of(device, outputs=outputs, scene=scene, more=["motion_blur.when=always"])
    forced.render(closed)
    scene.instances[1].transform = tilt(25.0, 50.0, 1.0, (-1.1, 0.65, 0.3))
    plain = images(renderer_of(device, "off", outputs, scene).render())
    assert_same(images(forced.render(closed)), plain)


def test_f2_one_colour_stays_one_colour(device):
    scene = moving_scene()
    scene.lights = type(scene.lights)()
    value = (1.0, 0.3, 3e4)
    for k, instance in enumerate(scene.instances):
        instance.material = wd.Material(model="lambert", base_color=(0, 0, 0, 1.0), emissive=value, name=str(k))
    scene.environment = wd.Environment(background=value)
    for rung in BOTH:
        renderer = renderer_of(device, rung, ("color",), scene)
        for x in (-1.2, -0.9, -0.5):
            scene.instances[1].transform = tilt(20.0, 30.0 * x, 1.0, (x, 0.6, 0.2))
            color = images(renderer.render())["color"]
        assert np.abs(color / np.float32(value) - 1.0).max() < 1e-6


def test_a_flying_edge_becomes_the_ramp_of_its_flight(device):
    scene = card_scene()
    fx = scene.camera.pixel_projection(96, 48)[0]
    step = 12.0
    found = {}
    for rung in BOTH:
        scene.instances[0].transform = card(scene, x=0.0)
        renderer = renderer_of(device, rung, ("color",), scene, ["motion_blur.samples=256"], width=96)
        renderer.render()
        scene.instances[0].transform = card(scene, x=step * 5.0 / fx)
        found[rung] = images(renderer.render())["color"][24, :, 0]
    edge = 48.0 + fx * np.array([-1.0, 1.0]) / 5.0
    x = np.arange(96) + 0.5
    # Where the card was for a share of the flight of twelve pixels.
    expected = np.clip((x - edge[0]) / step, 0, 1) * np.clip((edge[1] + step - x) / step, 0, 1)
    for rung, tolerance in (("velocity_gather", 0.1), ("shutter_samples", 0.06)):
        assert np.abs(found[rung] - expected).max() < tolerance, rung


def test_rotations_run_along_arcs(device):
    scene = card_scene()
    corner = 2.0**0.5
    renderer = renderer_of(device, "shutter_samples", ("color",), scene, ["motion_blur.samples=64"], height=64)
    renderer.render()
    scene.instances[0].transform = card(scene, angle=np.pi / 2)
    image = images(renderer.render())["color"][..., 0]
    # A square turned by a right angle sweeps a disc of its half diagonal; interpolated matrices would shrink it.
    fx = scene.camera.pixel_projection(64, 64)[0]
    y, x = np.mgrid[0:64, 0:64] - 31.5
    radius = np.hypot(x, y) * 5.0 / fx
    assert image[radius < 0.95].min() == 1.0 and image[radius > corner + 0.1].max() == 0.0
    ring = image[(radius > 1.2) & (radius < 1.3)]
    assert 0.1 < ring.mean() < 0.5 and ring.std() < 0.1


def test_rungs_hold_the_error_their_settings_state(device):
    tone = {}
    for rung in ("off", *BOTH):
        scene = stage.build(shutter=0.8)
        more = ["motion_blur.samples=64", "anti_aliasing.rung=samples_16"]
        renderer = renderer_of(device, rung, ("color",), scene, more, width=320, height=180)
        for time in (0.31 - 1 / 24, 0.31):
            stage.animate(scene, time)
            color = images(renderer.render())["color"]
        tone[rung] = color / (1.0 + color)
    error = {k: float(np.sqrt(np.mean((v - tone["shutter_samples"]) ** 2))) for k, v in tone.items()}
    assert error["velocity_gather"] <= 0.03 and error["velocity_gather"] < error["off"], error


@pytest.mark.parametrize("rung", BOTH)
def test_a_moving_scene_makes_nothing_new(rung, device):
    scene = stage.build()
    renderer = renderer_of(device, rung, scene=scene)
    times = (0.0, 0.04, 0.08, 0.12)
    renderer.render()
    for time in times:
        stage.animate(scene, time)
        last = images(spied(renderer))
    # Two frames are enough for another renderer to come to the same picture, and threads change nothing.
    for fields in ({"threads": 1}, {"share_memory": False}):
        other = renderer_of(device, rung, scene=scene, **fields)
        for time in times[-2:]:
            stage.animate(scene, time)
            again = images(other.render())
        assert_same(again, last)


def test_samples_of_the_shutter_leave_the_scene_as_it_was(device):
    scene = stage.build()
    outputs = ("depth", "instance_id", "color", "motion")
    renderer = renderer_of(device, "shutter_samples", outputs, scene)
    stage.animate(scene, 0.5)
    renderer.render()
    stage.animate(scene, 0.55)
    blurred = images(renderer.render())
    still = images(renderer_of(device, "off", ("depth", "instance_id", "color"), scene).render())
    assert np.array_equal(bits(blurred["depth"]), bits(still["depth"]))
    assert np.array_equal(blurred["instance_id"], still["instance_id"])
    assert np.abs(blurred["motion"]).max() > 0.5
    assert not np.array_equal(blurred["color"], still["color"])
    # A second frame at rest is sharp again: what was interpolated did not stay.
    rest = images(renderer.render())
    assert np.abs(rest["color"] - still["color"]).max() < 1e-5 and not rest["motion"].any()


def test_explain_tells_what_is_declared_to_move():
    scene = gallery()
    scene.camera = scene.camera.replace(shutter=0.5)

    def row(renderer, name="motion_blur"):
        return {r.name: r for r in renderer.explain(measure=False).rows}[name]

    renderer = renderer_of("cpu", scene=scene)
    renderer.render()
    assert not row(renderer).runs and row(renderer).reason == "nothing is declared moving"
    assert "trail_near" not in renderer.plan.memory and "motion" not in renderer.plan.memory
    scene.instances[1].transform = tilt(move=(0.1, 0.0, 0.0))
    renderer.render()
    assert row(renderer).runs and "have changed between frames" in row(renderer).reason
    assert row(renderer, "motion").reason == "motion_blur reads it"
    scene.camera = scene.camera.replace(shutter=0.0)
    renderer.render()
    assert row(renderer).reason == "no camera has an open shutter"
    animated = renderer_of("cpu", "shutter_samples", scene=stage.build())
    animated.render()
    assert row(animated).reason == "shutter_samples moves views and instances instead"
    assert row(animated, "shutter_samples").rung == "16 samples" and animated.plan.replays == 17


@pytest.mark.gpu
@pytest.mark.parametrize("rung", BOTH)
def test_devices_agree(rung, cuda_device):
    result = []
    for device in ("cpu", cuda_device):
        scene = stage.build()
        renderer = renderer_of(device, rung, ("color",), scene)
        renderer.render()
        stage.animate(scene, 0.04)
        color = images(renderer.render())["color"]
        result.append(color / (1.0 + color))
    difference = np.abs(result[0] - result[1]).max(axis=2)
    assert np.quantile(difference, 0.99) < 1e-3 and difference.max() < 0.2
