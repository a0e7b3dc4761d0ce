"""Bound points: the picture of a mesh made from them, whatever array they come in and wherever they go."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from builders import LAYERS, add_lights, assert_same, box, grid, images, sphere, tilt
from point_scenes import (
    INF,
    NAN,
    as_plain,
    as_vectors,
    assert_close,
    remade,
    render,
    renderer_of,
    scene_of,
    wave,
)  # fmt: skip

import warp_deferred as wd


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
