"""The pixel police: what it names, what it lets pass, and that it is not there where it is not asked for."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from builders import assert_same, gallery, images

import warp_deferred as wd
from warp_deferred.errors import Error

ON, OFF = wd.Settings(check_finite=True), wd.Settings(check_finite=False)
SIZE = (33, 17)


@wp.kernel
def spoil_kernel(place: wp.int32, component: wp.int32, value: wp.float32, out_image: wp.array[wp.vec3]):
    color = out_image[place]
    color[component] = value
    out_image[place] = color


class Spoil(wd.Pass):
    """Writes one number into the image."""

    image = "rewrite"

    def __init__(self, view, x, y, value, component=0, name="spoil", after="shade", scope="sample"):
        self.place = (view * SIZE[1] + y) * SIZE[0] + x
        self.value, self.component, self.name, self.after, self.scope = value, component, name, after, scope

    def run(self, resources):
        image = resources.channels[self.target]
        resources.program.launch(spoil_kernel, 1, [self.place, self.component, self.value], [image], block_dim=64)


def renderer_of(device, *passes, settings=ON, outputs=("color", "depth", "display"), **fields):
    scene = gallery()
    return wd.Renderer(
        scene, width=SIZE[0], height=SIZE[1], device=device, outputs=outputs, settings=settings, passes=passes, **fields
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pass_output_view_pixel_and_value_are_named(value, device):
    renderer = renderer_of(device, Spoil(1, 30, 16, value, 2))
    words = rf"spoil\.color: expected finite numbers, got {value} in component 2 of view 1, pixel \(30, 16\);"
    with pytest.raises(Error, match=words):
        renderer.render([renderer.scene.camera] * 2)


def test_the_first_pass_and_its_first_pixel_are_named(device):
    passes = [
        Spoil(0, 5, 9, np.inf, name="second"),
        Spoil(0, 6, 8, np.inf, name="first"),
        Spoil(0, 7, 2, np.nan, name="late", after="second"),
    ]
    passes[0].after = "first"
    renderer = renderer_of(device, passes[1], passes[0], passes[2])
    with pytest.raises(Error, match=r"first\.color.* got inf in component 0 of view 0, pixel \(6, 8\)"):
        renderer.render()


def test_the_value_is_that_of_the_sample_that_wrote_it(device):
    # Four samples, each of which writes the image anew before the pass spoils it.
    settings = ON.with_values(["anti_aliasing.rung=samples_4"])
    renderer = renderer_of(device, Spoil(0, 3, 4, -np.inf, 1), settings=settings)
    with pytest.raises(
        Error, match=r"spoil\.color: expected finite numbers, got -inf in component 1 of view 0, pixel \(3, 4\)"
    ):
        renderer.render()


def test_huge_numbers_and_background_depth_are_finite_enough(device):
    renderer = renderer_of(device, Spoil(0, 0, 0, 3e38))
    frame = renderer.render()
    assert np.isposinf(frame.numpy("depth")).any() and frame.numpy("color")[0, 0, 0, 0] == np.float32(3e38)


def test_minus_infinity_and_nan_are_no_depth(device):
    renderer = renderer_of(device, share_memory=False)
    renderer.render()
    check, depth = renderer.plan.finite_check, renderer.plan.resources.channels["depth"]
    program = renderer.plan.resources.program
    section = next(s for s in program.sections if s.name == "resolve")
    count = sum(name == "resolve" for name, _ in check.checked)
    for bad in (np.nan, -np.inf):
        values = depth.numpy().copy()
        values[40] = bad
        depth.assign(values)
        check.begin()
        for step in section.steps[-2 * count :]:
            for command in step:
                command()
        with pytest.raises(Error, match=rf"resolve\.depth.* got {bad} in component 0 of view 0, pixel \(7, 1\)"):
            check.end()


def test_half_images_are_looked_at(device):
    renderer = renderer_of(device, outputs=("display",), share_memory=False)
    renderer.render()
    check, channels = renderer.plan.finite_check, renderer.plan.resources.channels
    assert ("shade", "radiance") in check.checked and not any(name == "keys" for _, name in check.checked)
    halves = channels["radiance"].numpy().view(np.float16).reshape(-1, 4).copy()
    halves[SIZE[0] + 2, 1] = np.nan
    channels["radiance"].assign(halves.view(np.uint64).reshape(-1))
    check.begin()
    section = next(s for s in renderer.plan.resources.program.sections if s.name == "shade")
    for step in section.steps[-2:]:
        for command in step:
            command()
    with pytest.raises(Error, match=r"shade\.radiance: .* got nan in component 1 of view 0, pixel \(2, 1\)"):
        check.end()


def test_a_frame_that_failed_leaves_the_renderer_usable(device):
    stage = Spoil(0, 4, 4, np.nan)
    renderer = renderer_of(device, stage)
    before = renderer_of(device).render()
    expected = images(before)
    with pytest.raises(Error, match=r"spoil\.color"):
        renderer.render()
    assert_same(expected, images(renderer_of(device).render()))
    # The same renderer, whose scene now asks for no look.
    renderer._settings = OFF
    assert np.isnan(renderer.render().numpy("color")[0, 4, 4, 0])


def test_looking_changes_no_bit(device):
    names = ("color", "depth", "normal", "display")
    lens = gallery().camera.replace(aperture=0.1, focus_distance=4.0, bloom=0.3)
    for share in (True, False):
        frames = [
            images(renderer_of(device, settings=settings, outputs=names, share_memory=share).render(lens))
            for settings in (ON, OFF)
        ]
        assert_same(*frames)


def test_whole_buffers_are_all_looked_at(device):
    renderer = renderer_of(device, share_memory=False)
    renderer.render(gallery().camera.replace(aperture=0.1, focus_distance=4.0, bloom=0.3))
    names = {name for _, name in renderer.plan.finite_check.checked}
    assert {"depth", "emission", "ambient_visibility", "mask_bounds", "lens_taps", "bloom", "color"} <= names
    shared = renderer_of(device)
    shared.render()
    assert "emission" not in {name for _, name in shared.plan.finite_check.checked}


OFF_CODE = """
import json, sys
sys.path[:0] = [{tests!r}]
import warp as wp
import warp_deferred as wd
from builders import gallery
wp.config.log_level = wp.LOG_WARNING
renderer = wd.Renderer(gallery(), width=33, height=17, device="cpu", outputs=("color", "depth"))
renderer.render()
program = renderer.plan.resources.program
print(json.dumps([
    [name for name in sys.modules if "finite_check" in name],
    sorted({{kernel.func.__module__ for kernel, _ in program.kernels}}),
    renderer.plan.finite_check is None,
]))
"""


def test_off_it_is_not_even_imported(request):
    code = OFF_CODE.format(tests=str(request.path.parent))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    modules, kernels, none = json.loads(done.stdout.splitlines()[-1])
    assert modules == [] and none and not any("finite_check" in name for name in kernels)


def test_it_is_no_stage_of_settings():
    with pytest.raises(wd.InputError, match=r"Settings: expected one of 'raster', .*got 'check_finite'"):
        OFF.with_values(["check_finite.rung=on"])
    with pytest.raises(wd.InputError, match=r"Settings\.check_finite"):
        wd.Settings(check_finite="perhaps")
