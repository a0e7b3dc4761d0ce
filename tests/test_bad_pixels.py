"""One number that is none, in one place, shows there alone: an HDR pixel, a vertex, a light, an instance."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from builders import assert_same, box, gallery, images, room, tilt
from test_finite_check import Spoil

import warp_deferred as wd

SIZE = (33, 17)
OFF = ["bloom.rung=off", "depth_of_field.rung=off", "motion_blur.rung=off"]
#: Effects that work on the image, by the settings that turn all others off.
EFFECTS = {
    "nothing": OFF,
    "bloom neighbourhood": [*OFF[1:], "bloom.rung=neighbourhood"],
    "bloom mip_chain": [*OFF[1:], "bloom.rung=mip_chain"],
    "bloom exact": [*OFF[1:], "bloom.rung=exact"],
    "depth of field plane_lerp": [OFF[0], OFF[2], "depth_of_field.rung=plane_lerp"],
    "depth of field gather": [OFF[0], OFF[2], "depth_of_field.rung=gather"],
    "motion blur": [*OFF[:2], "motion_blur.rung=velocity_gather"],
    "blur": [*OFF, "blur.rung=gaussian", "blur.sigma_px=1"],
    "fxaa": [*OFF, "anti_aliasing.rung=fxaa"],
    "samples": [*OFF, "anti_aliasing.rung=samples_4"],
}


@wp.kernel
def fill_kernel(place: wp.int32, value: wp.float32, out_image: wp.array[wp.vec3]):
    out_image[place] = wp.vec3(value, value, value)


class Fill(Spoil):
    """Writes one pixel of the image."""

    def run(self, resources):
        image = resources.channels[self.target]
        resources.program.launch(fill_kernel, 1, [self.place, self.value], [image], block_dim=64)


def picture(name, value, device):
    """The second of two frames between which the camera moves, one pixel of whose light is set to a value."""
    scene = gallery()
    lens = {"bloom": 0.5, "aperture": 0.2, "focus_distance": 3.0, "shutter": 0.5}
    scene.camera = scene.camera.replace(**lens)
    settings = wd.Settings().with_values(EFFECTS[name])
    renderer = wd.Renderer(
        scene, width=SIZE[0], height=SIZE[1], device=device, outputs=("color", "display"), settings=settings,
        passes=[Fill(0, 14, 9, value)],
    )  # fmt: skip
    renderer.render()
    x, y, z = scene.camera.position
    return images(renderer.render(scene.camera.replace(position=(x + 0.1, y, z))))


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("value", [np.nan, -np.inf, -1.0])
def test_m1_a_pixel_that_is_no_light_is_black_to_every_effect(name, value, device, unchecked):
    black, bad = picture(name, 0.0, device), picture(name, value, device)
    # The pixel itself is what the user's pass wrote, unless an effect turned the image after it.
    shown = bad["color"][9, 14].copy()
    black["color"][9, 14] = bad["color"][9, 14] = 0.0
    if name == "depth of field plane_lerp":
        # Mixed with what is blurred it is black as a whole, where black would take a share of that.
        assert not shown.any()
        black["display"][9, 14] = bad["display"][9, 14] = 0
    assert_same(black, bad)
    assert np.isfinite(bad["color"]).all()


def test_an_instance_that_is_nowhere_changes_only_where_it_was(device):
    scene, without = room(), room()
    extra = scene.add(box(0.7), transform=tilt(0.0, 20.0, 1.0, (0.3, 1.0, 1.0)))
    fields = {"width": 48, "height": 36, "device": device, "outputs": ("color", "depth", "instance_id")}
    expected = images(wd.Renderer(without, **fields).render())
    count = len(scene.instances)
    for bad in (np.nan, np.inf, -np.inf):
        for place in ((0, 3), (1, 1)):
            matrices = np.stack([item.transform for item in scene.instances]).astype(np.float32)
            plain = np.stack([item.transform for item in without.instances]).astype(np.float32)
            matrices[count - 1][place] = bad
            scene.bind_transforms(wp.array(matrices, dtype=wp.float32, device=device))
            without.bind_transforms(wp.array(plain, dtype=wp.float32, device=device))
            expected = images(wd.Renderer(without, **fields).render())
            assert_same(expected, images(wd.Renderer(scene, **fields).render()))
    assert extra is scene.instances[-1]
