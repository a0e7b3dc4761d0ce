"""The same bits: in twenty repeats, in other processes, with an empty kernel cache, on other streams, beside others."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import threading

import numpy as np
import pytest
import warp as wp
from builders import FULL, LAYERS, assert_same, gallery, images, room

import warp_deferred as wd

SIZE = (49, 37)


def renderer_of(scene, device, outputs=LAYERS, settings=FULL, **fields):
    return wd.Renderer(
        scene, width=SIZE[0], height=SIZE[1], device=device, outputs=outputs, settings=settings, **fields
    )


def everything():
    """A scene whose frame has shadow maps, ambient visibility, depth of field and bloom."""
    scene = gallery()
    for kind in ("point", "spot", "directional"):
        group = getattr(scene.lights, kind)
        group.casts_shadow = np.ones(len(group), bool)
    scene.camera = scene.camera.replace(aperture=0.1, focus_distance=4.0, bloom=0.2)
    return scene


def digest(frame) -> str:
    """One text for all bits of a frame."""
    return hashlib.sha256(b"".join(frame.numpy(name).tobytes() for name in frame.outputs)).hexdigest()


@pytest.mark.parametrize("build", [room, everything])
def test_e8_twenty_repeats_are_one(build, device):
    renderer = renderer_of(build(), device, (*LAYERS, "display"), wd.Settings())
    assert len({digest(renderer.render()) for _ in range(20)}) == 1


CODE = """
import sys
sys.path.insert(0, {tests!r})
import warp as wp
wp.config.log_level = wp.LOG_WARNING
from builders import room
from test_determinism import digest
import warp_deferred as wd
renderer = wd.Renderer(room(), width=49, height=37, device={device!r}, outputs=("color", "depth", "instance_id"))
print(digest(renderer.render()))
"""


@pytest.mark.slow
def test_e8_processes_and_an_empty_kernel_cache_agree(device, tmp_path, request):
    here = wd.Renderer(room(), width=SIZE[0], height=SIZE[1], device=device, outputs=("color", "depth", "instance_id"))
    code = CODE.format(tests=str(request.path.parent), device=device)
    found = {digest(here.render())}
    for environment in ({}, {"WARP_CACHE_PATH": str(tmp_path / "cache")}):
        done = subprocess.run(
            [sys.executable, "-c", code], env=os.environ | environment, capture_output=True, text=True, timeout=600
        )
        assert done.returncode == 0, done.stderr
        found.add(done.stdout.split()[-1])
    assert len(found) == 1 and any((tmp_path / "cache").rglob("*wp_*")), "the cache was not empty, or not used"


@pytest.mark.gpu
def test_e8_streams_agree(cuda_device):
    renderer = renderer_of(everything(), cuda_device, ("color", "depth", "display"), wd.Settings())
    expected = images(renderer.render())
    for _ in range(3):
        stream = wp.Stream(cuda_device)
        with wp.ScopedStream(stream):
            found = images(renderer.render())
            wp.synchronize_stream(stream)
        assert_same(expected, found)
    fresh = wp.Stream(cuda_device)
    with wp.ScopedStream(fresh):
        assert_same(expected, images(renderer_of(everything(), cuda_device, tuple(expected), wd.Settings()).render()))


def test_e8_a_view_of_a_batch_of_any_size_is_the_same(device):
    scene = everything()
    outputs = ("color", "depth", "display", "instance_id")
    renderer = renderer_of(scene, device, outputs, wd.Settings())
    alone = images(renderer.render())
    for count in (2, 3, 7):
        frame = renderer.render([scene.camera] * count)
        for view in (0, count - 1):
            assert_same(alone, images(frame, view))


def test_renderers_of_one_process_do_not_disturb_one_another(device):
    one, two = renderer_of(gallery(), device), renderer_of(room(), device)
    expected = images(one.render()), images(two.render())
    for _ in range(3):
        assert_same(expected[0], images(one.render()))
        assert_same(expected[1], images(two.render()))


def test_threads_with_a_renderer_each_do_not_disturb_one_another(device):
    builds = [gallery, room, gallery, room]
    renderers = [renderer_of(build(), device, threads=k % 3 + 1) for k, build in enumerate(builds)]
    expected = [images(renderer.render()) for renderer in renderers]
    failures, start = [], threading.Barrier(len(builds))
    # Warp's current stream belongs to the device, not to the thread: on CUDA all share it.
    stream = wp.get_stream(device) if wp.get_device(device).is_cuda else None

    def work(k):
        try:
            start.wait()
            for _ in range(8):
                assert_same(expected[k], images(renderers[k].render()))
            # One of the thread's own, which is planned, and on CUDA captured, while the others render.
            assert_same(expected[k], images(renderer_of(builds[k](), device, threads=2).render()))
        except BaseException as error:
            failures.append((k, error))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(renderers))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    assert stream is None or wp.get_stream(device) is stream
