"""Decoding of image files for textures, through OpenImageIO, to 8-bit RGB or RGBA.

The Python binding of OpenImageIO reads from paths only, so bytes that lie inside another file go through a private
temporary file. The kind of file is told by its first bytes, never by its name, so that no reader but the named few is
ever tried on strange bytes, and the size is checked from the header before any pixel is decoded.
An orientation in the metadata (EXIF) is not applied: glTF 2.0 says that images are used as they are stored.
"""

from __future__ import annotations

import os
import tempfile

import numpy as np

__all__ = ["MAX_IMAGE_SIDE", "decode_image"]

#: Largest side of a texture [px]; the same limit as `Texture` has.
MAX_IMAGE_SIDE = 16384
#: Images of more bytes than this once they are decoded may be as many times the size of their file, no more: one colour
#: comes to 130 times as JPEG, 1000 times as PNG, which nobody paints.
MAX_BLANK_BYTES, MAX_RATIO = 1 << 26, 200

_MAGIC = (
    (b"\x89PNG\r\n\x1a\n", ".png"),
    (b"\xff\xd8\xff", ".jpg"),
    (b"BM", ".bmp"),
    (b"GIF8", ".gif"),
    (b"II*\x00", ".tif"),
    (b"MM\x00*", ".tif"),
)


def decode_image(data: bytes) -> np.ndarray:
    """Decode an image file.

    Args:
        data: The whole file: PNG, JPEG, WebP, BMP, GIF, TIFF or TGA.

    Returns:
        uint8 (height, width, 3 or 4), row 0 at the top, alpha not multiplied in; grey is spread over red, green and
        blue, palettes are looked up, 16 bits are rounded to 8.

    Raises:
        ValueError: With the reason, if the bytes are no such image, are cut short, or the image is too large.
    """
    import OpenImageIO as oiio

    suffix = _suffix(data)
    with tempfile.TemporaryDirectory(prefix="warp-deferred-") as folder:
        path = os.path.join(folder, "image" + suffix)
        with open(path, "wb") as file:
            file.write(data)
        config = oiio.ImageSpec()
        config["oiio:UnassociatedAlpha"] = 1
        source = oiio.ImageInput.open(path, config)
        if source is None:
            raise ValueError(_reason(oiio.geterror(), folder))
        try:
            spec = source.spec()
            if not (0 < spec.width <= MAX_IMAGE_SIDE and 0 < spec.height <= MAX_IMAGE_SIDE):
                raise ValueError(f"it has {spec.width}x{spec.height} pixels, more than {MAX_IMAGE_SIDE} a side")
            channels = min(spec.nchannels, 4)
            size = spec.width * spec.height * channels
            if size > MAX_BLANK_BYTES and size > MAX_RATIO * len(data):
                got = f"{spec.width}x{spec.height} pixels in {len(data)} bytes"
                raise ValueError(f"it has {got}, which would unpack to {size // len(data)} times its size")
            pixels = source.read_image(0, 0, 0, channels, oiio.UINT8)
            if pixels is None or source.has_error:
                raise ValueError(_reason(source.geterror(), folder))
        finally:
            source.close()
    return _color(np.asarray(pixels))


def _suffix(data: bytes) -> str:
    for magic, suffix in _MAGIC:
        if data.startswith(magic):
            return suffix
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return ".webp"
    # TGA has no magic at its start: a known image type and pixel depth at fixed places have to do.
    if len(data) > 18 and data[1] in (0, 1) and data[2] in (1, 2, 3, 9, 10, 11) and data[16] in (8, 15, 16, 24, 32):
        return ".tga"
    raise ValueError("its first bytes are not those of a PNG, JPEG, WebP, BMP, GIF, TIFF or TGA file")


def _reason(text: str, folder: str) -> str:
    """Return the reader's message on one line, without the name of the temporary file."""
    return " ".join(text.replace(folder + os.sep, "").split()) or "it cannot be decoded"


def _color(pixels: np.ndarray) -> np.ndarray:
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.shape[2] <= 2:
        pixels = np.concatenate([np.repeat(pixels[:, :, :1], 3, axis=2), pixels[:, :, 1:]], axis=2)
    return np.ascontiguousarray(pixels)
