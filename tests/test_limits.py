"""Capacities at their limit and one past it: it works, or is refused before anything is allocated.

Sizes of images and of the scene are in test_errors.py, lights in test_hard_cases_lights.py, bins and the store of large
triangles in test_invariance.py, shadow maps in passes/test_shadow_maps.py.
"""

from __future__ import annotations

import numpy as np
import pytest
from builders import FULL, Spy, assert_same, box, grid, images, tilt

import warp_deferred as wd
from warp_deferred import plan as plan_module
from warp_deferred import views as views_module


def lit_box(**fields):
    scene = wd.Scene()
    scene.add(box(1.0), material=wd.Material(model="lambert"), **fields)
    scene.lights.add(wd.PointLight(position=(1.0, 1.0, 2.0), intensity=5.0))
    scene.camera = wd.Camera.look_at((0.5, 0.7, 3.0), (0.0, 0.0, 0.0))
    return scene


@pytest.mark.parametrize("shape", [(1, 16384, 3), (16384, 1, 4)])
def test_e7_textures_of_the_largest_size_are_sampled(shape, device):
    pixels = np.full(shape, 200, np.uint8)
    material = wd.Material(model="lambert", base_color_texture=wd.Texture(pixels), two_sided=True)
    scene = wd.Scene()
    scene.add(grid(1, 4.0), material=material)
    scene.camera = wd.Camera.look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    frame = wd.Renderer(scene, width=16, height=9, device=device, outputs=("albedo",), settings=FULL).render()
    # Linear light of code 200.
    assert np.abs(frame.numpy("albedo") - ((200 / 255 + 0.055) / 1.055) ** 2.4).max() < 1e-3


@pytest.mark.parametrize("shape", [(1, 16385, 3), (16385, 1, 3)])
def test_e7_a_texture_past_the_largest_size_is_refused(shape):
    with pytest.raises(wd.InputError, match=r"Texture\.pixels: expected at most 16384 texels a side"):
        wd.Texture(np.zeros(shape, np.uint8))


def test_e7_views_at_the_limit_of_pixels_work_and_one_more_is_refused(device, monkeypatch):
    scene = lit_box()
    renderer = wd.Renderer(scene, width=8, height=6, device=device, outputs=("color", "depth"))
    one = images(renderer.render())
    monkeypatch.setattr(views_module, "MAX_PIXELS", 7 * 48)
    frame = renderer.render([scene.camera] * 7)
    assert_same(one, images(frame, 6))
    with Spy() as spy, pytest.raises(wd.CapacityError, match=r"views: expected at most 336 pixels .*got 384; render"):
        renderer.render([scene.camera] * 8)
    assert not spy.allocated
    assert_same(one, images(renderer.render()))


def test_e7_a_thousand_views_of_a_thousand_worlds(device):
    scene = lit_box(world=0)
    for world in range(1, 1000):
        scene.add(scene.instances[0].mesh, world=world, material=scene.instances[0].material, label=world)
    cameras = [scene.camera.replace(world=world) for world in range(1000)]
    renderer = wd.Renderer(scene, width=5, height=4, device=device, outputs=("depth", "semantic_id"))
    frame = renderer.render(cameras)
    ids = frame.numpy("semantic_id")
    for world in range(1000):
        assert set(np.unique(ids[world])) <= {-1, world} and (ids[world] == world).any()
    depth = frame.numpy("depth")
    assert np.array_equal(depth, np.broadcast_to(depth[:1], depth.shape))


def test_e7_pairs_of_views_and_instances_past_an_array_are_refused(device, monkeypatch):
    scene = lit_box()
    for k in range(15):
        scene.add(scene.instances[0].mesh, transform=tilt(move=(0.0, 0.0, -1.0 * k)))
    # The store of large triangles has a capacity of its own.
    settings = wd.Settings().with_values(["raster.bins=off"])
    renderer = wd.Renderer(scene, width=1, height=1, device=device, outputs=("depth",), settings=settings)
    monkeypatch.setattr(plan_module, "MAX_ELEMENTS", 64)
    assert renderer.render([scene.camera] * 4).numpy("depth").shape == (4, 1, 1)
    with (
        Spy() as spy,
        pytest.raises(wd.CapacityError, match=r"clusters: expected at most 64 elements of 'pairs', got 80"),
    ):
        renderer.render([scene.camera] * 5)
    assert not spy.allocated
