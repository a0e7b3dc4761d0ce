"""Bloom in frames: what calls for it, what skips it, what it sees and what shows it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from bloom_harness import RUNGS, Blooming, lamps, request_of, rung
from builders import Spy, gallery, grid, images

import warp_deferred as wd
from warp_deferred.effects import EFFECTS
from warp_deferred.views import ViewSize


def glowing(power=8.0):
    """Return a dark wall with a small emitting square before it."""
    scene = wd.Scene()
    scene.add(grid(2, 6.0), material=wd.Material(base_color=(0.3, 0.3, 0.3, 1.0)))
    lamp = wd.Material(base_color=(0.0, 0.0, 0.0, 1.0), emissive=(power, 0.6 * power, 0.1 * power))
    matrix = np.eye(4)
    matrix[:3, 3] = (0.2, 0.1, 0.3)
    scene.add(grid(1, 0.4), transform=matrix, material=lamp)
    scene.lights.add(wd.PointLight(position=(0.0, 1.0, 2.0), intensity=0.8))
    scene.camera = wd.Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), bloom=0.3)
    return scene


def render(scene, *changes, device="cpu", camera=None, outputs=("display",), **fields):
    settings = wd.Settings().with_values(list(changes))
    renderer = wd.Renderer(scene, width=75, height=50, device=device, outputs=outputs, settings=settings, **fields)
    return renderer, images(renderer.render(camera or scene.camera))["display"].copy()


def section_of(renderer):
    return next(s for s in renderer.plan.resources.program.sections if s.name == "bloom")


@pytest.mark.parametrize("name", RUNGS)
def test_a_lamp_glows_on_the_wall(name, device):
    scene = glowing()
    renderer, on = render(scene, rung(name), "bloom.window=8", device=device)
    _, off = render(scene, rung("off"), device=device)
    assert [s.name for s in renderer.plan.passes if s.name == "bloom"] == ["bloom"]
    grown = on.astype(int) - off
    y, x = np.nonzero(off[..., 0] == off[..., 0].max())
    beside = grown[int(y.mean()), int(x.max()) + 3, 0]
    assert beside > 10
    assert abs(grown[2, 2]).max() <= 8


def test_color_is_without_bloom(device):
    scene = glowing()
    frames = []
    for name in ("off", "mip_chain"):
        settings = wd.Settings().with_values([rung(name)])
        renderer = wd.Renderer(
            scene, width=75, height=50, device=device, outputs=("color", "display"), settings=settings
        )
        frames.append(images(renderer.render()))
    assert np.array_equal(frames[0]["color"], frames[1]["color"])
    assert not np.array_equal(frames[0]["display"], frames[1]["display"])


@pytest.mark.parametrize("name", RUNGS)
@pytest.mark.parametrize("outputs", [("display",), ("display", "color")])
def test_p11_always_with_no_strength_is_neutral_to_the_bit(name, outputs, device):
    scene = glowing()
    camera = scene.camera.replace(bloom=0.0)
    plain, off = render(scene, camera=camera, outputs=outputs, device=device)
    forced, on = render(scene, rung(name), "bloom.when=always", camera=camera, outputs=outputs, device=device)
    assert "bloom" not in [s.name for s in plain.plan.passes]
    assert "bloom" in [s.name for s in forced.plan.passes]
    assert np.array_equal(on, off)


def test_strengths_belong_to_views(device):
    scene = glowing()
    shares = (0.0, 0.1, 0.6)
    cameras = [scene.camera.replace(bloom=s) for s in shares]
    renderer = wd.Renderer(scene, width=75, height=50, device=device)
    batch = renderer.render(cameras)
    several = [images(batch, v)["display"].copy() for v in range(3)]
    for v, camera in enumerate(cameras):
        assert np.array_equal(images(renderer.render(camera))["display"], several[v])
    assert not np.array_equal(several[1], several[2])


def test_a_frame_without_bright_pixels_is_the_frame_without_bloom(device):
    """The flag: raised by one bright pixel, lowered by the next upload, and tested by display."""
    scene = glowing()
    renderer, lit = render(scene, device=device)
    _, lit_off = render(scene, rung("off"), device=device)
    section = section_of(renderer)
    flag = section.condition
    assert flag.numpy()[0] == 1 and not np.array_equal(lit, lit_off)
    dim = scene.camera.replace(exposure=-6.0)
    _, dim_off = render(scene, rung("off"), camera=dim, device=device)
    assert np.array_equal(images(renderer.render(dim))["display"], dim_off)
    assert flag.numpy()[0] == 0
    assert np.array_equal(images(renderer.render(scene.camera))["display"], lit)
    assert flag.numpy()[0] == 1
    # A bright pixel of a view whose lens does not scatter calls for nothing.
    renderer.render([dim, scene.camera.replace(bloom=0.0)])
    assert renderer.plan.resources.frame.bright.numpy()[0] == 0


def test_nothing_stale_shows():
    pictures = [lamps(40, 24)]
    stage = Blooming(pictures, bright=0)
    assert np.array_equal(stage.mixed()[0], np.minimum(pictures[0], 65504.0))
    # Without a threshold all light scatters: no flag is needed, and none is looked at.
    stage = Blooming(pictures, "bloom.threshold=0", bright=0).run()
    assert stage.stage.active(stage.resources) is None
    assert not np.array_equal(stage.mixed()[0], pictures[0])


def test_called_for_by_lens_and_settings():
    size = (ViewSize(8, 8),)
    effect = next(e for e in EFFECTS if e.name == "bloom")
    assert effect.verdict(request_of(size)) == (True, "a camera's lens has bloom")
    assert effect.verdict(request_of(size, lens=False)) == (False, "no camera's lens has bloom")
    assert effect.verdict(request_of(size, "bloom.rung=off")) == (False, "bloom.rung is off")
    assert effect.verdict(request_of(size, "bloom.when=always", "bloom.rung=off"))[0] is False
    assert effect.verdict(request_of(size, "bloom.when=always", lens=False))[0] is True


def test_explain_says_why_not():
    scene = glowing()
    scene.camera = scene.camera.replace(bloom=0.0)
    renderer, _ = render(scene)
    rows = {row.name: row for row in renderer.explain(measure=False).rows}
    assert not rows["bloom"].runs and rows["bloom"].reason == "no camera's lens has bloom"
    renderer = wd.Renderer(scene, width=8, height=8, device="cpu", outputs=("depth",))
    renderer.render(scene.camera.replace(bloom=0.5))
    assert "bloom" not in renderer.plan.resources.channels


@pytest.mark.parametrize("name", RUNGS)
def test_a_skipped_pass_touches_nothing(name, device):
    """Bloom's memory keeps what was put there while no pixel is bright, and the picture shows none of it."""
    scene = glowing()
    dim = scene.camera.replace(exposure=-6.0)
    renderer, on = render(scene, rung(name), device=device, share_memory=False)
    junk = renderer.plan.resources.channels["bloom"]
    junk.fill_(7 if junk.dtype is wp.uint64 else 7.0)
    before = junk.numpy().copy()
    _, dim_off = render(scene, rung("off"), camera=dim, device=device)
    assert np.array_equal(images(renderer.render(dim))["display"], dim_off)
    assert np.array_equal(junk.numpy(), before)
    assert np.array_equal(images(renderer.render(scene.camera))["display"], on)
    assert not np.array_equal(junk.numpy(), before)
    row = {r.name: r for r in renderer.explain().rows}["bloom"]
    assert row.reason == "a camera's lens has bloom; active if some pixel exceeds the threshold" and row.active


def test_samples_raise_the_flag_and_share_one_bloom(device):
    """Any sample may raise the flag; bloom then works on the average, once a frame."""
    scene = glowing()
    sampled = ("anti_aliasing.rung=samples_4",)
    renderer, on = render(scene, *sampled, device=device)
    _, off = render(scene, *sampled, rung("off"), device=device)
    assert section_of(renderer).condition.numpy()[0] == 1
    assert not np.array_equal(on, off)
    names = [s.name for s in renderer.plan.passes]
    assert names.index("bloom") > names.index("average")
    dim = scene.camera.replace(exposure=-6.0)
    _, dim_off = render(scene, *sampled, rung("off"), camera=dim, device=device)
    assert np.array_equal(images(renderer.render(dim))["display"], dim_off)


@wp.kernel
def brighten_kernel(
    source: wp.array[wp.vec3],
    out_image: wp.array[wp.vec3],
):
    i = wp.tid()
    out_image[i] = source[i] * 64.0


class BrightenPass(wd.Pass):
    """Makes a dark picture bright behind shade's back."""

    name = "brighten"
    image = "turn"

    def run(self, resources):
        source, target = resources.channels[self.source], resources.channels[self.target]
        resources.program.launch(brighten_kernel, source.size, [source], [target], block_dim=256)


def test_bloom_sees_the_image_behind_the_users_own_passes(device):
    scene = glowing()
    dim = scene.camera.replace(exposure=-6.0)
    renderer, on = render(scene, camera=dim, device=device, passes=[BrightenPass])
    assert [s.name for s in renderer.plan.passes][-3:] == ["brighten", "bloom", "display"]
    assert section_of(renderer).condition is None
    _, expected = render(scene, "shade.radiance=float32", device=device)
    assert np.array_equal(on, expected)


def test_nothing_of_bloom_is_imported_before_a_lens_asks(tmp_path):
    code = """
import sys
import warp_deferred as wd
scene = wd.load("lambert_plane")
wd.Renderer(scene, width=8, height=8, device="cpu").render()
assert not [n for n in sys.modules if "bloom" in n], [n for n in sys.modules if "bloom" in n]
wd.Renderer(scene, width=8, height=8, device="cpu").render(scene.camera.replace(bloom=0.1))
assert [n for n in sys.modules if n.startswith("warp_deferred") and "bloom" in n]
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_what_is_not_called_for_is_not_there(device):
    scene = gallery()
    scene.camera = scene.camera.replace(bloom=0.0)
    renderer = wd.Renderer(scene, width=40, height=30, device=device)
    renderer.render()
    modules = {kernel.module.name + kernel.key for kernel, _ in renderer.plan.resources.program.kernels}
    assert not any("bloom" in name or "bright" in name for name in modules)
    assert not any("bloom" in name for name in renderer.plan.memory)


@pytest.mark.parametrize("name", RUNGS)
def test_a_second_frame_makes_nothing_new(name, device):
    scene = glowing()
    renderer, _ = render(scene, rung(name), device=device)
    with Spy() as spy:
        for k in range(3):
            renderer.render(scene.camera.replace(bloom=0.1 + 0.2 * k, exposure=0.5 * k))
    spy.assert_nothing()


@pytest.mark.gpu
def test_graph_and_direct_run_agree(cuda_device):
    renderer, replayed = render(glowing(), device=cuda_device)
    program = renderer.plan.resources.program
    for section in program.sections:
        program.run_section(section)
    wp.synchronize()
    assert np.array_equal(renderer.plan.outputs["display"].numpy()[0], replayed)
