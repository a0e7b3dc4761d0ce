"""Reflection models and lights: twins, energy, reciprocity, and what extremes become."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import warp as wp
from warp_deferred.kernels.brdf import INVERSE_PI, Reflection, diffuse_albedo, make_reflectance
from warp_deferred.kernels.encoding import Surface
from warp_deferred.kernels.lights import Arrival, make_arrive
from warp_deferred.kernels.structs import LIGHT_POLYNOMIAL, Lights

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LAMBERT, PHONG, BLINN_PHONG, GGX = range(4)
MODELS = {"lambert": LAMBERT, "phong": PHONG, "blinn_phong": BLINN_PHONG, "ggx": GGX}
UP = np.array([0.0, 1.0, 0.0])

view_lobe_all, reflect_all = make_reflectance(15)
towards_all, arrive_all = make_arrive(7, True)


@wp.kernel
def reflect_kernel(
    surfaces: wp.array[Surface],
    to_light: wp.array[wp.vec3],
    to_viewer: wp.array[wp.vec3],
    out_reflection: wp.array[Reflection],
    out_albedo: wp.array[wp.vec3],
):
    i = wp.tid()
    s = surfaces[i % surfaces.shape[0]]
    n_dot_v = wp.max(wp.dot(s.normal, to_viewer[i]), 1.0e-4)
    n_dot_l = wp.dot(s.normal, to_light[i])
    if n_dot_l > 0.0:
        f = reflect_all(s, view_lobe_all(s, n_dot_v), to_light[i], to_viewer[i], n_dot_l)
        f.diffuse = wp.cw_mul(f.diffuse, diffuse_albedo(s)) * INVERSE_PI
        out_reflection[i] = f
    out_albedo[i] = diffuse_albedo(s)


@wp.kernel
def arrive_kernel(
    lights: Lights, points: wp.array[wp.vec3], out_arrivals: wp.array[Arrival], out_directions: wp.array[wp.vec3]
):
    i = wp.tid()
    k = i % lights.capacity
    place = lights.position[k]
    to_light = towards_all(lights, k, place, points[i])
    a = arrive_all(lights, k, place[3], to_light)
    out_arrivals[i] = a
    out_directions[i] = to_light * a.inverse


def make_surface(model: str, roughness: float = 0.5, metallic: float = 0.0, shininess: float = 32.0, **fields):
    row = np.zeros(1, dtype=Surface.numpy_dtype())
    row["normal"], row["albedo"], row["specular"] = UP, 1.0, 0.0
    row["model"], row["roughness"], row["metallic"], row["shininess"] = MODELS[model], roughness, metallic, shininess
    row["occlusion"] = 1.0
    for name, value in fields.items():
        row[name] = value
    return row


def reflect(surfaces, to_light, to_viewer, device):
    count = len(to_light)
    arrays = [wp.array(surfaces, dtype=Surface, device=device)]
    arrays += [wp.array(np.asarray(a, np.float32), dtype=wp.vec3, device=device) for a in (to_light, to_viewer)]
    out = wp.zeros(count, dtype=Reflection, device=device)
    albedo = wp.zeros(count, dtype=wp.vec3, device=device)
    wp.launch(reflect_kernel, count, arrays, [out, albedo], device=device)
    rows = out.numpy()
    return rows["diffuse"].astype(float), rows["specular"].astype(float), albedo.numpy()


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Unit vectors over the upper hemisphere, uniform by solid angle."""
    vectors = reference.unit(rng.normal(size=(count, 3)))
    vectors[:, 1] = np.abs(vectors[:, 1])
    return vectors


def lobe_quadrature(viewer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions and solid angles on a grid round the mirror direction.

    Cubes of equal steps space the polar angle, so that a lobe of a hundredth of a radian is resolved as a wide one is.
    """
    mirror = np.array([-viewer[0], viewer[1], -viewer[2]])
    theta_edges = np.pi * np.linspace(0.0, 1.0, 601) ** 3
    theta = 0.5 * (theta_edges[1:] + theta_edges[:-1])
    phi = (np.arange(256) + 0.5) * (2.0 * np.pi / 256)
    side = reference.unit(np.cross(mirror, [0.3, 0.1, 0.9]))
    other = np.cross(mirror, side)
    sine, cosine = np.sin(theta)[:, None, None], np.cos(theta)[:, None, None]
    turned = np.cos(phi)[None, :, None] * side + np.sin(phi)[None, :, None] * other
    area = np.cos(theta_edges[:-1]) - np.cos(theta_edges[1:])
    return (cosine * mirror + sine * turned).reshape(-1, 3), np.repeat(area * (2.0 * np.pi / 256), 256)


def directional_albedo(surface, viewer, device):
    vectors, area = lobe_quadrature(viewer)
    diffuse, specular, _ = reflect(surface, vectors, np.tile(viewer, (len(vectors), 1)), device)
    weight = np.maximum(vectors[:, 1], 0.0) * area
    return (diffuse[:, 0] * weight).sum(), (specular[:, 0] * weight).sum()


VIEW_ANGLES_DEG = (0.0, 30.0, 60.0, 80.0, 89.0)


@pytest.mark.parametrize("angle", VIEW_ANGLES_DEG)
def test_b2_white_furnace_lambert_is_one(angle, device):
    viewer = np.array([np.sin(np.radians(angle)), np.cos(np.radians(angle)), 0.0])
    diffuse, specular = directional_albedo(make_surface("lambert"), viewer, device)
    assert abs(diffuse - 1.0) < 1e-3 and specular == 0.0


@pytest.mark.parametrize("angle", VIEW_ANGLES_DEG)
def test_b2_white_furnace_ggx_makes_no_energy(angle, device):
    viewer = np.array([np.sin(np.radians(angle)), np.cos(np.radians(angle)), 0.0])
    for roughness in (0.0, 0.045, 0.1, 0.3, 0.6, 1.0):
        _, specular = directional_albedo(make_surface("ggx", roughness, metallic=1.0), viewer, device)
        assert specular <= 1.0 + 1e-3, roughness
        # Single scattering loses light only where the surface is rough, or the view grazes.
        if roughness <= 0.1 and angle <= 60.0:
            assert specular >= 0.98, roughness


@pytest.mark.parametrize("model", ["phong", "blinn_phong"])
@pytest.mark.parametrize("angle", VIEW_ANGLES_DEG)
def test_b2_white_furnace_classic_lobes_make_no_energy(model, angle, device):
    viewer = np.array([np.sin(np.radians(angle)), np.cos(np.radians(angle)), 0.0])
    for shininess in (1.0, 8.0, 64.0, 1024.0, 8192.0):
        surface = make_surface(model, shininess=shininess, specular=1.0)
        diffuse, specular = directional_albedo(surface, viewer, device)
        assert diffuse == 0.0 and specular <= 1.0 + 1e-3, shininess
        half = directional_albedo(make_surface(model, shininess=shininess, specular=0.3), viewer, device)
        assert abs(half[0] - 0.7) < 1e-3 and sum(half) <= 1.0 + 1e-3


def random_surfaces(rng: np.random.Generator, model: str, count: int) -> np.ndarray:
    rows = np.repeat(make_surface(model), count)
    rows["albedo"], rows["specular"] = rng.random((count, 3)), rng.random((count, 3))
    rows["roughness"], rows["metallic"] = rng.random(count), rng.random(count)
    rows["shininess"] = 2.0 ** rng.uniform(0.0, 10.0, count)
    return rows


def twin(rows: np.ndarray, to_light: np.ndarray, to_viewer: np.ndarray):
    model, normal = int(rows["model"][0]), rows["normal"].astype(float)
    column = {name: rows[name].astype(float)[:, None] for name in ("roughness", "metallic", "shininess")}
    if model == GGX:
        return reference.brdf_ggx(
            normal,
            to_light,
            to_viewer,
            base_color=rows["albedo"].astype(float),
            metallic=column["metallic"],
            roughness=column["roughness"],
        )
    if model == LAMBERT:
        return reference.brdf_lambert(normal, to_light, to_viewer, albedo=rows["albedo"].astype(float))
    function = reference.brdf_phong if model == PHONG else reference.brdf_blinn_phong
    return function(
        normal,
        to_light,
        to_viewer,
        albedo=rows["albedo"].astype(float),
        specular=rows["specular"].astype(float),
        shininess=column["shininess"],
    )


@pytest.mark.parametrize("model", MODELS)
def test_reflectance_equals_its_twin(model, device, rng):
    count = 20_000
    rows = random_surfaces(rng, model, count)
    to_light = directions(rng, count).astype(np.float32).astype(float)
    to_viewer = directions(rng, count).astype(np.float32).astype(float)
    diffuse, specular, albedo = reflect(rows, to_light, to_viewer, device)
    exact_diffuse, exact_specular = twin(rows, to_light, to_viewer)
    assert np.abs(diffuse - exact_diffuse).max() <= 1e-6
    # The relative error of cos^n is n times that of the cosine; the twin's ggx cancels at its peak, not the kernel's.
    size = np.abs(exact_specular) + 1e-3
    assert (np.abs(specular - exact_specular) / size).max() <= (5e-4 if model != "ggx" else 1e-4)
    if model == "lambert":
        assert np.abs(albedo / np.pi - diffuse).max() < 1e-6 and not specular.any()


@pytest.mark.parametrize("model", ["phong", "blinn_phong", "ggx"])
def test_b3_lobes_are_reciprocal(model, device, rng):
    count = 20_000
    rows = random_surfaces(rng, model, count)
    a, b = directions(rng, count), directions(rng, count)
    # Below n.v = 1e-4 the viewer's cosine is clamped and the light's is not.
    steep = (a[:, 1] > 1e-3) & (b[:, 1] > 1e-3)
    rows, a, b = rows[steep], a[steep], b[steep]
    there, back = reflect(rows, a, b, device), reflect(rows, b, a, device)
    scale = 1.0 if model == "ggx" else float(rows["shininess"].max())
    size = np.maximum(np.abs(there[1]), 1e-2)
    # cos^n multiplies the rounding of the cosine, 2^-24, by n.
    assert (np.abs(there[1] - back[1]) / size).max() <= max(2e-5, scale * 4.0 * 2.0**-24)
    assert np.abs(there[0] - back[0]).max() <= 1e-6


def grazing_directions() -> np.ndarray:
    angles = np.array([0.0, 1e-7, 1e-4, 1e-2, 1.0, np.pi / 2 - 1e-4, np.pi / 2, np.pi / 2 + 1e-4, np.pi - 1e-4])
    turn = np.array([0.0, 0.5 * np.pi, np.pi, 4.0])
    a, t = (grid.reshape(-1) for grid in np.meshgrid(angles, turn))
    return np.stack([np.cos(a) * np.cos(t), np.sin(a), np.cos(a) * np.sin(t)], axis=1)


@pytest.mark.parametrize("model", MODELS)
def test_b1_extremes_are_finite_and_positive(model, device):
    a = grazing_directions()
    a = np.concatenate([a, -a])
    to_light, to_viewer = np.repeat(a, len(a), axis=0), np.tile(a, (len(a), 1))
    for roughness in (0.0, 1e-3, 0.045, 1.0):
        for metallic in (0.0, 1.0):
            surface = make_surface(model, roughness, metallic, shininess=1.0 + 8191.0 * roughness, specular=0.5)
            diffuse, specular, _ = reflect(surface, to_light, to_viewer, device)
            for part in (diffuse, specular):
                assert np.isfinite(part).all() and (part >= 0.0).all()
                assert not part[to_light[:, 1] < 0.0].any()


def test_b1_roughness_is_at_least_0_045(device, rng):
    a, b = directions(rng, 500), directions(rng, 500)
    rough = [reflect(make_surface("ggx", r, metallic=1.0), a, b, device)[1] for r in (0.0, 1e-3, 0.045)]
    assert np.array_equal(rough[0], rough[2]) and np.array_equal(rough[1], rough[2])


def make_lights(rows: list[dict], device: str) -> Lights:
    """Staged lights as `stage_lights_kernel` would leave them, from plain numbers."""
    table = {name: np.zeros((len(rows), 4)) for name in ("position", "color", "axis", "shape", "polynomial")}
    for k, row in enumerate(rows):
        reach = row.get("range", np.inf)
        axis = reference.unit(np.array(row.get("direction", (0.0, -1.0, 0.0))))
        table["position"][k] = [*(-axis if row.get("kind") == 2 else row.get("position", (0, 0, 0))), reach]
        inner, outer = row.get("angles", (0.0, np.pi / 4))
        spot = row.get("kind", 0) == 1
        scale = 1.0 / max(0.001, np.cos(inner) - np.cos(outer)) if spot else 0.0
        offset = -np.cos(outer) * scale if spot else 1.0
        table["color"][k] = [1, 1, 1, np.cos(outer)]
        table["axis"][k] = [*axis, scale]
        inverse = 1.0 / reach**2 if reach > 0.0 else 0.0
        kind = row.get("kind", 0) + (int(LIGHT_POLYNOMIAL) if "coefficients" in row else 0)
        table["shape"][k] = [offset, 1.0 / row.get("source_radius", 1e-4) ** 2, inverse, kind]
        table["polynomial"][k, :3] = row.get("coefficients", (1, 0, 0))
    lights = Lights()
    for name, values in table.items():
        setattr(lights, name, wp.array(values.astype(np.float32), dtype=wp.vec4, device=device))
    lights.capacity = len(rows)
    return lights


def arrivals(row: dict, points: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    out = wp.zeros(len(points), dtype=Arrival, device=device)
    source = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
    directions = wp.zeros(len(points), dtype=wp.vec3, device=device)
    wp.launch(arrive_kernel, len(points), [make_lights([row], device), source], [out, directions], device=device)
    return out.numpy()["power"].astype(float), directions.numpy()


@pytest.mark.parametrize("reach", [1e-3, 1.0, 7.0, 1e6])
@pytest.mark.parametrize("coefficients", [None, (1.0, 0.5, 0.25)])
def test_c7_fall_off(reach, coefficients, device):
    ratio = np.concatenate([np.linspace(0.0, 1.5, 400), [1.0, 1.0 - 2.0**-20, 1.0 + 2.0**-23]])
    distance = np.concatenate([ratio * reach, 10.0 ** np.arange(-8.0, 8.0)]).astype(np.float32)
    row = {"range": reach} | ({"coefficients": coefficients} if coefficients else {})
    power, _ = arrivals(row, distance[:, None] * UP, device)
    assert np.isfinite(power).all() and (power >= 0.0).all()
    reach32 = float(np.float32(reach))
    assert not power[distance >= reach32].any()
    inside = (distance > 0.0) & (distance < 0.999 * reach32)
    d = distance[inside].astype(float)
    if coefficients:
        exact = 1.0 / (coefficients[0] + coefficients[1] * d + coefficients[2] * d * d)
    else:
        exact = (1.0 - (d / reach32) ** 4) / np.maximum(d * d, 1e-8)
    assert np.abs(power[inside] / exact - 1.0).max() <= 2e-4
    assert inside.sum() > 200


def test_c7_infinite_range_and_source_radius(device):
    distance = 10.0 ** np.arange(-7.0, 9.0)
    power, direction = arrivals({"source_radius": 0.01}, distance[:, None] * UP, device)
    assert np.abs(power * np.maximum(distance**2, 1e-4) - 1.0).max() < 1e-5
    assert np.abs(direction + UP).max() < 1e-6
    assert arrivals({}, np.zeros((1, 3)), device)[0][0] == 0.0


def test_c7_spot_cone(device):
    angle = np.linspace(0.0, np.pi, 721)
    points = np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(angle)], axis=1)
    row = {"kind": 1, "angles": (0.3, 0.7)}
    power, _ = arrivals(row, points, device)
    exact = np.clip((np.cos(angle) - np.cos(0.7)) / (np.cos(0.3) - np.cos(0.7)), 0.0, 1.0) ** 2
    assert np.abs(power - exact).max() < 1e-5
    assert not power[angle > 0.7 + 1e-3].any() and (power[angle < 0.3 - 1e-3] > 0.99999).all()


def test_directional_light_is_everywhere_the_same(device, rng):
    points = rng.normal(size=(50, 3)) * 1e5
    power, direction = arrivals({"kind": 2, "direction": (1.0, -2.0, 2.0)}, points, device)
    assert (power == 1.0).all() and np.abs(direction - np.array([-1.0, 2.0, -2.0]) / 3.0).max() < 1e-6


def test_c8_an_unusable_light_contributes_nothing(device):
    for reach in (-1.0, 0.0, np.nan):
        assert not arrivals({"range": reach}, np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.0]]), device)[0].any()
