"""The ladder of anti-aliasing: FXAA as a pass behind display, and what each rung leaves of the error."""

import subprocess
import sys

import numpy as np
import pytest
from builders import LAYERS, assert_same, gallery, images, spied
from reference import color as reference
from smoothing import smooth

import warp_deferred as wd
from warp_deferred import sampling
from warp_deferred.compare import compare

RUNGS = ("fxaa", "samples_2", "samples_4", "samples_8", "samples_16", "samples_32", "samples_64")


def settings_of(rung, *more):
    return wd.Settings().with_values([f"anti_aliasing.rung={rung}", *more])


def renderer_of(device, rung="fxaa", outputs=("display",), scene=None, size=(64, 48), **fields):
    return wd.Renderer(
        scene or gallery(), width=size[0], height=size[1], device=device, outputs=outputs, settings=settings_of(rung),
        **fields,
    )  # fmt: skip


# ---- the pass


@pytest.mark.parametrize("size", [(64, 48), (37, 29), (1, 1), (1, 50)])
def test_the_picture_is_display_s_smoothed(size, device):
    once = images(renderer_of(device, "off", size=size).render())["display"]
    result = images(renderer_of(device, size=size).render())["display"]
    assert result.shape == once.shape == (size[1], size[0], 4)
    assert np.array_equal(result, smooth([once], device)[0])
    assert np.array_equal(result, once) is (size == (1, 1)) and np.all(result[..., 3] == 255)


def test_other_outputs_stay_to_the_bit(device):
    outputs = (*LAYERS, "display")
    plain, smoothed = (images(renderer_of(device, rung, outputs).render()) for rung in ("off", "fxaa"))
    assert_same(plain, smoothed, LAYERS)
    assert not np.array_equal(plain["display"], smoothed["display"])


def test_views_of_a_batch_are_those_of_single_frames(device):
    scene = gallery()
    cameras = [scene.camera.replace(position=(x, 1.7, 4.0)) for x in (0.1, 0.9, -0.7)]
    renderer = renderer_of(device, scene=scene, size=(45, 31))
    alone = [images(renderer.render(camera))["display"] for camera in cameras]
    frame = renderer.render(cameras)
    for view, picture in enumerate(alone):
        assert np.array_equal(images(frame, view)["display"], picture)
    assert not np.array_equal(alone[0], alone[1])


def test_shared_memory_changes_nothing(device):
    shared, apart = renderer_of(device), renderer_of(device, share_memory=False)
    assert_same(images(shared.render()), images(apart.render()))
    assert shared.plan.memory["display_aliased"] == 64 * 48 * 4 and shared.plan.bytes < apart.plan.bytes


def test_a_second_frame_makes_nothing_new_and_graphs_equal_direct_runs(device):
    scene = gallery()
    renderer = renderer_of(device, scene=scene)
    first = images(renderer.render())
    scene.camera = wd.Camera.look_at((0.3, 1.9, 4.6), (0.0, 0.7, 0.0))
    moved = images(spied(renderer))
    assert not np.array_equal(first["display"], moved["display"])
    assert_same(images(renderer_of(device, scene=scene).render()), moved)
    renderer.plan.outputs["display"].zero_()
    renderer.plan.resources.program.run()
    assert np.array_equal(renderer.plan.outputs["display"].numpy()[0], moved["display"])


def test_explain_tells_why(device):
    def row(rung, outputs=("display",)):
        told = renderer_of(device, rung, outputs).explain(measure=False)
        return {r.name: r for r in told.rows}["anti_aliasing"]

    runs = row("fxaa")
    assert runs.runs and runs.rung == "fxaa" and runs.reason == "anti_aliasing.rung=fxaa" and runs.bytes == 64 * 48 * 8
    assert not row("off").runs and row("off").reason == "anti_aliasing.rung is off"
    assert not row("samples_4").runs and row("samples_4").reason == "anti_aliasing.rung=samples_4"
    no_picture = row("fxaa", ("color", "depth"))
    assert not no_picture.runs and no_picture.reason == "no output asked for is a picture"


def test_without_a_picture_nothing_is_smoothed(device):
    plain, asked = (renderer_of(device, rung, ("color", "depth")) for rung in ("off", "fxaa"))
    assert_same(images(plain.render()), images(asked.render()))
    assert [s.name for s in plain.plan.passes] == [s.name for s in asked.plan.passes]


SCRIPT = """
import sys
import warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_deferred as wd
for rung in ("off", "samples_4", "fxaa"):
    settings = wd.Settings().with_values([f"anti_aliasing.rung={rung}"])
    renderer = wd.Renderer(wd.load("lambert_plane"), width=32, height=24, device="cpu", settings=settings)
    renderer.prepare()
    loaded = [name for name in sys.modules if name.endswith("anti_aliasing")]
    assert len(loaded) == (2 if rung == "fxaa" else 0), (rung, loaded)
"""


def test_modules_are_imported_once_they_are_called_for():
    subprocess.run([sys.executable, "-c", SCRIPT], check=True, timeout=300)


# ---- what is left of the error


def wheel(spokes=24):
    """Return a scene of bright wedges on dark ground: straight edges of every slope, none along an axis."""
    angle = np.arange(2 * spokes) * np.pi / spokes + 0.037
    rim = 9.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    wedges = [[0, 1 + 2 * k, 2 + 2 * k] for k in range(spokes)]
    scene = wd.Scene("wheel")
    scene.add(wd.Mesh(np.vstack([np.zeros((1, 3)), rim]), wedges), material=wd.Material(model="lambert"))
    scene.environment = wd.Environment(ambient=(0.7, 0.7, 0.7), background=(0.02, 0.02, 0.02))
    scene.camera = wd.Camera(projection="orthographic", vertical_extent=8.0, position=(0.0, 0.0, 5.0), near=1.0)
    return scene


EDGES = ((0.7, 0.78), (0.75, 0.75), (0.45, 0.57), (0.3, 0.42), (0.2, 0.32), (0.14, 0.24), (0.1, 0.2))
SCENES = ((0.95, 1.3), (0.8, 0.85), (0.6, 0.7), (0.4, 0.5), (0.3, 0.43), (0.2, 0.32), (0.15, 0.27))
#: Scene, its size, and for each rung the bounds of AntiAliasingSettings: root mean square, FLIP.
CASES = {
    "wheel": (wheel, (192, 144), EDGES),
    "terrain": (
        lambda: wd.load("terrain?triangles=20000"), (192, 108), SCENES,
    ),
    "hundred_lights": (
        lambda: wd.load("hundred_lights"), (240, 135), SCENES,
    ),
}  # fmt: skip


def linear(picture):
    return reference.srgb_decode(picture[..., :3] / 255.0)


def rms(one, two):
    return float(np.sqrt(np.mean((linear(one) - linear(two)) ** 2)))


def flip(one, two):
    a, b = (dict(zip("RGB", np.moveaxis(p[..., :3], 2, 0), strict=True)) for p in (one, two))
    return compare(a, b).flip


def picture_of(scene, size, rung, device):
    return images(renderer_of(device, rung, scene=scene, size=size).render())["display"]


def oracles(scene, size, device, patch):
    """Return two pictures of 256 samples at other points than the rungs', one set the other's mirror image."""
    found, own = [], sampling.points
    patch.setattr(sampling, "pixel_samples", lambda request: 256)
    for side in (0.0, 1.0):
        # Axes exchanged, so that no rung's points are among them; the mirrored set has the same properties.
        patch.setattr(sampling, "points", lambda n, side=side: np.abs(side - own(n)[:, [1, 0, 2, 3, 4]]))
        renderer = renderer_of(device, "samples_64", scene=scene, size=size)
        found.append(images(renderer.render())["display"])
        assert renderer.plan.replays == 256
    patch.undo()
    return found


def errors_of(name, device, patch):
    """Root mean square and FLIP of every rung, `off` first, against 256 samples, and the latter's standard error."""
    make, size, _ = CASES[name]
    scene = make()
    truth, other = oracles(scene, size, device, patch)
    pictures = [picture_of(scene, size, rung, device) for rung in ("off", *RUNGS)]
    return [(rms(p, truth), flip(p, truth)) for p in pictures], rms(truth, other) / np.sqrt(2.0)


@pytest.mark.parametrize("name", ["wheel", "terrain", pytest.param("hundred_lights", marks=pytest.mark.slow)])
def test_rungs_leave_no_more_error_than_promised(name, device, monkeypatch):
    (off, *found), doubt = errors_of(name, device, monkeypatch)
    shares = {rung: (a / off[0], b / off[1]) for rung, (a, b) in zip(RUNGS, found, strict=True)}
    # The oracle is good enough to judge 16 samples by: a quarter of their error.
    assert doubt <= 0.25 * found[RUNGS.index("samples_16")][0]
    for (rung, share), bound in zip(shares.items(), CASES[name][2], strict=True):
        assert share[0] <= bound[0] and share[1] <= bound[1], (rung, share, bound)
    # And the ladder is one: every rung is nearer to the truth than the one before.
    for measure in (0, 1):
        sampled = [share[measure] for rung, share in shares.items() if rung != "fxaa"]
        assert sampled == sorted(sampled, reverse=True) and sampled[0] < 1.0
    assert off[0] > 0.01
