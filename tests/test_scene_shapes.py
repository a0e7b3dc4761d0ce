"""The shapes built-in scenes are made of: closed, outside out, with the normals of their formulas."""

import numpy as np
import pytest
from warp_deferred.scenes import shapes

CLOSED = {
    "box": (shapes.box(1.0, 2.0, 3.0, cells=3), 6.0),
    "bevelled_box": (shapes.bevelled_box(1.0, 2.0, 3.0, 0.1), 6.0),
    "sphere": (shapes.sphere(1.0, 64, 32), 4.0 / 3.0 * np.pi),
    "torus": (shapes.torus(1.0, 0.25, 96, 48), 2.0 * np.pi**2 * 0.0625),
    "cylinder": (shapes.lathe([(0, 0), (1, 0), (1, 2), (0, 2)], 96), 2.0 * np.pi),
    "column": (shapes.column(4.0, 0.3), 4.0 * np.pi * 0.09),
    "arch": (shapes.arch(2.0, 3.0, 1.5, 0.5), 0.5 * (4.5 - 0.5 * np.pi)),
    "arch of one span": (shapes.arch(2.0, 2.0, 1.5, 0.5), 0.5 * (3.0 - 0.5 * np.pi)),
}


def geometric_normals(shape):
    p, q, r = np.moveaxis(shape.positions[shape.triangles], 1, 0)
    normal = np.cross(q - p, r - p)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_shapes_are_closed_and_outside_out(name):
    shape, volume = CLOSED[name]
    _, welded = np.unique(np.round(shape.positions * 1e6).astype(np.int64), axis=0, return_inverse=True)
    t = welded.ravel()[shape.triangles].astype(np.int64)
    edges = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    forward, backward = edges @ [1 << 32, 1], edges @ [1, 1 << 32]
    assert len(np.unique(forward)) == len(forward)
    assert np.array_equal(np.sort(forward), np.sort(backward))
    assert shape.volume() == pytest.approx(volume, rel=0.25 if name == "column" else 0.03)


@pytest.mark.parametrize("name", CLOSED)
def test_normals_agree_with_winding(name):
    shape = CLOSED[name][0]
    facing = np.einsum("ij,ikj->ik", geometric_normals(shape), shape.normals[shape.triangles])
    assert facing.min() > 0.5
    assert np.allclose(np.linalg.norm(shape.normals, axis=1), 1.0)


def test_a_mirroring_matrix_keeps_shapes_outside_out():
    shape = CLOSED["column"][0]
    mirrored = shape.moved(np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert mirrored.volume() == pytest.approx(shape.volume())
    assert np.einsum("ij,ij->i", geometric_normals(mirrored), mirrored.normals[mirrored.triangles[:, 0]]).min() > 0.5


def test_a_torus_and_a_sphere_have_the_normals_of_the_formula():
    ring = shapes.torus(2.0, 0.5)
    flat = ring.positions * [1.0, 0.0, 1.0]
    centre = 2.0 * flat / np.linalg.norm(flat, axis=1, keepdims=True)
    assert np.allclose(ring.normals, (ring.positions - centre) / 0.5)
    ball = shapes.sphere(3.0)
    assert np.allclose(ball.normals * 3.0, ball.positions)


def test_a_grid_faces_up_with_the_slopes_handed_in():
    x, z = np.linspace(-1.0, 2.0, 7), np.linspace(0.0, 4.0, 9)
    xs, zs = np.meshgrid(x, z)
    shape = shapes.grid(x, z, 0.5 * xs - 0.25 * zs, np.full_like(xs, 0.5), np.full_like(xs, -0.25))
    expected = np.array([-0.5, 1.0, 0.25]) / np.linalg.norm([-0.5, 1.0, 0.25])
    assert np.allclose(geometric_normals(shape), expected) and np.allclose(shape.normals, expected)


def test_the_vault_and_the_apse_are_seen_from_inside():
    vault = shapes.coffered_vault(3.0, 10.0)
    middle = vault.positions[vault.triangles].mean(axis=1) * [1.0, 1.0, 0.0]
    assert np.einsum("ij,ij->i", geometric_normals(vault), middle).max() < 0.5
    reach = np.linalg.norm(vault.positions[:, :2], axis=1)
    assert reach.min() == pytest.approx(3.0) and reach.max() == pytest.approx(3.18)


def test_joining_mixes_coloured_and_plain_shapes():
    both = shapes.join(shapes.box(1, 1, 1), shapes.box(1, 1, 1).at(2, 0, 0).tinted((0.5, 0.25, 0.0)))
    assert len(both.triangles) == 24 and both.volume() == pytest.approx(2.0)
    assert np.array_equal(both.colors[0], [1, 1, 1]) and np.array_equal(both.colors[-1], [0.5, 0.25, 0.0])
    assert both.mesh("pair").colors.shape == (48, 4)
