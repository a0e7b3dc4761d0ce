"""Shadow maps: one set of launches with the cameras' views, kept while nothing moves, and nowhere else in a frame."""

import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from builders import LAYERS, Spy, assert_same, box, gallery, images, sphere, tilt
from shadow_scenes import CLAY, MAPS, NAMES, PLACE, RUNGS, add_light, drawn, mixed_scene, plate_scene, render, with_rung

import warp_deferred as wd


@pytest.mark.parametrize("rung", MAPS)
def test_maps_of_all_sizes_go_with_the_cameras_views(rung, device):
    scene = mixed_scene()
    names = tuple(n for n in LAYERS if n not in ("color", "light_count"))
    together = render(scene, rung, device, names=names)
    assert_same(together, render(scene, "off", device, names=names), set(names) - {"diffuse", "specular"})
    parts = []
    for kept in range(4):
        alone = mixed_scene()
        for (_, group), count in zip(alone.lights.groups(), (1, 2, 1), strict=True):
            start = {1: 0, 2: 1}[count] if group is not alone.lights.directional else 3
            group.intensity = np.where(np.arange(start, start + count) == kept, group.intensity, 0.0)
        parts.append(render(alone, rung, device, names=names)["diffuse"])
    total = sum(parts[1:], parts[0])
    assert np.abs(total - together["diffuse"]).max() <= 4e-6 * total.max()


@pytest.mark.parametrize("rung", RUNGS)
def test_threads_and_bins_give_the_same_bits(rung, device):
    scene = mixed_scene()
    one = render(scene, rung, device, threads=1)
    for threads, bins in ((2, "off"), (3, "off"), (1, "on")):
        assert_same(one, render(scene, rung, device, f"raster.bins={bins}", threads=threads))


@pytest.mark.parametrize("rung", ["pcf", "ray_traced"])
def test_several_cameras_and_worlds_share_maps_as_needed(rung, device):
    scene = plate_scene("directional")
    add_light(scene, "spot")
    add_light(scene, "point", world=1)
    for world in range(3):
        scene.add(box(0.5), transform=tilt(move=(1.2 * world - 1.2, 0.25, 0.8)), material=CLAY, world=world)
    poses = [scene.camera.replace(world=w) for w in (0, 1, 2, 1)]
    poses.append(wd.Camera.look_at((2.0, 2.5, 2.0), (0.0, 0.0, 0.0), world=-1))
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=with_rung(rung))
    batch = renderer.render(poses)
    # Cascades of five cameras, a spot light seen in four worlds, a point light of one.
    assert renderer.plan.request.shadow_slots == (5 * 4 + 4 * 1 + 6 if rung == "pcf" else 0)
    frames = [images(batch, k) for k in range(5)]
    for pose, expected in zip(poses, frames, strict=True):
        assert_same(images(renderer.render(pose)), expected)


def test_a_light_moved_by_a_device_array_moves_its_shadow(device):
    scene = plate_scene("point")
    renderer = wd.Renderer(scene, width=96, height=72, device=device, outputs=NAMES, settings=with_rung("pcf"))
    renderer.render()
    scene.lights.point.position = wp.array([[-1.4, 3.5, -0.8]], dtype=wp.vec3, device=device)
    renderer.render()
    with Spy() as spy:
        scene.lights.point.position.assign(np.array([[-1.0, 3.0, 0.5]], np.float32))
        moved = images(renderer.render())
    assert not spy.plans and not spy.loaded and not spy.kernels
    still = plate_scene("point")
    still.lights.point.position = np.array([[-1.0, 3.0, 0.5]])
    assert_same(moved, render(still, "pcf", device))
    assert not np.array_equal(moved["diffuse"], render(plate_scene("point"), "pcf", device)["diffuse"])


def cascade_keys(renderer):
    keys = renderer.plan.resources.channels["depth_keys"]
    return keys.numpy().copy(), renderer.plan.resources.frame.views.numpy()[1:]


def test_cascades_stand_still_while_the_camera_moves_a_little(device):
    scene = plate_scene("directional")
    scene.add(sphere(12, 0.4), transform=tilt(move=(0.8, 0.9, 0.3)), material=CLAY)
    names = ("diffuse",)
    renderer = wd.Renderer(scene, width=96, height=72, device=device, outputs=names, settings=with_rung("hard"),
                           share_memory=False)  # fmt: skip
    renderer.render()
    keys, views = cascade_keys(renderer)
    assert (keys > 0).any()
    same = 0
    for k in range(1, 9):
        # Less than a hundredth of the smallest texel a step.
        step = 1e-5 * k * np.array([1.0, -0.5, 0.7])
        renderer.render(scene.camera.replace(position=tuple(np.array(scene.camera.position) + step)))
        moved, places = cascade_keys(renderer)
        assert np.array_equal(places["scale"], views["scale"]) and np.array_equal(places["far"], views["far"])
        for c in range(4):
            if np.array_equal(places["origin"][c], views["origin"][c]):
                same += 1
                part = slice(512 * 512 * c, 512 * 512 * (c + 1))
                assert np.array_equal(moved[part], keys[part])
            else:
                # It moved by whole texels along the map's own axes.
                shift = places["rotation"][c] @ (places["origin"][c] - views["origin"][c])
                texels = shift * places["scale"][c][0]
                assert np.abs(texels - np.round(texels)).max() < 1e-3 and np.abs(texels).max() < 1.5
    assert same >= 24
    # Turning keeps every texel's size.
    renderer.render(wd.Camera.look_at(scene.camera.position, (0.9, 0.0, -0.4), vertical_fov_deg=50.0))
    assert np.array_equal(cascade_keys(renderer)[1]["scale"], views["scale"])


def test_without_a_casting_light_nothing_of_it_is_there(device):
    scene = gallery()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS)
    plain = images(renderer.render())
    plan = renderer.plan
    assert "shadow" not in [p.name for p in plan.passes] and plan.request.shadow_slots == 0
    assert not any(n.startswith(("shadow", "depth_keys")) for n in plan.memory)
    keys = {kernel.key for kernel, _ in plan.resources.program.kernels}
    assert not any("slot" in key or "bound_instances" in key for key in keys)
    # Forced, it changes no bit.
    for rung in RUNGS:
        settings = wd.Settings().with_values(["shadow.when=always", f"shadow.rung={rung}"])
        forced = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=settings)
        assert_same(images(forced.render()), plain)
        assert "shadow" in [p.name for p in forced.plan.passes]
    # Nor is it there where nothing lit is asked for, or the rung is off.
    scene.lights.spot.casts_shadow = np.ones(2, bool)
    depth = wd.Renderer(scene, width=64, height=48, device=device, outputs=("depth",))
    depth.render()
    assert depth.plan.request.shadow_slots == 0
    off = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS,
                      settings=wd.Settings().with_values(["shadow.rung=off"]))  # fmt: skip
    assert_same(images(off.render()), plain)


def test_lights_past_the_capacity_are_counted_and_lit(device):
    scene = plate_scene("spot")
    add_light(scene, "spot")
    scene.lights.spot.position = np.stack([PLACE, PLACE + np.array([0.3, 0.0, 0.0])])
    values = ("shadow.spot_lights=1",)
    renderer = wd.Renderer(
        scene, width=96, height=72, device=device, outputs=NAMES, settings=with_rung("hard", *values)
    )
    limited = images(renderer.render())
    assert "2 lights cast shadows; 1 past the capacity, without" in str(renderer.explain(measure=False))
    scene.lights.spot.casts_shadow = np.array([True, False])
    assert_same(limited, render(scene, "hard", device))


def test_a_frame_with_shadows_allocates_and_compiles_nothing(device):
    scene = mixed_scene()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=with_rung("pcss"))
    renderer.render()
    before = images(renderer.render())
    with Spy() as spy:
        scene.lights.spot.position = scene.lights.spot.position + 0.1
        scene.camera = scene.camera.replace(position=(-1.0, 3.0, 2.0))
        renderer.render()
    spy.assert_nothing()
    assert before["diffuse"].any()


@pytest.mark.parametrize("threads", [1, 2])
def test_maps_stay_while_neither_their_light_nor_a_caster_moves(threads, device):
    scene = mixed_scene()
    names, settings = ("diffuse",), with_rung("pcf")
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=names, settings=settings, threads=threads)
    # Point, spot, wide spot, four cascades.
    point, spot, wide, cascades = slice(0, 6), slice(6, 7), slice(7, 13), slice(13, 17)

    def check(*expected):
        """Render; the expected maps are drawn, the picture is that of a renderer that never kept any."""
        frame = images(renderer.render())
        fresh = wd.Renderer(scene, width=64, height=48, device=device, outputs=names, settings=settings)
        assert_same(frame, images(fresh.render()))
        marks = np.zeros(17, bool)
        for part in expected:
            marks[part] = True
        return np.array_equal(drawn(renderer), marks)

    everything = slice(0, 17)
    assert check(everything)
    assert check() and check()
    # A light moves: its maps alone. Another colour moves nothing.
    scene.lights.spot.position = scene.lights.spot.position + np.array([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert check(spot)
    scene.lights.spot.color = np.array([[1.0, 0.5, 0.2], [0.3, 1.0, 0.4]])
    assert check()
    # The camera leaps: cascades alone.
    scene.camera = scene.camera.replace(position=(-0.2, 2.6, 2.2))
    assert check(cascades)
    # A caster moves in some maps; where it left counts as well as where it went, and it may come back.
    box_at = scene.instances[2].transform
    scene.instances[2].transform = tilt(0.0, 30.0, 1.0, (1.3, 0.3, -0.6))
    check()
    some = drawn(renderer)
    assert some.any() and not some.all()
    assert check()
    scene.instances[2].transform = tilt(0.0, 30.0, 1.0, (1.3, -900.0, -0.6))
    check()
    assert drawn(renderer)[point].any() and drawn(renderer)[wide].any()
    scene.instances[2].transform = box_at
    check()
    # A light goes out and comes back after a caster moved unseen.
    place = np.array(scene.lights.point.position)
    scene.lights.point.position = wp.array([[np.nan, 0.0, 0.0]], dtype=wp.vec3, device=device)
    check()
    assert not drawn(renderer)[point].any()
    scene.instances[1].transform = tilt(-90.0, 0.0, 1.0, (0.1, 1.1, 0.0))
    check()
    scene.lights.point.position = wp.array(place.astype(np.float32), dtype=wp.vec3, device=device)
    check()
    assert drawn(renderer)[point].all()


def test_maps_are_drawn_every_frame_where_they_are_not_kept(device):
    scene = mixed_scene()
    kept = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=with_rung("pcf"))
    settings = with_rung("pcf", "shadow.keep_maps=false")
    plain = wd.Renderer(scene, width=64, height=48, device=device, outputs=NAMES, settings=settings)
    for _ in range(2):
        assert_same(images(kept.render()), images(plain.render()))
    assert drawn(plain).all() and not drawn(kept).any()
    # Another set of casting lights is another set of maps; the old ones do not show.
    scene.lights.spot.casts_shadow = np.array([True, False])
    assert_same(images(kept.render()), images(plain.render()))
    scene.lights.spot.casts_shadow = np.array([False, True])
    assert_same(images(kept.render()), images(plain.render()))
    scene.lights.spot.casts_shadow = np.array([True, True])
    assert_same(images(kept.render()), images(plain.render()))


def test_nothing_of_it_is_imported_without_a_casting_light():
    script = """
import sys
import warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_deferred as wd
scene = wd.load("lambert_plane")
for casts in (False, True):
    scene.lights.point.casts_shadow = [casts]
    wd.Renderer(scene, width=16, height=16, device="cpu").render()
    parts = [name.split(".") for name in sys.modules if name.startswith("warp_deferred.")]
    found = [p for p in parts if "shadow" in p[-1] and p[1] in ("kernels", "passes")]
    assert bool(found) == casts, (casts, found)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_other_passes_pay_nothing_for_the_maps(device):
    scene = mixed_scene()
    scene.environment = wd.Environment(ambient=(0.1, 0.1, 0.1))
    scene.camera = scene.camera.replace(bloom=0.5)
    plans = []
    for rung in ("off", "pcf"):
        renderer = wd.Renderer(
            scene, width=64, height=48, device=device, outputs=("display",), settings=with_rung(rung)
        )
        renderer.render()
        plans.append(renderer.plan)
    own = ("shadow", "depth_keys", "slice_depth_keys", "pairs", "work_entries", "bin_", "large_triangles")
    for name, size in plans[0].memory.items():
        if not name.startswith(own):
            assert plans[1].memory[name] == size, name
    for stage in plans[0].passes:
        other = next(s for s in plans[1].passes if s.name == stage.name)
        # Resolve's estimate knows only how many triangles all views may draw.
        if stage.name not in ("clusters", "raster", "resolve"):
            assert other.bytes_moved() == stage.bytes_moved(), stage.name
