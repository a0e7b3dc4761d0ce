"""Hard cases of light culling and light sums: C rows, P6, P10, B5."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from pixel_scenes import assert_same, render

import warp_deferred as wd

WIDTH, HEIGHT = 83, 61
OUTPUTS = ("color", "light_count")
RUNGS = (
    ("light_culling.rung=tiles",),
    ("light_culling.rung=tiles_depth",),
    ("light_culling.rung=tiles_depth", "light_culling.tile_size=8"),
    ("light_culling.rung=tiles", "light_culling.tile_size=64"),
)
CAMERA = wd.Camera.look_at((0.5, 1.7, 6.0), (0.0, 0.5, 0.0), near=0.05)
MATERIAL = wd.Material(base_color=(0.8, 0.7, 0.6, 1.0), roughness=0.5)


def room() -> wd.Scene:
    """A floor, a ball near the camera, a wall behind, and sky above: depth jumps in most tiles."""
    scene = wd.Scene()
    floor, ball, wall = reference.quad(30.0), reference.sphere(0.8, 10, 14), reference.quad(6.0)
    scene.add(wd.Mesh(floor.positions, floor.triangles), material=MATERIAL)
    moved = np.eye(4)
    moved[:3, 3] = (0.3, 0.9, 2.0)
    scene.add(wd.Mesh(ball.positions, ball.triangles, smooth=True), material=MATERIAL, transform=moved)
    upright = np.eye(4)
    upright[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    upright[:3, 3] = (-4.0, -3.0, -12.0)
    scene.add(wd.Mesh(wall.positions, wall.triangles), material=MATERIAL, transform=upright)
    return scene


def add_lights(scene: wd.Scene, rng: np.random.Generator, count: int) -> wd.Scene:
    """Point and spot lights strewn through the room, behind the camera and around its near plane."""
    for k in range(count):
        place = rng.uniform((-8.0, -0.5, -14.0), (8.0, 5.0, 9.0))
        if k % 5 == 0:
            place = np.array(CAMERA.position) + rng.normal(size=3) * 0.4
        fields = {
            "position": tuple(place),
            "intensity": float(rng.uniform(0.5, 5.0)),
            "range": float(2.0 ** rng.uniform(-1.0, 3.5)),
            "color": tuple(rng.uniform(0.2, 1.0, 3)),
        }
        if k % 2:
            direction = rng.normal(size=3)
            outer = float(rng.uniform(0.05, 1.5))
            scene.lights.add(
                wd.SpotLight(direction=tuple(direction), outer_angle=outer, inner_angle=0.3 * outer, **fields)
            )
        else:
            scene.lights.add(wd.PointLight(**fields))
    return scene


def lit(scene: wd.Scene, camera=CAMERA, settings=(), size=(WIDTH, HEIGHT), device: str = "cpu"):
    return render(scene, camera, *size, outputs=OUTPUTS, settings=settings, device=device)


def check_rungs(scene: wd.Scene, camera: wd.Camera, device: str, size=(WIDTH, HEIGHT), least: int = 1):
    """Every rung of culling gives the bits of brute force; some pixel sees `least` lights. Returns the image."""
    brute = lit(scene, camera, ("light_culling.rung=brute_force",), size, device)
    assert brute["light_count"].max() >= least and np.isfinite(brute["color"]).all()
    for settings in RUNGS:
        assert_same(brute, lit(scene, camera, settings, size, device))
    return brute


@pytest.mark.parametrize("count", [2, 60, 400])
def test_c1_culled_lights_equal_brute_force(count, device, rng):
    image = check_rungs(add_lights(room(), rng, count), CAMERA, device, least=1 if count < 60 else 3)
    assert image["light_count"].max() < count or count == 2


@pytest.mark.parametrize("place", ["inside", "behind", "near_plane", "eye_plane", "huge"])
def test_c2_lights_around_the_eye(place, device):
    eye = np.array(CAMERA.position)
    right, _, back = np.array(CAMERA.rotation).reshape(3, 3)
    offset, reach = {
        "inside": (0.2 * right, 9.0),
        "behind": (6.0 * back, 10.0),
        "near_plane": (-0.05 * back + 3.0 * right, 5.5),
        "eye_plane": (4.0 * right, 6.0),
        "huge": (50.0 * back + 300.0 * right, 1e4),
    }[place]
    scene = room()
    gain = 10.0 if place != "huge" else 1e5
    scene.lights.add(wd.PointLight(position=tuple(eye + offset), range=reach, intensity=gain))
    towards = tuple(np.array([0.0, 0.5, 0.0]) - eye - offset)
    scene.lights.add(
        wd.SpotLight(position=tuple(eye + offset), direction=towards, range=reach, intensity=gain, outer_angle=1.2)
    )
    image = check_rungs(scene, CAMERA, device)
    assert (image["light_count"] > 0).mean() > 0.05


def test_c2_orthographic_views_miss_nothing(device, rng):
    camera = wd.Camera.look_at(
        (3.0, 4.0, 9.0), (0.0, 0.0, 0.0), projection="orthographic", vertical_extent=9.0, near=-2.0, far=40.0
    )
    check_rungs(add_lights(room(), rng, 80), camera, device)


def test_c2_off_centre_views_miss_nothing(device, rng):
    camera = CAMERA.replace(intrinsics=(60.0, 75.0, -20.0, 12.0), image_size=(WIDTH, HEIGHT))
    check_rungs(add_lights(room(), rng, 80), camera, device)


def flat(depths: list[float]) -> wd.Scene:
    """Small squares before the camera at the origin, each at its own depth and its own direction."""
    scene = wd.Scene()
    for k, depth in enumerate(depths):
        x = (k - 0.5 * (len(depths) - 1)) * 0.25
        square = np.array([[-0.1, -0.4, -1.0], [0.1, -0.4, -1.0], [0.1, 0.4, -1.0], [-0.1, 0.4, -1.0]])
        square[:, 0] += x
        scene.add(wd.Mesh((square * depth).astype(np.float32), [[0, 1, 2], [0, 2, 3]]), material=MATERIAL)
    return scene


def test_c4_depth_jumps_and_sky(device):
    depths = [0.1, 1e5, 0.2, 1e4, 1.0]
    scene = flat(depths)
    for k, depth in enumerate(depths):
        place = ((k - 2) * 0.25 * depth, 0.0, -0.9 * depth)
        scene.lights.add(wd.PointLight(position=place, range=0.5 * depth, intensity=depth * depth))
        spot = wd.SpotLight(position=(0.0, 0.0, 0.0), direction=(*place[:2], -depth), range=2 * depth, outer_angle=0.1)
        scene.lights.add(spot.replace(intensity=depth * depth))
    image = check_rungs(scene, wd.Camera(near=0.01), device)
    assert (image["light_count"].max(axis=0) > 0).sum() >= 5


def test_c4_one_pixel_of_sky_or_of_surface_in_a_tile(device, rng):
    # A speck far away in an empty tile, and a pinhole of sky in a full one.
    scene = wd.Scene()
    speck = np.array([[0.0, 0.0, -40.0], [1.0, 0.0, -40.0], [1.0, 1.0, -40.0], [0.0, 1.0, -40.0]])
    scene.add(wd.Mesh(speck, [[0, 1, 2], [0, 2, 3]]), material=MATERIAL)
    outer = np.array([[-2.0, -1.5], [-0.2, -1.5], [-0.2, 1.5], [-2.0, 1.5]])
    hole = np.array([[-1.04, -0.04], [-0.96, -0.04], [-0.96, 0.04], [-1.04, 0.04]])
    ring = np.concatenate([np.concatenate([outer, hole]), np.full((8, 1), -2.0)], axis=1)
    faces = [f for k in range(4) for f in ([k, (k + 1) % 4, 4 + k], [(k + 1) % 4, 4 + (k + 1) % 4, 4 + k])]
    scene.add(wd.Mesh(ring, faces), material=MATERIAL)
    scene.lights.add(
        wd.PointLight(position=(0.5, 0.5, -39.0), range=2.0), wd.PointLight(position=(-1.0, 0.0, -1.5), range=1.0)
    )
    scene.lights.add(wd.SpotLight(position=(0.5, 0.5, 0.0), direction=(0.0, 0.0, -1.0), outer_angle=0.02, range=50.0))
    image = check_rungs(scene, wd.Camera(), device)
    sky = image["light_count"] == 0
    assert 0 < (~sky).sum() < sky.size and not image["color"][sky & (image["color"].max(axis=-1) > 0)].size


def test_c4_empty_sky_is_background(device, rng):
    scene = add_lights(wd.Scene(), rng, 10)
    scene.environment = wd.Environment(background=(0.25, 0.5, 1.0))
    image = lit(scene, device=device)
    assert (image["color"] == np.array([0.25, 0.5, 1.0], np.float32)).all() and not image["light_count"].any()


@pytest.mark.parametrize("count", [0, 1, 31, 32, 33, 64, 65, 1024, 1025, 3200])
def test_c5_counts_around_mask_words(count, device):
    # Many lights that all reach: none may be dropped at the end of a word, a summary word or a capacity.
    scene = room()
    scene.environment = wd.Environment(ambient=(0.1, 0.1, 0.1))
    scene.lights.extend("point", count, position=(0.0, 3.0, 3.0), range=100.0, intensity=1.0)
    image = lit(scene, size=(24, 16), device=device)
    seen = image["light_count"][-1]
    assert (seen == count).all()
    assert_same(image, lit(scene, settings=("light_culling.rung=brute_force",), size=(24, 16), device=device))


def test_c5_adding_and_clearing_lights_keeps_the_rest(device):
    scene = room()
    renderer = wd.Renderer(scene, width=24, height=16, outputs=OUTPUTS, device=device)
    for count in (3, 40, 0, 33, 1):
        scene.lights.clear()
        scene.lights.extend("point", count, position=(0.0, 3.0, 3.0), range=100.0, intensity=1.0)
        assert (renderer.render(CAMERA).numpy("light_count")[0][-1] == count).all(), count


@pytest.mark.parametrize("size", [(1, 1), (15, 17), (16, 16), (65, 3), (129, 130)])
def test_c6_sizes_off_the_tile_grid(size, device, rng):
    check_rungs(add_lights(room(), rng, 60), CAMERA, device, size, least=0)


def test_c7_extreme_lights_stay_finite(device):
    scene = room()
    for position in ((0.0, 0.0, 0.0), (0.3, 1.7, 2.0), CAMERA.position):
        for reach in (1e-6, 5.0, 1e9, np.inf):
            for intensity in (1e-8, 1e8, 1e30):
                scene.lights.add(wd.PointLight(position=position, range=reach, intensity=intensity))
                scene.lights.add(wd.SpotLight(position=position, range=reach, intensity=intensity, outer_angle=1e-3))
    image = check_rungs(scene, CAMERA, device)
    assert (image["color"] >= 0.0).all()


BAD_LIGHTS = [
    (wd.PointLight, {"position": (0.0, np.nan, 0.0)}, "position"),
    (wd.PointLight, {"position": (0.0, np.inf, 0.0)}, "position"),
    (wd.PointLight, {"intensity": -1.0}, "intensity"),
    (wd.PointLight, {"intensity": np.nan}, "intensity"),
    (wd.PointLight, {"intensity": np.inf}, "intensity"),
    (wd.PointLight, {"range": -1.0}, "range"),
    (wd.PointLight, {"range": 0.0}, "range"),
    (wd.PointLight, {"range": np.nan}, "range"),
    (wd.PointLight, {"color": (1.0, -1.0, 1.0)}, "color"),
    (wd.PointLight, {"color": (1.0, np.nan, 1.0)}, "color"),
    (wd.PointLight, {"source_radius": 0.0}, "source_radius"),
    (wd.SpotLight, {"direction": (0.0, 0.0, 0.0)}, "direction"),
    (wd.SpotLight, {"direction": (np.nan, 0.0, 0.0)}, "direction"),
    (wd.SpotLight, {"outer_angle": 0.0}, "outer_angle"),
    (wd.SpotLight, {"inner_angle": 1.0, "outer_angle": 0.5}, "angle"),
    (wd.DirectionalLight, {"direction": (0.0, 0.0, 0.0)}, "direction"),
    (wd.DirectionalLight, {"intensity": -0.5}, "intensity"),
]


@pytest.mark.parametrize(("kind", "fields", "name"), BAD_LIGHTS)
def test_c8_bad_lights_are_named(kind, fields, name):
    with pytest.raises(ValueError, match=name) as error:
        kind(**fields)
    assert isinstance(error.value, wd.InputError) and "expected" in str(error.value)


@pytest.mark.parametrize(
    ("field", "value"), [("position", [[np.nan, 0, 0]]), ("intensity", [-1.0]), ("range", [0.0]), ("range", [np.nan])]
)
def test_c8_bad_arrays_of_lights_are_named(field, value):
    scene = wd.Scene()
    scene.lights.add(wd.PointLight())
    with pytest.raises(wd.InputError, match=field):
        setattr(scene.lights.point, field, np.array(value))


def test_p6_lights_that_miss_change_nothing(device, rng):
    base = lit(add_lights(room(), rng, 20), device=device)
    scene = add_lights(room(), np.random.default_rng(20240607), 20)
    right = np.array(CAMERA.rotation).reshape(3, 3)[0]
    for k in range(30):
        outside = np.array(CAMERA.position) + right * (60.0 + k)
        scene.lights.add(wd.PointLight(position=tuple(outside), range=20.0, intensity=1e6))
        scene.lights.add(wd.PointLight(position=(0.0, 1.0, 3.0), intensity=0.0))
        scene.lights.add(wd.SpotLight(position=(0.0, 1.0, 3.0), direction=(0.0, 1.0, 0.0), outer_angle=0.2, range=40.0))
        scene.lights.add(wd.SpotLight(position=(0.0, 2.0, 3.0), world=7, intensity=1e6))
    image = lit(scene, CAMERA.replace(world=0), device=device)
    assert_same(base, image)


def test_p10_light_adds_up(device, rng):
    scene = add_lights(room(), rng, 12)
    whole = lit(scene, device=device)
    fields = {}
    for kind, group in scene.lights.groups():
        fields[kind] = group.intensity.copy() if len(group) else None
    for kind, group in scene.lights.groups():
        if len(group):
            group.intensity = fields[kind] * 2.0
    twice = lit(scene, device=device)
    assert np.array_equal(twice["color"], 2.0 * whole["color"])
    total = np.zeros(whole["color"].shape)
    for kind, group in scene.lights.groups():
        for k in range(len(group)):
            for other, rest in scene.lights.groups():
                if len(rest):
                    rest.intensity = np.where((np.arange(len(rest)) == k) & (other == kind), fields[other], 0.0)
            total += lit(scene, device=device)["color"]
    assert (np.abs(total - whole["color"]) <= 1e-6 * np.abs(total)).all()
    assert total.max() > 0.0
