"""The blur: against SciPy-free float64 twins, uniform images, edges of views, numbers that are none, and neutrality."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from builders import assert_same, gallery, images, spied

import warp_deferred as wd
from warp_deferred.passes.blur import GaussianBlur, gaussian_weights

SIZE = {"width": 61, "height": 43}


def settings(*values):
    return wd.Settings().with_values([f"blur.{value}" for value in values])


def renderer_of(device, *values, outputs=("color",), scene=None, **fields):
    return wd.Renderer(
        scene or gallery(), device=device, outputs=outputs, settings=settings(*values), **(SIZE | fields)
    )


def twin(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur (height, width, n) in float64; what lies beyond the edge is the edge."""
    radius = int(np.ceil(3.0 * sigma))
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        pad = [(radius, radius) if k == axis else (0, 0) for k in range(image.ndim)]
        padded = np.pad(image.astype(float), pad, mode="edge")
        count = image.shape[axis]
        image = sum(w * padded.take(range(k, k + count), axis=axis) for k, w in enumerate(weights))
    return image


@pytest.mark.parametrize("sigma", [1e-3, 0.3, 1.0, 2.5, 64.0])
def test_weights_sum_to_one(sigma):
    weights = gaussian_weights(sigma).astype(float)
    assert abs(weights[0] + 2 * weights[1:].sum() - 1) < 1e-6 and (np.diff(weights) <= 0).all()
    assert np.array_equal(gaussian_weights(0.0), [1.0])


@pytest.mark.parametrize("sigma", [0.4, 1.7, 9.0])
def test_the_image_is_the_twins(sigma, device):
    sharp = renderer_of(device).render().numpy("color")[0]
    blurred = renderer_of(device, "rung=gaussian", f"sigma_px={sigma}").render().numpy("color")[0]
    expected = twin(sharp, sigma)
    assert np.abs(blurred - expected).max() < 1e-5 * max(1.0, sharp.max())
    assert np.abs(blurred - sharp).max() > 0.05


def test_half_images_are_blurred_alike(device):
    full, half = (
        wd.Renderer(
            gallery(),
            device=device,
            settings=wd.Settings().with_values(["blur.rung=gaussian", f"shade.radiance={radiance}"]),
            **SIZE,
        )
        for radiance in ("float32", "half")
    )
    one, two = (r.render().numpy("display").astype(int) for r in (full, half))
    assert np.abs(one - two).max() <= 1 and "radiance" in half.plan.memory and "radiance" not in full.plan.memory


def test_each_view_ends_at_its_own_edge(device):
    scene = gallery()
    cameras = [scene.camera, scene.camera.replace(position=(0.3, 1.2, 3.0)), scene.camera]
    renderer = renderer_of(device, "rung=gaussian", "sigma_px=5", scene=scene)
    together = renderer.render(cameras).numpy("color")
    for camera, image in zip(cameras, together, strict=True):
        assert np.array_equal(renderer.render(camera).numpy("color")[0], image)


@pytest.mark.parametrize("value", [0.1, 1.0 / 3.0, 12345.678])
def test_a_uniform_image_stays_to_the_bit(value, device):
    scene = wd.Scene()
    scene.environment = wd.Environment(background=(value, value / 3.0, value / 7.0))
    scene.camera = wd.Camera()
    for sigma in (0.3, 2.0, 17.0):
        one = renderer_of(device, scene=scene).render().numpy("color")
        two = renderer_of(device, "rung=gaussian", f"sigma_px={sigma}", scene=scene).render().numpy("color")
        assert one.min() > 0 and np.array_equal(one, two)


@pytest.mark.parametrize("outputs", [("color", "display"), ("display",)])
def test_no_width_is_neutral_to_the_bit(outputs, device):
    plain = renderer_of(device, outputs=outputs)
    for values, runs in (
        (("rung=gaussian", "sigma_px=0"), False),
        (("rung=off", "sigma_px=3", "when=always"), False),
        (("rung=gaussian", "sigma_px=0", "when=always"), True),
    ):
        renderer = renderer_of(device, *values, outputs=outputs)
        assert_same(images(plain.render()), images(renderer.render()))
        assert ("blur" in [p.name for p in renderer.plan.passes]) == runs
        assert "blur_rows" not in renderer.plan.memory


def test_a_second_frame_makes_nothing_new(device):
    renderer = renderer_of(device, "rung=gaussian", outputs=("color", "display"))
    first = images(renderer.render())
    second = images(spied(renderer))
    assert_same(first, second)
    assert "gaussian, 2 px" in str(renderer.explain(measure=False))


def test_samples_are_blurred_once(device):
    both = ["blur.rung=gaussian", "anti_aliasing.rung=samples_4"]
    renderer = wd.Renderer(
        gallery(), device=device, outputs=("color",), settings=wd.Settings().with_values(both), **SIZE
    )
    result = renderer.render().numpy("color")[0]
    sampled = wd.Settings().with_values(both[1:])
    mean = wd.Renderer(gallery(), device=device, outputs=("color",), settings=sampled, **SIZE).render()
    assert np.abs(result - twin(mean.numpy("color")[0], 2.0)).max() < 1e-4
    assert {s.name: s.part for s in renderer.plan.resources.program.sections}["blur"] == 2


class BlurredDepth(wd.Pass):
    """A user's pass that blurs channels of its own."""

    name = "blurred_depth"
    after = "resolve"

    def reads(self):
        return ("depth", "normal")

    def writes(self):
        n = self.layout.pixels
        result = {f"depth_{k}": wd.Buffer(wp.float32, n, lasting=True) for k in ("rows", "soft")}
        return result | {f"normal_{k}": wd.Buffer(wp.vec3, n, lasting=True) for k in ("rows", "soft")}

    def prepare(self, resources):
        self.scalar = GaussianBlur(resources, "float32", 1.5)
        self.vector = GaussianBlur(resources, "vec3", 1.5)

    def run(self, resources):
        c = resources.channels
        self.scalar.add(resources, c["depth"], c["depth_rows"], c["depth_soft"])
        self.vector.add(resources, c["normal"], c["normal_rows"], c["normal_soft"])


def test_channels_are_blurred_for_other_passes(device, unchecked):
    renderer = renderer_of(device, outputs=("depth", "normal"), passes=[BlurredDepth])
    data = images(renderer.render())
    channels = renderer.plan.resources.channels
    soft = channels["normal_soft"].numpy().reshape(*data["normal"].shape)
    assert np.abs(soft - twin(data["normal"], 1.5)).max() < 1e-5 and soft.min() < -0.1
    depth, blurred = data["depth"], channels["depth_soft"].numpy().reshape(data["depth"].shape)
    # The background neither spreads nor is lost.
    assert np.array_equal(np.isinf(depth), np.isinf(blurred)) and not np.isnan(blurred).any()
    seen = np.isfinite(depth)
    assert seen.any() and (~seen).any()
    assert blurred[seen].min() >= depth[seen].min() - 1e-5 and blurred[seen].max() <= depth[seen].max() + 1e-5
    assert np.abs(blurred[seen] - depth[seen]).max() > 0.05


@wp.kernel
def spoil_kernel(image: wp.array[wp.vec3], out_image: wp.array[wp.vec3]):
    i = wp.tid()
    value = image[i]
    if i % 101 == 0:
        value = wp.vec3(wp.nan, wp.inf, -wp.inf)
    elif i % 101 == 50:
        value = wp.vec3(3.0e38, -5.0, 1.0e30)
    out_image[i] = value


class Spoil(wd.Pass):
    name = "spoil"
    image = "turn"
    scope = "sample"

    def run(self, resources):
        c = resources.channels
        resources.program.launch(spoil_kernel, self.layout.pixels, [c[self.source]], [c[self.target]], block_dim=64)


def test_bad_numbers_end_here(device, unchecked):
    spoiled = renderer_of(device, "rung=gaussian", passes=[Spoil])
    image = spoiled.render().numpy("color")[0]
    names = [stage.name for stage in spoiled.plan.passes]
    assert names.index("spoil") < names.index("blur"), names
    assert np.isfinite(image).all() and image.min() >= 0 and image.max() <= 65504.0


@pytest.mark.parametrize("value", ["sigma_px=-1", "sigma_px=nan", "sigma_px=65", "rung=box"])
def test_settings_out_of_range_are_refused(value):
    with pytest.raises(wd.InputError, match=r"blur|Blur"):
        settings(value)
