"""Real files end to end: what a stranger would call right, as far as numbers can tell. Skipped without the folder."""

import numpy as np
import pytest
from builders import images

import warp_deferred as wd

NAMES = ("color", "display", "alpha", "depth", "normal", "albedo", "instance_id", "triangle_id")
SIZE = (160, 90)
FILES = ("DamagedHelmet.glb", "Duck.glb", "CesiumMilkTruck.glb", "capsule.obj", "bunny.ply")


@pytest.fixture(scope="module")
def rendered(assets):
    """Each file's scene and image, rendered once on the CPU."""
    cache = {}

    def get(name):
        if name not in cache:
            scene = wd.load(assets / name)
            renderer = wd.Renderer(scene, width=SIZE[0], height=SIZE[1], device="cpu", outputs=NAMES)
            cache[name] = scene, images(renderer.render())
        return cache[name]

    return get


@pytest.mark.parametrize("name", FILES)
def test_a_file_fills_a_plausible_part_of_the_picture(name, rendered):
    scene, image = rendered(name)
    assert scene.triangle_count > 0 and scene.camera is not None
    inside = image["instance_id"] >= 0
    assert 0.03 <= inside.mean() <= 0.9
    rows, columns = np.nonzero(inside)
    assert abs(rows.mean() - SIZE[1] / 2) < 0.2 * SIZE[1] and abs(columns.mean() - SIZE[0] / 2) < 0.2 * SIZE[0]
    border = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    assert border.mean() < 0.5, "it should be framed"
    for layer in ("color", "normal", "albedo"):
        assert np.isfinite(image[layer]).all(), layer
    assert np.array_equal(np.isfinite(image["depth"]), inside) and image["depth"].min() > 0.0
    length = np.linalg.norm(image["normal"], axis=2)
    assert np.abs(length[inside] - 1.0).max() <= 1e-4
    facing = image["normal"][inside] @ np.array(scene.camera.rotation).reshape(3, 3)[2]
    assert facing.mean() > 0.3, "normals should face the viewer"
    luminance = image["color"][inside].mean()
    assert 0.02 <= luminance <= 5.0
    picture = image["display"][..., :3][inside].astype(float)
    assert 25 <= picture.mean() <= 230 and picture.std() > 10, "neither black nor white nor flat"


def test_the_duck_is_yellow(rendered):
    scene, image = rendered("Duck.glb")
    assert len(scene.instances) == 1 and scene.triangle_count == 4212
    red, green, blue = image["albedo"][image["instance_id"] == 0].mean(axis=0)
    assert red > green > 2.0 * blue and red > 0.4


def test_the_truck_has_a_body_and_four_wheels(rendered):
    scene, image = rendered("CesiumMilkTruck.glb")
    assert len(scene.instances) == 5
    wheels = [i for i in scene.instances if sum(j.mesh is i.mesh for j in scene.instances) == 2]
    assert len(wheels) == 2, "both axles share one mesh"
    assert len({id(i.mesh) for i in scene.instances}) == 4
    seen = np.unique(image["instance_id"])
    assert len(seen[seen >= 0]) >= 4


def test_the_helmet_is_textured_and_detailed(rendered):
    scene, image = rendered("DamagedHelmet.glb")
    assert len(scene.instances) == 1 and scene.triangle_count > 10_000
    material = scene.instances[0].material
    assert all(texture is not None for texture in material.textures)
    inside = image["instance_id"] == 0
    assert image["albedo"][inside].std() > 0.05
    assert len(np.unique(image["triangle_id"][inside])) > 800


def test_the_capsule_wears_its_texture(rendered):
    scene, image = rendered("capsule.obj")
    assert scene.instances[0].material.base_color_texture is not None
    assert image["albedo"][image["instance_id"] == 0].std() > 0.03


def test_the_bunny_is_smooth(rendered):
    scene, image = rendered("bunny.ply")
    inside = image["instance_id"] == 0
    both = inside[:, 1:] & inside[:, :-1]
    turn = (image["normal"][:, 1:] * image["normal"][:, :-1]).sum(axis=2)[both]
    assert np.median(turn) > 0.95 and scene.triangle_count > 1000


@pytest.mark.gpu
@pytest.mark.parametrize("name", FILES)
def test_e9_files_look_the_same_on_cuda(name, assets, rendered, cuda_device):
    scene, expected = rendered(name)
    renderer = wd.Renderer(scene, width=SIZE[0], height=SIZE[1], device=cuda_device, outputs=NAMES)
    image = images(renderer.render())
    for layer in ("instance_id", "triangle_id", "depth", "alpha"):
        assert np.array_equal(image[layer], expected[layer]), layer
    steps = np.abs(image["display"].astype(int) - expected["display"].astype(int)).max(axis=2)
    # A thousandth of linear contrast, by which texture filters differ, is some three codes in the darks.
    assert (steps > 6).mean() <= 0.005
