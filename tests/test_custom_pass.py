"""Passes of a user's own: the worked example, the chain of images, what they may read, and what is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from builders import assert_same, bits, gallery, images, spied
from test_readme import blocks

import warp_deferred as wd
from warp_deferred.passes.base import Pass

PAGE = Path(__file__).resolve().parents[1] / "docs" / "custom-pass.md"


@wp.kernel
def scale_kernel(image: wp.array[wp.vec3], factor: wp.float32, out_image: wp.array[wp.vec3]):
    i = wp.tid()
    out_image[i] = image[i] * factor


@wp.kernel
def add_kernel(image: wp.array[wp.vec3], amount: wp.float32, out_image: wp.array[wp.vec3]):
    i = wp.tid()
    out_image[i] = image[i] + wp.vec3(amount)


@wp.kernel
def count_kernel(depth: wp.array[wp.float32], ids: wp.array[wp.int32], out_flag: wp.array[wp.int32]):
    i = wp.tid()
    out_flag[i] = wp.where(wp.isfinite(depth[i]), ids[i], -7)


class Scale(wd.Pass):
    name = "gain"
    image = "turn"
    kernel = scale_kernel

    def __init__(self, amount, name="gain", after="shade", image="turn"):
        self.amount, self.name, self.after, self.image = amount, name, after, image

    def run(self, resources):
        c = resources.channels
        resources.program.launch(
            self.kernel, self.layout.pixels, [c[self.source], self.amount], [c[self.target]], block_dim=64
        )


class Add(Scale):
    kernel = add_kernel


class Flag(wd.Pass):
    name = "flag"
    after = "resolve"

    def reads(self):
        return ("depth", "instance_id")

    def writes(self):
        return {"flags": wd.Buffer(wp.int32, self.layout.pixels, lasting=True)}

    def run(self, resources):
        c = resources.channels
        inputs = [c["depth"], c["instance_id"]]
        resources.program.launch(count_kernel, self.layout.pixels, inputs, [c["flags"]], block_dim=64)


def renderer_of(device="cpu", outputs=("color", "display"), scene=None, **fields):
    return wd.Renderer(scene or gallery(), width=64, height=48, device=device, outputs=outputs, **fields)


def test_the_example_runs_as_printed(tmp_path, monkeypatch):
    (example,) = blocks(PAGE.read_text("utf-8"), "python")
    # A kernel's source is read from its file.
    file = tmp_path / "fog_example.py"
    file.write_text(example.replace("width=640, height=360", "width=64, height=36"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    import fog_example

    assert (tmp_path / "fog.png").stat().st_size > 1000
    plain = wd.Renderer(fog_example.scene, width=64, height=36, device="cpu", outputs=("color", "depth"))
    color, depth = (plain.render().numpy(n)[0] for n in ("color", "depth"))
    clear = np.exp(-np.float32(0.05) * depth)[..., None]
    foggy = wd.Renderer(
        fog_example.scene, width=64, height=36, device="cpu", outputs=("color",), passes=[fog_example.fog]
    )
    expected = color * clear + np.float32((0.5, 0.6, 0.7)) * (1 - clear)
    assert np.abs(foggy.render().numpy("color")[0] - expected).max() < 1e-5
    assert np.abs(expected - color).max() > 0.05


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("kind", ["turn", "rewrite"])
def test_the_image_goes_from_pass_to_pass(device, kind, share):
    plain = images(renderer_of(device).render())
    passes = [Scale(3.0, image=kind), Add(0.25, "add", "shade", kind), Scale(0.5, "half_of_it", "add", kind)]
    renderer = renderer_of(device, passes=passes, share_memory=share)
    result = images(renderer.render())
    expected = (plain["color"] * np.float32(3.0) + np.float32(0.25)) * np.float32(0.5)
    assert np.array_equal(bits(result["color"]), bits(expected))
    assert not np.array_equal(result["display"], plain["display"])
    names = [stage.name for stage in renderer.plan.passes]
    assert names[names.index("shade") + 1 :] == ["gain", "add", "half_of_it", "display"]
    # The picture alone shows the same image, which is then nobody's output.
    alone = renderer_of(device, ("display",), passes=passes, share_memory=share)
    assert np.array_equal(alone.render().numpy("display")[0], result["display"])
    assert ("radiance_shade" in alone.plan.memory) == (kind == "turn")


def test_a_pass_reads_outputs_nobody_asked_for_and_writes_its_own(device):
    renderer = renderer_of(device, ("color",), passes=[Flag])
    frame = renderer.render()
    assert frame.outputs == ("color",)
    flags = renderer.plan.resources.channels["flags"].numpy().reshape(48, 64)
    expected = images(renderer_of(device, ("depth", "instance_id")).render())
    assert np.array_equal(flags, np.where(np.isfinite(expected["depth"]), expected["instance_id"], -7))
    assert np.array_equal(images(frame)["color"], images(renderer_of(device, ("color",)).render())["color"])
    assert "flag" in str(renderer.explain(measure=False)) and "handed in with passes=" in str(renderer.explain())


def test_the_image_is_lit_for_a_pass_though_no_output_is(device):
    seen = Scale(2.0)
    renderer = renderer_of(device, ("depth",), passes=[seen], share_memory=False)
    renderer.render()
    image = renderer.plan.resources.channels[renderer.plan.passes[-1].target].numpy().reshape(48, 64, 3)
    assert np.array_equal(image, 2.0 * images(renderer_of(device, ("color",)).render())["color"])


def test_a_second_frame_makes_nothing_new(device):
    renderer = renderer_of(device, passes=[Scale(2.0), Flag()])
    first = images(renderer.render())
    second = images(spied(renderer))
    assert_same(first, second)


def test_equal_passes_are_one_request():
    @dataclasses.dataclass(frozen=True)
    class Tint(Pass):
        amount: float
        name = "tint"

        def run(self, resources):
            pass

    def request(given):
        return renderer_of(passes=[given])._passes

    tint = Tint(1.0)
    assert request(tint) == request(tint) == request(Tint(1.0)) != request(Tint(2.0))
    assert hash(request(tint)) == hash(request(Tint(1.0)))
    one = Scale(1.0)
    assert request(one) == request(one) != request(Scale(1.0))
    renderer_of(passes=[tint]).render()


def reading(name, after="resolve", **fields):
    kind = type("Reader", (Flag,), {"reads": lambda self: (name,), "after": after, **fields})
    return kind()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (reading("gbuffer_norm"), r"Reader reads 'gbuffer_norm': expected .*; written before it are .*keys"),
        (reading("mask_words", "resolve"), r"Reader reads 'mask_words'.*set after = 'light_culling'"),
        (reading("depth", "clusters"), r"Reader reads 'depth'.*set after = 'resolve'"),
        (Scale(1.0, after="resolve"), r"Scale reads the image: expected an earlier pass that writes it"),
        (
            reading("depth", writes=lambda self: {"depth": wd.Buffer(wp.int32, 3)}),
            r"Reader writes 'depth': expected 3072 elements of .*float32.*, got 3 of .*int32.*; give the channel",
        ),
    ],
    ids=["unknown", "later", "later_output", "no_image", "two_types"],
)  # fmt: skip
def test_channels_that_do_not_fit_are_refused(given, message):
    with pytest.raises(wd.Error, match=message):
        renderer_of(passes=[given]).render()


@pytest.mark.parametrize(
    ("passes", "message"),
    [
        ([3], r"Renderer\.passes\[0\]: expected a warp_deferred\.Pass"),
        ([Scale(1.0, "shade")], r"passes\[0\]\.name: expected a name of its own, .*got 'shade'; taken"),
        ([Scale(1.0), Scale(2.0)], r"passes\[1\]\.name: expected a name of its own"),
        ([Scale(1.0, after="shad")], r"passes\[0\]\.after: .*did you mean 'shade'"),
        ([Scale(1.0, image="write")], r"passes\[0\]\.image: expected one of"),
    ],
    ids=["no_pass", "name_taken", "same_name", "after", "image"],
)  # fmt: skip
def test_passes_that_do_not_fit_are_refused(passes, message):
    with pytest.raises(wd.InputError, match=message):
        renderer_of(passes=passes)


def order_of(scene, passes, rung):
    """Names of the passes between shading and display, those that open and close samples left out."""
    settings = wd.Settings().with_values([f"anti_aliasing.rung={rung}"])
    renderer = renderer_of(outputs=("display",), scene=scene, passes=passes, settings=settings)
    renderer.prepare()
    names = [stage.name for stage in renderer.plan.passes if stage.name not in ("accumulate", "average")]
    return names[names.index("shade") + 1 :]


LENS = ["motion", "depth_of_field", "motion_blur"]


@pytest.mark.parametrize(
    ("after", "scope", "expected"),
    [
        ("shade", "sample", ["gain", *LENS, "bloom", "display"]),
        ("shade", "frame_end", [*LENS, "gain", "bloom", "display"]),
        ("resolve", "frame_end", ["gain", *LENS, "bloom", "display"]),
        ("depth_of_field", "sample", [*LENS[:2], "gain", LENS[2], "bloom", "display"]),
        ("depth_of_field", "frame_end", [*LENS[:2], "gain", LENS[2], "bloom", "display"]),
        ("blur", "sample", [*LENS, "gain", "bloom", "display"]),
        ("shade", "frame_start", ["gain", *LENS, "bloom", "display"]),
    ],
)
def test_the_order_does_not_depend_on_the_number_of_samples(after, scope, expected):
    scene = gallery()
    scene.camera = scene.camera.replace(aperture=0.3, shutter=0.5, bloom=0.1)
    scene.animate = lambda scene, time: None
    passes = [Scale(2.0, after=after), Scale(0.5, "follower", "gain")]
    passes[0].scope = scope
    place = expected.index("gain") + 1
    expected = [*expected[:place], "follower", *expected[place:]]
    for rung in ("off", "samples_4"):
        assert order_of(scene, passes, rung) == expected, rung


@wp.kernel
def square_kernel(image: wp.array[wp.vec3], factor: wp.float32, out_image: wp.array[wp.vec3]):
    i = wp.tid()
    out_image[i] = wp.cw_mul(image[i], image[i]) * factor


class Square(Scale):
    kernel = square_kernel


def test_one_sample_and_several_see_the_same_image(device):
    scene = gallery(lights=False)
    for k, instance in enumerate(scene.instances):
        glow = (9.0 * (k % 2), 0.5, 0.25)
        instance.material = wd.Material(model="lambert", base_color=(0, 0, 0, 1.0), emissive=glow, name=str(k))
    scene.camera = scene.camera.replace(aperture=0.4, focus_distance=2.0)

    def color(after, rung):
        settings = wd.Settings().with_values([f"anti_aliasing.rung={rung}"])
        passes = [Square(0.1, after=after)]
        return images(renderer_of(device, ("color",), scene, passes=passes, settings=settings).render())["color"]

    sharp, blurred = color("shade", "off"), color("depth_of_field", "off")
    apart = np.mean(np.abs(sharp - blurred))
    for expected, after in ((sharp, "shade"), (blurred, "depth_of_field")):
        assert np.mean(np.abs(color(after, "samples_16") - expected)) < 0.25 * apart, after
