"""The image comparer: it must pass what is equal and fail on every injected error."""

import numpy as np
import pytest

from warp_deferred.compare import compare, difference_picture, write_difference
from warp_deferred.errors import InputError, LoadError
from warp_deferred.images import read_png, write_exr, write_png


def part(height=24, width=32):
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    depth = np.where(x > 20, np.float32(np.inf), 1.0 + y)
    image = {"R": x / width, "G": y / height, "B": 0.5 + 0.5 * np.sin(x), "Z": depth}
    image["normal.X"] = rng.standard_normal((height, width)).astype(np.float32)
    image["instance_id"] = np.where(x > 20, -1, (x // 4).astype(np.int32)).astype(np.int32)
    return {name: a.astype(np.int32 if name.endswith("id") else np.float32) for name, a in image.items()}


def changed(name, where, value):
    image = part()
    image[name][where] = value
    return image


def test_equal_images_are_ok():
    result = compare(part(), part())
    assert result.ok and result.problems == [] and result.max_error == result.rmse == result.share_over == 0.0
    assert result.psnr == np.inf and result.flip == 0.0 and result.to_dict()["psnr"] is None


@pytest.mark.parametrize(
    ("name", "where", "value", "word"),
    [
        ("R", (3, 4), 9.0, None),
        ("normal.X", (0, 0), 5.0, None),
        ("instance_id", (3, 4), 77, "ids differ"),
        ("R", (3, 4), np.nan, "NaN"),
        ("R", (3, 4), np.inf, "infinite"),
        ("Z", (3, 4), np.inf, "background in one image only"),
        ("Z", (3, 25), 7.0, "background in one image only"),
        ("Z", (3, 4), -np.inf, "infinite"),
        ("Z", (3, 4), np.nan, "NaN"),
    ],
)
def test_one_injected_pixel_fails(name, where, value, word):
    for a, b in ((changed(name, where, value), part()), (part(), changed(name, where, value))):
        result = compare(a, b, threshold=1e-3)
        assert not result.ok and result.share_over == pytest.approx(1 / part()["R"].size)
        assert bool(result.problems) == (word is not None)
        if word:
            y, x = where
            assert word in result.problems[0] and name in result.problems[0] and f"({x}, {y})" in result.problems[0]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_the_same_bad_pixel_in_both_images_fails(value):
    bad = changed("G", (1, 1), value)
    assert not compare(bad, changed("G", (1, 1), value), threshold=1e3, tolerance=1.0).ok


def test_a_shifted_row_fails():
    image = part()
    image["B"][5] = np.roll(image["B"][5], 1)
    result = compare(image, part(), threshold=1e-3, tolerance=0.02)
    assert not result.ok and result.share_over > 0.03


def test_ids_have_no_tolerance():
    result = compare(changed("instance_id", (0, 0), 5), part(), threshold=1e9, tolerance=1.0)
    assert not result.ok and "5, reference 0" in result.problems[0]


def test_threshold_and_tolerance():
    image = changed("R", (slice(0, 6), 0), 0.5)
    assert not compare(image, part(), threshold=0.4).ok
    assert compare(image, part(), threshold=0.5).ok
    share = 6 / image["R"].size
    assert compare(image, part(), threshold=0.1, tolerance=share).ok
    assert not compare(image, part(), threshold=0.1, tolerance=share * 0.99).ok


def test_figures_match_their_definitions():
    image, reference = part(), part()
    image["R"] = image["R"] + np.float32(0.25)
    image["R"][2, 3] += 1.0
    row = next(r for r in compare(image, reference).channels if r.name == "R")
    error = image["R"].astype(np.float64) - reference["R"]
    assert row.max_error == error.max() and row.worst == (3, 2)
    assert row.rmse == pytest.approx(np.sqrt((error**2).mean()), rel=1e-12)
    assert row.psnr == pytest.approx(20 * np.log10(float(reference["R"].max()) / row.rmse), rel=1e-12)


def test_flip_agrees_with_its_authors_evaluator():
    evaluator = pytest.importorskip("flip_evaluator")
    rng = np.random.default_rng(5)
    a, b = rng.integers(0, 256, (2, 40, 50, 3), dtype=np.uint8)
    b = (0.9 * a + 0.1 * b).astype(np.uint8)
    planes = [{name: image[..., i] for i, name in enumerate("RGB")} for image in (a, b)]
    result = compare(planes[1], planes[0])
    images = [(image / 255.0).astype(np.float32) for image in (a, b)]
    expected = evaluator.evaluate(*images, "LDR", inputsRGB=True, applyMagma=False)[1]
    assert result.flip_note == "FLIP" and 0.01 < expected < 1.0
    assert result.flip == pytest.approx(expected, abs=2e-4)


def test_flip_says_why_it_is_missing():
    assert "no colour" in compare({"Z": part()["Z"]}, {"Z": part()["Z"]}).flip_note
    bad = changed("R", (0, 0), np.nan)
    result = compare(bad, part())
    assert result.flip is None and "not finite" in result.flip_note
    assert compare(part(), part(), flip=False).flip_note == "not asked for"
    noisy = changed("R", (slice(None), 3), 2.0)
    assert compare(noisy, part()).flip > 0.0


def test_layouts_that_differ_are_refused():
    less = part()
    del less["G"]
    with pytest.raises(InputError, match="without G"):
        compare(less, part())
    with pytest.raises(InputError, match="with G beside"):
        compare(part(), less)
    with pytest.raises(InputError, match="size 32x24, got <32x23>"):
        compare(part(23, 32), part())
    with pytest.raises(InputError, match="2 parts"):
        compare(part(), [part(), part()])
    with pytest.raises(InputError, match="kind"):
        compare({"R": np.zeros((2, 2), np.uint8)}, {"R": np.zeros((2, 2), np.float32)})
    with pytest.raises(InputError, match="threshold"):
        compare(part(), part(), threshold=-1)
    with pytest.raises(InputError, match="tolerance"):
        compare(part(), part(), tolerance=2)


def test_files_of_several_views(tmp_path):
    write_exr(tmp_path / "a.exr", [part(), part()])
    write_exr(tmp_path / "b.exr", [part(), changed("R", (1, 2), 4.0)])
    assert compare(tmp_path / "a.exr", tmp_path / "a.exr").ok
    result = compare(tmp_path / "a.exr", tmp_path / "b.exr")
    assert not result.ok and {r.part for r in result.channels if r.max_error > 0} == {1}
    gain = write_difference(tmp_path / "d.png", tmp_path / "a.exr", tmp_path / "b.exr")
    picture = read_png(tmp_path / "d.png")
    assert picture.shape == (24, 64, 4) and gain == 0.25
    assert np.argwhere(picture[..., :3].any(axis=2)).tolist() == [[1, 34]]
    with pytest.raises(LoadError, match="no such file"):
        compare(tmp_path / "a.exr", tmp_path / "missing.exr")


def test_codes_are_compared_as_shares_of_the_range(tmp_path):
    codes = np.full((4, 4, 4), 100, np.uint8)
    write_png(tmp_path / "a.png", codes)
    codes[1, 1, 0] = 101
    write_png(tmp_path / "b.png", codes)
    result = compare(tmp_path / "b.png", tmp_path / "a.png")
    assert not result.ok and result.max_error == pytest.approx(1 / 255)
    assert compare(tmp_path / "b.png", tmp_path / "a.png", threshold=1.5 / 255).ok


def test_the_difference_picture_shows_what_differs():
    image = changed("R", (3, 4), part()["R"][3, 4] + np.float32(0.125))
    image["instance_id"][0, 0] = 9
    image["Z"][1, 1] = np.inf
    picture, gain = difference_picture(image, part())
    assert gain == 8.0 and picture[3, 4].tolist() == [255, 0, 0]
    assert picture[0, 0].tolist() == picture[1, 1].tolist() == [255, 0, 255]
    assert np.count_nonzero(picture.any(axis=2)) == 3
    assert difference_picture(image, part(), gain=4.0)[0][3, 4].tolist() == [128, 0, 0]
    assert not difference_picture(part(), part())[0].any()
