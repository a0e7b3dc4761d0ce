"""FXAA on pictures: a twin in plain Python, exact coverage, and what must stay as it is to the bit."""

import numpy as np
import pytest
from reference import color as reference
from smoothing import smooth


def twin(picture):
    """The same method, one pixel after the other."""
    height, width = picture.shape[:2]
    luma = picture[..., :3].astype(int) @ np.array([54, 183, 19])
    linear = reference.srgb_decode(np.arange(256) / 255.0).astype(np.float32)
    result = picture.copy()
    for y, x in np.ndindex(height, width):
        near = np.pad(luma, 1, mode="edge")[y : y + 3, x : x + 3]
        cross = near[[1, 0, 2, 1, 1], [1, 1, 1, 0, 2]]
        contrast = int(np.ptp(cross))
        if contrast < 21 * 256 or 6 * contrast < cross.max():
            continue
        second = np.abs(near[0] - 2 * near[1] + near[2]) @ [1, 2, 1], np.abs(near.T[0] - 2 * near.T[1] + near.T[2])
        along_x = second[0] >= second[1] @ [1, 2, 1]
        # In coordinates where the edge runs along the row.
        rows, here, at = (luma, y, x) if along_x else (luma.T, x, y)
        m, last = int(rows[here, at]), rows.shape[0] - 1
        gaps = [abs(int(rows[min(max(here + d, 0), last), at]) - m) for d in (-1, 1)]
        side = -1 if gaps[0] >= gaps[1] else 1
        other_row = min(max(here + side, 0), last)
        other = int(rows[other_row, at])
        low_pass = abs(int((near * [[1, 2, 1], [2, -12, 2], [1, 2, 1]]).sum())) / (12 * contrast)
        share = 0.25 * np.sqrt(max(0.0, (min(low_pass, 1.0) - 1 / 3) * 1.5))
        if other != m:
            ends = []
            for d in (-1, 1):
                ends.append((17, 0))
                for k in range(1, 17):
                    if not 0 <= at + d * k < rows.shape[1]:
                        break
                    change = int(rows[here, at + d * k]) + int(rows[other_row, at + d * k]) - m - other
                    if abs(change) >= abs(other - m) / 2:
                        ends[-1] = (k, change)
                        break
            (near_end, change), (far_end, _) = sorted(ends, key=lambda end: end[0])
            if change * (m - other) < 0:
                share = max(share, 0.5 - (near_end - 0.5) / (near_end + far_end - 1))
        partner = picture[other_row, x] if along_x else picture[y, other_row]
        own = linear[picture[y, x, :3]].astype(float)
        mixed = own + (linear[partner[:3]] - own) * share
        result[y, x, :3] = np.round(reference.srgb_encode(mixed) * 255.0)
    return result


def noise(rng, height, width, levels=4):
    """Return blotches of few colours, so that edges of all kinds, lines and lone pixels are there, and any alpha."""
    coarse = rng.integers(0, levels, (height // 3 + 2, width // 3 + 2))
    index = coarse.repeat(3, axis=0).repeat(3, axis=1)[1 : height + 1, 2 : width + 2]
    index = np.where(rng.random((height, width)) < 0.1, rng.integers(0, levels, (height, width)), index)
    return np.dstack([rng.integers(0, 256, (levels, 3), np.uint8)[index], rng.integers(0, 256, index.shape, np.uint8)])


def slope(run, width=64):
    """Return a white half plane below an edge that falls one row in `run` columns, and its exact coverage."""
    height = 16 + width // run
    x, y = np.arange(width), np.arange(height)
    # The edge meets the border of two rows in the middle of each run.
    line = (x[None, :] + 0.5 - run / 2) / run + 8.0
    picture = np.full((height, width, 4), 255, np.uint8)
    picture[..., :3] = np.where(y[:, None] + 0.5 > line, 255, 0)[..., None]
    fine = (np.arange(1024) + 0.5) / 1024
    under = (x[:, None] + fine - run / 2) / run + 8.0
    return picture, np.clip(y[:, None, None] + 1.0 - under[None], 0.0, 1.0).mean(axis=2)


@pytest.mark.parametrize("levels", [2, 4, 12])
def test_pictures_equal_their_twins(levels, device, rng):
    pictures = [noise(rng, h, w, levels) for h, w in ((37, 45), (8, 8), (50, 3), (2, 33), (1, 20), (1, 1))]
    changed = 0
    for got, picture in zip(smooth(pictures, device), pictures, strict=True):
        expected = twin(picture)
        # The twin rounds in float64: a code may fall on the other side of a rounding point, and does so rarely.
        assert np.abs(got.astype(int) - expected).max() <= 1
        assert (got != expected).mean() < 1e-3
        changed += (got != picture).any(axis=2).sum()
    assert changed > 500


def test_views_do_not_see_one_another(device, rng):
    pictures = [noise(rng, h, w) for h, w in ((9, 17), (1, 1), (16, 8), (33, 5))]
    for got, picture in zip(smooth(pictures, device), pictures, strict=True):
        assert np.array_equal(got, smooth([picture], device)[0])


def test_alpha_is_kept(device, rng):
    picture = noise(rng, 32, 32)
    got = smooth([picture], device)[0]
    assert np.array_equal(got[..., 3], picture[..., 3]) and not np.array_equal(got, picture)


def test_flat_pictures_stay(device, rng):
    for _ in range(20):
        picture = np.broadcast_to(rng.integers(0, 256, 4, np.uint8), (13, 21, 4))
        assert np.array_equal(smooth([picture], device)[0], picture)


def test_monotone_edges_along_an_axis_stay(device, rng):
    for seed in range(20):
        profile = np.sort(rng.integers(0, 256, (rng.integers(1, 12), 1)), axis=0)
        profile = profile.repeat(rng.integers(1, 5, len(profile)), axis=0) * [1.0, 0.9, 0.6]
        picture = np.full((len(profile), 40, 4), 255, np.uint8)
        picture[..., :3] = profile[:: -1 if seed % 2 else 1, None]
        assert np.array_equal(smooth([picture], device)[0], picture)
        assert np.array_equal(smooth([picture.transpose(1, 0, 2)], device)[0], picture.transpose(1, 0, 2))


@pytest.mark.parametrize("run", [2, 4, 8, 16])
def test_an_edge_is_mixed_by_its_coverage(run, device):
    picture, coverage = slope(run)
    for turned, wanted in (
        (picture, coverage), (picture[::-1], coverage[::-1]), (picture[:, ::-1], coverage[:, ::-1]),
        (picture.transpose(1, 0, 2), coverage.T), (255 - picture, 1.0 - coverage),
    ):  # fmt: skip
        got = reference.srgb_decode(smooth([turned], device)[0][..., 0] / 255.0)
        inner = (slice(None), slice(run, 64 - run))
        inner = inner if wanted.shape == coverage.shape else inner[::-1]
        # Half a code is at most 0.0045 of white; the borders cut the outer runs short.
        assert np.abs(got - wanted)[inner].max() < 0.0046
        assert np.abs(turned[..., 0] / 255.0 - wanted)[inner].max() >= 0.25
