"""Bound points from frame to frame: nothing compiled or allocated anew, nothing there without them, and bad ones."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from builders import Spy, assert_same, box, gallery, grid, images, sphere
from point_scenes import NAN, as_vectors, remade, render, renderer_of, scene_of, wave

import warp_deferred as wd


def test_points_that_move_every_frame_make_nothing_new(device):
    mesh = grid(20, 2.0, smooth=True)
    scene = scene_of(mesh, copies=2)
    arrays = [as_vectors(wave(mesh.positions, 0.7 * k), device) for k in range(5)]
    scene.bind_points(mesh, arrays[0])
    renderer = renderer_of(scene, device)
    seen = [images(renderer.render())]
    plan = renderer.plan
    frames = []
    for array in arrays[1:]:
        with Spy() as spy:
            scene.bind_points(mesh, array)
            frame = renderer.render()
        spy.assert_nothing()
        seen.append(images(frame))
        frames.append(renderer.plan is plan)
    assert all(frames)
    # Written in place, without a word to the scene.
    arrays[-1].assign(arrays[0])
    with Spy() as spy:
        frame = renderer.render()
    spy.assert_nothing()
    assert_same(seen[0], images(frame))
    for k, image in enumerate(seen):
        other = scene_of(mesh, copies=2)
        other.bind_points(mesh, as_vectors(wave(mesh.positions, 0.7 * k), device))
        assert_same(render(other, device), image)
    assert not np.array_equal(seen[0]["depth"], seen[1]["depth"])


def test_numpy_points_are_copied_when_they_are_bound(device):
    mesh = grid(6, 2.0)
    points = wave(mesh.positions)
    scene = scene_of(mesh)
    scene.bind_points(mesh, points)
    renderer = renderer_of(scene, device)
    first = images(renderer.render())
    points += 1.0
    assert_same(first, images(renderer.render()))
    scene.bind_points(mesh, wave(mesh.positions, 1.0))
    second = images(renderer.render())
    assert_same(render(scene_of(remade(mesh, wave(mesh.positions, 1.0))), device), second)
    # A device array in between must not hide that the host's array is new to the staging.
    scene.bind_points(mesh, as_vectors(wave(mesh.positions, 2.0), device))
    renderer.render()
    scene.bind_points(mesh, wave(mesh.positions, 1.0))
    assert_same(second, images(renderer.render()))


def test_unbinding_brings_the_mesh_back_to_the_bit(device):
    mesh = sphere(12, 0.8)
    scene = scene_of(mesh)
    renderer = renderer_of(scene, device)
    before = images(renderer.render())
    scene.bind_points(mesh, as_vectors(wave(mesh.positions), device))
    assert not np.array_equal(images(renderer.render())["depth"], before["depth"])
    scene.bind_points(mesh, None)
    assert_same(before, images(renderer.render()))
    assert renderer.plan.passes[0].name == "clusters"


def test_only_a_binding_calls_for_the_pass(device):
    scene = scene_of(grid(6, 2.0))
    renderer = renderer_of(scene, device)
    renderer.render()
    assert "points" not in [p.name for p in renderer.plan.passes] and "points" not in renderer.plan.memory
    assert "points" not in [report.name for report in renderer.plan.reports(False)]
    mesh = scene.instances[1].mesh
    scene.bind_points(mesh, as_vectors(mesh.positions, device))
    renderer.render()
    report = renderer.plan.reports(False)[0]
    assert report.name == "points" and report.runs and report.reason == "1 mesh takes points from arrays"
    assert report.bytes > 32 * len(mesh.positions)


def test_without_a_binding_its_kernels_are_not_even_imported():
    code = (
        "import sys, warp_deferred as wd; s = wd.Scene(); s.add(wd.Mesh([[0,0,0],[1,0,0],[0,1,0]], [[0,1,2]]));"
        "s.camera = wd.Camera.look_at((0, 0, 3), (0, 0, 0));"
        "wd.Renderer(s, width=8, height=8, device='cpu', outputs=('depth',)).render();"
        "print([m for m in sys.modules if m.endswith(('kernels.points', 'point_store'))])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip().splitlines()[-1] == "[]"


def test_points_that_do_not_fit_are_refused(device):
    mesh, other = grid(6, 2.0), box()
    scene = scene_of(mesh)
    count = len(mesh.positions)
    for array in (
        as_vectors(np.zeros((count + 1, 3)), device),
        wp.zeros((count, 4), dtype=wp.float32, device=device),
        np.zeros((count, 2)),
        np.full((count, 3), NAN),
        np.full((count, 3), 1e300),
        "points",
    ):
        with pytest.raises(wd.InputError, match=r"Scene\.bind_points"):
            scene.bind_points(mesh, array)
    assert not scene.point_bindings
    for meshes in (other, [], [mesh, mesh], 5, None):
        with pytest.raises(wd.InputError, match="meshes of this scene"):
            scene.bind_points(meshes, as_vectors(np.zeros((count, 3)), device))
    scene.add(other)
    scene.bind_points([mesh, other], np.zeros((count + 8, 3)))
    with pytest.raises(wd.InputError, match="alone or together"):
        scene.bind_points(mesh, None)
    scene.bind_points([mesh, other], None)
    for dtype in (wp.float64, wp.int32):
        scene.bind_points(mesh, wp.zeros((count, 3), dtype=dtype, device=device))
        with pytest.raises(wd.InputError, match="float32"):
            render(scene, device)
    scene.bind_points(mesh, wp.zeros(count, dtype=wp.float32, device=device))
    with pytest.raises(wd.InputError, match="shape"):
        render(scene, device)


def test_an_array_that_speaks_no_dlpack_is_refused_by_name(device):
    class Speechless:
        shape = (49, 3)
        __cuda_array_interface__ = None

    mesh = grid(6, 2.0)
    scene = scene_of(mesh)
    scene.bind_points(mesh, Speechless())
    with pytest.raises(wd.InputError, match="Speechless"):
        render(scene, device)


def test_clearing_the_scene_unbinds(device):
    scene = gallery()
    mesh = scene.instances[1].mesh
    scene.bind_points(mesh, as_vectors(mesh.positions, device))
    renderer = renderer_of(scene, device)
    renderer.render()
    scene.clear()
    assert not scene.point_bindings and np.all(images(renderer.render())["instance_id"] == -1)
