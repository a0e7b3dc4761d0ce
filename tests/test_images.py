"""Images in and out: exact round trips, atomic writes, errors that name the file."""

import os
import stat

import numpy as np
import pytest

from warp_deferred.channels import ID_CHANNELS, OUTPUTS, check_outputs
from warp_deferred.errors import InputError, LoadError
from warp_deferred.images import check_target, read_image, read_png, write_exr, write_png

IDS = np.array([[-1, 0, 1], [2**24 + 1, 2**31 - 1, 7]], np.int32)


def picture(height=5, width=7, channels=4):
    return np.arange(height * width * channels, dtype=np.uint8).reshape(height, width, channels)


def test_table_names_do_not_collide():
    names = [name for channel in OUTPUTS.values() for name in channel.exr]
    assert len(names) == len(set(names))
    assert {n for n in names if n.endswith("_id")} < ID_CHANNELS
    assert all(len(c.exr) in (0, c.components) for c in OUTPUTS.values())


def test_check_outputs_orders_and_refuses():
    assert check_outputs("outputs", ["depth", "color", "depth"]) == ("color", "depth")
    assert check_outputs("outputs", "normal") == ("normal",)
    with pytest.raises(InputError, match="did you mean 'depth'"):
        check_outputs("outputs", ["dept"])
    with pytest.raises(InputError, match="at least one"):
        check_outputs("outputs", [])


def test_exr_round_trip_is_bit_exact(tmp_path, rng):
    bits = rng.integers(0, 2**32, (300, 17), dtype=np.uint32).view(np.float32)
    floats = np.where(np.isfinite(bits), bits, np.float32(0.5))
    ids = rng.integers(-1, 2**31 - 1, (300, 17), dtype=np.int32)
    depth = np.where(ids % 2 == 0, np.float32(np.inf), floats)
    path = tmp_path / "a.exr"
    write_exr(path, [{"R": floats, "Z": depth, "instance_id": ids}])
    (part,) = read_image(path)
    assert np.array_equal(part["R"].view(np.uint32), floats.view(np.uint32))
    assert np.array_equal(part["Z"].view(np.uint32), depth.view(np.uint32))
    assert part["instance_id"].dtype == np.int32 and np.array_equal(part["instance_id"], ids)


def test_exr_ids_survive_at_their_limits(tmp_path):
    write_exr(tmp_path / "a.exr", [{"Z": np.ones((2, 3), np.float32), "semantic_id": IDS}])
    assert np.array_equal(read_image(tmp_path / "a.exr")[0]["semantic_id"], IDS)
    write_exr(tmp_path / "b.exr", [{"semantic_id": IDS}])
    assert np.array_equal(read_image(tmp_path / "b.exr")[0]["semantic_id"], IDS)


def test_exr_views_become_parts(tmp_path):
    path = tmp_path / "a.exr"
    parts = [
        {"R": np.full((4, 5), 1.0, np.float32), "instance_id": np.full((4, 5), 3)},
        {"R": np.full((4, 5), 2.0, np.float32), "instance_id": np.full((4, 5), -1)},
    ]
    write_exr(path, parts, names=["left", "right"])
    back = read_image(path)
    assert [set(p) for p in back] == [{"R", "instance_id"}] * 2
    for one, two in zip(parts, back, strict=True):
        assert all(np.array_equal(one[name], two[name]) for name in one)


def test_exr_keeps_attributes(tmp_path):
    import OpenImageIO as oiio

    write_exr(tmp_path / "a.exr", [{"R": np.ones((1, 1), np.float32)}], [{"camera_name": "left eye"}])
    assert oiio.ImageBuf(str(tmp_path / "a.exr")).spec().getattribute("camera_name") == "left eye"


def test_e4_exr_cleans_what_is_not_finite(tmp_path):
    big = float(np.finfo(np.float32).max)
    row = np.array([[np.nan, np.inf, -np.inf, -2.5]])
    for dtype in (np.float64, np.float32, np.float16):
        write_exr(tmp_path / "a.exr", [{"R": row.astype(dtype), "Z": row.astype(dtype)}])
        (part,) = read_image(tmp_path / "a.exr")
        assert part["R"].tolist() == [[0.0, big, -big, -2.5]]
        assert part["Z"].tolist() == [[0.0, np.inf, -big, -2.5]]
    write_exr(tmp_path / "a.exr", [{"R": np.array([[1e300, -1e300]])}])
    assert read_image(tmp_path / "a.exr")[0]["R"].tolist() == [[big, -big]]


def test_e4_non_contiguous_arrays_give_the_right_bytes(tmp_path, rng):
    wide = rng.random((6, 8, 3)).astype(np.float32)
    view = wide[::-1, ::2, 1]
    write_exr(tmp_path / "a.exr", [{"R": view}])
    assert np.array_equal(read_image(tmp_path / "a.exr")[0]["R"], view)
    codes = picture(6, 8)[::-1, ::2]
    write_png(tmp_path / "a.png", codes)
    assert np.array_equal(read_png(tmp_path / "a.png"), codes)


def test_e4_png_floats_are_cleaned_and_rounded(tmp_path):
    row = np.array([[[np.nan, np.inf, -np.inf], [-0.1, 1.1, 0.5], [0.4 / 255, 0.6 / 255, 1.0]]])
    write_png(tmp_path / "a.png", row)
    expected = [[[0, 255, 0, 255], [0, 255, 128, 255], [0, 1, 255, 255]]]
    assert read_png(tmp_path / "a.png").tolist() == expected


@pytest.mark.parametrize(
    "bad", [np.ones((2, 3, 1)), np.ones(4), np.ones((0, 3)), np.array([["a"]]), np.ones((1, 1)) > 0]
)
def test_e4_wrong_arrays_are_refused_and_leave_nothing(tmp_path, bad):
    with pytest.raises(InputError, match=r"write_exr\.R"):
        write_exr(tmp_path / "a.exr", [{"R": bad}])
    assert not list(tmp_path.iterdir())


def test_e4_other_wrong_input(tmp_path):
    one = np.ones((2, 2), np.float32)
    with pytest.raises(InputError, match="one size"):
        write_exr(tmp_path / "a.exr", [{"R": one, "G": one[:1]}])
    with pytest.raises(InputError, match="one size"):
        write_exr(tmp_path / "a.exr", [{"R": one}, {"R": one[:1]}])
    with pytest.raises(InputError, match="ids from -1"):
        write_exr(tmp_path / "a.exr", [{"instance_id": np.array([[-2]])}])
    with pytest.raises(InputError, match="at least one channel"):
        write_exr(tmp_path / "a.exr", [])
    for bad in (np.ones((2, 2)), np.ones((2, 2, 5)), np.ones((2, 2, 3), np.int32), np.ones((0, 2, 3), np.uint8)):
        with pytest.raises(InputError, match=r"write_png\.rgba"):
            write_png(tmp_path / "a.png", bad)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(1, 1), (1, 513), (513, 1), (33, 17), (257, 255)])
def test_e5_sizes(tmp_path, shape):
    array = np.arange(shape[0] * shape[1], dtype=np.float32).reshape(shape)
    write_exr(tmp_path / "a.exr", [{"Z": array}])
    assert np.array_equal(read_image(tmp_path / "a.exr")[0]["Z"], array)
    write_png(tmp_path / "a.png", picture(*shape))
    assert np.array_equal(read_png(tmp_path / "a.png"), picture(*shape))


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGB", "RGBA", "I;16"])
def test_e1_png_kinds_read_as_pillow_reads_them(tmp_path, mode):
    image = pytest.importorskip("PIL.Image")
    path = tmp_path / "a.png"
    if mode == "I;16":
        codes = np.arange(0, 60000, 1000, dtype=np.uint16).reshape(6, 10)
        image.fromarray(codes).save(path)
        expected = np.round(codes / 257.0).astype(np.uint8)
        assert np.array_equal(read_png(path)[..., :3], np.repeat(expected[..., None], 3, axis=2))
        return
    made = image.fromarray(picture(6, 10)).convert(mode)
    made.save(path)
    assert np.array_equal(read_png(path), np.asarray(made.convert("RGBA")))


def test_png_alpha_is_not_premultiplied(tmp_path):
    image = pytest.importorskip("PIL.Image")
    codes = np.array([[[200, 100, 50, 0], [200, 100, 50, 128]]], np.uint8)
    write_png(tmp_path / "a.png", codes)
    assert np.array_equal(np.asarray(image.open(tmp_path / "a.png")), codes)
    assert np.array_equal(read_png(tmp_path / "a.png"), codes)


def test_a_link_at_the_target_is_replaced_not_followed(tmp_path):
    victim = tmp_path / "victim.txt"
    victim.write_text("precious")
    link = tmp_path / "a.png"
    link.symlink_to(victim)
    write_png(link, picture())
    assert victim.read_text() == "precious"
    assert not link.is_symlink() and np.array_equal(read_png(link), picture())


def test_new_files_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_png(tmp_path / "a.png", picture())
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.png").stat().st_mode) == 0o640


@pytest.mark.parametrize("failure", [KeyboardInterrupt, MemoryError, OSError(28, "No space left on device")])
def test_e4_an_interrupted_write_keeps_the_old_file(tmp_path, monkeypatch, failure):
    path = tmp_path / "a.exr"
    write_exr(path, [{"R": np.ones((2, 2), np.float32)}])
    old = path.read_bytes()

    def fail(name, rows):
        raise failure

    monkeypatch.setattr("warp_deferred.images._clean", fail)
    with pytest.raises(LoadError if isinstance(failure, OSError) else failure):
        write_exr(path, [{"R": np.zeros((2, 2), np.float32)}])
    assert path.read_bytes() == old and list(tmp_path.iterdir()) == [path]


def test_e4_a_failing_writer_becomes_one_error(tmp_path, monkeypatch):
    import OpenImageIO as oiio

    monkeypatch.setattr(oiio, "ImageOutput", type("Full", (), {"create": staticmethod(lambda path: FullDisk())}))
    with pytest.raises(LoadError, match=r"a\.png: expected to write the image, got disk is full"):
        write_png(tmp_path / "a.png", picture())
    assert not list(tmp_path.iterdir())


class FullDisk:
    """Opens and takes pixels, but reports an error as OpenImageIO does when the disk fills up."""

    def open(self, path, spec):
        return True

    def write_image(self, pixels):
        return True

    def close(self):
        return False

    def geterror(self):
        return "disk is full"


def test_targets_are_checked_before_any_work(tmp_path):
    (tmp_path / "dir.exr").mkdir()
    (tmp_path / "file").write_text("")
    cases = {
        "a.jpg": "ends in .exr",
        "a": "no suffix",
        "dir.exr": "got a folder",
        "missing/a.exr": "no such folder",
        "file/a.exr": "a file in its place",
        "x" * 400 + ".png": "rename the output",
        "a\0b.png": "rename the output",
    }
    for name, words in cases.items():
        with pytest.raises(LoadError, match=words):
            check_target(tmp_path / name)
    assert check_target(tmp_path / "a.PNG").name == "a.PNG"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_the_right_to_write(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(LoadError, match="without the right"):
        check_target(tmp_path / "a.png")


def test_e2_unreadable_files_give_one_error(tmp_path):
    path = tmp_path / "a.exr"
    with pytest.raises(LoadError, match="no such file"):
        read_image(path)
    with pytest.raises(LoadError, match="got a folder"):
        read_image(tmp_path)
    path.write_bytes(b"not an image at all")
    with pytest.raises(LoadError, match=r"a\.exr: expected an image"):
        read_image(path)
    write_exr(path, [{"R": np.random.default_rng(1).random((64, 64)).astype(np.float32)}])
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(LoadError, match="whole image"):
        read_image(path)
    with pytest.raises(LoadError, match="8- or 16-bit"):
        write_exr(path, [{"R": np.ones((2, 2), np.float32)}])
        read_png(path)
