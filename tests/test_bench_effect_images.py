"""Strips and the sheet of effects: where they are cut, how they are laid out, labelled and kept small."""

import dataclasses

import bench_package  # noqa: F401
import numpy as np

from bench import effect_cases, effect_images


def test_a_cut_is_where_the_case_says_and_enlarged():
    image = np.zeros((40, 60, 4), np.uint8)
    image[20, 15] = 255
    case = dataclasses.replace(effect_cases.EFFECT_CASES["anti_aliasing"], centre=(0.25, 0.5), zoom=2)
    piece = effect_images.cut(image, case, (12, 8))
    assert piece.shape == (8, 12, 4) and piece[..., 0].sum() == 4 * 255
    y, x = np.argwhere(piece[..., 0])[0]
    assert (y, x) == (4, 6)
    # At a border the cut moves inwards; it never grows past the picture.
    corner = effect_images.cut(image, dataclasses.replace(case, centre=(1.0, 1.0), zoom=1), (500, 8))
    assert corner.shape == (8, 60, 4)


def test_pictures_lie_from_left_to_right_then_down():
    cuts = [np.full((2, 3, 4), k, np.uint8) for k in range(5)]
    sheet = effect_images.lay_side_by_side(cuts)
    gap = effect_images.GAP
    assert sheet.shape == (4 + gap, 9 + 2 * gap, 4)
    assert [sheet[0, k * (3 + gap), 0] for k in range(3)] == [0, 1, 2]
    assert [sheet[2 + gap, k * (3 + gap), 0] for k in range(3)] == [3, 4, 255]


def test_differences_are_multiplied_and_opaque():
    one, other = np.zeros((2, 3, 4), np.uint8), np.full((2, 3, 4), 10, np.uint8)
    other[0, 0] = 200
    apart = effect_images.difference(one, other, 4)
    assert apart[1, 1].tolist() == [40, 40, 40, 255] and apart[0, 0].tolist() == [255] * 4
    assert np.array_equal(apart, effect_images.difference(other, one, 4))


def test_labels_stand_above_their_pictures():
    picture = np.full((20, 100, 4), 7, np.uint8)
    shown = effect_images.labelled(picture, "gtao_half")
    bar = shown[: effect_images.BAR]
    assert np.array_equal(shown[effect_images.BAR :], picture)
    assert (bar[..., 3] == 255).all() and 20 < (bar[..., 0] < 128).sum() < 500
    assert (effect_images.labelled(picture, "")[: effect_images.BAR] == 255).all()


def test_a_sheet_s_cell_is_half_without_and_half_with():
    off, on = np.zeros((8, 60, 4), np.uint8), np.full((8, 60, 4), 90, np.uint8)
    cell = effect_images._halves("bloom", off, on)[effect_images.BAR :]
    assert cell[0, 28, 0] == 0 and (cell[:, 29:31] == 255).all() and cell[0, 31, 0] == 90
    assert effect_images._smaller(np.arange(16, dtype=np.uint8).reshape(2, 2, 4), 2).tolist() == [[[6, 7, 8, 9]]]


def test_a_strip_shrinks_until_it_fits(tmp_path, monkeypatch):
    noise = np.random.default_rng(0).integers(0, 255, (270, 480, 4)).astype(np.uint8)
    monkeypatch.setattr(effect_images, "MOST_BYTES", 60_000)
    case = effect_cases.EFFECT_CASES["bloom"]
    path = effect_images.write_cells(tmp_path / "a.png", case, {"off": noise, "exact": noise})
    assert 20_000 < path.stat().st_size <= 60_000 and effect_images.strip_rungs(path) == ["off", "exact"]
