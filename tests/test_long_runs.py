"""Long runs and broken frames: nothing grows, drifts or is left over."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import warp as wp
from builders import FULL, Spy, assert_same, gallery, images, tilt

import warp_deferred as wd
from warp_deferred.plan import Plan

SIZE = (32, 24)
OUTPUTS = ("color", "depth", "display", "instance_id")
#: No look at the numbers of ten thousand frames: it waits for each.
FREE = wd.Settings(check_finite=False).with_values(["shadow.directional_size=128", "shadow.cascades=1"])


def renderer_of(scene, device, settings=FREE, outputs=OUTPUTS):
    return wd.Renderer(scene, width=SIZE[0], height=SIZE[1], device=device, outputs=outputs, settings=settings)


def place(scene, start, k):
    """Put camera, lights and an instance where frame k wants them; every 97 frames all comes back."""
    turn = 2.0 * np.pi * (k % 97) / 97
    scene.camera = wd.Camera.look_at((4.0 * np.sin(turn), 1.9, 4.6 * np.cos(turn)), (0.0, 0.7, 0.0), bloom=0.1)
    scene.lights.point.position = start + 0.5 * np.array([np.sin(turn), 0.0, np.cos(turn)])
    scene.lights.point.intensity = np.full(len(start), 5.0 + 4.0 * np.sin(turn))
    scene.instances[1].transform = tilt(20.0, np.degrees(turn), 1.0, (-1.2, 0.6, 0.2))


def run(device, frames):
    """Render so many frames of moving lights, camera and instance, and check all that must not change."""
    scene = gallery()
    scene.lights.directional.casts_shadow = np.ones(1, bool)
    start = np.array(scene.lights.point.position)
    renderer = renderer_of(scene, device)
    for k in range(2 * 97):
        place(scene, start, k)
        frame = renderer.render()
        if k in (40, 96):
            kept = kept | {k: images(frame)} if k == 96 else {k: images(frame)}
    gc.collect()
    memory, plan = used_memory(device), renderer.plan
    with Spy() as spy:
        for k in range(frames):
            place(scene, start, k)
            frame = renderer.render()
    spy.assert_nothing()
    assert renderer.plan is plan
    if memory is not None:
        assert used_memory(device) - memory < 1 << 20
    for k, expected in kept.items():
        place(scene, start, k)
        assert_same(expected, images(renderer.render()))


def used_memory(device):
    """Bytes that this process holds of a CUDA device's pool; None on the CPU, where the spy counts every allocation."""
    if not device.startswith("cuda"):
        return None
    wp.synchronize_device(device)
    return wp.get_mempool_used_mem_current(device)


def test_hundreds_of_frames_change_nothing_but_the_picture():
    run("cpu", 200)


@pytest.mark.gpu
@pytest.mark.slow
def test_ten_thousand_frames_change_nothing_but_the_picture(cuda_device):
    run(cuda_device, 10_000)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, MemoryError])
@pytest.mark.parametrize("when", ["before", "after", "within"])
def test_a_frame_that_is_broken_off_leaves_the_renderer_usable(error, when, device, monkeypatch):
    scene = gallery()
    renderer = renderer_of(scene, device, FULL.replace(check_finite=False))
    expected = images(renderer.render())
    program = renderer.plan.resources.program
    replay = program.replay

    def break_off():
        if when == "after":
            replay()
        elif when == "within":
            # A few passes run, then the host is interrupted.
            program.run(stop=3)
        raise error

    for k in range(3):
        with monkeypatch.context() as patch:
            patch.setattr(program, "replay", break_off)
            with pytest.raises(error):
                renderer.render(wd.Camera.look_at((2.0, 1.0 + k, 3.0), (0.0, 0.0, 0.0)))
        assert_same(expected, images(renderer.render()))


def test_a_plan_that_cannot_be_built_leaves_the_renderer_usable(device, monkeypatch):
    scene = gallery()
    renderer = renderer_of(scene, device)
    expected = images(renderer.render())

    def refuse(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Plan, "_build", refuse)
        with pytest.raises(KeyboardInterrupt):
            renderer.render([scene.camera, scene.camera])
    assert_same(expected, images(renderer.render()))
    frame = renderer.render([scene.camera, scene.camera])
    assert_same(expected, images(frame, 1))


def test_an_emptied_scene_leaves_nothing_stale(device):
    scene = gallery()
    scene.lights.directional.casts_shadow = np.ones(1, bool)
    camera = scene.camera.replace(bloom=0.3)
    renderer = renderer_of(scene, device)
    full = images(renderer.render(camera))
    kept = list(scene.instances)
    scene.clear()
    scene.lights.clear()
    scene.environment = wd.Environment(background=(0.25, 0.5, 1.0))
    empty = images(renderer.render(camera))
    assert (empty["instance_id"] == -1).all() and np.isposinf(empty["depth"]).all()
    assert (empty["color"] == np.array([0.25, 0.5, 1.0], np.float32)).all()
    again = gallery()
    again.lights.directional.casts_shadow = np.ones(1, bool)
    for item in kept:
        scene.add(item.mesh, transform=item.transform, material=item.material, label=item.label)
    for kind, group in again.lights.groups():
        fields = {name: np.array(getattr(group, name)) for name in group.FIELDS[kind]}
        scene.lights.extend(kind, len(group), **fields)
    scene.environment = again.environment
    assert_same(full, images(renderer.render(camera)))


@pytest.mark.gpu
def test_frames_behind_one_another_do_not_mix(cuda_device):
    # Nothing waits between frames: what the host writes for the next must not reach the one before.
    scene = gallery()
    renderer = renderer_of(scene, cuda_device, outputs=("color",))
    start = np.array(scene.lights.point.position)
    copies, expected = [], []
    for k in range(64):
        place(scene, start, k)
        copies.append(wp.clone(renderer.render()["color"]))
    for k in range(64):
        place(scene, start, k)
        expected.append(renderer.render().numpy("color"))
    for copy, image in zip(copies, expected, strict=True):
        assert np.array_equal(copy.numpy(), image)
