"""The built-in scenes: repeatable, countable, moving as they say, and right where the answer has a closed form."""

import gc
import importlib
import inspect
import weakref

import numpy as np
import pytest
from warp_deferred.scenes import (
    _hall,
    fullscreen_spots,
    furnace,
    glow,
    hundred_lights,
    lambert_plane,
    many_lights,
    shadows,
    spheres_50k,
    terrain,
    terrain_400k,
)
from warp_deferred.scenes._reach import PERIOD, camera_rays, range_for_mean

import warp_deferred as wd
from warp_deferred.errors import InputError
from warp_deferred.loading import built_in_scenes, load
from warp_deferred.settings import GBufferSettings, Settings, ShadeSettings

FULL = Settings(gbuffer=GBufferSettings(rung="full"), shade=ShadeSettings(radiance="float32"))
#: Small forms of every scene, by name.
SMALL = {
    "corner": "corner",
    "focus": "focus",
    "fullscreen_spots": "fullscreen_spots",
    "furnace": "furnace",
    "glow": "glow",
    "hundred_lights": "hundred_lights",
    "lambert_plane": "lambert_plane",
    "motion": "motion",
    "many_lights": "many_lights?lights=200&triangles=6000",
    "spheres_50k": "spheres_50k",
    "shadows": "shadows",
    "terrain": "terrain?triangles=5000&lights=100",
    "terrain_400k": "terrain_400k?triangles=5000",
}
MOVING = ("fullscreen_spots", "hundred_lights", "many_lights", "shadows", "spheres_50k", "terrain", "terrain_400k")


def arrays_of(scene):
    """All arrays of a scene, by a name of their own."""
    found = {}
    for k, instance in enumerate(scene.instances):
        found[f"{k}.transform"] = instance.transform
        for field in ("positions", "triangles", "normals", "uvs", "colors"):
            value = getattr(instance.mesh, field)
            if value is not None:
                found[f"{k}.{field}"] = value
    for kind, group in scene.lights.groups():
        for field in group.FIELDS[kind]:
            found[f"{kind}.{field}"] = getattr(group, field)
    return found


def light_state(scene):
    return np.concatenate([scene.lights.point.position.ravel(), scene.lights.spot.direction.astype(float).ravel()])


def test_all_built_in_scenes_are_listed_with_a_line():
    found = built_in_scenes()
    assert set(found) == set(SMALL)
    assert all(len(line) > 20 for line in found.values())


@pytest.mark.parametrize("name", SMALL)
def test_building_twice_gives_the_same_bits(name):
    one, two = arrays_of(load(SMALL[name])), arrays_of(load(SMALL[name]))
    assert one.keys() == two.keys()
    assert all(np.array_equal(one[key], two[key]) for key in one)


def test_another_seed_moves_the_lights():
    for name in ("many_lights?lights=50&triangles=6000&seed=", "terrain?triangles=800&lights=50&seed="):
        one, two = load(name + "0"), load(name + "1")
        assert not np.isclose(one.lights.point.position, two.lights.point.position).all(axis=1).any()


def test_hundred_lights_has_a_hundred_and_ninety_eight():
    scene = hundred_lights.build()
    counts = [len(group) for _, group in scene.lights.groups()]
    assert counts == [100, 98, 0]
    assert 100_000 < scene.triangle_count < 600_000
    for group in (scene.lights.point, scene.lights.spot):
        assert group.range.min() >= 2.0 and group.range.max() <= 8.0


@pytest.mark.parametrize("name", MOVING)
def test_animation_moves_every_light_keeps_counts_and_comes_back(name):
    scene = load(SMALL[name])
    period = getattr(importlib.import_module(f"warp_deferred.scenes.{name}"), "PERIOD", PERIOD)
    structure = scene.structure_revision, scene.lights.structure_revision
    start = light_state(scene)
    scene.animate(scene, 2.7)
    moved = light_state(scene)
    count = len(scene.lights.point), len(scene.lights.spot)
    assert (np.abs(moved - start).reshape(-1, 3).max(axis=1) > 1e-5).all() and sum(count) == len(start) // 3
    assert (scene.structure_revision, scene.lights.structure_revision) == structure
    scene.animate(scene, 2.7 + 1e-4)
    assert np.abs(light_state(scene) - moved).max() < 1e-3
    scene.animate(scene, period)
    assert np.allclose(light_state(scene), start, atol=1e-6)


def test_the_ball_of_a_light_goes_with_the_light():
    scene = hundred_lights.build()
    scene.animate(scene, 5.0)
    balls = np.array([i.transform[:3, 3] for i in scene.instances if i.mesh.name == "glow"])
    assert np.array_equal(balls, scene.lights.point.position)


def test_hundred_lights_assigns_one_array_a_kind():
    scene = hundred_lights.build()
    revision = scene.lights.revision
    scene.animate(scene, 1.0)
    assert scene.lights.revision - revision == 2


@pytest.mark.parametrize("name", MOVING)
def test_a_scene_that_moves_is_let_go(name):
    scene = load(SMALL[name])
    scene.animate(scene, 1.0)
    watch = weakref.ref(scene)
    del scene
    gc.collect()
    assert watch() is None


def test_animating_a_foreign_scene_says_whose_it_must_be():
    for module in (fullscreen_spots, hundred_lights, many_lights, shadows, spheres_50k, terrain_400k):
        with pytest.raises(InputError, match="build"):
            module.animate(wd.Scene(), 0.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("terrain?triangles=0", "terrain.triangles: expected a whole number from 2"),
        ("terrain?lights=-1", "terrain.lights"),
        ("terrain?mean=nan", "terrain.mean"),
        ("many_lights?lights=0", "many_lights.lights"),
        ("many_lights?lights=10&mean=6", "at most half of the lights"),
        ("many_lights?seed=x", "many_lights.seed"),
        ("furnace?radiance=-1", "furnace.radiance"),
        ("furnace?segments=2", "furnace.segments"),
        ("lambert_plane?height=0", "lambert_plane.height"),
        ("lambert_plane?tilt_deg=80", "see the sky"),
        ("glow?bloom=2", "glow.bloom"),
        ("hundred_lights?brightness=-2", "hundred_lights.brightness"),
        ("hundred_lights?sede=2", "did you mean 'seed'"),
        ("spheres_50k?lights=spots", "did you mean 'spot'"),
        ("spheres_50k?casts_shadow=2", "spheres_50k.casts_shadow"),
        ("terrain_400k?sun=-1", "terrain_400k.sun"),
        ("fullscreen_spots?intensity=inf", "fullscreen_spots.intensity"),
    ],
)
def test_bad_parameters_are_named(name, message):
    with pytest.raises(InputError, match=message):
        load(name)


@pytest.mark.parametrize("name", SMALL)
def test_parameters_have_defaults_and_a_description(name):
    module = importlib.import_module(f"warp_deferred.scenes.{name}")
    described = inspect.getdoc(module.build)
    for parameter in inspect.signature(module.build).parameters.values():
        assert parameter.default is not inspect.Parameter.empty and f"{parameter.name}: " in described


@pytest.mark.parametrize(("asked", "made"), [(500_000, 500_000), (10_000_000, 9_999_392), (7, 8)])
def test_terrain_takes_the_nearest_square(asked, made):
    side = round((asked / 2) ** 0.5)
    assert 2 * side * side == made
    if asked <= 500_000:
        assert terrain.build(triangles=asked).triangle_count == made


def test_terrain_has_the_slopes_of_its_height():
    x, z = np.random.default_rng(3).uniform(-10.0, 10.0, (2, 200))
    step = 1e-5
    slope_x = (terrain.height(x + step, z)[0] - terrain.height(x - step, z)[0]) / (2 * step)
    slope_z = (terrain.height(x, z + step)[0] - terrain.height(x, z - step)[0]) / (2 * step)
    _, expected_x, expected_z = terrain.height(x, z)
    assert np.allclose(slope_x, expected_x, atol=1e-5) and np.allclose(slope_z, expected_z, atol=1e-5)


def test_the_range_for_a_mean_is_the_one_that_counting_confirms(rng):
    points, lights = rng.uniform(-5.0, 5.0, (200, 3)), rng.uniform(-5.0, 5.0, (400, 3))
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = rng.uniform(0.5, 2.0, 200)
    to_light = lights[None] - points[:, None]
    for mean in (0.5, 5.0, 40.0):
        reach = range_for_mean(points, normals, lights, mean, weights)
        lit = (np.linalg.norm(to_light, axis=-1) < reach) & (np.einsum("ijk,ik->ij", to_light, normals) > 0.0)
        assert np.average(lit.sum(axis=1), weights=weights) == pytest.approx(mean, abs=0.03)


def test_rays_go_through_pixel_centres():
    camera = wd.Camera.look_at((1.0, 2.0, 3.0), (0.0, 0.0, -4.0), vertical_fov_deg=60.0)
    eye, rays = camera_rays(camera, 8, 6)
    view = rays @ np.array(camera.rotation).reshape(3, 3).T
    fx, fy, cx, cy = camera.pixel_projection(8, 6)
    assert np.array_equal(eye, camera.position) and np.allclose(view[..., 2], -1.0)
    assert np.allclose(view[..., 0] * fx + cx, np.broadcast_to(np.arange(8) + 0.5, (6, 8)))
    assert np.allclose(cy - view[..., 1] * fy, np.broadcast_to((np.arange(6) + 0.5)[:, None], (6, 8)))


@pytest.mark.parametrize(
    ("parameters", "tolerance"),
    [
        ({}, 1e-4),
        ({"height": 0.6, "intensity": 300.0}, 1e-4),
        ({"light_range": 2.0}, 1e-4),
        # Vertices snap to 1/256 px; on a slanted plane half of that moves the depth by up to 5e-5 of itself.
        ({"tilt_deg": 35.0}, 5e-4),
        ({"tilt_deg": 60.0}, 1e-3),
    ],
)
def test_lambert_plane_has_the_radiance_of_the_formula(parameters, tolerance):
    scene = lambert_plane.build(**parameters)
    frame = wd.Renderer(scene, width=96, height=54, device="cpu", outputs=("color",), settings=FULL).render()
    color = frame.numpy("color")[0]
    expected = lambert_plane.expected_radiance(scene, 96, 54)
    assert expected.max() > 0.05 and np.ptp(expected) > 0.5 * expected.max()
    # Where the range window runs out, its own slope magnifies any rounding of the distance.
    lit = expected > (0.02 * expected.max() if "light_range" in parameters else 0.0)
    assert np.abs(color[lit] / expected[lit] - 1.0).max() <= tolerance
    assert np.abs(color - expected).max() <= tolerance * expected.max()
    if "light_range" in parameters:
        assert (expected == 0.0).any() and (color[expected == 0.0] == 0.0).all()


@pytest.mark.parametrize(("radiance", "settings"), [(1.0, FULL), (1.0, Settings()), (0.25, FULL)])
def test_b2_furnace_shows_nothing(radiance, settings):
    scene = furnace.build(radiance=radiance)
    renderer = wd.Renderer(scene, width=64, height=48, device="cpu", outputs=("color", "alpha"), settings=settings)
    frame = renderer.render()
    assert 0.1 < frame.numpy("alpha").mean() < 0.9
    assert np.abs(frame.numpy("color") / radiance - 1.0).max() <= 1e-6


@pytest.mark.parametrize(("lights", "mean"), [(10_000, 5.0), (1000, 5.0), (1000, 20.0), (400, 80.0)])
def test_many_lights_keeps_its_mean(lights, mean):
    scene = many_lights.build(lights=lights, mean=mean, triangles=12_000)
    frame = wd.Renderer(scene, width=320, height=180, device="cpu", outputs=("light_count", "alpha")).render()
    assert frame.numpy("alpha").min() == 1.0, "the city must fill the picture"
    assert frame.numpy("light_count").mean() == pytest.approx(mean, rel=0.1)


def test_terrain_lights_reach_about_five_to_a_pixel():
    scene = terrain.build(triangles=20_000, lights=1000)
    frame = wd.Renderer(scene, width=320, height=180, device="cpu", outputs=("light_count", "alpha")).render()
    covered = frame.numpy("alpha") > 0.0
    assert frame.numpy("light_count")[covered].mean() == pytest.approx(5.0, rel=0.2)


@pytest.mark.parametrize("name", SMALL)
def test_every_scene_shows_something_finite(name):
    scene = load(SMALL[name])
    renderer = wd.Renderer(scene, width=64, height=36, device="cpu", outputs=("color", "display"))
    frame = renderer.render()
    color, display = frame.numpy("color"), frame.numpy("display")
    assert np.isfinite(color).all() and color.min() >= 0.0
    assert display[..., :3].max(axis=-1).mean() > 25.0


def test_each_kind_of_light_casts_a_shadow_in_the_courtyard():
    for kind in ("sun", "lamp", "moon"):
        scene = shadows.build(**{name: float(name == kind) for name in ("sun", "lamp", "moon")})
        assert scene.lights.casts_shadow
        pictures = []
        for rung in ("off", "pcf"):
            settings = Settings().with_values([f"shadow.rung={rung}", "shadow.directional_size=512"])
            renderer = wd.Renderer(
                scene, width=96, height=54, device="cpu", outputs=("diffuse", "light_count"), settings=settings
            )
            pictures.append(renderer.render().numpy("diffuse")[0].sum(axis=-1))
        lit = pictures[0] > 0.01 * pictures[0].max()
        shaded = lit & (pictures[1] < 0.01 * pictures[0])
        assert 0.05 < shaded.sum() / lit.sum() < 0.8, kind


def test_the_hall_is_closed_to_the_camera_and_well_lit():
    scene = hundred_lights.build()
    renderer = wd.Renderer(
        scene, width=320, height=180, device="cpu", outputs=("alpha", "display", "light_count", "semantic_id")
    )
    for moment in (0.0, 9.0):
        scene.animate(scene, moment)
        frame = renderer.render()
        brightest = frame.numpy("display")[0, ..., :3].max(axis=-1)
        assert frame.numpy("alpha").mean() > 0.999
        assert (brightest < 6).mean() < 0.03 and (brightest >= 250).mean() < 0.03
        assert 5.0 < frame.numpy("light_count").mean() < 20.0
        assert set(np.unique(frame.numpy("semantic_id"))) >= {1, 2, 3, 4, 5, 6, 7}


def test_no_column_stands_in_the_eye():
    eye = np.array(hundred_lights.build().camera.position)
    assert np.linalg.norm((_hall.column_places() - eye)[:, [0, 2]], axis=1).min() > 1.0


def test_every_emitter_of_the_glow_is_above_white_and_lights_its_surroundings():
    scene = glow.build()
    emitting = [i for i in scene.instances if max(i.material.emissive) > 0.0]
    assert len(emitting) > 70 and all(max(i.material.emissive) > 2.0 for i in emitting)
    assert scene.camera.bloom == 0.3 and glow.build(bloom=0.0).camera.bloom == 0.0
    lights = scene.lights.point.position
    for item in emitting:
        if item.mesh.name in ("tube", "ember"):
            place = item.transform[:3, 3]
            assert np.linalg.norm(lights - place, axis=1).min() < 0.6
    dark = glow.build(brightness=0.0)
    assert not any(max(i.material.emissive) for i in dark.instances) and not dark.lights.point.intensity.any()


@pytest.mark.parametrize("kind", ["point", "spot"])
def test_fifty_thousand_triangles_of_spheres_rest_on_the_floor_or_above_it(kind):
    scene = load(f"spheres_50k?lights={kind}")
    counts = {name: len(group) for name, group in scene.lights.groups()}
    assert scene.triangle_count == 50_000 and counts == {"point": 0, "spot": 0, "directional": 0} | {kind: 4}
    assert scene.lights.casts_shadow and not load(f"spheres_50k?lights={kind}&casts_shadow=false").lights.casts_shadow
    for time in (0.0, 1.3, 4.7):
        scene.animate(scene, time)
        balls = np.array([i.transform for i in scene.instances if i.mesh.name in ("pearl", "ball")])
        # The pearl's mesh has its radius, the balls' are in their transforms.
        radius = np.append(spheres_50k.PEARL, np.linalg.norm(balls[1:, :3, 0], axis=1))
        centre = balls[:, :3, 3]
        assert (centre[:, 1] - radius).min() > -1e-5
        apart = np.linalg.norm(centre[:, None] - centre[None], axis=-1) - radius[:, None] - radius[None]
        assert apart[~np.eye(len(balls), dtype=bool)].min() > 0.0, "balls do not touch"


def test_four_lights_of_either_kind_light_most_of_the_spheres():
    for kind in ("point", "spot"):
        scene = load(f"spheres_50k?lights={kind}")
        frame = wd.Renderer(scene, width=160, height=90, device="cpu", outputs=("light_count", "semantic_id")).render()
        lit = frame.numpy("light_count")[frame.numpy("semantic_id") > 0]
        assert (lit > 0).mean() > 0.8 and lit.max() == 4


def test_terrain_400k_has_its_triangles_and_a_lamp_above_the_ground():
    scene = terrain_400k.build()
    assert abs(scene.triangle_count - 400_000) < 1500
    assert [len(group) for _, group in scene.lights.groups()] == [1, 0, 1] and scene.lights.casts_shadow
    for time in (0.0, 3.0, 9.5):
        scene.animate(scene, time)
        x, y, z = scene.lights.point.position[0]
        assert y - terrain.height(x, z)[0] == pytest.approx(terrain_400k.ABOVE)
        assert np.allclose(scene.instances[1].transform[:3, 3], (x, y, z))


@pytest.mark.parametrize("time", [0.0, 4.0])
def test_five_spots_each_light_every_pixel_of_the_square(time):
    scene = fullscreen_spots.build()
    scene.animate(scene, time)
    frame = wd.Renderer(scene, width=600, height=600, device="cpu", outputs=("light_count", "normal")).render()
    assert (frame.numpy("light_count") == 5).all()
    normal = frame.numpy("normal")[0]
    slope = np.hypot(normal[..., 0], normal[..., 1]) / normal[..., 2]
    assert 0.3 < slope.max() <= fullscreen_spots.STEEPEST + 0.01
