"""The reference's lights, reflection models and codecs against closed forms, and a check that its tests can fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference as ref
from reference import scene_of, view_of

DOWN = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
"""Rotation of a view that looks straight down -Y."""
MODELS = {
    "lambert": lambda n, l, v: ref.brdf_lambert(n, l, v, albedo=np.array([0.5, 0.6, 0.7])),
    "phong": lambda n, l, v: ref.brdf_phong(
        n, l, v, albedo=np.array([0.5, 0.6, 0.7]), specular=np.array([0.3, 0.2, 0.1]), shininess=20.0
    ),
    "blinn_phong": lambda n, l, v: ref.brdf_blinn_phong(
        n, l, v, albedo=np.array([0.5, 0.6, 0.7]), specular=np.array([0.3, 0.2, 0.1]), shininess=20.0
    ),
    "ggx": lambda n, l, v: ref.brdf_ggx(
        n, l, v, base_color=np.array([0.5, 0.6, 0.7]), metallic=0.4, roughness=np.array(0.3)
    ),
}


def directions(seed, count):
    """Random unit vectors of the upper hemisphere round +Z."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    v[:, 2] = np.abs(v[:, 2])
    return ref.unit(v)


def test_lambert_plane_equals_the_cosine_law():
    light = ref.Light("point", (20.0, 10.0, 5.0), (0.4, 1.5, -0.3))
    view = view_of(eye=(0, 3, 0), rotation=DOWN)
    out = ref.render(ref.lambert_plane(0.6, light), view)
    assert (out["alpha"] == 1).all()
    expected = ref.lambert_plane_radiance(out["position"], 0.6, light)
    assert np.allclose(out["color"], expected, rtol=1e-12) and np.array_equal(out["color"], out["diffuse"])
    assert np.allclose(out["position"][..., 1], 0, atol=1e-12) and np.allclose(out["normal"], (0, 1, 0))


@pytest.mark.parametrize("albedo", [1.0, 0.25])
def test_b2_lambert_in_a_furnace_shows_its_albedo(albedo):
    mesh = ref.sphere(0.6, 10, 14)
    mesh = replace(mesh, positions=mesh.positions - (0, 0, 2))
    out = ref.render(ref.furnace(mesh, albedo), view_of())
    hit = out["alpha"] > 0
    assert 200 < hit.sum() < hit.size
    assert (out["color"][hit] == albedo).all() and (out["color"][~hit] == 1).all()


@pytest.mark.parametrize("model", MODELS)
def test_b5_flat_grey_under_one_directional_light(model):
    # No specular and no metal: what is left is albedo / pi E, less the glTF layer's Fresnel share.
    light = ref.Light("directional", (3.0, 2.0, 1.0), direction=(1.0, -2.0, 0.5))
    cosine = 2.0 / np.sqrt(5.25)
    material = ref.Material(model=model, base_color=(0.5, 0.5, 0.5, 1.0), specular=(0, 0, 0), roughness=1.0)
    scene = replace(ref.lambert_plane(0.5, light), materials=(material,))
    view = view_of(eye=(0, 3, 0), rotation=DOWN)
    out = ref.render(scene, view)
    expected = np.broadcast_to(0.5 / np.pi * cosine * np.array([3.0, 2.0, 1.0]), out["diffuse"].shape)
    if model == "ggx":
        viewer = ref.unit(np.array([0, 3.0, 0]) - out["position"])
        to_light = ref.unit(np.array([-1.0, 2.0, -0.5]))
        v_dot_h = ref.dot(viewer, ref.unit(viewer + to_light))
        expected = expected * (1.0 - (0.04 + 0.96 * (1.0 - v_dot_h) ** 5))
        assert (out["specular"] > 0).all()
    else:
        assert not out["specular"].any()
    assert np.allclose(out["diffuse"], expected, rtol=1e-9)
    assert (out["light_count"] == 1).all()


@pytest.mark.parametrize("model", MODELS)
def test_b3_reflection_is_reciprocal(model):
    l, v = directions(1, 4000), directions(2, 4000)
    steep = (l[:, 2] > 1e-3) & (v[:, 2] > 1e-3)
    l, v = l[steep], v[steep]
    n = np.broadcast_to([0.0, 0.0, 1.0], l.shape)
    for forth, back in zip(MODELS[model](n, l, v), MODELS[model](n, v, l), strict=True):
        assert np.allclose(forth, back, rtol=1e-9)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 1e-3, 0.045, 1.0])
def test_b1_ggx_is_finite_and_dark_below_the_horizon(roughness, metallic):
    tilt = np.array([1.0, 0.5, 1e-3, 1e-8, 0.0, -1e-8, -0.5, -1.0])
    cosines = np.stack(np.meshgrid(tilt, tilt), axis=-1).reshape(-1, 2)
    n = np.broadcast_to([0.0, 0.0, 1.0], (len(cosines), 3))
    for azimuth in (0.0, 1.0, np.pi):
        sine = np.sqrt(1.0 - cosines**2)
        l = np.stack([sine[:, 0], 0 * sine[:, 0], cosines[:, 0]], axis=1)
        v = np.stack([sine[:, 1] * np.cos(azimuth), sine[:, 1] * np.sin(azimuth), cosines[:, 1]], axis=1)
        # The last rows are light exactly opposite to the viewer: the half vector is 0.
        l, v, m = np.concatenate([l, l]), np.concatenate([v, -l]), np.concatenate([n, n])
        parts = ref.brdf_ggx(m, l, v, base_color=np.ones(3), metallic=metallic, roughness=np.array(roughness))
        for part in parts:
            assert np.isfinite(part).all() and (part >= 0).all()
            assert (part[l[:, 2] <= 0] == 0).all()
    mirror = np.array([[0.0, 0.0, 1.0]])
    clamped, least = (
        ref.brdf_ggx(mirror, mirror, mirror, base_color=np.ones(3), metallic=1.0, roughness=np.array(r))[1]
        for r in (roughness, max(roughness, 0.045))
    )
    # Head-on the lobe is D / 4 with D = 1 / (pi alpha²).
    assert np.array_equal(clamped, least) and np.allclose(least, 0.25 / (np.pi * max(roughness, 0.045) ** 4))


@pytest.mark.parametrize("model", ["phong", "blinn_phong", "ggx"])
@pytest.mark.parametrize("angle", [0.0, 0.7, 1.3])
def test_b2_no_lobe_reflects_more_than_it_gets(model, angle):
    # Midpoint rule over the hemisphere of light directions.
    theta = (np.arange(400) + 0.5) * (np.pi / 800)
    phi = (np.arange(400) + 0.5) * (2 * np.pi / 400)
    t, p = (x.ravel() for x in np.meshgrid(theta, phi))
    l = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    n = np.broadcast_to([0.0, 0.0, 1.0], l.shape)
    v = np.broadcast_to([np.sin(angle), 0.0, np.cos(angle)], l.shape)
    weight = (np.sin(t) * np.cos(t) * (np.pi / 800) * (2 * np.pi / 400))[:, None]
    for sharp in (0, 1, 2):
        one = np.ones(3)
        if model == "ggx":
            f = ref.brdf_ggx(n, l, v, base_color=one, metallic=1.0, roughness=np.array((0.2, 0.5, 1.0)[sharp]))
        else:
            lobe = {"phong": ref.brdf_phong, "blinn_phong": ref.brdf_blinn_phong}[model]
            f = lobe(n, l, v, albedo=one, specular=one, shininess=(1.0, 10.0, 100.0)[sharp])
        albedo = (f[0] * weight).sum(axis=0), (f[1] * weight).sum(axis=0)
        assert 0.05 < albedo[1][0] < 1.001
        assert np.allclose(albedo[0], 0)  # nothing is left for the diffuse part
        if angle == 0.0 and model != "ggx":
            assert np.allclose(albedo[1], 1.0, atol=2e-3)


def test_c7_attenuation_is_finite_and_ends_at_the_range():
    d = np.array([0.0, 1e-30, 0.005, 0.01, 1.0, 2.0, np.nextafter(3.0, 0), 3.0, 4.0, 1e30])
    light = ref.Light("point", (1e8,) * 3, range=3.0)
    got = ref.attenuation(d, light)
    assert np.allclose(got[:4], 1e4 * (1 - (d[:4] / 3) ** 4), rtol=1e-14)
    assert np.allclose(got[4:6], [1 - 1 / 81, (1 - 16 / 81) / 4]) and 0 <= got[6] < 1e-10
    assert (got[7:] == 0).all()
    assert np.allclose(ref.attenuation(d[4:6], replace(light, range=np.inf)), [1.0, 0.25])
    for reach in (1e-20, 1e20):
        value = ref.attenuation(d, replace(light, range=reach))
        assert np.isfinite(value).all() and (value[d >= reach] == 0).all()
    fall = ref.attenuation(d, replace(light, coefficients=(1.0, 2.0, 3.0)))
    assert np.allclose(fall[[0, 4, 5]], [1.0, 1 / 6, 1 / 17]) and fall[6] > 0.02 and (fall[7:] == 0).all()
    assert ref.attenuation(np.array(0.0), replace(light, coefficients=(0.0, 0.0, 1.0))) == 1e8


def test_c7_light_on_the_surface_gives_nothing_but_finite_numbers():
    on_it, near_it = (ref.Light("point", (1e8,) * 3, (0.0, h, 0.0)) for h in (0.0, 1e-9))
    floor = ref.lambert_plane(1.0, on_it)
    view = view_of(3, 3, focal=3.0, eye=(0, 3, 0), rotation=DOWN)
    for light in (on_it, near_it):
        out = ref.render(replace(floor, lights=(light,)), view)
        assert np.isfinite(out["color"]).all()
    assert out["color"][1, 1, 0] > 1e11


def test_spot_fades_from_the_inner_to_the_outer_angle():
    inner, outer = 0.3, 0.6
    got = ref.spot_factor(np.cos([0.0, 0.3, 0.45, 0.6, 0.7, np.pi]), inner, outer)
    middle = (np.cos(0.45) - np.cos(0.6)) / (np.cos(0.3) - np.cos(0.6))
    assert np.allclose(got, [1, 1, middle**2, 0, 0, 0], atol=1e-15)
    # A cone whose angles nearly coincide keeps a finite slope of 1000.
    assert np.isclose(ref.spot_factor(np.cos(0.5) + 0.0005, 0.5 - 1e-9, 0.5), 0.25)


def test_spot_lights_its_disc_and_nothing_else():
    light = ref.Light("spot", (10.0,) * 3, (0.0, 2.0, 0.0), (0, -5, 0), inner_angle=0.0, outer_angle=0.4)
    out = ref.render(ref.lambert_plane(1.0, light), view_of(eye=(0, 3, 0), rotation=DOWN))
    radius = np.hypot(out["position"][..., 0], out["position"][..., 2])
    disc = radius < 2.0 * np.tan(0.4)
    assert 0.1 < disc.mean() < 0.9
    assert np.array_equal(out["light_count"] == 1, disc) and np.array_equal(out["color"][..., 0] > 0, disc)


@pytest.mark.parametrize("model", MODELS)
def test_p10_light_adds_up(model):
    rng = np.random.default_rng(5)
    lights = [ref.Light("point", tuple(rng.uniform(1, 5, 3)), tuple(rng.uniform((-2, 0.2, -2), 2))) for _ in range(3)]
    lights += [ref.Light("spot", (4.0, 2.0, 1.0), (0.5, 1.0, 0.0), (0.1, -1, 0)), ref.Light("directional")]
    floor = replace(ref.lambert_plane(0.5, lights[0]), materials=(ref.Material(model=model, roughness=0.2),))
    view = view_of(eye=(0, 2, 1), rotation=DOWN)
    together = ref.render(replace(floor, lights=tuple(lights)), view)
    single = [ref.render(replace(floor, lights=(light,)), view) for light in lights]
    for name in ("diffuse", "specular", "light_count"):
        assert np.allclose(together[name], sum(out[name] for out in single), rtol=1e-12)
    doubled = [replace(light, radiance=tuple(2 * r for r in light.radiance)) for light in lights]
    assert np.array_equal(ref.render(replace(floor, lights=tuple(doubled)), view)["color"], 2 * together["color"])


def test_ambient_is_diffuse_only():
    view = view_of(eye=(0, 2, 0), rotation=DOWN)
    expected = {"lambert": 0.5, "phong": 0.5 * 0.7, "blinn_phong": 0.5 * 0.7, "ggx": 0.5 * 0.75}
    for model, share in expected.items():
        material = ref.Material(model=model, base_color=(0.5,) * 3 + (1.0,), specular=(0.1, 0.3, 0.2), metallic=0.25)
        scene = scene_of(ref.quad(9.0), material=material, ambient=(1.0, 2.0, 4.0))
        out = ref.render(scene, view)
        assert np.allclose(out["color"], np.array([1.0, 2.0, 4.0]) * share) and not out["diffuse"].any()


@pytest.mark.parametrize(
    ("bits", "plain", "precise"), [(8, 0.940, 0.626), (10, 0.236, 0.156), (12, 0.0583, 0.0389), (16, 0.00359, 0.00244)]
)
def test_g1_g2_octahedral_normals_stay_within_their_error(bits, plain, precise):
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    octants = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3) / np.sqrt(3)
    folds = ref.unit(np.array([[1, 1, 0], [-1, 1, 0], [0, 1, 1], [0, -1, -1], [1, 0, -1], [3, -2, -1e-9], [0, 0, -1]]))
    n = ref.unit(np.concatenate([axes, octants, folds, np.random.default_rng(0).normal(size=(20000, 3))]))
    for encode, bound in ((ref.oct_encode, plain), (ref.oct_encode_precise, precise)):
        codes = encode(n, bits)
        assert np.abs(codes).max() <= 2 ** (bits - 1) - 1
        decoded = ref.oct_decode(codes, bits)
        assert np.allclose(np.linalg.norm(decoded, axis=1), 1.0, atol=1e-12)
        error = np.degrees(2 * np.arcsin(np.linalg.norm(decoded - n, axis=1) / 2))
        assert error.max() <= bound * 1.02
        assert np.allclose(decoded[:6], axes, atol=1e-12)
        bad = np.array([[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0.0]])
        assert np.allclose(ref.oct_decode(encode(bad, bits), bits), (0, 0, 1))
    assert np.allclose(ref.oct_unwrap(ref.oct_wrap(n)), n, atol=1e-12)


@pytest.mark.parametrize("bits", [8, 16])
def test_g3_unorm_packing_keeps_every_code_and_survives_bad_numbers(bits):
    top = 2**bits - 1
    codes = np.arange(top + 1)
    assert np.array_equal(ref.pack_unorm(ref.unpack_unorm(codes, bits), bits), codes)
    assert np.array_equal(
        ref.pack_unorm([np.nan, -np.inf, np.inf, -0.1, 1.1, 0.5], bits), [0, 0, top, 0, top, top // 2 + 1]
    )


def test_o4_srgb_round_trip_and_continuity():
    codes = np.arange(256) / 255.0
    assert np.allclose(ref.srgb_encode(ref.srgb_decode(codes)), codes, atol=1e-7)
    assert ref.srgb_decode(0.0) == 0 and np.isclose(ref.srgb_decode(1.0), 1) and np.isclose(ref.srgb_encode(1.0), 1)
    knee = 0.0031308
    assert abs(ref.srgb_encode(np.nextafter(knee, 1)) - ref.srgb_encode(knee)) < 1e-6
    assert np.isclose(ref.srgb_decode(128 / 255), 0.21586050011389926)


@pytest.mark.parametrize("curve", [ref.tone_reinhard, ref.tone_aces, ref.tone_pbr_neutral, ref.tone_agx])
def test_o1_o2_tone_curves_are_bounded_and_monotone(curve):
    odd = np.array([0.0, -0.0, -1.0, np.nan, 65504.0, 1e19, np.inf, -np.inf])
    got = curve(np.repeat(odd[:, None], 3, axis=1))
    assert ((got >= 0) & (got <= 1)).all()
    assert (got[[0, 1, 2, 3, 7]] == 0).all() and (got[[5, 6]] == got[4]).all()
    grey = curve(np.repeat(2.0 ** np.linspace(-14, 16, 3000)[:, None], 3, axis=1))
    assert (np.diff(grey, axis=0) >= -1e-15).all() and grey[-1, 0] > 0.98
    mixed = curve(np.random.default_rng(0).exponential(2.0, (5000, 3)))
    assert ((mixed >= 0) & (mixed <= 1)).all()


def test_o3_pbr_neutral_takes_four_percent_off_greys():
    grey = np.linspace(0.08, 0.80, 50)[:, None].repeat(3, axis=1)
    assert np.allclose(ref.tone_pbr_neutral(grey), grey - 0.04, atol=1e-6)


def test_tone_curves_at_known_points():
    assert np.allclose(ref.tone_reinhard([0.25, 1.0, 3.0]), [0.2, 0.5, 0.75])
    assert np.isclose(ref.tone_aces(1.0), 2.54 / 3.16)
    # Peak 2.04 above the 4 % offset: 1 - 0.24² / (2 + 0.24 - 0.76) = 0.9610811
    assert np.allclose(ref.tone_pbr_neutral([2.04, 2.04, 2.04]), 1 - 0.0576 / 1.48)
    # (4, 1, 0.5) less 0.04, scaled so that 3.96 becomes p = 1 - 0.0576 / 3.44, then mixed g of the way to white p.
    p = 1 - 0.0576 / 3.44
    g = 1 - 1 / (0.15 * (3.96 - p) + 1)
    expected = [p, p * (0.96 / 3.96 * (1 - g) + g), p * (0.46 / 3.96 * (1 - g) + g)]
    assert np.allclose(ref.tone_pbr_neutral([4.0, 1.0, 0.5]), expected)


@pytest.mark.parametrize("orthographic", [False, True])
def test_z6_depth_decodes_to_view_depth(orthographic):
    fields = {"near": 0.5, "far": 8.0, "orthographic": orthographic}
    points = np.array([[0.0, 0.0, -d] for d in (0.5, 1.0, 2.0, 7.999)])
    clip = ref.project(points, view_of(**fields))
    z = clip[:, 2] / clip[:, 3]
    assert z[0] == 1.0 and (np.diff(z) < 0).all()
    assert np.allclose(ref.linear_depth(z, **fields), -points[:, 2])
    assert ref.linear_depth(0.0, **fields) == (8.0 if orthographic else np.inf)


def test_an_error_in_the_scene_shows_in_the_picture():
    # The oracle must notice small things: half a percent of light, a millimetre, four thousandths of blue.
    light = ref.Light("point", (5.0,) * 3, (0.5, 1.0, 0.0))
    scene, view = ref.lambert_plane(0.5, light), view_of(eye=(0, 2, 0), rotation=DOWN)
    right = ref.render(scene, view)["color"]
    for wrong in (
        replace(scene, lights=(replace(light, radiance=(5.025,) * 3),)),
        replace(scene, lights=(replace(light, position=(0.501, 1.0, 0.0)),)),
        replace(scene, materials=(replace(scene.materials[0], base_color=(0.5, 0.5, 0.502, 1.0)),)),
    ):
        assert np.abs(ref.render(wrong, view)["color"] - right).max() > 5e-4 * right.max()
