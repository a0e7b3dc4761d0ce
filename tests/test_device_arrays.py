"""Numbers handed in as device arrays: the same picture as from the host, no read-back, no new plan."""

import numpy as np
import pytest
import warp as wp
from builders import FULL, LAYERS, Spy, assert_same, box, gallery, images, tilt

import warp_deferred as wd

NAN, INF = float("nan"), float("inf")


def render(scene, device, camera=None, **fields):
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    return images(renderer.render(camera, **fields))


def lit(seed=3):
    """Return the gallery with ranges on all lights and float32 positions, so that host and device hold the same."""
    scene, rng = gallery(), np.random.default_rng(seed)
    for group in (scene.lights.point, scene.lights.spot):
        group.position = group.position.astype(np.float32)
        group.range = rng.uniform(3.0, 8.0, len(group)).astype(np.float32)
    return scene


def bind_all(scene, device, wrap):
    """Bind every field that may live on a device."""
    for kind, group in scene.lights.groups():
        for name in group.DYNAMIC:
            if name in group.FIELDS[kind]:
                setattr(group, name, wrap(np.array(getattr(group, name), np.float32), device))


def as_plain(values, device):
    return wp.array(values, dtype=wp.float32, device=device)


def as_vectors(values, device):
    return wp.array(values, dtype=wp.vec3 if values.ndim == 2 else wp.float32, device=device)


def as_strided(values, device):
    wide = wp.array(np.repeat(values, 2, axis=0), dtype=wp.vec3 if values.ndim == 2 else wp.float32, device=device)
    return wide[::2]


@pytest.mark.parametrize("wrap", [as_plain, as_vectors, as_strided])
def test_bound_lights_give_the_image_of_host_lights(wrap, device):
    expected = render(lit(), device)
    scene = lit()
    bind_all(scene, device, wrap)
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    assert_same(expected, images(renderer.render()))
    moved = lit(seed=4)
    for kind, group in scene.lights.groups():
        for name in [n for n in group.DYNAMIC if n in group.FIELDS[kind]]:
            setattr(group, name, wrap(np.array(getattr(getattr(moved.lights, kind), name), np.float32), device))
    assert_same(render(moved, device), images(renderer.render()))


def test_torch_lights_give_the_image_of_host_lights(device):
    torch = pytest.importorskip("torch")
    scene = lit()
    bind_all(scene, device, lambda values, d: torch.from_numpy(values).to("cuda" if d.startswith("cuda") else "cpu"))
    assert_same(render(lit(), device), render(scene, device))


def test_written_in_place_arrays_show_in_the_next_frame(device):
    scene = lit()
    position = as_vectors(scene.lights.point.position.astype(np.float32), device)
    scene.lights.point.position = position
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    renderer.render()
    moved = position.numpy() + np.float32((0.3, 0.2, -0.1))
    position.assign(moved)
    other = lit()
    other.lights.point.position = moved
    assert_same(render(other, device), images(renderer.render()))


def test_a_host_array_takes_over_from_a_bound_one(device):
    scene = lit()
    kept = scene.lights.point.position.copy()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    expected = images(renderer.render())
    scene.lights.point.position = as_vectors(np.full_like(kept, 100.0, dtype=np.float32), device)
    assert not np.array_equal(images(renderer.render())["color"], expected["color"])
    scene.lights.point.position = kept
    assert_same(expected, images(renderer.render()))


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize("field", ["position", "color", "intensity", "range", "direction"])
def test_c8_a_bound_light_that_is_not_finite_contributes_nothing(field, bad, device):
    kind = "spot" if field == "direction" else "point"
    if field == "range" and bad == INF:
        pytest.skip("a light without a range is a light")
    scene, without = lit(), lit()
    group = getattr(scene.lights, kind)
    values = np.array(getattr(group, field), np.float32)
    values.reshape(len(values), -1)[0, -1] = bad
    setattr(group, field, as_plain(values, device))
    quiet = np.array(getattr(without.lights, kind).intensity)
    quiet[0] = 0.0
    getattr(without.lights, kind).intensity = quiet
    for settings in (FULL, FULL.with_values(["light_culling.rung=brute_force"])):
        renderers = [
            wd.Renderer(s, width=64, height=48, device=device, outputs=LAYERS, settings=settings)
            for s in (without, scene)
        ]
        a, b = (images(r.render()) for r in renderers)
        assert np.isfinite(b["color"]).all()
        assert_same(a, b)


def matrices(scene):
    return np.stack([i.transform for i in scene.instances]).astype(np.float32)


def test_bound_matrices_give_the_image_of_host_transforms(device):
    scene = gallery()
    for item, matrix in zip(scene.instances, matrices(scene), strict=True):
        item.transform = matrix.astype(np.float64)
    expected = render(scene, device)
    values = matrices(scene)
    host = [i.transform for i in scene.instances]
    for item in scene.instances:
        item.transform = tilt(0.0, 0.0, 1.0, (0.0, 50.0, 0.0))
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    assert not np.array_equal(images(renderer.render())["color"], expected["color"])
    for array in (wp.array(values, dtype=wp.mat44, device=device), wp.array(values, dtype=wp.float32, device=device)):
        scene.bind_transforms(array)
        assert_same(expected, images(renderer.render()))
    scene.bind_transforms(None)
    for item, matrix in zip(scene.instances, host, strict=True):
        item.transform = matrix
    assert_same(expected, images(renderer.render()))


def test_unbinding_brings_the_host_transforms_back(device):
    scene = gallery()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    expected = images(renderer.render())
    moved = matrices(scene)
    moved[:, 0, 3] += 0.5
    scene.bind_transforms(wp.array(moved, dtype=wp.mat44, device=device))
    assert not np.array_equal(images(renderer.render())["depth"], expected["depth"])
    scene.bind_transforms(None)
    assert_same(expected, images(renderer.render()))


def test_bound_poses_give_the_image_of_matrices(device):
    scene = wd.Scene()
    angles, poses = np.radians([10.0, 60.0, 200.0]), []
    for k, angle in enumerate(angles):
        item = scene.add(box(0.8), material=wd.Material(model="lambert"))
        poses.append([k - 1.0, 0.1 * k, 0.0, 0.0, np.sin(angle / 2), 0.0, np.cos(angle / 2)])
        item.transform = tilt(0.0, np.degrees(angle), 1.0, poses[-1][:3])
    scene.camera = wd.Camera.look_at((0.3, 1.0, 4.0), (0.0, 0.0, 0.0))
    names = ("depth", "instance_id", "triangle_id", "normal")
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=names)
    expected = images(renderer.render())
    for array in (
        wp.array(np.float32(poses), dtype=wp.transform, device=device),
        # A quaternion of another length is the same rotation.
        wp.array(np.float32(poses) * np.float32([1, 1, 1, 3, 3, 3, 3]), dtype=wp.float32, device=device),
    ):
        scene.bind_transforms(array)
        actual = images(renderer.render())
        same = actual["triangle_id"] == expected["triangle_id"]
        assert same.mean() > 0.995, "quaternions round otherwise than matrices, but barely"
        near = same & np.isfinite(expected["depth"])
        assert np.abs(actual["depth"][near] / expected["depth"][near] - 1.0).max() <= 1e-4
        assert np.abs(actual["normal"] - expected["normal"])[near].max() <= 1e-5


@pytest.mark.parametrize("bad", [NAN, INF])
@pytest.mark.parametrize("place", [(0, 0), (1, 3), (2, 2)])
def test_a_transform_that_is_not_finite_hides_its_instance(bad, place, device):
    scene = gallery()
    values = matrices(scene)
    values[2][place] = bad
    scene.bind_transforms(wp.array(values, dtype=wp.mat44, device=device))
    image = render(scene, device)
    hidden = gallery()
    small = [i.transform for i in hidden.instances]
    for k, item in enumerate(hidden.instances):
        item.transform = tilt(0.0, 0.0, 1.0, (0.0, 0.0, 900.0)) if k == 2 else small[k].astype(np.float32)
    expected = render(hidden, device)
    assert 2 not in image["instance_id"]
    assert all(np.isfinite(image[name]).all() for name in LAYERS if name != "depth")
    assert_same(expected, image)


def pose_of(camera):
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = np.array(camera.rotation).reshape(3, 3).T
    pose[:3, 3] = camera.position
    return pose


def test_camera_poses_on_the_device_replace_the_host_s(device):
    scene = gallery()
    cameras = [scene.camera, wd.Camera.look_at((-2.0, 1.5, 3.0), (0.0, 0.4, 0.0))]
    # The same numbers on both sides: float32 positions.
    cameras = [c.replace(position=tuple(float(np.float32(x)) for x in c.position)) for c in cameras]
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    frame = renderer.render(cameras)
    expected = [images(frame, k) for k in range(2)]
    poses = np.stack([pose_of(c) for c in cameras])
    elsewhere = [c.replace(position=(0.0, 90.0, 0.0)) for c in cameras]
    for array in (
        wp.array(poses, dtype=wp.mat44, device=device),
        wp.array(poses, dtype=wp.float32, device=device),
    ):
        frame = renderer.render(elsewhere, poses=array)
        for k in range(2):
            assert_same(expected[k], images(frame, k))
    assert not np.array_equal(images(renderer.render(elsewhere))["depth"], expected[0]["depth"])
    bad = poses.copy()
    bad[1, 0, 3] = NAN
    frame = renderer.render(elsewhere, poses=wp.array(bad, dtype=wp.mat44, device=device))
    assert_same(expected[0], images(frame, 0))
    assert np.all(images(frame, 1)["instance_id"] == -1) and np.isfinite(images(frame, 1)["color"]).all()


def test_new_pointers_each_frame_make_nothing_new(device):
    scene = lit()
    count = len(scene.instances)
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    kept = []

    def hand_in():
        lights = scene.lights
        kept.append(as_vectors(np.random.default_rng(len(kept)).uniform(0, 2, (len(lights.point), 3)), device))
        lights.point.position = kept[-1]
        kept.append(wp.array(matrices(gallery()), dtype=wp.mat44, device=device))
        scene.bind_transforms(kept[-1])
        kept.append(wp.array(pose_of(scene.camera)[None], dtype=wp.mat44, device=device))
        return kept[-1]

    renderer.render(poses=hand_in())
    for _ in range(3):
        poses = hand_in()
        with Spy() as spy:
            renderer.render(poses=poses)
        spy.assert_nothing()
    assert len({a.ptr for a in kept}) == len(kept) and count == len(scene.instances)


def test_device_arrays_that_do_not_fit_are_refused(device):
    scene = lit()
    count = len(scene.lights.point)
    with pytest.raises(wd.InputError, match=r"Lights.point.position.*shape"):
        scene.lights.point.position = wp.zeros(count + 1, dtype=wp.vec3, device=device)
    with pytest.raises(wd.InputError, match=r"Lights.point.position.*shape"):
        flat = lit()
        flat.lights.point.position = wp.zeros(count, dtype=wp.float32, device=device)
        render(flat, device)
    with pytest.raises(wd.InputError, match="may live on a device"):
        scene.lights.point.source_radius = wp.zeros(count, dtype=wp.float32, device=device)
    with pytest.raises(wd.InputError, match="bind_transforms"):
        scene.bind_transforms(wp.zeros((2, 4, 4), dtype=wp.float32, device=device))
    with pytest.raises(wd.InputError, match=r"Instance\.transform"):
        scene.bind_transforms(np.zeros((len(scene.instances), 4, 4)))
    renderer = wd.Renderer(scene, width=8, height=8, device=device, outputs=("depth",))
    with pytest.raises(wd.InputError, match="poses"):
        renderer.render(poses=wp.zeros((2, 4, 4), dtype=wp.float32, device=device))


@pytest.mark.parametrize("what", ["position", "intensity", "transforms", "poses"])
def test_device_arrays_of_another_number_type_are_refused_by_name(what, device):
    scene = lit()
    with pytest.raises(wd.InputError, match="float32"):
        if what == "position":
            scene.lights.point.position = wp.zeros((len(scene.lights.point), 3), dtype=wp.float64, device=device)
        elif what == "intensity":
            scene.lights.point.intensity = wp.zeros(len(scene.lights.point), dtype=wp.int32, device=device)
        elif what == "transforms":
            scene.bind_transforms(wp.zeros((len(scene.instances), 4, 4), dtype=wp.float64, device=device))
        poses = wp.zeros((1, 4, 4), dtype=wp.float64, device=device) if what == "poses" else None
        wd.Renderer(scene, width=8, height=8, device=device, outputs=LAYERS, settings=FULL).render(poses=poses)


def test_dlpack_reads_outputs_in_place(device):
    scene = gallery()
    renderer = wd.Renderer(scene, width=64, height=48, device=device, outputs=LAYERS, settings=FULL)
    frame = renderer.render()
    if device == "cpu":
        color = np.from_dlpack(frame["color"])
        assert color.shape == (1, 48, 64, 3) and color.dtype == np.float32
        assert color.ctypes.data == frame["color"].ptr
        assert np.array_equal(color, frame.numpy("color"))
        assert np.array_equal(np.from_dlpack(frame["instance_id"]), frame.numpy("instance_id"))
    back = wp.from_dlpack(frame["depth"])
    assert back.ptr == frame["depth"].ptr and back.shape == (1, 48, 64)


def test_dlpack_reads_outputs_in_place_in_torch(device):
    torch = pytest.importorskip("torch")
    frame = wd.Renderer(gallery(), width=64, height=48, device=device, outputs=LAYERS, settings=FULL).render()
    color = torch.from_dlpack(frame["color"])
    assert color.data_ptr() == frame["color"].ptr and tuple(color.shape) == (1, 48, 64, 3)
    assert np.array_equal(color.cpu().numpy(), frame.numpy("color"))


class Foreign:
    """An array of somebody else's that speaks only DLPack, as JAX's do."""

    def __init__(self, array):
        self._array = array

    shape = property(lambda self: self._array.shape)

    def __dlpack__(self, **fields):
        return self._array.__dlpack__(**fields)

    def __dlpack_device__(self):
        return self._array.__dlpack_device__()


def test_dlpack_arrays_are_taken_in(device):
    scene = lit()
    bind_all(scene, device, lambda values, d: Foreign(as_plain(values, d)))
    scene.bind_transforms(Foreign(as_plain(matrices(scene), device)))
    expected = lit()
    for item, matrix in zip(expected.instances, matrices(expected), strict=True):
        item.transform = matrix.astype(np.float64)
    assert_same(render(expected, device), render(scene, device))
