"""Motion of bound points: by their pose, by themselves, and of those that are no number."""

import numpy as np
import warp as wp
from builders import assert_same, box, grid, images, spied, tilt
from motion_scenes import SIZE, card, card_scene, renderer_of

import warp_deferred as wd


def bound_motion(device, start, end, before, now, camera):
    """Motion of a card whose pose and points change between two frames, and its positions."""
    scene = card_scene()
    array = wp.array(start, dtype=wp.vec3, device=device)
    scene.bind_points(scene.instances[0].mesh, array)
    scene.add(box(0.4), transform=tilt(move=(1.3, 0.8, -4.0)))
    scene.instances[0].transform = before
    renderer = renderer_of(device, "off", ("motion", "position", "instance_id"), scene)
    assert not images(renderer.render(camera[0]))["motion"].any()
    array.assign(end)
    scene.instances[0].transform = now
    return images(renderer.render(camera[1])), renderer, array


def test_bound_points_move_with_what_they_are_bound_to(device):
    start = grid(1, 2.0).positions
    # A shear and a stretch: affine, so that every point of the card is known before and after.
    change = np.array([[1.2, 0.15, 0.0], [0.0, 0.9, 0.0], [0.1, -0.2, 1.0]])
    shift = np.array([0.05, -0.1, 0.2])
    end = (start @ change.T + shift).astype(np.float32)
    before, now = tilt(0.0, 10.0, 1.0, (0.1, 0.0, -5.0)), tilt(5.0, -12.0, (1.1, 1.0, 1.0), (-0.1, 0.1, -4.8))
    one = wd.Camera(shutter=1.0)
    two = one.replace(position=(0.06, -0.04, 0.1))
    result, renderer, array = bound_motion(device, start, end, before, now, (one, two))
    card_seen = result["instance_id"] == 0
    points = result["position"][card_seen].astype(float)
    own = (points - now[:3, 3]) @ np.linalg.inv(now[:3, :3]).T
    past = (own - shift) @ np.linalg.inv(change).T @ before[:3, :3].T + before[:3, 3]

    def project(camera, p):
        fx, fy, cx, cy = camera.pixel_projection(*SIZE)
        q = p - np.array(camera.position)
        return np.stack([fx * q[:, 0] / -q[:, 2] + cx, -fy * q[:, 1] / -q[:, 2] + cy], axis=1)

    expected = project(two, points) - project(one, past)
    assert card_seen.sum() > 200 and np.abs(expected).max() > 4.0
    assert np.abs(result["motion"][card_seen] - expected).max() < 5e-3
    # At rest nothing moves, to the bit, and a frame makes nothing new.
    assert not images(spied(renderer, two))["motion"].any()
    array.assign(start)
    assert images(spied(renderer, two))["motion"][card_seen].any()


def test_bound_points_that_stand_still_change_no_bit(device):
    start = grid(1, 2.0).positions
    before, now = tilt(0.0, 10.0, 1.0, (0.1, 0.0, -5.0)), tilt(5.0, -12.0, 1.0, (-0.1, 0.1, -4.8))
    camera = wd.Camera(shutter=1.0)
    bound, renderer, _ = bound_motion(device, start, start, before, now, (camera, camera))
    assert renderer.plan.memory["motion_points"] >= 16 * len(start)
    scene = card_scene()
    scene.add(box(0.4), transform=tilt(move=(1.3, 0.8, -4.0)))
    scene.instances[0].transform = before
    plain = renderer_of(device, "off", ("motion", "position", "instance_id"), scene)
    plain.render(camera)
    scene.instances[0].transform = now
    assert_same(images(plain.render(camera)), bound)
    assert "motion_points" not in plain.plan.memory


def test_points_that_are_not_finite_leave_no_mark(device):
    start = grid(2, 2.0).positions
    scene = card_scene()
    scene.clear()
    glow = wd.Material(model="lambert", emissive=(1.0, 1.0, 1.0), two_sided=True)
    scene.add(grid(2, 2.0), transform=card(scene), material=glow)
    array = wp.array(start, dtype=wp.vec3, device=device)
    scene.bind_points(scene.instances[0].mesh, array)
    renderer = renderer_of(device, "off", ("motion", "instance_id"), scene)
    camera = wd.Camera(shutter=1.0)
    renderer.render(camera)
    bad = start.copy()
    bad[0] = np.nan
    for points in (bad, start):
        array.assign(points)
        assert np.isfinite(images(renderer.render(camera))["motion"]).all()


def test_bound_points_are_blurred(device):
    scene = card_scene()
    scene.animate = None
    start = scene.instances[0].mesh.positions
    array = wp.array(start, dtype=wp.vec3, device=device)
    scene.bind_points(scene.instances[0].mesh, array)
    renderer = renderer_of(device, "velocity_gather", ("color",), scene)
    sharp = images(renderer.render())["color"]
    told = {r.name: r for r in renderer.explain(measure=False).rows}["motion_blur"]
    assert told.runs and "points come from an array" in told.reason
    renderer.render()
    array.assign(start + np.float32([0.6, 0.0, 0.0]))
    blurred = images(renderer.render())["color"]
    edge = blurred[SIZE[1] // 2, :, 0]
    assert np.count_nonzero((edge > 0.05) & (edge < 0.95)) >= 4
    assert not np.any((sharp > 0.05) & (sharp < 0.95))
