"""Bound points: the picture of a mesh made from them, frame after frame, with nothing compiled or allocated anew."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from builders import FULL, LAYERS, Spy, add_lights, assert_same, box, gallery, grid, images, sphere, tilt

import warp_deferred as wd

NAN, INF = float("nan"), float("inf")
#: What does not depend on normals.
FIRM = ("alpha", "depth", "position", "albedo", "instance_id", "semantic_id", "material_id", "triangle_id")
#: Normals within 1e-6 of the host's; radiance by that times the slope of a lobe of roughness 0.6, about 10 at most.
NORMAL_BOUND, LIGHT_BOUND = 1e-6, 2e-5


def wave(positions, phase=0.0, amount=0.15):
    p = np.asarray(positions, float)
    return (p + amount * np.sin(4.0 * p[:, [1, 2, 0]] + [phase, 1.0 + phase, 2.0]) + [0.0, 0.1, 0.0]).astype(np.float32)


def remade(mesh, points, triangles=None):
    """Return the mesh made anew from points."""
    faces = mesh.triangles if triangles is None else triangles
    return wd.Mesh(points, faces, uvs=mesh.uvs, colors=mesh.colors, smooth=mesh.smooth)


def scene_of(mesh, *, copies=1, world=-1):
    scene = wd.Scene()
    material = wd.Material(roughness=0.6)
    scene.add(grid(2, 9.0), transform=tilt(-90.0, 0.0, 1.0, (0.0, -1.0, 0.0)))
    for k in range(copies):
        place = tilt(10.0, 30.0 * k, (1.0 - 2.0 * (k % 2), 1.0, 1.0), (1.3 * k - 0.4 * (copies > 1), 0.2, -0.5 * k))
        scene.add(mesh, transform=place, material=material, world=world, label=k)
    add_lights(scene)
    scene.environment = wd.Environment(ambient=(0.1, 0.1, 0.1))
    scene.camera = wd.Camera.look_at((0.4, 1.0, 3.2), (0.0, 0.0, 0.0), vertical_fov_deg=50.0)
    return scene


def renderer_of(scene, device, **fields):
    return wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL, **fields)


def render(scene, device, camera=None, **fields):
    return images(renderer_of(scene, device, **fields).render(camera))


def assert_close(expected, actual):
    """Firm layers agree to the bit, normals and radiance within their bounds."""
    assert_same(expected, actual, FIRM)
    assert np.abs(expected["normal"] - actual["normal"]).max() <= NORMAL_BOUND
    for name in ("color", "diffuse", "specular"):
        assert np.abs(expected[name] - actual[name]).max() <= LIGHT_BOUND * max(1.0, expected[name].max()), name


def as_plain(values, device):
    return wp.array(values, dtype=wp.float32, device=device)


def as_vectors(values, device):
    return wp.array(values, dtype=wp.vec3, device=device)


def as_strided(values, device):
    return wp.array(np.repeat(values, 2, axis=0), dtype=wp.vec3, device=device)[::2]


def as_numpy(values, device):
    return values.astype(np.float64)


class Foreign:
    """An array of somebody else's that speaks only DLPack, as JAX's do."""

    def __init__(self, values, device):
        self._array = as_plain(values, device)

    shape = property(lambda self: self._array.shape)

    def __dlpack__(self, **fields):
        return self._array.__dlpack__(**fields)

    def __dlpack_device__(self):
        return self._array.__dlpack_device__()


class Interface:
    """A host array of somebody else's."""

    def __init__(self, values, device):
        self._array, self.__array_interface__ = values, values.__array_interface__


@pytest.mark.parametrize("wrap", [as_plain, as_vectors, as_strided, as_numpy, Foreign, Interface])
@pytest.mark.parametrize("make", [lambda: grid(6, 2.0), lambda: box(1.2), lambda: sphere(5, 0.8, colored=True)])
def test_bound_points_give_the_image_of_a_mesh_made_from_them(make, wrap, device):
    # At most 128 triangles: one cluster either way. Flat faces: every layer agrees to the bit.
    mesh = make()
    mesh.normals = None
    points = wave(mesh.positions)
    expected = render(scene_of(remade(mesh, points)), device)
    scene = scene_of(mesh)
    scene.bind_points(mesh, wrap(points, device))
    assert not np.array_equal(render(scene_of(mesh), device)["depth"], expected["depth"])
    assert_same(expected, render(scene, device))


def test_torch_points_give_the_image_of_a_mesh_made_from_them(device):
    torch = pytest.importorskip("torch")
    mesh = grid(6, 2.0)
    points = wave(mesh.positions)
    scene = scene_of(mesh)
    scene.bind_points(mesh, torch.from_numpy(points).to("cuda" if device.startswith("cuda") else "cpu"))
    assert_same(render(scene_of(remade(mesh, points)), device), render(scene, device))


@pytest.mark.parametrize("make", [lambda: grid(20, 2.0, smooth=True), lambda: sphere(16, 0.8)])
def test_smooth_meshes_of_many_clusters_are_shaded_as_the_host_would(make, device):
    mesh = make()
    # Seam and poles in one place to the bit, unlike sin(pi): what is welded at load is what is welded later.
    mesh = wd.Mesh(np.round(mesh.positions, 5) + 0.0, mesh.triangles, smooth=True)
    points = wave(mesh.positions)
    other = remade(mesh, points)
    scene = scene_of(mesh, copies=2)
    scene.bind_points(mesh, as_vectors(points, device))
    assert_close(render(scene_of(other, copies=2), device), render(scene, device))


def test_points_that_are_all_zero_at_load_hold_a_place_open(device):
    shape = grid(20, 2.0)
    points = wave(shape.positions)
    mesh = wd.Mesh(np.zeros_like(points), shape.triangles, uvs=shape.uvs, smooth=True)
    scene = scene_of(mesh)
    assert 1 not in render(scene, device)["instance_id"]
    scene.bind_points(mesh, as_vectors(points, device))
    assert_close(
        render(scene_of(wd.Mesh(points, mesh.triangles, uvs=mesh.uvs, smooth=True)), device), render(scene, device)
    )


def test_points_that_move_every_frame_make_nothing_new(device):
    mesh = grid(20, 2.0, smooth=True)
    scene = scene_of(mesh, copies=2)
    arrays = [as_vectors(wave(mesh.positions, 0.7 * k), device) for k in range(5)]
    scene.bind_points(mesh, arrays[0])
    renderer = renderer_of(scene, device)
    seen = [images(renderer.render())]
    plan = renderer.plan
    frames = []
    for array in arrays[1:]:
        with Spy() as spy:
            scene.bind_points(mesh, array)
            frame = renderer.render()
        spy.assert_nothing()
        seen.append(images(frame))
        frames.append(renderer.plan is plan)
    assert all(frames)
    # Written in place, without a word to the scene.
    arrays[-1].assign(arrays[0])
    with Spy() as spy:
        frame = renderer.render()
    spy.assert_nothing()
    assert_same(seen[0], images(frame))
    for k, image in enumerate(seen):
        other = scene_of(mesh, copies=2)
        other.bind_points(mesh, as_vectors(wave(mesh.positions, 0.7 * k), device))
        assert_same(render(other, device), image)
    assert not np.array_equal(seen[0]["depth"], seen[1]["depth"])


def test_numpy_points_are_copied_when_they_are_bound(device):
    mesh = grid(6, 2.0)
    points = wave(mesh.positions)
    scene = scene_of(mesh)
    scene.bind_points(mesh, points)
    renderer = renderer_of(scene, device)
    first = images(renderer.render())
    points += 1.0
    assert_same(first, images(renderer.render()))
    scene.bind_points(mesh, wave(mesh.positions, 1.0))
    second = images(renderer.render())
    assert_same(render(scene_of(remade(mesh, wave(mesh.positions, 1.0))), device), second)
    # A device array in between must not hide that the host's array is new to the staging.
    scene.bind_points(mesh, as_vectors(wave(mesh.positions, 2.0), device))
    renderer.render()
    scene.bind_points(mesh, wave(mesh.positions, 1.0))
    assert_same(second, images(renderer.render()))


def test_unbinding_brings_the_mesh_back_to_the_bit(device):
    mesh = sphere(12, 0.8)
    scene = scene_of(mesh)
    renderer = renderer_of(scene, device)
    before = images(renderer.render())
    scene.bind_points(mesh, as_vectors(wave(mesh.positions), device))
    assert not np.array_equal(images(renderer.render())["depth"], before["depth"])
    scene.bind_points(mesh, None)
    assert_same(before, images(renderer.render()))
    assert renderer.plan.passes[0].name == "clusters"


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_a_vertex_that_is_not_finite_drops_its_faces_alone(bad, device):
    mesh = grid(20, 2.0, smooth=True)
    points = wave(mesh.positions)
    lost = points.copy()
    lost[[30, 211, 212], [0, 1, 2]] = bad
    faces = mesh.triangles.copy()
    gone = np.isin(faces, [30, 211, 212]).any(axis=1)
    # A face without an area keeps the ids of the others.
    faces[gone] = faces[gone][:, :1]
    scene = scene_of(mesh)
    scene.bind_points(mesh, as_vectors(lost, device))
    image = render(scene, device)
    assert all(np.isfinite(image[name]).all() for name in LAYERS if name != "depth")
    expected = render(scene_of(remade(mesh, points, faces)), device)
    whole = render(scene_of(remade(mesh, points)), device)
    assert not np.array_equal(whole["triangle_id"], expected["triangle_id"])
    assert_close(expected, image)


def test_a_mesh_whose_points_are_all_lost_is_not_drawn(device):
    mesh = grid(20, 2.0)
    scene = scene_of(mesh)
    scene.bind_points(mesh, as_vectors(np.full_like(mesh.positions, NAN), device))
    image = render(scene, device)
    assert 1 not in image["instance_id"] and np.isfinite(image["color"]).all()


def test_faces_without_area_are_not_drawn_and_come_back(device):
    mesh = grid(20, 2.0)
    flat, points = wave(mesh.positions) * np.float32([1.0, 0.0, 0.0]), wave(mesh.positions)
    scene = scene_of(mesh)
    scene.bind_points(mesh, as_vectors(flat, device))
    renderer = renderer_of(scene, device)
    assert 1 not in images(renderer.render())["instance_id"]
    scene.bind_points(mesh, as_vectors(points, device))
    assert_same(render(scene_of(remade(mesh, points)), device), images(renderer.render()))


@pytest.mark.parametrize("move", [(400.0, -30.0, 900.0), (-1e6, 2e5, 3e5)])
def test_a_mesh_far_out_of_its_load_bounds_is_drawn(move, device):
    mesh = grid(20, 2.0)
    points = wave(mesh.positions) + np.float32(move)
    scene = scene_of(mesh)
    scene.bind_points(mesh, as_vectors(points, device))
    place = scene.instances[1].transform
    there = place[:3, :3] @ np.float64(move) + place[:3, 3]
    camera = wd.Camera.look_at(there + np.array([0.3, 1.0, 3.0]), there)
    image = render(scene, device, camera)
    assert_same(render(scene_of(remade(mesh, points)), device, camera), image)
    assert (image["instance_id"] == 1).mean() > 0.1


def test_a_mesh_through_the_near_plane_is_clipped_as_any_other(device):
    mesh = grid(20, 2.0)
    points = wave(mesh.positions) * np.float32([1.0, 1.0, 8.0]) + np.float32([0.4, 0.4, 0.0])
    camera = wd.Camera.look_at((0.4, 0.5, 0.8), (0.2, 0.2, -2.0), near=0.5)
    scene = scene_of(mesh)
    scene.bind_points(mesh, as_vectors(points, device))
    image = render(scene, device, camera)
    assert_same(render(scene_of(remade(mesh, points)), device, camera), image)
    assert (image["instance_id"] == 1).any() and image["depth"].min() < 0.55


def test_all_instances_of_a_mesh_follow_it_and_other_meshes_stay(device):
    mesh, other = sphere(6, 0.6), sphere(7, 0.3)
    mesh.normals = other.normals = None
    points = wave(mesh.positions)
    scenes = [scene_of(mesh, copies=3), scene_of(remade(mesh, points), copies=3)]
    for scene in scenes:
        scene.add(other, transform=tilt(0.0, 0.0, 1.0, (0.0, 0.9, 1.0)))
    scenes[0].bind_points(mesh, as_vectors(points, device))
    image = render(scenes[0], device)
    assert {1, 2, 3, 4} <= set(image["instance_id"].ravel())
    assert_same(render(scenes[1], device), image)


def test_one_array_holds_the_points_of_many_meshes_in_many_worlds(device):
    shapes = [grid(6, 2.0), sphere(5, 0.7), box(1.1)]
    for mesh in shapes:
        mesh.normals = None
    points = [wave(m.positions, k) for k, m in enumerate(shapes)]
    scenes = [wd.Scene(), wd.Scene()]
    for scene, meshes in zip(
        scenes, (shapes, [remade(m, p) for m, p in zip(shapes, points, strict=True)]), strict=True
    ):
        # The order of worlds is not the order of the array.
        for world, mesh in zip((2, 0, 1), meshes, strict=True):
            scene.add(mesh, world=world, transform=tilt(20.0, 30.0))
        scene.add(grid(1, 9.0), transform=tilt(-90.0, 0.0, 1.0, (0.0, -1.0, 0.0)))
        add_lights(scene)
        scene.camera = wd.Camera.look_at((0.4, 1.0, 3.2), (0.0, 0.0, 0.0))
    scenes[0].bind_points(shapes, as_vectors(np.concatenate(points), device))
    cameras = [scenes[0].camera.replace(world=world) for world in (0, 1, 2, -1)]
    frames = [renderer_of(scene, device).render(cameras) for scene in scenes]
    for k in range(len(cameras)):
        assert_same(images(frames[1], k), images(frames[0], k))
    assert len({images(frames[0], k)["depth"].tobytes() for k in range(4)}) == 4


def test_a_mesh_with_an_origin_of_its_own_takes_points_in_the_space_it_was_made_in(device):
    shape = grid(6, 2.0)
    offset = np.array([4096.0, -512.0, 1024.0])
    mesh = wd.Mesh(shape.positions.astype(np.float64) + offset, shape.triangles)
    assert mesh.origin.any()
    # Multiples of 2^-10 stay exact in float32 beside the offset.
    points = (np.round(wave(shape.positions) * 1024.0) / 1024.0).astype(np.float64) + offset
    expected = scene_of(wd.Mesh(points - mesh.origin, mesh.triangles))
    scene = scene_of(mesh)
    for s, move in ((scene, -offset), (expected, mesh.origin - offset)):
        matrix = np.eye(4)
        matrix[:3, 3] = move
        s.instances[1].transform = matrix
    scene.bind_points(mesh, as_vectors(points.astype(np.float32), device))
    assert_same(render(expected, device), render(scene, device))


def test_host_threads_change_nothing():
    mesh = sphere(16, 0.8)
    scene = scene_of(mesh, copies=2)
    scene.bind_points(mesh, as_vectors(wave(mesh.positions), "cpu"))
    one, two, three = (render(scene, "cpu", threads=count) for count in (1, 2, 3))
    assert_same(one, two)
    assert_same(one, three)


@pytest.mark.gpu
def test_cpu_and_cuda_agree(cuda_device):
    mesh = sphere(16, 0.8)
    pictures = []
    for device in ("cpu", cuda_device):
        scene = scene_of(mesh, copies=2)
        scene.bind_points(mesh, as_vectors(wave(mesh.positions), device))
        pictures.append(render(scene, device))
    assert_close(*pictures)


def test_only_a_binding_calls_for_the_pass(device):
    scene = scene_of(grid(6, 2.0))
    renderer = renderer_of(scene, device)
    renderer.render()
    assert "points" not in [p.name for p in renderer.plan.passes] and "points" not in renderer.plan.memory
    assert "points" not in [report.name for report in renderer.plan.reports(False)]
    mesh = scene.instances[1].mesh
    scene.bind_points(mesh, as_vectors(mesh.positions, device))
    renderer.render()
    report = renderer.plan.reports(False)[0]
    assert report.name == "points" and report.runs and report.reason == "1 mesh takes points from arrays"
    assert report.bytes > 32 * len(mesh.positions)


def test_without_a_binding_its_kernels_are_not_even_imported():
    code = (
        "import sys, warp_deferred as wd; s = wd.Scene(); s.add(wd.Mesh([[0,0,0],[1,0,0],[0,1,0]], [[0,1,2]]));"
        "s.camera = wd.Camera.look_at((0, 0, 3), (0, 0, 0));"
        "wd.Renderer(s, width=8, height=8, device='cpu', outputs=('depth',)).render();"
        "print([m for m in sys.modules if m.endswith(('kernels.points', 'point_store'))])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip().splitlines()[-1] == "[]"


def test_points_that_do_not_fit_are_refused(device):
    mesh, other = grid(6, 2.0), box()
    scene = scene_of(mesh)
    count = len(mesh.positions)
    for array in (
        as_vectors(np.zeros((count + 1, 3)), device),
        wp.zeros((count, 4), dtype=wp.float32, device=device),
        np.zeros((count, 2)),
        np.full((count, 3), NAN),
        np.full((count, 3), 1e300),
        "points",
    ):
        with pytest.raises(wd.InputError, match=r"Scene\.bind_points"):
            scene.bind_points(mesh, array)
    assert not scene.point_bindings
    for meshes in (other, [], [mesh, mesh], 5, None):
        with pytest.raises(wd.InputError, match="meshes of this scene"):
            scene.bind_points(meshes, as_vectors(np.zeros((count, 3)), device))
    scene.add(other)
    scene.bind_points([mesh, other], np.zeros((count + 8, 3)))
    with pytest.raises(wd.InputError, match="alone or together"):
        scene.bind_points(mesh, None)
    scene.bind_points([mesh, other], None)
    for dtype in (wp.float64, wp.int32):
        scene.bind_points(mesh, wp.zeros((count, 3), dtype=dtype, device=device))
        with pytest.raises(wd.InputError, match="float32"):
            render(scene, device)
    scene.bind_points(mesh, wp.zeros(count, dtype=wp.float32, device=device))
    with pytest.raises(wd.InputError, match="shape"):
        render(scene, device)


def test_an_array_that_speaks_no_dlpack_is_refused_by_name(device):
    class Speechless:
        shape = (49, 3)
        __cuda_array_interface__ = None

    mesh = grid(6, 2.0)
    scene = scene_of(mesh)
    scene.bind_points(mesh, Speechless())
    with pytest.raises(wd.InputError, match="Speechless"):
        render(scene, device)


def test_clearing_the_scene_unbinds(device):
    scene = gallery()
    mesh = scene.instances[1].mesh
    scene.bind_points(mesh, as_vectors(mesh.positions, device))
    renderer = renderer_of(scene, device)
    renderer.render()
    scene.clear()
    assert not scene.point_bindings and np.all(images(renderer.render())["instance_id"] == -1)
