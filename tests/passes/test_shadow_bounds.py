"""Casters that shade nothing that is looked at are not drawn, and the picture does not show it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builders import assert_same, images

import warp_deferred as wd
from warp_deferred.passes.shadow import ShadowPass

NAMES = ("diffuse", "instance_id")


def draw_everything(patch):
    """Draw whatever a map holds, as if no bound were known."""
    prepare = ShadowPass.prepare

    def prepare_unbounded(stage, resources):
        prepare(stage, resources)
        stage.casters.one_eye = 0
        stage.casters.inner = -1.0

    patch.setattr(ShadowPass, "prepare", prepare_unbounded)


def drawn(scene, device, *values):
    """The picture, and how many clusters all views draw."""
    settings = wd.Settings().with_values(["ambient_visibility.rung=off", "raster.bins=off", *values])
    renderer = wd.Renderer(
        scene, width=96, height=64, device=device, outputs=NAMES, settings=settings, share_memory=False
    )
    frame = images(renderer.render())
    return frame, int(renderer.plan.resources.channels["work_counts"].numpy().sum())


def terrain(rng, kind, projection="perspective"):
    """Hills seen by a camera somewhere among them, and casting lights of a kind."""
    scene = wd.load("terrain?triangles=20000&lights=0")
    eye = np.array((rng.uniform(-6.0, 6.0), rng.uniform(1.0, 4.0), rng.uniform(-6.0, 6.0)))
    target = rng.uniform(-8.0, 8.0, 3) * (1.0, 0.1, 1.0)
    fields = {"projection": projection, "near": 0.05}
    if projection == "orthographic":
        fields.update(near=-5.0, far=12.0, vertical_extent=6.0)
    scene.camera = wd.Camera.look_at(tuple(eye), tuple(target), **fields)
    for _ in range(3):
        x, z = rng.uniform(-8.0, 8.0, 2)
        down = (rng.normal(), -rng.uniform(0.3, 2.0), rng.normal())
        if kind == "directional":
            scene.lights.add(wd.DirectionalLight(direction=down, intensity=2.0, casts_shadow=True))
        elif kind == "spot":
            scene.lights.add(
                wd.SpotLight(position=(x, 3.0, z), direction=down, intensity=60.0, range=rng.uniform(3.0, 15.0),
                             outer_angle=rng.uniform(0.4, 1.2), inner_angle=0.2, casts_shadow=True)
            )  # fmt: skip
        else:
            reach = math.inf if rng.random() < 0.2 else rng.uniform(2.0, 12.0)
            scene.lights.add(wd.PointLight(position=(x, 2.0, z), intensity=30.0, range=reach, casts_shadow=True))
    return scene


@pytest.mark.parametrize("rung", ["hard", "pcf", "pcss"])
@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
def test_bounds_change_no_bit(kind, rung, device, rng, monkeypatch):
    saved = 0
    for draw in range(6):
        scene = terrain(rng, kind, "orthographic" if draw == 5 else "perspective")
        values = (f"shadow.rung={rung}", "shadow.keep_maps=false", "shadow.directional_size=256",
                  "shadow.point_size=128", "shadow.spot_size=256")  # fmt: skip
        bounded, few = drawn(scene, device, *values)
        with monkeypatch.context() as patch:
            draw_everything(patch)
            whole, many = drawn(scene, device, *values)
        assert_same(bounded, whole)
        assert (whole["diffuse"] > 0.0).any() and few <= many
        saved += few < many
    assert saved >= 1


def test_a_light_that_reaches_nothing_seen_draws_nothing(device):
    scene = wd.load("terrain?triangles=20000&lights=0")
    scene.camera = wd.Camera.look_at((0.0, 2.0, 0.0), (0.0, 0.0, -6.0))
    scene.lights.add(wd.PointLight(position=(0.0, 1.0, 9.0), intensity=5.0, range=3.0))
    values = ("shadow.rung=pcf", "shadow.keep_maps=false")
    alone = drawn(scene, device, *values)[1]
    scene.lights.point.casts_shadow = np.array([True])
    assert drawn(scene, device, *values)[1] == alone


def test_kept_maps_are_drawn_anew_where_the_camera_turns_towards_other_casters(device):
    scene = wd.load("terrain?triangles=20000&lights=0")
    scene.lights.add(wd.DirectionalLight(direction=(0.5, -0.6, 0.3), intensity=2.0, casts_shadow=True))
    scene.lights.add(wd.PointLight(position=(1.0, 2.0, 1.0), intensity=30.0, range=8.0, casts_shadow=True))
    settings = [wd.Settings().with_values([f"shadow.keep_maps={keep}", "shadow.rung=pcf",
                                           "shadow.directional_size=256"]) for keep in ("true", "false")]  # fmt: skip
    kept, fresh = (wd.Renderer(scene, width=96, height=64, device=device, outputs=NAMES, settings=s) for s in settings)
    for angle in (0.0, 0.0, 1e-4, 0.3, 0.6, 0.0, 2.0):
        camera = wd.Camera.look_at((0.0, 2.0, 0.0), (5.0 * math.sin(angle), 0.5, 5.0 * math.cos(angle)))
        assert_same(images(kept.render(camera)), images(fresh.render(camera)))


def test_kept_cascades_are_drawn_anew_where_the_camera_rolls(device):
    # The sphere around a slice, and with it the map's view, stays to the bit; the frustum in it does not.
    scene = wd.load("terrain?triangles=20000&lights=0")
    scene.lights.add(wd.DirectionalLight(direction=(0.5, -0.4, 0.3), intensity=2.0, casts_shadow=True))
    settings = [wd.Settings().with_values([f"shadow.keep_maps={keep}", "shadow.rung=pcf",
                                           "shadow.directional_size=512"]) for keep in ("true", "false")]  # fmt: skip
    kept, fresh = (wd.Renderer(scene, width=192, height=24, device=device, outputs=NAMES, settings=s) for s in settings)
    pictures, views = [], []
    for up in ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        camera = wd.Camera.look_at((0.0, 2.5, 4.0), (0.0, 0.5, -4.0), up=up)
        pictures.append(images(kept.render(camera)))
        assert_same(pictures[-1], images(fresh.render(camera)))
        views.append(kept.plan.resources.frame.views.numpy()[1:]["origin"])
    assert all(np.array_equal(view, views[0]) for view in views)
    assert not np.array_equal(pictures[0]["diffuse"], pictures[1]["diffuse"])


def test_samples_through_a_lens_see_every_caster(device, monkeypatch):
    scene = wd.load("terrain?triangles=20000&lights=0")
    scene.lights.add(wd.DirectionalLight(direction=(0.5, -0.6, 0.3), intensity=2.0, casts_shadow=True))
    scene.camera = wd.Camera.look_at((0.0, 1.5, 0.0), (5.0, 0.5, 2.0), aperture=0.5, focus_distance=2.0)
    values = ("shadow.rung=pcf", "depth_of_field.rung=lens_samples", "depth_of_field.samples=16",
              "shadow.directional_size=256")  # fmt: skip
    settings = wd.Settings().with_values(values)

    def picture():
        fields = {"width": 96, "height": 64, "device": device, "outputs": ("color",), "settings": settings}
        return images(wd.Renderer(scene, **fields).render())

    bounded = picture()
    draw_everything(monkeypatch)
    assert_same(bounded, picture())
