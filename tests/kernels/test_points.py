"""Points: device normals, spheres, cones and boxes against those made on the host at load."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp
from builders import box, grid, sphere
from warp_deferred.kernels import points as kernels
from warp_deferred.kernels import structs

import warp_deferred as wd
from warp_deferred.clustering import cut_clusters
from warp_deferred.normals import smooth_normals

#: The kernels work in float64 as the host does, so a rounding to float32 is all that may differ.
NORMAL_BOUND = 1e-6


def deform(positions, seed, amount=0.3):
    """Bend, stretch and shift, the same for vertices that share a place."""
    rng = np.random.default_rng(seed)
    p = np.asarray(positions, float)
    waves = sum(
        amount * rng.normal(size=3) * np.sin(p @ rng.normal(size=(3, 1)) * 3.0 + rng.uniform(0, 6)) for _ in range(3)
    )
    return (p * rng.uniform(0.5, 2.0, 3) + waves + rng.normal(size=3)).astype(np.float32)


def exact_sphere(rings):
    """A sphere whose seam and poles lie in one place to the bit, unlike sin(pi)."""
    mesh = sphere(rings)
    return np.round(mesh.positions, 5) + np.float32(0.0), mesh.triangles


def staged(mesh, points, device, steps=()):
    """Render a scene with bound points and return its device scene; `steps` are points of frames before."""
    scene = wd.Scene()
    scene.add(mesh)
    scene.camera = wd.Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0))
    renderer = wd.Renderer(scene, width=8, height=8, device=device, outputs=("depth",))
    for step in (*steps, points):
        scene.bind_points(mesh, wp.array(step, dtype=wp.vec3, device=device))
        renderer.render()
    return renderer.plan.resources.scene


def rows(array, count):
    return array.numpy()[:count]


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e12])
@pytest.mark.parametrize("seed", range(3))
def test_normals_are_those_of_the_host(seed, scale, device):
    mesh = wd.Mesh(*exact_sphere(9), smooth=True)
    points = deform(mesh.positions, seed) * np.float32(scale)
    normals = rows(staged(mesh, points, device).geometry.normals, len(points))
    expected = smooth_normals(points, mesh.triangles)
    assert np.abs(normals[:, :3] - expected).max() <= NORMAL_BOUND and not normals[:, 3].any()


def test_normals_of_slivers_are_those_of_the_host(device):
    mesh = wd.Mesh(grid(12).positions, grid(12).triangles, smooth=True)
    points = deform(mesh.positions, 5) * np.float32([1.0, 1e-4, 1.0])
    normals = rows(staged(mesh, points, device).geometry.normals, len(points))[:, :3]
    assert np.abs(normals - smooth_normals(points, mesh.triangles)).max() <= NORMAL_BOUND


def test_a_given_hard_edge_stays_hard_and_a_seam_stays_welded(device):
    cube = box()
    corners = cube.positions[cube.triangles]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    soup, triangles = corners.reshape(-1, 3), np.arange(36).reshape(-1, 3)
    points = deform(soup, 1, amount=0.0)
    hard = wd.Mesh(soup, triangles, normals=flat.repeat(3, axis=0))
    faces = points.reshape(-1, 3, 3).astype(float)
    faces = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    normals = rows(staged(hard, points, device).geometry.normals, 36)[:, :3]
    assert np.abs(normals - faces.repeat(3, axis=0)).max() <= NORMAL_BOUND
    welded = rows(staged(wd.Mesh(soup, triangles, smooth=True), points, device).geometry.normals, 36)[:, :3]
    assert np.abs(welded - smooth_normals(points, triangles)).max() <= NORMAL_BOUND
    assert np.abs(welded - normals).max() > 0.3


def check_bounds(table, used, triangles, points):
    """Every drawable face in its cluster's sphere and cone."""
    p = points.astype(float)
    for cluster in table:
        own = used[cluster["first"] : cluster["first"] + cluster["count"]]
        own = own[own[:, 0] != own[:, 1]]
        corners = p[own[:, :3]]
        assert (np.linalg.norm(corners - cluster["center"], axis=-1) <= cluster["radius"] * (1.0 + 1e-6)).all()
        if cluster["cutoff"] <= 1.0:
            n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            n /= np.linalg.norm(n, axis=1, keepdims=True)
            assert (np.linalg.norm(np.cross(n, cluster["axis"]), axis=1) <= cluster["cutoff"]).all()
            assert (n @ cluster["axis"].astype(float) > 0.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_spheres_and_cones_hold_their_faces_and_are_those_of_the_host(seed, device):
    mesh = grid(24, 4.0)
    points = deform(mesh.positions, seed, amount=0.1)
    scene = staged(mesh, points, device)
    table = scene.geometry.clusters.numpy()
    used = rows(scene.geometry.cluster_triangles, len(mesh.triangles))
    check_bounds(table, used, mesh.triangles, points)
    # The host's numbers for the same clusters: each cut alone, so that it is one cluster.
    for cluster in table:
        own = used[cluster["first"] : cluster["first"] + cluster["count"], :3]
        cut = cut_clusters(points, own)
        assert len(cut.first) == 1
        assert np.abs(cluster["center"] - cut.center[0]).max() == 0.0
        for name in ("radius", "axis", "cutoff"):
            assert np.allclose(cluster[name], getattr(cut, name)[0], rtol=1e-6, atol=1e-7), name
    instance = scene.geometry.instances.numpy()[0]
    assert np.array_equal(instance["bounds_low"], points.min(axis=0))
    assert np.array_equal(instance["bounds_high"], points.max(axis=0))


def test_faces_that_cannot_be_drawn_are_collapsed_and_come_back(device):
    mesh = grid(12)
    good = deform(mesh.positions, 2)
    bad = good.copy()
    bad[[5, 20]], bad[40, 1], bad[77] = np.nan, np.inf, bad[78]
    corners = bad[mesh.triangles].astype(float)
    with np.errstate(invalid="ignore"):
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lost = ~np.isfinite(corners).all(axis=(1, 2)) | (np.abs(area).max(axis=1) == 0.0)
    assert lost.sum() > 10
    scene = staged(mesh, bad, device, steps=[good])
    used = rows(scene.geometry.cluster_triangles, len(mesh.triangles))
    assert np.array_equal(np.sort(used[:, 3]), np.arange(len(used)))
    collapsed = used[used[:, 0] == used[:, 1]]
    assert np.array_equal(np.sort(collapsed[:, 3]), np.flatnonzero(lost)) and np.all(collapsed[:, 0] == collapsed[:, 2])
    table = scene.geometry.clusters.numpy()
    assert np.isfinite(table["center"]).all() and np.isfinite(table["radius"]).all()
    check_bounds(table, used, mesh.triangles, bad)
    kept = np.unique(mesh.triangles[~lost])
    assert np.array_equal(scene.geometry.instances.numpy()[0]["bounds_low"], bad[kept].min(axis=0))
    used = rows(staged(mesh, good, device, steps=[bad]).geometry.cluster_triangles, len(mesh.triangles))
    assert np.array_equal(mesh.triangles[used[:, 3]], used[:, :3])


def test_a_mesh_without_a_face_to_draw_has_finite_bounds(device):
    mesh = grid(12)
    scene = staged(mesh, np.full_like(mesh.positions, np.nan), device)
    table, instance = scene.geometry.clusters.numpy(), scene.geometry.instances.numpy()[0]
    assert np.isfinite(table["center"]).all() and np.all(table["radius"] == 0.0)
    assert not instance["bounds_low"].any() and not instance["bounds_high"].any() and instance["anchor_grid"] > 0.0


@wp.kernel(module="unique", module_options=structs.MODULE_OPTIONS)
def grid_kernel(extents: wp.array[wp.float64], out_grid: wp.array[wp.float32]):
    i = wp.tid()
    out_grid[i] = kernels.anchor_grid(extents[i])


def test_anchor_grids_are_those_of_the_host(device, rng):
    extents = np.concatenate(
        [[0.0], 2.0 ** np.arange(-149, 129), rng.uniform(1, 2, 500) * 2.0 ** rng.integers(-149, 128, 500)]
    )
    got = wp.zeros(len(extents), dtype=wp.float32, device=device)
    wp.launch(grid_kernel, len(extents), [wp.array(extents, dtype=wp.float64, device=device)], [got], device=device)
    expected = [2.0 ** max(math.floor(math.log2(e)) - 6, -126) if e > 0.0 else 1.0 for e in extents]
    assert np.array_equal(got.numpy(), np.float32(expected))
