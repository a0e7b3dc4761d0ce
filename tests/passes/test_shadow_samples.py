"""Shadows in frames of several samples: what moves within the shutter takes its shadow along, the rest is shared."""

import numpy as np
import pytest
from builders import images
from shadow_scenes import mixed_scene, render, with_rung

import warp_deferred as wd


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
