"""Codecs of the G-buffer and packed numbers: error bounds, exact codes, what bad numbers become."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import reference
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from warp_deferred.kernels.encoding import (
    FLAG_EMISSIVE,
    Surface,
    make_gbuffer_codec,
    make_normal_codec,
    pack_root,
    pack_unorm,
    unpack_root,
    unpack_unorm,
)
from warp_deferred.kernels.image import to_half
from warp_deferred.kernels.structs import GBuffer

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CODECS = ("rgb8", "xy16", "oct16", "oct24", "oct32")
#: Largest angle in degrees: the octahedral ones measured (hard cases, section 0); half a step of each component of
#: rgb8; for xy16 the root of the error of x² + y² at the horizon, where z is rebuilt from nothing.
LARGEST_ERROR = {
    "rgb8": np.degrees(np.sqrt(3.0) * 0.5 / 127.0),
    "xy16": np.degrees(np.sqrt(2.0 * np.hypot(0.5 / 16383.0, 0.5 / 32767.0)) + 1e-4),
    "oct16": 0.940 * 1.02,
    "oct24": 0.0583 * 1.02,
    "oct32": 0.00359 * 1.02,
}

encode_rgb8, decode_rgb8 = make_normal_codec("rgb8")
encode_xy16, decode_xy16 = make_normal_codec("xy16")
encode_oct16, decode_oct16 = make_normal_codec("oct16")
encode_oct24, decode_oct24 = make_normal_codec("oct24")
encode_oct32, decode_oct32 = make_normal_codec("oct32")
encode_compact, decode_compact = make_gbuffer_codec("compact", "oct24", True)
encode_full, decode_full = make_gbuffer_codec("full", "float32", True)


@wp.func
def encode_by(codec: wp.int32, n: wp.vec3):
    if codec == 0:
        return encode_rgb8(n)
    if codec == 1:
        return encode_xy16(n)
    if codec == 2:
        return encode_oct16(n)
    if codec == 3:
        return encode_oct24(n)
    return encode_oct32(n)


@wp.func
def decode_by(codec: wp.int32, code: wp.uint32):
    if codec == 0:
        return decode_rgb8(code)
    if codec == 1:
        return decode_xy16(code)
    if codec == 2:
        return decode_oct16(code)
    if codec == 3:
        return decode_oct24(code)
    return decode_oct32(code)


@wp.kernel
def normal_codes_kernel(normals: wp.array[wp.vec3], codec: wp.int32, out_codes: wp.array[wp.uint32]):
    i = wp.tid()
    out_codes[i] = encode_by(codec, normals[i])


@wp.kernel
def code_normals_kernel(codes: wp.array[wp.uint32], codec: wp.int32, out_normals: wp.array[wp.vec3]):
    i = wp.tid()
    out_normals[i] = decode_by(codec, codes[i])


@wp.kernel
def unorm_kernel(
    values: wp.array[wp.float32],
    levels: wp.float32,
    out_codes: wp.array[wp.uint32],
    out_values: wp.array[wp.float32],
):
    i = wp.tid()
    out_codes[i] = pack_unorm(values[i], levels)
    out_values[i] = unpack_unorm(out_codes[i], levels)


@wp.kernel
def root_kernel(colors: wp.array[wp.vec3], out_codes: wp.array[wp.uint32], out_colors: wp.array[wp.vec3]):
    i = wp.tid()
    out_codes[i] = pack_root(colors[i])
    out_colors[i] = unpack_root(out_codes[i])


@wp.kernel
def half_kernel(colors: wp.array[wp.vec3], out_halves: wp.array[wp.uint64]):
    i = wp.tid()
    out_halves[i] = to_half(colors[i])


@wp.kernel
def surface_kernel(full: wp.int32, surfaces: wp.array[Surface], gbuffer: GBuffer, out_surfaces: wp.array[Surface]):
    i = wp.tid()
    if full != 0:
        encode_full(gbuffer, i, surfaces[i])
        out_surfaces[i] = decode_full(gbuffer, i)
    else:
        encode_compact(gbuffer, i, surfaces[i])
        out_surfaces[i] = decode_compact(gbuffer, i)


def encode(normals: np.ndarray, codec: str, device: str) -> np.ndarray:
    out = wp.zeros(len(normals), dtype=wp.uint32, device=device)
    source = wp.array(normals, dtype=wp.vec3, device=device)
    wp.launch(normal_codes_kernel, len(normals), [source, CODECS.index(codec)], [out], device=device)
    return out.numpy()


def decode(codes: np.ndarray, codec: str, device: str) -> np.ndarray:
    out = wp.zeros(len(codes), dtype=wp.vec3, device=device)
    source = wp.array(codes, dtype=wp.uint32, device=device)
    wp.launch(code_normals_kernel, len(codes), [source, CODECS.index(codec)], [out], device=device)
    return out.numpy().astype(float)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))


def special_normals() -> np.ndarray:
    """Axes, octant centres, the octahedron's folds with zeros of both signs, and normals a hair below the horizon."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    octants = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    turn = np.linspace(0.0, 2.0 * np.pi, 97)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    folds = [ring + np.array([0.0, 0.0, z]) for z in (0.0, -0.0, 1e-7, -1e-7, -1e-3)]
    folds += [np.roll(ring, 1, axis=1), np.roll(ring, 2, axis=1)]
    return reference.unit(np.concatenate([axes, octants, *folds]))


@pytest.mark.parametrize("codec", CODECS)
def test_g1_special_normals_come_back(codec, device):
    normals = special_normals().astype(np.float32)
    back = decode(encode(normals, codec, device), codec, device)
    assert angle_deg(back, normals.astype(float)).max() <= LARGEST_ERROR[codec]
    assert np.abs(np.linalg.norm(back, axis=1) - 1.0).max() <= 1e-6
    # Axes lie on codes: nothing flat gets a tint.
    assert np.abs(back[:6] - normals[:6]).max() == 0.0


@pytest.mark.parametrize("codec", CODECS)
def test_g2_random_normals_stay_within_the_bound(codec, device, rng):
    normals = reference.unit(rng.normal(size=(60_000, 3))).astype(np.float32)
    back = decode(encode(normals, codec, device), codec, device)
    error = angle_deg(back, normals.astype(float))
    assert error.max() <= LARGEST_ERROR[codec]
    assert np.abs(np.linalg.norm(back, axis=1) - 1.0).max() <= 1e-6
    if codec == "xy16":
        assert error[np.abs(normals[:, 2]) > 0.5].max() < 0.006


@pytest.mark.parametrize("codec", ["oct16", "oct24", "oct32"])
def test_g2_length_does_not_matter(codec, device, rng):
    normals = rng.normal(size=(1000, 3))
    normals *= 2.0 ** rng.integers(-60, 60, (1000, 1))
    back = decode(encode(normals.astype(np.float32), codec, device), codec, device)
    assert angle_deg(back, reference.unit(normals)).max() <= LARGEST_ERROR[codec]


@pytest.mark.parametrize("codec", CODECS)
def test_g2_zero_and_non_finite_normals_become_z(codec, device):
    bad = [[0, 0, 0], [-0.0, 0, 0], [np.nan, 0, 1], [0, np.inf, 0], [-np.inf, np.nan, 0], [1, 1, -np.inf]]
    back = decode(encode(np.array(bad, np.float32), codec, device), codec, device)
    assert np.array_equal(back, np.tile([0.0, 0.0, 1.0], (len(bad), 1)))


# rgb8 and xy16 scale to unit length after decoding, which moves a vector off its code: they cannot be idempotent.
@pytest.mark.parametrize("codec", ["oct16", "oct24", "oct32"])
def test_p12_octahedral_codecs_are_idempotent(codec, device, rng):
    normals = reference.unit(rng.normal(size=(40_000, 3))).astype(np.float32)
    codes = encode(normals, codec, device)
    back = decode(codes, codec, device)
    again = encode(back.astype(np.float32), codec, device)
    assert angle_deg(decode(again, codec, device), back).max() < 1e-4
    bits = int(codec[3:]) // 2
    x, y = codes & (2**bits - 1), codes >> bits
    # On the rim of the unfolded square two codes mean one direction.
    inner = (np.minimum(x, y) > 0) & (np.maximum(x, y) < 2**bits - 2)
    assert np.array_equal(codes[inner], again[inner])
    assert inner.mean() > 0.95


@pytest.mark.parametrize("codec", ["oct16", "oct24", "oct32"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), power=st.integers(-40, 40))
def test_p12_any_direction_comes_back_from_its_code(codec, seed, power, device):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(500, 3)) * rng.choice([0.0, 1e-6, 1.0], (500, 3))
    normals = normals[np.abs(normals).max(axis=1) > 1e-7]
    back = decode(encode((normals * 2.0**power).astype(np.float32), codec, device), codec, device)
    assert angle_deg(back, reference.unit(normals)).max() <= LARGEST_ERROR[codec]
    again = decode(encode(back.astype(np.float32), codec, device), codec, device)
    assert angle_deg(again, back).max() < 1e-4


@pytest.mark.parametrize("levels", [254, 255, 32766, 65534, 65535])
def test_g3_every_unorm_code_comes_back(levels, device):
    codes = np.arange(levels + 1)
    got, values = pack(codes / levels, levels, device)
    assert np.array_equal(got, codes)
    assert np.abs(values - codes / levels).max() <= 2**-24
    assert np.array_equal(pack(values, levels, device)[0], codes)


def pack(values, levels, device):
    source = wp.array(np.asarray(values, np.float32), dtype=wp.float32, device=device)
    codes = wp.zeros(len(source), dtype=wp.uint32, device=device)
    back = wp.zeros(len(source), dtype=wp.float32, device=device)
    wp.launch(unorm_kernel, len(source), [source, float(levels)], [codes, back], device=device)
    return codes.numpy(), back.numpy()


@pytest.mark.parametrize("bits", [8, 16])
def test_g3_unorm_rounds_to_the_nearest_code(bits, device, rng):
    values = np.concatenate([rng.random(100_000), [0.0, 1.0, 0.5, 1e-30, np.nextafter(1.0, 0.0)]]).astype(np.float32)
    codes, _ = pack(values, 2**bits - 1, device)
    assert np.abs(codes - values.astype(float) * (2**bits - 1)).max() <= 0.6


def test_g3_unorm_of_bad_numbers(device):
    bad = np.array([np.nan, -np.inf, np.inf, -0.1, 1.1, -0.0, 3e38, -3e38, 1e-45], np.float32)
    assert pack(bad, 255, device)[0].tolist() == [0, 0, 255, 0, 255, 0, 255, 0, 0]


def test_g3_root_codes_come_back_and_keep_dark_tones(device, rng):
    ramp = (np.arange(256) / 255.0) ** 2
    colors = np.concatenate([np.repeat(ramp[:, None], 3, axis=1), rng.random((5000, 3)) ** 4])
    source = wp.array(colors.astype(np.float32), dtype=wp.vec3, device=device)
    codes = wp.zeros(len(colors), dtype=wp.uint32, device=device)
    back = wp.zeros(len(colors), dtype=wp.vec3, device=device)
    wp.launch(root_kernel, len(colors), [source], [codes, back], device=device)
    assert np.array_equal(codes.numpy()[:256], np.arange(256) * 0x010101)
    assert np.abs(np.sqrt(back.numpy()) - np.sqrt(colors)).max() <= 0.5 / 255.0 + 1e-6


def test_g4_half_stores_never_overflow(device):
    values = [65504.0, 65519.0, 65520.0, 1e30, np.inf, 1e-8, 0.0, -1.0, -np.inf, np.nan, 2.0**-24, 0.1]
    expected = [65504.0, 65504.0, 65504.0, 65504.0, 65504.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0**-24, np.float16(0.1)]
    colors = np.zeros((len(values), 3), np.float32)
    colors[:, 1] = values
    out = wp.zeros(len(values), dtype=wp.uint64, device=device)
    wp.launch(half_kernel, len(values), [wp.array(colors, dtype=wp.vec3, device=device)], [out], device=device)
    halves = out.numpy().view(np.float16).reshape(-1, 4)
    assert np.array_equal(halves[:, 1].astype(float), np.array(expected, float))
    assert (halves[:, 0] == 0.0).all() and (halves[:, 3] == 1.0).all()


def make_surfaces(rng: np.random.Generator, count: int) -> np.ndarray:
    rows = np.zeros(count, dtype=Surface.numpy_dtype())
    rows["normal"] = reference.unit(rng.normal(size=(count, 3)))
    for name in ("albedo", "specular"):
        rows[name] = rng.random((count, 3))
    for name in ("roughness", "metallic", "occlusion"):
        rows[name] = rng.random(count)
    rows["shininess"] = 2.0 ** rng.uniform(0.0, 13.0, count)
    rows["model"] = np.arange(count) % 4
    rows["flags"] = (rng.random(count) < 0.5) * int(FLAG_EMISSIVE)
    return rows


def through_gbuffer(rows: np.ndarray, full: bool, device: str) -> np.ndarray:
    gbuffer = GBuffer()
    for name in ("normal", "normal_wide", "albedo", "extra"):
        setattr(gbuffer, name, wp.zeros(len(rows), dtype=wp.uint32, device=device))
    for name in ("full_normal", "full_albedo", "full_extra"):
        setattr(gbuffer, name, wp.zeros(len(rows), dtype=wp.vec4, device=device))
    gbuffer.depth = wp.zeros(1, dtype=wp.float32, device=device)
    source = wp.array(rows, dtype=Surface, device=device)
    out = wp.zeros(len(rows), dtype=Surface, device=device)
    wp.launch(surface_kernel, len(rows), [int(full), source, gbuffer], [out], device=device)
    return out.numpy()


@pytest.mark.parametrize("full", [False, True])
def test_surface_comes_back_from_the_gbuffer(full, device, rng):
    rows = make_surfaces(rng, 4096)
    back = through_gbuffer(rows, full, device)
    step = 0.0 if full else 0.5 / 255.0 + 1e-6
    model = rows["model"]
    lobes, ggx = (model == 1) | (model == 2), model == 3
    assert np.array_equal(back["model"], model) and np.array_equal(back["flags"], rows["flags"])
    assert np.abs(np.sqrt(back["albedo"]) - np.sqrt(rows["albedo"])).max() <= step
    assert np.abs(back["occlusion"] - rows["occlusion"]).max() <= step
    assert np.abs(back["roughness"] - rows["roughness"])[ggx].max() <= step
    assert np.abs(back["metallic"] - rows["metallic"])[ggx].max() <= step
    assert np.abs(np.sqrt(back["specular"]) - np.sqrt(rows["specular"]))[lobes].max() <= step
    ratio = np.abs(np.log2(back["shininess"][lobes] / rows["shininess"][lobes]))
    assert ratio.max() <= (0.0 if full else 13.0 * step)
    error = angle_deg(back["normal"].astype(float), rows["normal"].astype(float))
    assert error.max() <= (1e-5 if full else LARGEST_ERROR["oct24"])


def test_p12_gbuffer_is_idempotent(device, rng):
    once = through_gbuffer(make_surfaces(rng, 4096), False, device)
    twice = through_gbuffer(once, False, device)
    # A direction on the octahedron's rim has two codes, which decode to within rounding of each other.
    assert np.abs(twice["normal"] - once["normal"]).max() < 1e-6
    for name in ("albedo", "specular", "roughness", "metallic", "shininess", "occlusion", "model", "flags"):
        assert np.array_equal(once[name], twice[name]), name


def test_normal_codec_names_are_checked():
    with pytest.raises(ValueError, match="float64"):
        make_normal_codec("float64")
