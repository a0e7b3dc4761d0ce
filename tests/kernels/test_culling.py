"""Culling functions against sampled float64 geometry: in vain is allowed, missing is not."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import warp as wp
from warp_deferred.kernels.clusters import classify_sphere, faces_away
from warp_deferred.kernels.light_culling import light_reaches, tile_volume
from warp_deferred.kernels.structs import Cluster, Lights, Pair, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

WIDTH, HEIGHT, NEAR = 640, 360, 0.05
COUNT = 100_000


@wp.kernel
def light_kernel(
    views: wp.array[View],
    tiles: wp.array[wp.vec4i],
    bounds: wp.array[wp.vec2],
    lights: Lights,
    out_kept: wp.array[wp.int32],
):
    i = wp.tid()
    view = views[i % views.shape[0]]
    t = tiles[i]
    volume = tile_volume(view, t[0], t[1], t[2], t[3], bounds[i])
    if light_reaches(view, volume, lights, 0, i):
        out_kept[i] = 1


@wp.kernel
def sphere_kernel(views: wp.array[View], spheres: wp.array[wp.vec4], out_kind: wp.array[wp.int32]):
    i = wp.tid()
    s = spheres[i]
    out_kind[i] = classify_sphere(views[i % views.shape[0]], wp.vec3(s[0], s[1], s[2]), s[3])


@wp.kernel
def cone_kernel(
    views: wp.array[View], pairs: wp.array[Pair], clusters: wp.array[Cluster], out_away: wp.array[wp.int32]
):
    i = wp.tid()
    if faces_away(pairs[i], views[i % views.shape[0]], clusters[i], False):
        out_away[i] = 1


def make_views(orthographic: bool) -> np.ndarray:
    """Four views: level, turned, off-centre and with a narrow lens."""
    rng = np.random.default_rng(3)
    rows = np.zeros(4, dtype=View.numpy_dtype())
    rows["width"], rows["height"], rows["near"], rows["far"] = WIDTH, HEIGHT, NEAR, 50.0
    rows["projection"] = int(orthographic)
    focal = np.array([[300.0, 300.0], [500.0, 480.0], [250.0, 400.0], [4000.0, 4000.0]])
    if orthographic:
        focal /= 20.0
    rows["scale"] = focal * [1.0, -1.0]
    rows["center"] = [[320.0, 180.0], [320.5, 181.0], [-100.0, 500.0], [320.0, 180.0]]
    turned = np.linalg.qr(rng.normal(size=(3, 3, 3)))[0]
    rows["rotation"][0] = np.eye(3)
    rows["rotation"][1:] = turned * np.sign(np.linalg.det(turned))[:, None, None]
    rows["cull_mode"] = 1
    return rows


def inside_points(rows: np.ndarray, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """World-oriented points relative to the eye, in float64, at image places and view depths."""
    scale, center = rows["scale"].astype(float), rows["center"].astype(float)
    px, py = (x - center[:, 0]) / scale[:, 0], (y - center[:, 1]) / scale[:, 1]
    lift = np.where(rows["projection"] == 1, 1.0, depth)
    local = np.stack([px * lift, py * lift, -depth], axis=1)
    return np.einsum("nji,nj->ni", rows["rotation"].astype(float), local)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("spot", [False, True])
def test_c2_a_light_that_reaches_a_surface_is_never_missed(orthographic, spot, device, rng):
    views = make_views(orthographic)
    rows = views[np.arange(COUNT) % 4]
    side = 2 ** rng.integers(3, 8, COUNT)
    x0, y0 = rng.integers(0, WIDTH, COUNT) // side * side, rng.integers(0, HEIGHT, COUNT) // side * side
    x1, y1 = np.minimum(x0 + side, WIDTH), np.minimum(y0 + side, HEIGHT)
    near = 2.0 ** rng.uniform(-4.0, 5.0, COUNT)
    far = near * 2.0 ** rng.choice([0.0, 0.01, 1.0, 10.0], COUNT)
    bounds = np.stack([near, far], axis=1).astype(np.float32)
    # A surface point at a pixel centre, between the bounds: half of them at the very ends.
    share = np.round(rng.random(COUNT) * 3.0) / 3.0
    depth = np.clip(near + (far - near) * share, bounds[:, 0], bounds[:, 1])
    x, y = rng.integers(x0, x1) + 0.5, rng.integers(y0, y1) + 0.5
    point = inside_points(rows, x, y, depth)
    # A light somewhere else whose range, and whose cone, just holds the point.
    reach = 2.0 ** rng.uniform(-6.0, 8.0, COUNT)
    towards = reference.unit(rng.normal(size=(COUNT, 3)))
    distance = reach * rng.choice([0.5, 0.9999, 0.999999], COUNT)
    place = point - towards * distance[:, None]
    outer = rng.uniform(0.02, 1.55, COUNT)
    lean = outer * rng.choice([0.1, 0.99, 0.9999], COUNT)
    across = reference.unit(np.cross(towards, rng.normal(size=(COUNT, 3))))
    axis = np.cos(lean)[:, None] * towards + np.sin(lean)[:, None] * across

    lights = Lights()
    tables = {
        "position": np.concatenate([place, reach[:, None]], axis=1),
        "color": np.stack([*[np.ones(COUNT)] * 3, np.cos(outer)], axis=1),
        "axis": np.concatenate([axis, np.zeros((COUNT, 1))], axis=1),
        "shape": np.stack([*[np.zeros(COUNT)] * 3, np.full(COUNT, int(spot))], axis=1),
        "polynomial": np.zeros((COUNT, 4)),
    }
    for name, values in tables.items():
        setattr(lights, name, wp.array(values.astype(np.float32), dtype=wp.vec4, device=device))
    lights.capacity = COUNT
    tiles = wp.array(np.stack([x0, y0, x1, y1], axis=1).astype(np.int32), dtype=wp.vec4i, device=device)
    kept = wp.zeros(COUNT, dtype=wp.int32, device=device)
    inputs = [wp.array(views, dtype=View, device=device), tiles, wp.array(bounds, dtype=wp.vec2, device=device), lights]
    wp.launch(light_kernel, COUNT, inputs, [kept], device=device)
    missed = np.flatnonzero(kept.numpy() == 0)
    assert not len(missed), f"{len(missed)} of {COUNT} missed, first: {missed[:5]}"


@pytest.mark.parametrize("orthographic", [False, True])
def test_far_lights_are_culled(orthographic, device, rng):
    # The other side of the promise: culling that keeps everything would never miss either.
    views = make_views(orthographic)
    count = 4000
    rows = views[np.arange(count) % 4]
    place = inside_points(rows, np.full(count, 8.0), np.full(count, 8.0), np.full(count, 10.0))
    sideways = np.einsum("nji,nj->ni", rows["rotation"].astype(float), np.tile([[-40.0, 0.0, 0.0]], (count, 1)))
    lights = Lights()
    for name in ("color", "axis", "shape", "polynomial"):
        setattr(lights, name, wp.zeros(count, dtype=wp.vec4, device=device))
    table = np.concatenate([place + sideways, np.full((count, 1), 5.0)], axis=1).astype(np.float32)
    lights.position, lights.capacity = wp.array(table, dtype=wp.vec4, device=device), count
    tiles = wp.array(np.tile([0, 0, 16, 16], (count, 1)).astype(np.int32), dtype=wp.vec4i, device=device)
    bounds = wp.array(np.tile([9.0, 11.0], (count, 1)).astype(np.float32), dtype=wp.vec2, device=device)
    kept = wp.zeros(count, dtype=wp.int32, device=device)
    wp.launch(
        light_kernel, count, [wp.array(views, dtype=View, device=device), tiles, bounds, lights], [kept], device=device
    )
    assert not kept.numpy().any()


@pytest.mark.parametrize("orthographic", [False, True])
def test_spheres_in_view_are_never_dropped(orthographic, device, rng):
    views = make_views(orthographic)
    rows = views[np.arange(COUNT) % 4]
    depth = NEAR + 2.0 ** rng.uniform(-10.0, 5.6, COUNT) - 2.0**-10
    x, y = rng.uniform(0.0, WIDTH, COUNT), rng.uniform(0.0, HEIGHT, COUNT)
    x[::5], y[::7] = 0.0, HEIGHT
    scale, center = np.abs(rows["scale"].astype(float)), rows["center"].astype(float)
    lift = np.where(rows["projection"] == 1, 1.0, depth)[:, None]
    # A point on the sphere is seen; spheres are given in metres, with x and y scaled to pixels as `to_view` gives them.
    metres = np.concatenate([(np.stack([x, y], axis=1) - center) * lift / scale, depth[:, None]], axis=1)
    radius = 2.0 ** rng.uniform(-8.0, 8.0, COUNT)
    middle = metres + reference.unit(rng.normal(size=(COUNT, 3))) * radius[:, None] * rng.choice(
        [0.5, 0.9999], (COUNT, 1)
    )
    scaled = np.concatenate([middle[:, :2] * scale, middle[:, 2:]], axis=1)
    # The caller inflates by the rounding bound; so do we.
    grown = radius * 1.0001 + 4e-6 * np.abs(middle).sum(axis=1)
    spheres = np.concatenate([scaled, grown[:, None]], axis=1).astype(np.float32)
    kind = wp.zeros(COUNT, dtype=wp.int32, device=device)
    inputs = [wp.array(views, dtype=View, device=device), wp.array(spheres, dtype=wp.vec4, device=device)]
    wp.launch(sphere_kernel, COUNT, inputs, [kind], device=device)
    kind = kind.numpy()
    assert not (kind == 0).any()
    if not orthographic:
        # A plain sphere needs no near clip: all of it is in front of the near plane.
        assert (middle[:, 2] - radius >= NEAR)[kind == 1].all() and (kind == 1).sum() > 1000


def test_spheres_that_are_not_numbers_go_the_careful_way(device):
    spheres = np.array([[np.nan, 0, 1, 1], [0, np.inf, 1, 1], [0, 0, 1, np.nan], [0, 0, -np.inf, 1]], np.float32)
    kind = wp.zeros(4, dtype=wp.int32, device=device)
    views = wp.array(make_views(False), dtype=View, device=device)
    wp.launch(sphere_kernel, 4, [views, wp.array(spheres, dtype=wp.vec4, device=device)], [kind], device=device)
    assert kind.numpy().tolist() == [2, 2, 2, 2]


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("cull", [1, 2])
def test_clusters_with_a_visible_face_are_kept(orthographic, cull, device, rng):
    views = make_views(orthographic)
    views["cull_mode"] = cull
    clusters, pairs = np.zeros(COUNT, dtype=Cluster.numpy_dtype()), np.zeros(COUNT, dtype=Pair.numpy_dtype())
    axis = reference.unit(rng.normal(size=(COUNT, 3)))
    half_angle = rng.uniform(0.0, 1.4, COUNT)
    center = rng.normal(size=(COUNT, 3)) * 5.0
    radius = 2.0 ** rng.uniform(-8.0, 2.0, COUNT)
    eye = rng.normal(size=(COUNT, 3)) * 8.0
    # One face of the cluster: a point in the sphere, a normal in the cone.
    point = center + reference.unit(rng.normal(size=(COUNT, 3))) * (radius * rng.random(COUNT) ** (1 / 3))[:, None]
    lean = half_angle * np.sqrt(rng.random(COUNT))
    across = reference.unit(np.cross(axis, rng.normal(size=(COUNT, 3))))
    normal = np.cos(lean)[:, None] * axis + np.sin(lean)[:, None] * across
    towards = eye if orthographic else eye - point
    facing = (normal * towards).sum(axis=1)
    seen = facing > 0.0 if cull == 1 else facing < 0.0

    clusters["center"], clusters["radius"], clusters["axis"] = center, radius * (1.0 + 1e-6), axis
    clusters["cutoff"] = np.where(np.cos(half_angle) > 0.1, np.sin(half_angle) + 1e-4, 2.0)
    pairs["camera"] = eye
    out = wp.zeros(COUNT, dtype=wp.int32, device=device)
    inputs = [
        wp.array(rows, dtype=kind, device=device) for rows, kind in ((views, View), (pairs, Pair), (clusters, Cluster))
    ]
    wp.launch(cone_kernel, COUNT, inputs, [out], device=device)
    away = out.numpy() != 0
    assert not (away & seen).any()
    assert away.mean() > 0.05
