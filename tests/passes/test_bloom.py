"""Bloom's rungs: against their float64 twins and each other, hard cases M1 to M6 and P11, views."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from bloom_harness import KEEP, RUNGS, Blooming, bloom_of, gaussians_of, lamps, noise, request_of, rung, shown

from warp_deferred.passes.bloom import CHAINED, KINDS, BloomPass
from warp_deferred.views import ViewLayout, ViewSize

SIZES = [(64, 48), (33, 17), (1, 1), (1, 9), (7, 1), (2, 2), (135, 40), (65, 129)]
#: Rounding of a half, relative; below 2^-14 absolute steps of 2^-24.
HALF, TINY = 2.0**-11, 2.0**-24
#: Six levels even on small images.
WIDE = "bloom.radius=0.5"


# ---- against the twins


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("changes", [KEEP, ("bloom.fireflies=0", "bloom.threshold=1.5", "bloom.knee=0.3")])
def test_mip_chain_is_its_twin(width, height, changes, device):
    image = noise(width, height)
    bright = image if changes is KEEP else reference.bloom_bright(image, 1.5, 0.45)
    shares, _ = gaussians_of(height, *changes, WIDE)
    expected = reference.bloom_chain(bright, shares)
    actual = Blooming([image], *changes, WIDE, device=device).run().level()
    # Each of the 2 levels - 1 steps rounds to a half once.
    np.testing.assert_allclose(actual, expected, rtol=2 * len(shares) * HALF, atol=1e-6)


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("window", [1, 3, 8])
def test_neighbourhood_is_its_twin(width, height, window, device):
    image = noise(width, height)
    expected = reference.bloom_window(image.astype(float), window)
    fields = (*KEEP, rung("neighbourhood"), f"bloom.window={window}")
    actual = Blooming([image], *fields, device=device).run().level()
    np.testing.assert_allclose(actual, expected, rtol=3 * HALF)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_exact_is_the_sum_of_gaussians(width, height, device):
    image = noise(width, height)
    expected = reference.bloom_gaussians(image.astype(float), *gaussians_of(height, WIDE))
    actual = Blooming([image], *KEEP, WIDE, rung("exact"), device=device).run().level()
    # Five deviations hold all but 6e-7 of a Gaussian.
    np.testing.assert_allclose(actual, expected, rtol=5e-6)


@pytest.mark.parametrize("limit", [1.0, 16.0])
def test_weighted_level_is_a_weighted_mean(limit, device):
    image = lamps(32, 20)
    stage = Blooming([image], "bloom.threshold=0", "bloom.radius=0.01", f"bloom.fireflies={limit}", device=device).run()
    padded = np.pad(image.astype(float), ((1, 1), (1, 1), (0, 0)), mode="symmetric")
    taps = np.outer((1, 3, 3, 1), (1, 3, 3, 1))
    for y, x in ((0, 0), (4, 7), (9, 15)):
        block = padded[2 * y : 2 * y + 4, 2 * x : 2 * x + 4]
        w = taps / (1.0 + block @ (0.2126, 0.7152, 0.0722) / limit)
        expected = (w[..., None] * block).sum(axis=(0, 1)) / w.sum()
        np.testing.assert_allclose(stage.level()[y, x], expected, rtol=2 * HALF)


# ---- the ladder's stated bounds


@pytest.mark.parametrize("radius", [0.07, 0.2])
def test_rungs_keep_their_bounds_against_exact(radius):
    """Bounds of BloomSettings' docstring."""
    image = lamps(160, 96)
    fields = ("bloom.fireflies=0", f"bloom.radius={radius}")
    exact = bloom_of(image, *fields, rung("exact"))
    for name, most, worst in (("mip_chain", 0.15, 0.3), ("neighbourhood", 1.6, np.inf)):
        error = np.abs(bloom_of(image, *fields, rung(name)) - exact)
        assert error.sum() <= most * exact.sum()
        assert error.max() <= worst * exact.max()
    assert error.sum() > 0.15 * exact.sum()


# ---- hard cases


@pytest.mark.parametrize("name", RUNGS)
@pytest.mark.parametrize(
    "bad", [np.nan, np.inf, -np.inf, -1.0, (1.0, np.nan, 2.0), (np.inf, 1.0, 1.0), (5.0, -2.0, 1.0)]
)
def test_m1_a_bad_pixel_counts_as_black(name, bad, device):
    image, zero = lamps(40, 24), lamps(40, 24)
    image[11, 17], zero[11, 17] = bad, 0.0
    fields = (rung(name), WIDE)
    a, b = (Blooming([i], *fields, device=device).run() for i in (image, zero))
    assert np.isfinite(a.level()).all()
    assert np.array_equal(a.level(), b.level())
    mixed = a.mixed()[0]
    assert np.isfinite(mixed).all() and mixed.min() >= 0.0


@pytest.mark.parametrize("name", RUNGS)
@pytest.mark.parametrize("fireflies", [0, 1, 16])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (37, 19), (1, 5), (1, 1)])
def test_m2_a_constant_image_stays(name, fireflies, width, height, device):
    """Halves hold these values, so nothing is rounded away."""
    for c in (2.0**-10, 0.75, 3.0, 1000.0):
        image = np.full((height, width, 3), (c, 0.5 * c, 2.0 * c), np.float32)
        stage = Blooming([image], rung(name), "bloom.threshold=0", f"bloom.fireflies={fireflies}", WIDE, device=device)
        stage.run()
        count = 1
        if name == "mip_chain":
            # The chain keeps the widest level nowhere where it widens.
            pyramid = stage.stage.pyramid
            count = pyramid.count - (stage.stage.chained and "widen" in dict(pyramid.steps(True)))
        for index in range(count):
            level = stage.level(index=index)
            np.testing.assert_allclose(level, np.broadcast_to(image[0, 0], level.shape), rtol=1e-6)
        np.testing.assert_allclose(stage.mixed()[0], image, rtol=1e-6)


@pytest.mark.parametrize("name", RUNGS)
@pytest.mark.parametrize("power", [-3, 1, 6])
def test_m3_powers_of_two_pass_through_to_the_bit(name, power, device):
    image = 0.25 + noise(45, 30)
    one = Blooming([image], *KEEP, rung(name), WIDE, device=device).run().level()
    two = Blooming([image * 2.0**power], *KEEP, rung(name), WIDE, device=device).run().level()
    assert np.array_equal(one * np.float32(2.0**power), two)


@pytest.mark.parametrize("name", RUNGS)
@pytest.mark.parametrize(("width", "height"), [(33, 17), (7, 5), (1, 9), (9, 1), (3, 3), (1, 1), (127, 63), (64, 64)])
@pytest.mark.parametrize("radius", [0.05, 0.5])
def test_m5_the_centroid_stays(name, width, height, radius):
    """A lamp in the middle of an image of any size, with far more levels than the image has halves."""
    image = np.zeros((height, width, 3), np.float32)
    y, x = np.mgrid[0:height, 0:width]
    image[(np.abs(x - (width - 1) / 2) < 1.5) & (np.abs(y - (height - 1) / 2) < 1.5)] = 8.0
    out = bloom_of(image, *KEEP, rung(name), f"bloom.radius={radius}")[..., 0]
    assert out.sum() > 0.0
    assert abs((x * out).sum() / out.sum() - (width - 1) / 2) <= 0.5
    assert abs((y * out).sum() / out.sum() - (height - 1) / 2) <= 0.5


@pytest.mark.parametrize("name", RUNGS)
def test_m5_more_levels_than_halves(name):
    stage = Blooming([noise(3, 300), noise(1, 1), noise(700, 2)], *KEEP, rung(name), WIDE).run()
    for row in stage.stage.pyramid.rows[stage.stage.pyramid.rows["width"] > 0]:
        assert row["height"] >= 1
    assert all(np.isfinite(stage.level(v)).all() and stage.level(v).min() >= 0.0 for v in range(3))
    assert stage.stage.pyramid.count > 6 or name != "mip_chain"


@pytest.mark.parametrize("name", RUNGS)
@pytest.mark.parametrize("fireflies", [0, 1, 16])
def test_m6_the_largest_half_everywhere(name, fireflies, device):
    image = np.full((30, 41, 3), 65504.0, np.float32)
    for threshold in ("0", "1"):
        fields = (rung(name), WIDE, f"bloom.threshold={threshold}", f"bloom.fireflies={fireflies}")
        stage = Blooming([image], *fields, exposures=4.0, device=device).run()
        assert np.isfinite(stage.level()).all() and stage.level().max() <= 65504.0
        # The pyramid rounds what is above the threshold to halves, 32 apart here.
        np.testing.assert_allclose(stage.mixed()[0], image, rtol=HALF)


@pytest.mark.parametrize("name", RUNGS)
def test_p11_strength_zero_is_the_identity_and_all_is_finite(name, device):
    rng = np.random.default_rng(7)
    image = (10.0 ** rng.uniform(-30, 30, (29, 37, 3))).astype(np.float32)
    image[:4] = rng.choice(np.float32([0.0, -0.0, 1e-45, 1.1754944e-38, 1.0, 65504.0, 65519.0, 3.0e38]), (4, 37, 3))
    with np.errstate(over="ignore"):
        plain = np.minimum(np.maximum(image, 0.0), np.float32(65504.0))
    for fields in ((), ("bloom.threshold=0",), ("bloom.knee=0",)):
        off = shown(image, rung(name), *fields, shares=0.0, device=device)
        assert np.array_equal(off, plain)
        for exposure in (-20.0, 0.0, 20.0):
            on = shown(image, rung(name), *fields, exposures=exposure, device=device)
            assert np.isfinite(on).all() and on.min() >= 0.0 and on.max() <= 65504.0


# ---- what bloom is


@pytest.mark.parametrize("name", RUNGS)
@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_light_is_moved_not_made(name, threshold):
    # Lamps well inside, on sizes that halve without rest: what mirrors return is exact there.
    image = np.zeros((64, 128, 3), np.float32)
    image[28:36, 50:64], image[20, 80], image[40:50, 30] = (3.0, 7.0, 1.5), 30.0, 4.0
    fields = (rung(name), f"bloom.threshold={threshold}", "bloom.fireflies=0", "bloom.radius=0.12")
    total = shown(image, *fields, shares=0.6).sum(axis=(0, 1), dtype=float)
    np.testing.assert_allclose(total, image.sum(axis=(0, 1), dtype=float), rtol=2e-3)


@pytest.mark.parametrize("name", RUNGS)
def test_mixing_is_what_the_settings_say(name):
    image = lamps(52, 35)
    stage = Blooming([image], rung(name), shares=0.3, exposures=1.0).run()
    c = 2.0 * image.astype(float)
    expected = c - 0.3 * reference.bloom_bright(c, 1.0, 0.5) + 0.3 * stage.seen()
    np.testing.assert_allclose(stage.mixed()[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["neighbourhood", "mip_chain"])
def test_mirrored_images_have_mirrored_blooms(name):
    image = lamps(64, 32)
    one = Blooming([image], *KEEP, rung(name)).run().level()
    two = Blooming([image[::-1, ::-1].copy()], *KEEP, rung(name)).run().level()
    np.testing.assert_allclose(two[::-1, ::-1], one, rtol=2 * HALF, atol=1e-5)


def test_weighting_tames_a_lone_pixel():
    image = np.full((48, 64, 3), 0.1, np.float32)
    image[20, 30] = 1000.0
    kept, weighted = (bloom_of(image, *changes).max() for changes in (("bloom.fireflies=0",), ()))
    assert weighted < 0.05 * kept


def test_nothing_reaches_across_views(device):
    """Views of different sizes and strengths in one batch have the bits they have alone."""
    pictures = [lamps(40, 24), np.full((9, 1, 3), 50.0, np.float32), lamps(97, 61, 5), noise(64, 8), lamps(16, 200)]
    shares, exposures = (0.2, 1.0, 0.0, 0.7, 0.4), (0.0, -1.0, 2.0, 0.5, 1.0)
    for name in RUNGS:
        both = Blooming(pictures, rung(name), shares=shares, exposures=exposures, device=device).run()
        mixed = both.mixed()
        for v, picture in enumerate(pictures):
            alone = Blooming([picture], rung(name), shares=shares[v], exposures=exposures[v], device=device).run()
            assert np.array_equal(alone.mixed()[0], mixed[v]), (name, v)
            if shares[v]:
                assert np.array_equal(alone.level(), both.level(v)), (name, v)


@pytest.mark.parametrize("name", RUNGS)
def test_threads_change_no_bit(name):
    image = lamps(130, 70)
    one, three = (Blooming([image], rung(name), threads=n).run() for n in (1, 3))
    assert np.array_equal(one.level(), three.level())


@pytest.mark.parametrize("radius", [0.07, 0.5])
@pytest.mark.parametrize(
    "sizes", [[(64, 48)], [(33, 17)], [(3, 300), (135, 40), (65, 129)], [(640, 360)], [(641, 363), (97, 61), (1, 1)]]
)
def test_levels_made_together_have_the_bits_of_levels_made_one_by_one(sizes, radius, device):
    """What `chain_kernel` makes in two frames against `downsample_kernel` and `upsample_kernel`."""
    pictures = [noise(w, h, seed) for seed, (w, h) in enumerate(sizes)]
    # A view that does not scatter makes nothing.
    shares = np.linspace(0.0 if len(sizes) == 3 else 1.0, 1.0, len(sizes))
    fields = ("bloom.threshold=0", f"bloom.radius={radius}")
    alone, together = (
        Blooming(pictures, *fields, shares=shares, together=t, device=device).run().run() for t in (False, True)
    )
    assert together.stage.chained and not alone.stage.chained
    assert not together.stage.counters.numpy().any()
    for v, share in enumerate(shares):
        assert np.array_equal(alone.level(v), together.level(v), equal_nan=True)
        assert np.isfinite(together.level(v)).all() == (share > 0.0)
    if radius == 0.5 and sizes[0] == (64, 48):
        assert [name for name, _ in together.stage.pyramid.steps(True)] == ["narrow", "widen"]


def test_a_1080p_frame_takes_six_steps_of_waiting():
    request = request_of((ViewSize(1920, 1080),))
    pyramid = BloomPass().bound(request, ViewLayout(request.sizes, 16)).pyramid
    names = ["downsample", "downsample", "narrow", "widen", "upsample", "upsample"]
    assert [name for name, _ in pyramid.steps(True)] == names
    items, steps, count = pyramid.chain()
    assert count == 6 and len(items) == CHAINED * len(steps) and (np.diff(steps[:, 0]) >= 0).all()
    sizes = np.bincount(steps[:, 0])
    for k, (name, blocks) in enumerate(pyramid.steps(True)):
        own = items.reshape(-1, CHAINED, 4)[steps[:, 0] == k].reshape(-1, 4)
        assert np.array_equal(own[: len(blocks)], blocks) and (own[len(blocks) :] == -1).all()
        # What it is, the blocks it waits for, and those that are counted: negative in the last step.
        row = (k, KINDS.index(name), sizes[k - 1] if k else 0, sizes[k] if k < 5 else -sizes[k])
        assert (steps[steps[:, 0] == k] == row).all()


@pytest.mark.gpu
@pytest.mark.parametrize("name", RUNGS)
def test_devices_agree_to_the_bit(name, cuda_device):
    pictures = [lamps(130, 70), lamps(33, 65, 4)]
    for fields in ((), KEEP, (WIDE,)):
        a, b = (Blooming(pictures, rung(name), *fields, shares=0.4, device=d).run() for d in ("cpu", cuda_device))
        for v in range(2):
            assert np.array_equal(a.level(v), b.level(v))
            assert np.array_equal(a.mixed()[v], b.mixed()[v])


def test_half_radiance_gives_the_same_bits_as_what_it_holds(device):
    image = lamps(40, 26).astype(np.float16).astype(np.float32)
    for name in RUNGS:
        full, half = (Blooming([image], rung(name), half=h, device=device).run() for h in (False, True))
        assert np.array_equal(full.level(), half.level())
