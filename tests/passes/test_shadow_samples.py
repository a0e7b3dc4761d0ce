"""Shadows in frames of several samples: what moves within the shutter takes its shadow along, the rest is shared."""

import numpy as np
import pytest
import warp as wp
from builders import images, tilt
from shadow_scenes import MAPS, RUNGS, drawn, mixed_scene, plate_scene, render, with_rung

import warp_deferred as wd
from warp_deferred.sampling import sample_table

SHUTTER = ("motion_blur.rung=shutter_samples", "motion_blur.samples=16", "ambient_visibility.rung=off")


@pytest.mark.parametrize("rung", ["pcf", "ray_traced"])
def test_samples_share_the_maps_of_their_frame(rung, device):
    scene = mixed_scene()
    values = ("anti_aliasing.rung=samples_4",)
    whole = render(scene, "off", device, *values, names=("diffuse",))["diffuse"]
    kept = render(scene, rung, device, *values, names=("diffuse",))["diffuse"]
    plain = render(scene, rung, device, *values, "shadow.keep_maps=false", names=("diffuse",))["diffuse"]
    one = render(scene, rung, device, names=("diffuse",))["diffuse"]
    assert np.array_equal(kept, plain)
    assert (kept < whole - 1e-6).mean() > 0.1 and np.all(kept <= whole + 1e-6)
    # The average over a pixel is what its centre shows, but for the edges.
    assert np.mean(np.abs(kept - one) > 0.05 * whole.max()) < 0.08
    renderer = wd.Renderer(
        scene, width=96, height=72, device=device, outputs=("diffuse",), settings=with_rung(rung, *values)
    )
    for _ in range(2):
        assert np.array_equal(images(renderer.render())["diffuse"], kept)


def shot(kind, time, *, travel=0.5, turn_deg=0.0):
    """Return a plate on its way over a floor, seen by a camera that may turn; the way ends at time 1."""
    scene = plate_scene(kind)
    scene.instances[1].transform = tilt(-90.0, 0.0, 1.0, (travel * (time - 1.0), 1.0, 0.0))
    a = np.radians(turn_deg) * (time - 1.0)
    place = np.array([-1.2, 3.0, 2.6])
    ahead = np.array([1.0, -3.0, -2.6])
    ahead[[0, 2]] = np.cos(a) * ahead[0] - np.sin(a) * ahead[2], np.sin(a) * ahead[0] + np.cos(a) * ahead[2]
    scene.camera = wd.Camera.look_at(place, place + ahead, vertical_fov_deg=50.0, shutter=1.0)
    scene.environment = wd.Environment(ambient=(0.3, 0.3, 0.3))
    scene.animate = lambda scene, time: None
    return scene


def renderer_of(scene, rung, device, *values, outputs=("color",)):
    settings = with_rung(rung, *SHUTTER, *values)
    return wd.Renderer(scene, width=96, height=72, device=device, outputs=outputs, settings=settings)


def show(renderer, kind, time, **way):
    """Render the shot at a time with a renderer made for it before."""
    now = shot(kind, time, **way)
    for mine, other in zip(renderer.scene.instances, now.instances, strict=True):
        mine.transform = other.transform
    return images(renderer.render(now.camera))["color"]


def blurred_and_mean(kind, rung, device, *values, **way):
    """Return a frame of several samples whose shutter is open all the way, and the mean of frames at their times."""
    renderer = renderer_of(shot(kind, 0.0, **way), rung, device, *values)
    renderer.render()
    blurred = show(renderer, kind, 1.0, **way)
    single = renderer_of(shot(kind, 0.0, **way), rung, device, *values, "motion_blur.rung=off")
    times = 1.0 - sample_table(renderer.plan.request, False)[:, 4]
    assert len(times) == 16 and renderer.plan.replays == 17
    frames = [show(single, kind, float(time), **way) for time in times]
    return blurred, np.mean(frames, axis=0, dtype=np.float64), frames


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
@pytest.mark.parametrize("rung", RUNGS)
def test_a_moving_casters_shadow_is_the_mean_of_those_at_its_times(kind, rung, device):
    blurred, expected, frames = blurred_and_mean(kind, rung, device)
    assert np.abs(frames[0] - frames[-1]).max() > 0.1
    # Poses in between are interpolated on the device: at most a few pixels may see another edge.
    assert np.mean(np.abs(blurred - expected) > 1e-5) < 1e-3


@pytest.mark.parametrize("rung", ["hard", "pcf"])
def test_cascades_follow_a_camera_that_turns_while_the_shutter_is_open(rung, device):
    # The scene reaches farther than the maps: fitted to the frame's own camera they would end too early in the picture
    # of another time, and 0.002 of the pixels and more be lit in place of shaded.
    way = {"travel": 0.0, "turn_deg": 45.0}
    blurred, expected, _ = blurred_and_mean("directional", rung, device, "shadow.distance_m=5", **way)
    assert np.mean(np.abs(blurred - expected) > 1e-3) < 5e-4


@pytest.mark.parametrize("keep", ["true", "false"])
def test_only_what_moves_is_drawn_in_every_sample(keep, device):
    scene = shot("spot", 0.0)
    # A lamp so far from the plate that nothing moves in its maps.
    scene.lights.add(wd.PointLight(position=(60.0, 2.0, 0.0), range=5.0, intensity=5.0, casts_shadow=True))
    renderer = renderer_of(scene, "pcf", device, f"shadow.keep_maps={keep}")
    renderer.render()
    scene.instances[1].transform = shot("spot", 1.0).instances[1].transform
    renderer._update()
    program, views = renderer.plan.resources.program, renderer.plan.resources.frame
    (first, _), (each, count), _ = program.parts
    for section in first:
        program.run_section(section)
    found = []
    for _ in range(count):
        for section in each:
            program.run_section(section)
        views.sampling = True
        found.append(views.views.numpy()["skipped"][1:] == 0)
    found = np.array(found)
    lamp, spot = found[:, :6], found[:, 6]
    assert count == 17 and found.shape == (17, 7)
    assert spot.all() and not lamp[1:].any() and lamp[0].all() == (keep == "false")


def test_bound_points_are_drawn_once_a_frame(device):
    scene = plate_scene("spot")
    plate = scene.instances[1].mesh
    scene.bind_points(plate, wp.array(plate.positions, dtype=wp.vec3, device=device))
    renderer = renderer_of(scene, "pcf", device, "anti_aliasing.rung=samples_4")
    expected = render(plate_scene("spot"), "pcf", device, "anti_aliasing.rung=samples_4", names=("color",))["color"]
    for _ in range(2):
        assert np.abs(images(renderer.render())["color"] - expected).max() < 1e-4
        # What the last sample drew, which is no longer the first.
        renderer.plan.resources.frame.sampling = True
        assert not drawn(renderer).any()


@pytest.mark.parametrize("rung", MAPS)
def test_explain_tells_when_samples_draw_maps(rung):
    def reason(scene, *values):
        renderer = renderer_of(scene, rung, "cpu", *values)
        renderer.render()
        return {r.name: r for r in renderer.explain(measure=False).rows}["shadow"].reason

    assert reason(shot("spot", 0.0)).endswith("; samples draw anew what the shutter moves")
    still = plate_scene("spot")
    assert reason(still) == "1 light casts shadows"
    assert reason(still, "anti_aliasing.rung=samples_4") == "1 light casts shadows; samples share the maps"


LENS = ("depth_of_field.rung=lens_samples", "depth_of_field.samples=16")


def lens_frames(scene, rung, device, *values, names=("diffuse",)):
    """Render with a pinhole and through a wide lens; return the images and the views of the maps of both."""
    scene.environment = wd.Environment()
    results, maps = [], []
    for aperture in (0.0, 0.3):
        settings = with_rung(rung, *LENS, *values)
        renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=names, settings=settings)
        renderer.render(scene.camera.replace(aperture=aperture, focus_distance=3.6))
        results.append(images(renderer.render(scene.camera.replace(aperture=aperture, focus_distance=3.6))))
        frame = renderer.plan.resources.frame
        frame.sampling = True
        maps.append(frame.views.numpy()[1:].copy())
        assert renderer.plan.replays == (16 if aperture else 1)
    return results, maps


@pytest.mark.parametrize("rung", MAPS)
def test_points_of_the_lens_share_the_maps_of_its_middle(rung, device):
    (sharp, soft), (one, many) = lens_frames(mixed_scene(), rung, device)
    assert len(one) == 17 and one["scale"].any()
    for name in ("origin", "rotation", "scale", "near", "far"):
        assert np.array_equal(one[name], many[name]), name
    # The last sample, and the last frame, drew none of them.
    assert many["skipped"].all() and not np.array_equal(sharp["diffuse"], soft["diffuse"])


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
@pytest.mark.parametrize("rung", RUNGS)
def test_s1_a_lit_plane_does_not_shadow_itself_through_a_lens(kind, rung, device):
    scene = plate_scene(kind)
    # Off the floor's own plane there is nothing: every sample must see all of the light, to the bit.
    scene.instances[1].transform = tilt(-90.0, 0.0, 1.0, (0.0, -5.0, 0.0))
    (_, soft), _ = lens_frames(scene, rung, device)
    (_, whole), _ = lens_frames(scene, "off", device)
    assert np.array_equal(soft["diffuse"], whole["diffuse"]) and whole["diffuse"].any()


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
def test_maps_through_a_lens_come_as_near_to_rays_as_without(kind, device):
    """The bound is half as much again: acne, or light that comes in under the box, would show in every sample."""
    scene = mixed_scene()
    for other, (_, group) in zip(("point", "spot", "directional"), scene.lights.groups(), strict=True):
        if other != kind:
            group.intensity = np.zeros(len(group))
    values = ("shadow.samples=32", "shadow.directional_size=1024", "shadow.spot_size=512", "shadow.point_size=512")
    rays, _ = lens_frames(scene, "ray_traced", device, *values)
    total = rays[1]["diffuse"].sum(dtype=np.float64)
    for rung in MAPS:
        maps, _ = lens_frames(scene, rung, device, *values)
        sharp, soft = (np.abs(a["diffuse"] - b["diffuse"]) for a, b in zip(maps, rays, strict=True))
        assert soft.mean() <= 1.5 * sharp.mean() and soft.max() <= 1.5 * sharp.max(), rung
        # As much light in all: neither a shadow nor its foot is lost.
        assert abs(maps[1]["diffuse"].sum(dtype=np.float64) / total - 1.0) < 0.005, rung
