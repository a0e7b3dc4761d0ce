"""Depth codecs: bounds of the round trip, order, and what background, near plane, far things and bad numbers become."""

import numpy as np
import pytest
import warp as wp
from warp_deferred.kernels.depth_encoding import DEPTH_CODECS, make_depth_access, make_depth_codec
from warp_deferred.kernels.structs import ORTHOGRAPHIC, GBuffer, View

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CODED = ("unorm16", "ufloat16", "unorm24")
LARGEST = {"unorm16": 65535, "ufloat16": 65535, "unorm24": 2**24 - 1}
PAIRS = {name: make_depth_codec(name) for name in CODED}
ACCESS = {name: make_depth_access(name) for name in DEPTH_CODECS}


def make_codec_kernel(name):
    encode, decode = PAIRS[name]

    @wp.kernel(module="unique", module_options={"enable_backward": False, "fuse_fp": False})
    def codec_kernel(
        # In
        z: wp.array[wp.float32],
        # Out
        out_codes: wp.array[wp.uint32],
        out_back: wp.array[wp.float32],
    ):
        i = wp.tid()
        code = encode(z[i])
        out_codes[i] = code
        out_back[i] = decode(code)

    return codec_kernel


def make_access_kernel(name):
    store, clear, load = ACCESS[name]

    @wp.kernel(module="unique", module_options={"enable_backward": False, "fuse_fp": False})
    def access_kernel(
        # Frame
        views: wp.array[View],
        # In
        z: wp.array[wp.float32],
        gbuffer: GBuffer,
        # Out
        out_depth: wp.array[wp.float32],
    ):
        i = wp.tid()
        if z[i] < 0.0:
            clear(gbuffer, i)
        else:
            store(gbuffer, views[0], i, z[i])
        out_depth[i] = load(gbuffer, views[0], i)

    return access_kernel


CODEC_KERNELS = {name: make_codec_kernel(name) for name in CODED}
ACCESS_KERNELS = {name: make_access_kernel(name) for name in DEPTH_CODECS}


def through(z, name, device):
    source = wp.array(np.asarray(z, np.float32), dtype=wp.float32, device=device)
    codes = wp.zeros(len(source), dtype=wp.uint32, device=device)
    back = wp.zeros(len(source), dtype=wp.float32, device=device)
    wp.launch(CODEC_KERNELS[name], len(source), [source], [codes, back], device=device)
    return codes.numpy(), back.numpy().astype(np.float64)


def accessed(z, name, device, near=0.05, far=np.inf, projection=0):
    views = np.zeros(1, dtype=View.numpy_dtype())
    views["near"], views["far"], views["projection"] = near, far, projection
    gbuffer = GBuffer()
    for field, dtype in (("depth", wp.float32), ("depth16", wp.uint16), ("depth32", wp.uint32)):
        setattr(gbuffer, field, wp.zeros(len(z), dtype=dtype, device=device))
    out = wp.zeros(len(z), dtype=wp.float32, device=device)
    source = wp.array(np.asarray(z, np.float32), dtype=wp.float32, device=device)
    views = wp.array(views, dtype=View, device=device)
    wp.launch(ACCESS_KERNELS[name], len(z), [views, source, gbuffer], [out], device=device)
    return out.numpy().astype(np.float64)


def depths(rng, count=200_000):
    """z over all scales, and those next to every place where something may turn."""
    corners = np.array([1.0, 0.5, 0.25, 2.0**-16, 2.0**-24, 2.0**-31], np.float32)
    beside = [np.nextafter(corners, np.float32(0.0)), np.nextafter(corners, np.float32(1.0))]
    return np.concatenate([rng.random(count), 2.0 ** -rng.uniform(0.0, 31.0, count), corners, *beside]).astype(
        np.float32
    )


@pytest.mark.parametrize("name", CODED)
def test_depth_comes_back_within_its_bound(name, device, rng):
    z = depths(rng)
    codes, back = through(z, name, device)
    exact = z.astype(np.float64)
    if name == "ufloat16":
        assert (np.abs(back - exact) <= 2.0**-12 * exact).all()
    else:
        step = 1.0 / LARGEST[name]
        deep = exact < 0.5 * step
        assert (np.abs(back - exact) <= 0.5 * step + 2.0**-23 * exact)[~deep].all()
        assert (codes[deep] == 1).all()
    # And the bound is no larger than it must be.
    worst = np.abs(back - exact)[exact > 1e-3].max()
    assert worst > (0.9 * 2.0**-13 if name == "ufloat16" else 0.45 / LARGEST[name])


@pytest.mark.parametrize("name", CODED)
def test_codes_keep_the_order_of_depths(name, device, rng):
    z = np.sort(depths(rng))
    codes, back = through(z, name, device)
    assert (np.diff(codes.astype(np.int64)) >= 0).all() and (np.diff(back) >= 0.0).all()
    again, once_more = through(back, name, device)
    assert np.array_equal(again, codes) and np.array_equal(once_more, back)


@pytest.mark.parametrize("name", ["unorm16", "ufloat16"])
def test_every_short_code_comes_back(name, device):
    decode = np.arange(1, 65536)
    if name == "unorm16":
        z = decode / 65535.0
    else:
        z = ((decode + 0x3F800 - 65535).astype(np.uint32) << 12).view(np.float32)
    codes, back = through(z, name, device)
    assert np.array_equal(codes, decode) and np.abs(back - z).max() <= 2.0**-24


@pytest.mark.parametrize("name", CODED)
def test_near_plane_and_what_is_no_depth(name, device):
    codes, back = through([1.0, 1.5, np.inf, 0.0, -0.0, -1.0, np.nan, 1e-38, 1e-45], name, device)
    # The near plane is exact; what is infinitely far, or no number, is no background: a surface keeps its 1.
    assert codes.tolist() == [LARGEST[name]] * 3 + [1] * 6
    assert back[:3].tolist() == [1.0] * 3


@pytest.mark.parametrize("name", list(DEPTH_CODECS))
def test_background_is_infinitely_far_and_surfaces_are_not(name, device):
    got = accessed([-1.0, 1.0, 0.5, 0.05, 1e-12], name, device)
    assert np.isinf(got[0]) and got[1] == np.float32(0.05)
    assert np.isfinite(got[1:]).all() and (np.diff(got[1:]) > 0.0).all()
    assert got[3] == pytest.approx(1.0, rel={"unorm16": 2e-4, "ufloat16": 2.5e-4}.get(name, 1e-6))
    if name == "float32":
        assert np.array_equal(got[1:].astype(np.float32), np.float32(0.05) / np.float32([1.0, 0.5, 0.05, 1e-12]))


@pytest.mark.parametrize("name", CODED)
def test_shares_of_depth_are_as_the_docstring_says(name, device, rng):
    near = 0.3
    depth = near * 10.0 ** rng.uniform(0.0, 3.0, 100_000)
    z = (near / depth).astype(np.float32)
    share = np.abs(accessed(z, name, device, near=near) - near / z.astype(np.float64)) / depth
    if name == "ufloat16":
        assert share.max() < 2.5e-4
    else:
        flat = depth / (2.0 * LARGEST[name] * near)
        assert (share <= flat / (1.0 - flat) + 4.0 * 2.0**-24).all()


@pytest.mark.parametrize("name", CODED)
def test_orthographic_depth_is_off_by_a_share_of_the_range(name, device, rng):
    near, far = -2.0, 14.0
    z = rng.uniform(1e-4, 1.0, 10_000).astype(np.float32)
    got = accessed(z, name, device, near=near, far=far, projection=int(ORTHOGRAPHIC))
    share = np.abs(got - (far - z.astype(np.float64) * (far - near))) / (far - near)
    bound = {"unorm16": 0.5 / 65535, "ufloat16": 2.0**-12, "unorm24": 0.5 / (2**24 - 1) + 2.0**-23}[name]
    assert share.max() <= bound + 2.0**-23


def test_names_are_checked():
    with pytest.raises(ValueError, match="float32"):
        make_depth_codec("float32")
    with pytest.raises(ValueError, match="unorm8"):
        make_depth_access("unorm8")
