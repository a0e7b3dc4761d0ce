"""Drawing only what lies behind given keys: peeling layer after layer finds every triangle of every pixel, in order."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import warp as wp
from pixel_scenes import GEOMETRY, at_pixels, loose_mesh, pixel_camera, scene_of, settings_of, snapped

import warp_deferred as wd
from warp_deferred.passes import raster

WIDTH, HEIGHT = 70, 50


def expected_layers(triangles: np.ndarray, depth: np.ndarray) -> list[np.ndarray]:
    """Triangle ids of each layer, nearest first; of equally near ones the smaller id first."""
    order = np.lexsort((np.arange(len(depth)), depth))
    covers = np.stack([reference.coverage_count(snapped(t[None]), WIDTH, HEIGHT) > 0 for t in triangles])
    rank = np.cumsum(covers[order], axis=0)
    layers = []
    for k in range(1, int(rank.max()) + 2):
        layer = np.full((HEIGHT, WIDTH), -1)
        for place, triangle in enumerate(order):
            layer[covers[triangle] & (rank[place] == k)] = triangle
        layers.append(layer)
    return layers


@pytest.mark.parametrize("bins", ["off", "on"])
def test_layers_come_off_in_order(bins, device, rng, monkeypatch):
    makers = (
        (raster.kernels, "make_raster_kernel"),
        (raster.bin_kernels, "make_bin_kernel"),
        (raster.draw_kernels, "make_draw_bins_kernel"),
    )
    for module, name in makers:
        make = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *flags, make=make: make(*flags[:-1], True))
    limit = wp.zeros(WIDTH * HEIGHT, dtype=wp.uint64, device=device)
    prepare = raster.RasterPass.prepare

    def prepare_with_limit(stage, resources):
        prepare(stage, resources)
        for target in stage.targets:
            target.behind = limit

    monkeypatch.setattr(raster.RasterPass, "prepare", prepare_with_limit)

    center, size = rng.uniform(0.0, WIDTH, (30, 1, 2)), 2.0 ** rng.uniform(1.0, 8.0, (30, 1, 1))
    triangles = snapped(center + rng.normal(size=(30, 3, 2)) * size) / 256.0
    depth = rng.permutation(30) * 0.5 + 0.5
    # Ten stand there twice: of equally near ones the smaller id is in front, the other one right behind it.
    twice = rng.permutation(30)[:10]
    triangles, depth = np.concatenate([triangles, triangles[twice]]), np.concatenate([depth, depth[twice]])
    mesh = loose_mesh(at_pixels(triangles, WIDTH, HEIGHT, depth[:, None]))
    renderer = wd.Renderer(
        scene_of(mesh),
        width=WIDTH,
        height=HEIGHT,
        outputs=GEOMETRY,
        device=device,
        settings=settings_of(f"raster.bins={bins}"),
    )
    limit.fill_(2**64 - 1)
    expected = expected_layers(triangles, depth)
    assert len(expected) > 5
    for layer in expected:
        frame = renderer.render(pixel_camera(HEIGHT))
        ids, found = frame.numpy("triangle_id")[0], frame.numpy("depth")[0]
        assert np.array_equal(ids, layer)
        assert np.abs(found[ids >= 0] - depth[ids[ids >= 0]]).max(initial=0.0) <= 1e-5
        wp.copy(limit, renderer.plan.resources.channels["keys"])
    assert (expected[-1] == -1).all()
