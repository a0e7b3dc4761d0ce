"""A frame after the first one only replays: it loads no module, makes no kernel, allocates nothing, builds no plan."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from builders import FULL, LAYERS, Spy, assert_same, box, gallery, images, tilt

import warp_deferred as wd
from warp_deferred.program import Program


def renderer_of(scene, device, **fields):
    return wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL, **fields)


def move_everything(scene, k):
    """Move camera, lights and instances; change colours, powers, ambient light and exposure."""
    scene.camera = wd.Camera.look_at((0.6 - 0.3 * k, 1.9, 4.6), (0.0, 0.7, 0.1 * k), exposure=0.5 * k)
    for kind, group in scene.lights.groups():
        group.intensity = group.intensity * (1.0 + 0.1 * k)
        group.color = group.color[:, ::-1]
        if kind != "directional":
            group.position = group.position + np.array([0.1 * k, 0.0, 0.05])
            group.range = group.range * 1.5
    for n, item in enumerate(scene.instances):
        item.transform = tilt(0.0, 3.0 * k, 1.0, (0.0, 0.02 * n, 0.0)) @ item.transform
    scene.environment = wd.Environment(ambient=(0.1 + 0.1 * k, 0.1, 0.1), background=(0.0, 0.1 * k, 0.0))


def test_the_spy_sees_what_it_watches(device):
    with Spy() as spy:
        renderer_of(gallery(), device).render()
    assert spy.plans == 1 and spy.allocated
    with Spy() as spy:
        wp.zeros(3, device=device)
    assert len(spy.allocated) == 1 and not spy.plans

    def nothing_kernel():
        pass

    with Spy() as spy:
        kernel = wp.Kernel(nothing_kernel, module=wp.get_module("spied"))
        wp.launch(kernel, dim=1, device=device)
    assert spy.kernels == ["nothing_kernel"] and len(spy.loaded) == 1


def test_a_second_frame_makes_nothing_new(device):
    scene = gallery()
    renderer = renderer_of(scene, device)
    first = images(renderer.render())
    with Spy() as spy:
        for k in (1, 2, 3):
            move_everything(scene, k)
            renderer.render()
    spy.assert_nothing()
    last = images(renderer.render())
    assert not np.array_equal(first["color"], last["color"])
    assert_same(images(renderer_of(scene, device).render()), last)


def test_a_second_batch_makes_nothing_new(device):
    scene = gallery()
    for world in range(4):
        scene.add(box(0.5), transform=tilt(0.0, 20.0 * world, 1.0, (0.3 * world, 1.5, 0.5)), world=world)
    renderer = renderer_of(scene, device)
    cameras = [scene.camera.replace(world=k) for k in (0, 1, 2)]
    renderer.render(cameras)
    with Spy() as spy:
        moved = [c.replace(position=(0.1, 2.0, 4.0)) for c in cameras]
        frame = renderer.render(moved)
    spy.assert_nothing()
    many = images(frame, 2)
    with Spy() as spy:
        renderer.render([scene.camera.replace(world=k) for k in (3, 1, 0)])
    spy.assert_nothing()
    assert_same(images(renderer_of(scene, device).render(moved[2])), many)


def test_what_changes_the_plan_is_looked_up_again(device):
    scene = gallery()
    renderer = renderer_of(scene, device)
    before = images(renderer.render())
    cameras = [scene.camera, scene.camera.replace(exposure=1.0)]
    renderer.render(cameras)
    with Spy() as spy:
        assert_same(before, images(renderer.render()))
        renderer.render(cameras)
    assert not spy.plans and not spy.loaded and not spy.kernels


def test_lights_that_come_and_go_are_drawn(device):
    scene = gallery()
    renderer = renderer_of(scene, device)
    before = images(renderer.render())
    scene.lights.add(wd.PointLight(position=(0.0, 2.0, 3.0), intensity=20.0, range=6.0))
    brighter = images(renderer.render())
    assert brighter["color"].sum() > 1.05 * before["color"].sum()
    assert_same(images(renderer_of(scene, device).render()), brighter)
    scene.lights.clear()
    dark = images(renderer.render())
    assert not dark["diffuse"].any() and not dark["light_count"].any()
    scene.clear()
    assert np.all(images(renderer.render())["instance_id"] == -1)


def test_light_outputs_alone_call_for_nothing_else(device):
    scene = gallery()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=("depth",), settings=FULL)
    renderer.render()
    plan = renderer._plan
    assert [p.name for p in plan.passes] == ["clusters", "raster", "resolve"]
    names = {kernel.key for kernel, _ in plan.resources.program.kernels}
    assert not any("shade" in n or "mask" in n or "stage_lights" in n for n in names), names
    assert not any(n.startswith(("gbuffer", "mask", "emission")) for n in plan.memory)
    deep = images(renderer.render())["depth"]
    assert np.array_equal(deep, images(renderer_of(scene, device).render())["depth"])


def test_an_output_outlives_its_renderer(device):
    scene = gallery()
    color = renderer_of(scene, device).render()["color"]
    kept = color.numpy().copy()
    # Memory that nobody holds would be handed out again here.
    others = [wp.full(color.size, value=7.0, dtype=wp.vec3, device=device) for _ in range(4)]
    assert np.array_equal(color.numpy(), kept) and len(others) == 4


def test_settings_are_changed_and_prepared_for_a_camera(device):
    scene = gallery()
    camera = scene.camera.replace(bloom=0.2)
    renderer = renderer_of(scene, device)
    renderer.prepare(camera=camera)
    assert any(stage.name == "bloom" for stage in renderer.plan.passes) == ("display" in renderer.outputs)
    with Spy() as spy:
        renderer.render(camera)
    assert not spy.plans
    full = images(renderer.render(camera))
    renderer.settings = FULL.with_values(["gbuffer.rung=compact"])
    assert renderer.settings.gbuffer.rung == "compact"
    assert not np.array_equal(images(renderer.render(camera))["color"], full["color"])
    renderer.settings = None
    assert renderer.settings is scene.settings
    renderer.settings = FULL
    assert_same(images(renderer.render(camera)), full)
    with pytest.raises(wd.InputError, match=r"Renderer\.settings: expected a Settings object, got 'str'"):
        renderer.settings = "draft"
    assert renderer.cameras_of(None) == [scene.camera] and renderer.cameras_of([camera, camera]) == [camera] * 2


# ---- loading


def loading(loads, threads):
    """A program whose kernels' modules load as told."""
    program = Program(wp.get_device("cpu"), threads)
    program.kernels = [
        (SimpleNamespace(key=f"make__{name}_kernel", module=SimpleNamespace(name=name, load=load)), 64)
        for name, load in loads.items()
    ]
    return program


@pytest.mark.parametrize("threads", [1, 2])
def test_modules_load_as_many_at_a_time_as_there_are_threads(threads):
    both, told, loaded = threading.Barrier(threads, timeout=20.0), [], []

    def load(device, block_dim):
        both.wait()
        loaded.append(block_dim)

    program = loading({name: load for name in ("cull", "raster", "shade", "show")}, threads)
    program.load(lambda *what: told.append(what))
    assert told == [("cull", 0, 4), ("raster", 1, 4), ("shade", 2, 4), ("show", 3, 4), ("", 4, 4)] and loaded == [1] * 4


def test_a_module_that_does_not_load_is_told_and_the_rest_is_left():
    loaded = []

    def fail(device, block_dim):
        raise RuntimeError("no compiler")

    first, rest = {"cull": fail}, {f"k{n}": lambda device, block_dim: loaded.append(1) for n in range(3)}
    with pytest.raises(RuntimeError, match="no compiler"):
        loading(first | rest, 1).load()
    assert not loaded
    with pytest.raises(RuntimeError, match="no compiler"):
        loading(first | rest, 2).load()
    loading(rest, 2).load()
    assert len(loaded) >= 3
