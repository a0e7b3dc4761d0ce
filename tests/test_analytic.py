"""Scenes whose picture is known on paper."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from pixel_scenes import render

import warp_deferred as wd

SIZE = 48
OUTPUTS = ("color", "diffuse", "specular", "position", "depth", "normal")
LAMBERT = wd.Material(model="lambert", base_color=(0.5, 0.25, 0.75, 1.0))
#: Float32 throughout: what is compared is light, not the codec's 8 bits.
FULL = ("gbuffer.rung=full", "ambient_visibility.rung=off")


def floor(material: wd.Material = LAMBERT) -> wd.Scene:
    scene = wd.Scene()
    plane = reference.quad(100.0)
    scene.add(wd.Mesh(plane.positions, plane.triangles), material=material)
    return scene


def picture(scene: wd.Scene, camera: wd.Camera, device: str) -> dict[str, np.ndarray]:
    return render(scene, camera, SIZE, SIZE, outputs=OUTPUTS, settings=FULL, device=device)


DOWN = wd.Camera.look_at((0.0, 5.0, 0.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0, 85.0, 90.0, 120.0])
def test_b5_directional_light_on_a_plane(angle_deg, device):
    angle = np.radians(angle_deg)
    scene = floor()
    scene.lights.add(wd.DirectionalLight(direction=(np.sin(angle), -np.cos(angle), 0.0), intensity=3.0))
    image = picture(scene, DOWN, device)
    expected = np.array([0.5, 0.25, 0.75]) / np.pi * 3.0 * max(np.cos(angle), 0.0)
    if angle_deg > 90.0:
        assert not image["color"].any()
    assert np.abs(image["color"] - expected).max() <= 1e-6 * 3.0
    assert np.array_equal(image["color"], image["diffuse"]) and not image["specular"].any()


def test_point_light_over_a_plane(device):
    scene = floor()
    light = wd.PointLight(position=(0.7, 2.0, -0.4), intensity=10.0)
    scene.lights.add(light)
    image = picture(scene, DOWN, device)
    twin = reference.Light("point", radiance=(10.0, 10.0, 10.0), position=light.position)
    points = image["position"].reshape(-1, 3).astype(float)
    expected = reference.lambert_plane_radiance(points, 1.0, twin).reshape(SIZE, SIZE, 3) * [0.5, 0.25, 0.75]
    assert np.abs(image["color"] / expected - 1.0).max() <= 1e-5
    assert np.abs(points[:, 1]).max() < 1e-5 and np.abs(image["depth"] - 5.0).max() < 1e-5


def test_spot_light_draws_its_cone(device):
    scene = floor()
    scene.lights.add(wd.SpotLight(position=(0.0, 4.0, 0.0), inner_angle=0.2, outer_angle=0.4, intensity=10.0))
    image = picture(scene, DOWN, device)
    distance = np.hypot(image["position"][..., 0], image["position"][..., 2]).astype(float)
    angle = np.arctan(distance / 4.0)
    assert not image["color"][angle > 0.4 + 1e-3].any() and (image["color"][angle < 0.4 - 0.02] > 0.0).all()
    inside = angle < 0.2 - 1e-3
    d2 = distance**2 + 16.0
    expected = 10.0 * np.cos(angle) / d2 / np.pi * 0.5
    assert np.abs(image["color"][..., 0] / expected - 1.0)[inside].max() < 1e-5


def test_light_beyond_its_range_is_exactly_dark(device):
    scene = floor()
    scene.lights.add(wd.PointLight(position=(0.0, 1.0, 0.0), range=1.75, intensity=100.0))
    image = picture(scene, DOWN, device)
    distance = np.sqrt((image["position"].astype(float) - [0.0, 1.0, 0.0]) ** 2 @ np.ones(3))
    assert not image["color"][distance > 1.75 * (1 + 1e-6)].any() and image["color"][distance < 1.74].all()


@pytest.mark.parametrize("albedo", [1.0, 0.3])
def test_b2_a_body_in_uniform_light_shows_its_albedo(albedo, device):
    ball = reference.sphere(1.0, 12, 16)
    material = wd.Material(model="lambert", base_color=(albedo, albedo, albedo, 1.0))
    scene = wd.Scene()
    scene.add(wd.Mesh(ball.positions, ball.triangles, smooth=True), material=material)
    scene.environment = wd.Environment(ambient=(1.0, 1.0, 1.0), background=(1.0, 1.0, 1.0))
    image = picture(scene, wd.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0)), device)
    body = np.isfinite(image["depth"])
    assert np.abs(image["color"][body] - albedo).max() < 1e-6 and (image["color"][~body] == 1.0).all()
    assert 200 < body.sum() < SIZE * SIZE


def test_ball_has_the_normals_and_depth_of_a_sphere(device):
    ball = reference.sphere(1.0, 64, 96)
    scene = wd.Scene()
    scene.add(wd.Mesh(ball.positions, ball.triangles, normals=ball.normals), material=LAMBERT)
    image = picture(scene, wd.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), vertical_fov_deg=40.0), device)
    body = np.isfinite(image["depth"])
    radius = np.linalg.norm(image["position"][body], axis=1)
    assert np.abs(radius - 1.0).max() < 2e-3
    assert np.abs(image["normal"][body] - image["position"][body] / radius[:, None]).max() < 5e-3
    assert abs(image["depth"][SIZE // 2, SIZE // 2] - 3.0) < 5e-3
    # The outline of a ball of radius 1 seen from 4 m: tan of its half angle is 1 / sqrt(15).
    outline = np.pi * (0.5 * SIZE / np.tan(np.radians(20.0)) / np.sqrt(15.0)) ** 2
    assert abs(body.sum() / outline - 1.0) < 0.02


def test_emission_is_added_unlit(device):
    scene = floor(LAMBERT.replace(emissive=(2.0, 0.5, 0.0)))
    image = picture(scene, DOWN, device)
    assert (image["color"] == np.array([2.0, 0.5, 0.0], np.float32)).all() and not image["diffuse"].any()
