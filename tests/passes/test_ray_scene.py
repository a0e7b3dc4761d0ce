"""The trees that rays are traced against: one set for all who trace, refitted when something moves, its bytes told."""

import numpy as np
import pytest
import warp as wp
from builders import assert_same, box, grid, images, sphere, spied, tilt
from shadow_scenes import CLAY, mixed_scene, plate_scene, with_rung

import warp_deferred as wd

BOTH = ("ambient_visibility.rung=ray_traced", "ambient_visibility.rays=16", "ambient_visibility.radius_m=1")
NAMES = ("diffuse", "ambient_visibility")


def lit_scene():
    scene = mixed_scene()
    scene.environment = wd.Environment(ambient=(0.3, 0.3, 0.3))
    return scene


def renderer_of(scene, device, rung="ray_traced", *values, outputs=NAMES, **fields):
    settings = with_rung(rung, *BOTH, *values)
    return wd.Renderer(scene, width=64, height=48, device=device, outputs=outputs, settings=settings, **fields)


def rows_of(renderer):
    return {row.name: row for row in renderer.explain(measure=False).rows}


def test_shadows_and_ambient_visibility_share_one_set(device):
    renderer = renderer_of(lit_scene(), device)
    together = images(renderer.render())
    plan = renderer.plan
    keys = [kernel.key.split("__")[-1] for kernel, _ in plan.resources.program.kernels]
    assert keys.count("place_instances_kernel") == 1
    row = rows_of(renderer)["ray_scene"]
    assert row.rung == "once a frame"
    assert row.reason == "shadow.rung is ray_traced and ambient_visibility.rung is ray_traced"
    rays = plan.resources.scene.rays()
    shade, visible = (next(s for s in plan.passes if s.name == name) for name in ("shade", "ambient_visibility"))
    assert shade.shadows.scene.tree == visible.rays.tree == rays.tree.id
    alone = images(renderer_of(lit_scene(), device, "pcf").render())
    assert_same(alone, together, ("ambient_visibility",))
    settings = with_rung("ray_traced", "ambient_visibility.rung=off")
    plain = wd.Renderer(lit_scene(), width=64, height=48, device=device, outputs=("diffuse",), settings=settings)
    assert_same(images(plain.render()), together, ("diffuse",))


def test_nothing_of_it_is_there_where_nothing_traces(device):
    renderer = renderer_of(lit_scene(), device, "pcf", "ambient_visibility.rung=gtao")
    renderer.render()
    assert "ray_scene" not in rows_of(renderer) and renderer.plan.resources.scene.ray_bytes == 0
    assert renderer.memory_report().rays == 0 and "trees for rays" not in str(renderer.memory_report())


@pytest.mark.parametrize("shutter", [0.0, 1.0])
def test_samples_share_the_trees_unless_the_shutter_moves_instances(shutter, device):
    scene = lit_scene()
    scene.camera = scene.camera.replace(shutter=shutter)
    scene.animate = lambda scene, time: None
    values = ("anti_aliasing.rung=samples_4", "motion_blur.rung=shutter_samples", "motion_blur.samples=16")
    renderer = renderer_of(scene, device, "ray_traced", *values, outputs=("color",))
    renderer.render()
    parts = {s.name: s.part for s in renderer.plan.resources.program.sections}
    moving = shutter > 0.0
    assert rows_of(renderer)["ray_scene"].rung == ("once a sample" if moving else "once a frame")
    assert parts["ray_scene"] < parts["begin_sample"] and ("ray_instances" in parts) == moving
    assert parts.get("ray_instances", 1) == parts["begin_sample"]


def test_its_bytes_are_those_that_warp_allocates(device):
    from warp._src.context import runtime

    from warp_deferred.ray_scene import RayScene

    scene = wd.Scene()
    shapes = [sphere(6, 0.5), sphere(12, 0.5), box(1.0), grid(20)]
    for k in range(40):
        scene.add(shapes[k % 4], transform=tilt(move=(k % 7, k // 7, 0.3 * k)), material=CLAY)
    renderer = wd.Renderer(scene, width=8, height=8, device=device, outputs=("depth",))
    renderer.render(wd.Camera())
    current = runtime.core.wp_alloc_tracker_get_current_bytes
    with wp.ScopedMemoryTracker(print=False):
        before = current()
        rays = RayScene(renderer._device_scene)
        held = current() - before
    # Descriptors of five trees, and what the small arrays are rounded up by.
    assert 0 <= held - rays.bytes <= 5 * 600 + 10 * 512
    assert rays.bytes > 80 * sum(len(mesh.triangles) for mesh in shapes)
    tracing = renderer_of(lit_scene(), device)
    tracing.render()
    told = tracing.memory_report()
    assert told.rays == tracing.plan.resources.scene.rays().bytes and told.to_dict()["rays"] == told.rays
    assert "trees for rays" in str(told) and "trees for rays" in str(tracing.explain(measure=False))


def test_trees_are_cut_by_where_instances_stand(device):
    """As they are made, whoever placed the instances: boxes that all lie in one place would have no order."""
    scene = plate_scene("spot")
    poses = np.stack([tilt(move=(3.0 * k, 0.0, 0.0)) for k in range(2)]).astype(np.float32)
    scene.bind_transforms(wp.array(poses, dtype=wp.float32, device=device))
    renderer = renderer_of(scene, device)
    renderer.prepare()
    rays = renderer.plan.resources.scene.rays()
    low, high = rays.low.numpy(), rays.high.numpy()
    assert np.abs(0.5 * (low + high)[:, 0] - [0.0, 3.0]).max() < 1e-3


def test_visibility_far_from_the_origin_is_the_same(device):
    near, far = lit_scene(), lit_scene()
    shift = np.array([3e6, -1e6, 2e6])
    for instance in far.instances:
        matrix = instance.transform.copy()
        matrix[:3, 3] += shift
        instance.transform = matrix
    far.camera = far.camera.replace(position=tuple(np.array(far.camera.position) + shift))
    a, b = (images(renderer_of(s, device, "off").render())["ambient_visibility"] for s in (near, far))
    assert a.min() < 0.7 and np.mean(a != b) < 0.01


def test_bound_points_move_in_both(device):
    scene = lit_scene()
    plate = scene.instances[1].mesh
    bound = wp.array(plate.positions, dtype=wp.vec3, device=device)
    scene.bind_points(plate, bound)
    renderer = renderer_of(scene, device)
    first = images(renderer.render())
    moved = plate.positions + np.float32([0.3, 0.2, 0.4])
    bound.assign(moved)
    second = images(spied(renderer))
    assert not np.array_equal(first["diffuse"], second["diffuse"])
    still = wd.Scene()
    for k, instance in enumerate(lit_scene().instances):
        mesh = wd.Mesh(moved, plate.triangles) if k == 1 else instance.mesh
        still.add(mesh, transform=instance.transform, material=CLAY)
    still.lights, still.camera, still.environment = lit_scene().lights, scene.camera, scene.environment
    expected = images(renderer_of(still, device).render())
    for name in NAMES:
        assert np.mean(np.abs(second[name] - expected[name]) > 1e-4) < 0.01, name


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_flat_instances_stop_rays(axis, device):
    """A box without height stops what a plate in its place stops."""
    pictures = []
    for flat in (False, True):
        scene = plate_scene("spot")
        scene.environment = wd.Environment(ambient=(0.3, 0.3, 0.3))
        if flat:
            place = scene.instances[1].transform
            scale = np.ones(3)
            scale[axis] = 0.0
            # The box's flat axis to the plate's own, z.
            turn = np.roll(np.eye(3), 2 - axis, axis=0)
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = place[:3, :3] @ turn @ np.diag(scale), place[:3, 3]
            scene.instances[1].transform = tilt(move=(0.0, -90.0, 0.0))
            scene.add(box(1.0), transform=matrix, material=CLAY)
        pictures.append(images(renderer_of(scene, device, "ray_traced", "ambient_visibility.radius_m=4").render()))
    plate, boxed = pictures
    assert plate["ambient_visibility"].min() < 0.9
    for name in NAMES:
        assert np.mean(np.abs(plate[name] - boxed[name]) > 0.02) < 0.01, name
