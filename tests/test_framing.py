"""The camera that frames a scene, and the light for a dark one."""

from __future__ import annotations

import numpy as np
import pytest

import warp_deferred as wd
from warp_deferred.framing import frame_camera, light_if_dark

BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = [[0, 1, 3], [4, 5, 7], [2, 6, 7]]


def scene_with(points, **material) -> wd.Scene:
    scene = wd.Scene()
    scene.add(wd.Mesh(points, FACES), material=wd.Material(**material) if material else None)
    return scene


def project(camera, points, aspect):
    """Return (x, y) from -1 to 1 across the picture, and depth."""
    x, y, z = np.array(camera.rotation).reshape(3, 3) @ (points - np.array(camera.position)).T
    half = np.tan(camera.vertical_fov / 2)
    return x / -z / (half * aspect), y / -z / half, -z


@pytest.mark.parametrize("size", [(1, 1, 1), (100, 1, 1), (1, 100, 1), (1, 1, 100), (1e-4, 2e-4, 1e-4), (1e6, 1e6, 0)])
@pytest.mark.parametrize("aspect", [16 / 9, 1.0, 0.3])
def test_all_corners_are_in_the_picture_and_fill_it(size, aspect):
    points = (BOX - 0.5) * size + np.array((3.0, -2.0, 7.0))
    camera = frame_camera(scene_with(points), aspect=aspect)
    low, high = scene_with(points).bounds()
    x, y, depth = project(camera, low + BOX * (high - low), aspect)
    assert np.abs(x).max() < 0.95 and np.abs(y).max() < 0.95
    # Tight: in one direction both sides of the box come as close to the border as the margin allows.
    assert min(x.max(), -x.min()) > 0.9 or min(y.max(), -y.min()) > 0.9
    assert (depth > camera.near).all() and camera.near > 1e-4 * depth.min()


def test_l18_framing_scales_with_the_scene():
    one = frame_camera(scene_with(BOX))
    for scale in (2.0**-20, 2.0**20):
        other = frame_camera(scene_with(BOX * scale))
        np.testing.assert_allclose(np.array(other.position) / scale, one.position, rtol=1e-6)
        assert other.near == pytest.approx(one.near * scale, rel=1e-6)
        assert other.rotation == pytest.approx(one.rotation)


def test_view_is_three_quarters_from_above():
    camera = frame_camera(scene_with(BOX))
    right, up, back = np.array(camera.rotation).reshape(3, 3)
    assert np.degrees(np.arctan2(back[0], back[2])) == pytest.approx(30.0)
    assert 15.0 <= np.degrees(np.arcsin(back[1])) <= 20.0
    assert right[1] == pytest.approx(0.0) and up[1] > 0.9
    assert np.degrees(camera.vertical_fov) == pytest.approx(40.0)


def test_l1_empty_scenes_and_single_points_are_framed():
    empty = frame_camera(wd.Scene())
    x, y, _ = project(empty, np.zeros((1, 3)), 1.0)
    assert abs(x[0]) < 0.3 and abs(y[0]) < 0.3
    point = frame_camera(scene_with(np.full((8, 3), 5e6)))
    x, y, depth = project(point, np.full((1, 3), 5e6), 1.0)
    assert abs(x[0]) < 0.3 and abs(y[0]) < 0.3 and depth[0] > point.near


def test_dark_scene_gets_key_fill_rim_and_ambient():
    scene = scene_with(BOX)
    scene.cameras.append(frame_camera(scene))
    notes = light_if_dark(scene)
    assert len(notes) == 1 and scene.notes == notes and "no light" in notes[0]
    sun = scene.lights.directional
    right, up, back = np.array(scene.camera.rotation).reshape(3, 3)
    # The key comes from the upper left of the camera and is warm; the fill is weaker and from the other side.
    assert sun.direction[0] @ right > 0 and sun.direction[0] @ up < 0 and sun.direction[0] @ back < 0
    assert sun.direction[1] @ right < 0 and sun.intensity[1] < 0.5 * sun.intensity[0]
    # The rim comes from behind, towards the camera.
    assert sun.direction[2] @ back > 0
    assert sun.color[0, 0] > sun.color[0, 2] and min(scene.environment.ambient) > 0
    background = scene.environment.background
    assert 0 < max(background) < 0.1 and background[2] > background[0]
    assert light_if_dark(scene) == [] and len(sun) == 3


def test_metal_gets_lamps_to_reflect():
    plain, metal = scene_with(BOX, metallic=0.0), scene_with(BOX, metallic=1.0)
    light_if_dark(plain), light_if_dark(metal)
    assert len(plain.lights) == 3 and len(metal.lights) > 20 and "metal" in metal.notes[0]
    lamps = metal.lights.directional
    # From all sides and from above, each far weaker than the key; a diffuse surface gets about as much light as before.
    dome = lamps.direction[3:]
    assert (dome.min(axis=0) < -0.6).all() and (dome[:, [0, 2]].max(axis=0) > 0.6).all()
    assert dome.mean(axis=0) @ np.array(frame_camera(metal).rotation[3:6]) < -0.1
    assert lamps.intensity[3:].max() < 0.1 * lamps.intensity[0]
    assert max(metal.environment.ambient) < max(plain.environment.ambient)


def test_vertices_and_not_their_box_are_framed():
    # A tall spike on a flat disk: the box has corners that nothing fills.
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    disk = np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    points = np.concatenate([disk, [[0.0, 3.0, 0.0]]])
    scene = wd.Scene()
    scene.add(wd.Mesh(points, [[k, (k + 1) % 12, 12] for k in range(12)]))
    x, y, _ = project(frame_camera(scene), points, 16 / 9)
    assert y.max() == pytest.approx(0.92, abs=1e-6) and y.min() == pytest.approx(-0.92, abs=1e-6)
    assert x.max() == pytest.approx(-x.min(), abs=1e-6)


def test_scenes_of_too_many_vertices_are_framed_by_their_box(monkeypatch):
    scene = scene_with(BOX)
    exact = frame_camera(scene)
    monkeypatch.setattr("warp_deferred.framing.MAX_POINTS", 7)
    assert np.allclose(frame_camera(scene).position, exact.position)


@pytest.mark.parametrize("light", [wd.PointLight(), wd.SpotLight(), wd.DirectionalLight()])
def test_scene_with_a_light_is_left_alone(light):
    scene = scene_with(BOX)
    scene.lights.add(light)
    assert light_if_dark(scene) == [] and len(scene.lights) == 1
    assert scene.environment == wd.Environment() and scene.notes == []


def test_scene_with_ambient_light_is_left_alone():
    scene = scene_with(BOX)
    scene.environment = wd.Environment(ambient=(0.1, 0.1, 0.1))
    assert light_if_dark(scene) == [] and len(scene.lights) == 0


def test_only_scenes_that_merely_glow_count_as_lit():
    glowing = scene_with(BOX, base_color=(0, 0, 0, 1), emissive=(1, 1, 1))
    assert light_if_dark(glowing) == []
    glowing.add(glowing.instances[0].mesh)
    assert len(light_if_dark(glowing)) == 1


def test_background_of_the_scene_is_kept():
    scene = scene_with(BOX)
    scene.environment = wd.Environment(background=(0.5, 0.6, 0.7))
    light_if_dark(scene)
    assert scene.environment.background == (0.5, 0.6, 0.7)


def test_a_face_towards_the_eye_is_seen_from_a_distance():
    # All but on one line towards the eye: the nearest eye that sees all of it would be at its nearest corner.
    scene = wd.Scene()
    scene.add(wd.Mesh([[1, 0.25, 0], [0, 1, 0], [0, 1, 0], [1, 1, 1], [0.5, 0.25, 0]], [[3, 1, 4]]))
    back = np.array(frame_camera(wd.Scene()).rotation).reshape(3, 3)[2]
    for scale in (1.0, 2.0**100, 2.0**-100):
        line = wd.Scene()
        points = np.array([[0, 0, 0], back, 0.5 * back]) * scale
        line.add(wd.Mesh(points.astype(np.float32), [[0, 1, 2]]))
        camera = frame_camera(line)
        depth = project(camera, points, 1.0)[2]
        assert camera.near > 0.0 and (depth > camera.near).all() and depth.min() > 0.4 * scale
    assert frame_camera(scene).near > 0.0
