"""Decoding of images, against Pillow, and images that cannot be used."""

from __future__ import annotations

import io
import struct
import warnings
import zlib

import numpy as np
import pytest

import warp_deferred as wd
from warp_deferred.loading import LoadWarning
from warp_deferred.texture_files import decode_image

Image = pytest.importorskip("PIL.Image")

RANDOM = np.random.default_rng(3)
RGB = RANDOM.integers(0, 256, (5, 7, 3), dtype=np.uint8)
RGBA = RANDOM.integers(0, 256, (5, 7, 4), dtype=np.uint8)


def encoded(image, kind="PNG", **options) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


@pytest.mark.parametrize(
    ("image", "kind", "channels"),
    [
        (Image.fromarray(RGB), "PNG", 3),
        (Image.fromarray(RGBA), "PNG", 4),
        (Image.fromarray(RGB[:, :, 0]), "PNG", 3),
        (Image.fromarray(RGB[:, :, 0]).convert("LA"), "PNG", 4),
        (Image.fromarray(RGB).convert("P", palette=Image.Palette.ADAPTIVE), "PNG", 3),
        (Image.fromarray(RGB[:, :, 0] > 127), "PNG", 3),
        (Image.fromarray(RGB[:1, :1]), "PNG", 3),
        (Image.fromarray(RGB), "BMP", 3),
        (Image.fromarray(RGBA), "TGA", 4),
        (Image.fromarray(RGBA), "TIFF", 4),
    ],
)
def test_e1_pixels_equal_those_of_pillow(image, kind, channels):
    found = decode_image(encoded(image, kind))
    expected = np.asarray(image.convert("RGBA"))
    assert found.dtype == np.uint8 and found.shape == (*expected.shape[:2], channels)
    np.testing.assert_array_equal(found, expected[:, :, :channels])


def test_e1_sixteen_bits_are_rounded_to_eight():
    values = np.array([[0, 128, 129, 32768, 40000, 65535]], np.uint16)
    found = decode_image(encoded(Image.fromarray(values)))
    np.testing.assert_array_equal(found[0, :, 1], np.round(values[0] / 257.0))


def test_e1_transparent_palette_entries_keep_their_alpha():
    image = Image.fromarray(np.array([[0, 1]], np.uint8), "L").convert("P")
    image.putpalette([10, 20, 30, 40, 50, 60])
    found = decode_image(encoded(image, transparency=1))
    assert found.shape == (1, 2, 4) and found[0, :, 3].tolist() == [255, 0]
    assert found[0, 0].tolist() == [10, 20, 30, 255]


def test_e1_jpeg_and_the_orientation_in_its_metadata_is_not_applied():
    wide = Image.fromarray(np.repeat(np.repeat(RGB[:2, :4], 16, 0), 16, 1))
    exif = Image.Exif()
    exif[0x0112] = 6
    found = decode_image(encoded(wide, "JPEG", quality=95, exif=exif))
    assert found.shape == (32, 64, 3)
    assert np.abs(found.astype(int) - np.asarray(Image.open(io.BytesIO(encoded(wide, "JPEG", quality=95))))).max() <= 4


def header_bomb(side: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")


BROKEN = {
    "text": b"hello, this is no image at all",
    "nothing": b"",
    "header alone": b"\x89PNG\r\n\x1a\n",
    "cut short": encoded(Image.fromarray(RANDOM.integers(0, 256, (64, 64, 3), dtype=np.uint8)))[:3000],
    "cut jpeg": encoded(Image.fromarray(RANDOM.integers(0, 256, (64, 64, 3), dtype=np.uint8)), "JPEG")[:900],
    "bomb": header_bomb(60000),
    "other kind": b"RIFF0000AVI xxxx",
}


@pytest.mark.parametrize("name", BROKEN)
def test_e2_images_that_cannot_be_used_are_dropped_with_one_warning(gltf, name):
    with pytest.raises(ValueError, match=r"\w"):
        decode_image(BROKEN[name])
    image = gltf.add("images", {"bufferView": gltf.view(BROKEN[name]), "name": "bark"})
    info = {"index": gltf.texture(image)}
    material = gltf.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": info}, "occlusionTexture": info})
    gltf.node(mesh=gltf.mesh(gltf.primitive(material=material)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = wd.load(gltf.write())
    messages = [str(w.message) for w in caught if issubclass(w.category, LoadWarning)]
    assert len(messages) == 1 and "'bark'" in messages[0] and "tmp/warp" not in messages[0]
    assert scene.instances[0].material.textures == (None,) * 4
    assert any("'bark'" in note for note in scene.notes)


def test_missing_image_file_is_dropped_and_a_forbidden_one_is_an_error(gltf, tmp_path):
    gltf.add("images", {"uri": "absent.png"})
    info = {"index": gltf.texture(0)}
    material = gltf.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": info}})
    gltf.node(mesh=gltf.mesh(gltf.primitive(material=material)))
    with pytest.warns(LoadWarning, match=r"absent\.png"):
        scene = wd.load(gltf.write())
    assert scene.instances[0].material.base_color_texture is None
    gltf.json["images"][0]["uri"] = "http://127.0.0.1:9/a.png"
    with pytest.raises(wd.LoadError, match="/images/0/uri"):
        wd.load(gltf.write())


def test_decoding_leaves_no_file_behind(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    decode_image(encoded(Image.fromarray(RGB)))
    with pytest.raises(ValueError, match=r"\w"):
        decode_image(BROKEN["cut short"])
    assert list(tmp_path.iterdir()) == []
