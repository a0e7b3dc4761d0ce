"""Clusters: every drawable triangle once, inside its sphere and its cone; normals made where a file has none."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import reference

from warp_deferred.clustering import CLUSTER_SIZE, Clusters, cut_clusters
from warp_deferred.normals import smooth_normals


def face_normals(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners = np.nan_to_num(positions[triangles].astype(float), posinf=0.0)
    return reference.unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def soup(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Small triangles strewn through a box."""
    centers = rng.uniform(-10.0, 10.0, (count, 1, 3))
    points = centers + rng.normal(size=(count, 3, 3)) * 0.3
    return points.reshape(-1, 3).astype(np.float32), np.arange(3 * count).reshape(-1, 3).astype(np.int32)


def ball(rings: int, sectors: int, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    mesh = reference.sphere(1.0, rings, sectors)
    return (mesh.positions + offset).astype(np.float32), mesh.triangles.astype(np.int32)


def check(positions: np.ndarray, triangles: np.ndarray, clusters: Clusters) -> None:
    """Check what culling relies on."""
    assert np.array_equal(clusters.first, np.cumsum(clusters.count) - clusters.count)
    assert clusters.count.sum() == len(clusters.triangles)
    assert (clusters.count >= 1).all() and (clusters.count <= CLUSTER_SIZE).all()
    assert np.array_equal(triangles[clusters.triangles[:, 3]], clusters.triangles[:, :3])
    normals = face_normals(positions, triangles)
    for k, (first, count) in enumerate(zip(clusters.first, clusters.count, strict=True)):
        rows = clusters.triangles[first : first + count]
        points = positions[rows[:, :3]].astype(float)
        assert (np.linalg.norm(points - clusters.center[k], axis=-1) <= clusters.radius[k]).all()
        if clusters.cutoff[k] <= 1.0:
            # A normal leans from the axis by at most the angle whose sine is the cutoff.
            axis = clusters.axis[k].astype(float)
            assert (np.linalg.norm(np.cross(normals[rows[:, 3]], axis), axis=1) <= clusters.cutoff[k]).all()
            assert (normals[rows[:, 3]] @ axis > 0.0).all()


@pytest.mark.parametrize("make", [lambda rng: soup(rng, 1000), lambda rng: ball(40, 64), lambda rng: ball(8, 12, 1e4)])
def test_each_triangle_is_in_one_cluster(make, rng):
    positions, triangles = make(rng)
    normals = face_normals(positions, triangles)
    drawable = np.flatnonzero((normals != 0.0).any(axis=1))
    clusters = cut_clusters(positions, triangles)
    assert np.array_equal(np.sort(clusters.triangles[:, 3]), drawable)
    assert len(clusters.first) == -(-len(drawable) // CLUSTER_SIZE)
    check(positions, triangles, clusters)


def test_neighbours_share_a_cluster(rng):
    positions, triangles = ball(64, 96)
    order = rng.permutation(len(triangles))
    clusters = cut_clusters(positions, triangles[order])
    # Whatever order a file has, clusters stay small against the mesh, so that most have a cone.
    assert np.median(clusters.radius) < 0.5 and (clusters.cutoff <= 1.0).mean() > 0.8
    check(positions, triangles[order], clusters)


def test_l7_faces_without_area_are_left_out(rng):
    positions, triangles = soup(rng, 300)
    bad = np.array([[0, 0, 1], [5, 7, 7], [2, 2, 2]], np.int32)
    line = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2]], np.float32)
    points = np.concatenate([positions, line, [[np.nan, 0, 0], [np.inf, 1, 1]]]).astype(np.float32)
    n = len(positions)
    extra = np.array([[n, n + 1, n + 2], [0, 1, n + 3], [n + 4, 1, 2]], np.int32)
    mixed = np.concatenate([bad[:2], triangles, bad[2:], extra])
    clusters = cut_clusters(points, mixed)
    assert np.array_equal(np.sort(clusters.triangles[:, 3]), np.arange(2, 302))
    check(points, mixed, clusters)


@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 257])
def test_counts_round_the_size(count, rng):
    positions, triangles = soup(rng, count)
    clusters = cut_clusters(positions, triangles)
    assert len(clusters.triangles) == count and len(clusters.first) == -(-count // 128)
    check(positions, triangles, clusters)


def test_l18_extreme_scales_keep_their_triangles(rng):
    positions, triangles = soup(rng, 200)
    for exponent in (-60, -30, 30, 60):
        scaled = positions * np.float32(2.0) ** exponent
        clusters = cut_clusters(scaled, triangles)
        assert len(clusters.triangles) == 200
        check(scaled, triangles, clusters)


def test_flat_patch_has_a_narrow_cone():
    x, z = np.meshgrid(np.arange(9.0), np.arange(9.0))
    positions = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3).astype(np.float32)
    faces = [[a, a + 9, a + 1] for a in (9 * r + c for r, c in itertools.product(range(8), range(8)))]
    clusters = cut_clusters(positions, np.array(faces, np.int32))
    assert len(clusters.first) == 1 and clusters.cutoff[0] < 1e-3
    assert np.allclose(clusters.axis[0], [0.0, 1.0, 0.0])


def test_smooth_normals_equal_their_twin(rng):
    positions, triangles = ball(6, 9)
    positions = (positions * [1.0, 2.0, 0.5] + rng.normal(size=positions.shape) * 0.05).astype(np.float32)
    exact = reference.angle_weighted_normals(positions, triangles)
    assert np.abs(smooth_normals(positions, triangles) - exact).max() < 1e-6


def test_smooth_normals_do_not_show_a_seam():
    positions, triangles = ball(6, 9)
    loose, faces = positions[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3)
    assert (
        np.abs(smooth_normals(loose, faces) - smooth_normals(positions, triangles)[triangles.reshape(-1)]).max() < 1e-6
    )


def test_l6_smooth_normals_of_degenerate_faces_are_zero():
    positions = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]], np.float32)
    assert not smooth_normals(positions, np.array([[0, 1, 2], [0, 0, 3]], np.int32)).any()
