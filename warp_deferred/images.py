"""Images in and out through OpenImageIO, which is imported on first use.

OpenEXR keeps linear floats, PNG keeps encoded 8-bit pictures; nothing here converts between colour spaces. A file
appears whole or not at all: it is written under another name beside its target and then renamed over it, so an error,
a full disk or Ctrl-C leaves what was there before. A link at the target is replaced, never followed.

Integers: OpenEXR knows unsigned 32-bit numbers only, so -1 is stored as 0xFFFFFFFF and read back as -1. OpenImageIO
sends parts of mixed type through float32, which is exact to 2^24 only; ids therefore get a part of their own beside the
floats, of plain UINT, named after the part they belong to with `.ids` added, and `read_image` puts the two together.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .channels import ID_CHANNELS
from .checks import input_error
from .errors import LoadError

__all__ = ["SUFFIXES", "check_target", "read_image", "read_png", "write_exr", "write_png"]

SUFFIXES = (".exr", ".png")
"""File types that can be written."""

_BAND = 256
"""Rows handed over at a time, so that a 16384-pixel frame is not held twice; a multiple of every EXR block height."""

_IDS = ".ids"


def check_target(path: str | os.PathLike[str]) -> Path:
    """Return `path` if a file could be written there, without touching it.

    Raises:
        LoadError: If the suffix is not known, the folder is missing or not writable, or the path is a folder.
    """
    target = Path(path)
    if target.suffix.lower() not in SUFFIXES:
        raise LoadError(
            f"{target}: expected a file name that ends in .exr (linear layers) or .png (the finished picture), "
            f"got {target.suffix or 'no suffix'!r}; rename the output"
        )
    try:
        if "\0" in str(target):  # the tests below would call it merely absent
            raise ValueError("a zero byte in it")
        if target.is_dir():
            raise LoadError(f"{target}: expected a file to write, got a folder; add a file name to the path")
        folder = target.parent
        if not folder.is_dir():
            got = "a file in its place" if folder.exists() else "no such folder"
            raise LoadError(f"{target}: expected an existing folder {str(folder)!r}, got {got}; create it first")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise LoadError(
                f"{target}: expected a folder that may be written to, got {str(folder)!r} without the right to; "
                "choose another folder"
            )
    except (OSError, ValueError) as error:  # a name too long, or with a zero byte
        raise LoadError(f"{target}: expected a usable file name, got {error}; rename the output") from None
    return target


def write_exr(
    path: str | os.PathLike[str],
    parts: Sequence[Mapping[str, Any]],
    attributes: Sequence[Mapping[str, Any]] | None = None,
    names: Sequence[str] | None = None,
) -> None:
    """Write one OpenEXR file of one or several parts, losslessly compressed.

    NaN becomes 0 and infinities the largest float32 of their sign; only `Z` keeps +inf, which means background there.

    Args:
        path: Where to write; replaced in one step.
        parts: Per part, channel name to array of shape (height, width), one shape for all: floats of any width, or
            whole numbers from -1.
        attributes: Per part, texts and numbers kept in the header.
        names: Per part, its name; `view0`, `view1`, ... if left out.

    Raises:
        InputError: If arrays differ in shape or are of another kind.
        LoadError: If the file cannot be written.
    """
    target = check_target(path)
    if not parts or not all(parts):
        raise input_error("write_exr.parts", "at least one channel in every part", "<none>")
    names = [f"view{i}" for i in range(len(parts))] if names is None else names
    if len(set(names)) != len(parts) or (attributes is not None and len(attributes) != len(parts)):
        raise input_error("write_exr.names", "one name of its own and one set of attributes per part", list(names))
    pieces: list[tuple[str, dict[str, np.ndarray], Mapping[str, Any]]] = []
    arrays = [{name: _check_channel(name, array) for name, array in part.items()} for part in parts]
    shapes = {array.shape for part in arrays for array in part.values()}
    if len(shapes) != 1:  # OpenEXR wants one display window in all parts
        raise input_error("write_exr.parts", "channels of one size", f"<shapes {sorted(shapes)}>")
    for i, checked in enumerate(arrays):
        floats = {name: array for name, array in checked.items() if array.dtype.kind == "f"}
        whole = {name: array for name, array in checked.items() if array.dtype.kind != "f"}
        extra = attributes[i] if attributes is not None else {}
        pieces += [(names[i], floats, extra)] if floats else []
        pieces += [(names[i] + _IDS if floats else names[i], whole, extra)] if whole else []
    _replace(target, lambda temporary: _write_parts(temporary, pieces))


def _check_channel(name: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.ndim != 2 or 0 in array.shape:
        raise input_error(f"write_exr.{name}", "shape (height, width), both > 0", f"<shape {array.shape}>")
    if array.dtype.kind not in "fiu":
        raise input_error(f"write_exr.{name}", "floats or whole numbers", f"<{array.dtype} array>")
    if array.dtype.kind in "iu" and (int(array.min()) < -1 or int(array.max()) > 2**32 - 2):
        raise input_error(f"write_exr.{name}", "ids from -1 to 4294967294", f"<{array.min()} to {array.max()}>")
    return array


def _write_parts(path: Path, pieces: list[tuple[str, dict[str, np.ndarray], Mapping[str, Any]]]) -> None:
    """Write parts of one type each; raises LoadError with OpenImageIO's words, `path` standing for the target."""
    import OpenImageIO as oiio

    specs = []
    for name, channels, attributes in pieces:
        first = next(iter(channels.values()))
        kind = "float" if first.dtype.kind == "f" else "uint"
        spec = oiio.ImageSpec(first.shape[1], first.shape[0], len(channels), kind)
        spec.channelnames = tuple(channels)
        spec.attribute("compression", "zip")
        for key, value in attributes.items():
            spec.attribute(key, value)
        if len(pieces) > 1:
            spec.attribute("oiio:subimagename", name)
        specs.append(spec)
    with _Writer(path) as output:
        _must(output, output.open(str(path), tuple(specs)) if len(specs) > 1 else output.open(str(path), specs[0]))
        for index, (_, channels, _) in enumerate(pieces):
            if index:
                _must(output, output.open(str(path), specs[index], "AppendSubimage"))
            height = specs[index].height
            for top in range(0, height, _BAND):
                bottom = min(top + _BAND, height)
                band = np.stack([_clean(name, array[top:bottom]) for name, array in channels.items()], axis=-1)
                _must(output, output.write_scanlines(top, bottom, 0, band))


def _clean(name: str, rows: np.ndarray) -> np.ndarray:
    """Return rows as OpenEXR keeps them: float32 without NaN, or uint32 with 0xFFFFFFFF for -1."""
    if rows.dtype.kind != "f":
        return rows.astype(np.int64).astype(np.uint32)  # through int64, so that -1 wraps and nothing else does
    limit = float(np.finfo(np.float32).max)
    wide = rows.astype(np.float64 if rows.dtype.itemsize > 4 else np.float32, copy=False)
    clean = np.clip(np.nan_to_num(wide, nan=0.0, posinf=limit, neginf=-limit), -limit, limit)
    if name == "Z":
        clean = np.where(wide == np.inf, np.inf, clean)
    return clean.astype(np.float32)


def write_png(path: str | os.PathLike[str], rgba: Any) -> None:
    """Write an 8-bit sRGB picture, alpha not premultiplied.

    Args:
        path: Where to write; replaced in one step.
        rgba: Shape (height, width, 3 or 4), top row first: uint8 codes, or encoded floats in [0, 1], which are
            clamped and rounded (NaN becomes 0).

    Raises:
        InputError: If shape or kind of number do not fit.
        LoadError: If the file cannot be written.
    """
    target = check_target(path)
    array = np.asarray(rgba)
    if array.ndim != 3 or array.shape[2] not in (3, 4) or 0 in array.shape:
        raise input_error("write_png.rgba", "shape (height, width, 3 or 4)", f"<shape {array.shape}>")
    if array.dtype.kind == "f":
        # Round half up by adding 0.5 and cutting off, as Direct3D 11 does (functional specification, 3.2.3.6).
        array = (np.clip(np.nan_to_num(array, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0) * 255.0 + 0.5).astype(
            np.uint8
        )
    if array.dtype != np.uint8:
        raise input_error("write_png.rgba", "uint8 or floats", f"<{array.dtype} array>", "convert to uint8 first")
    array = np.ascontiguousarray(array)

    def write(temporary: Path) -> None:
        import OpenImageIO as oiio

        spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], "uint8")
        spec.attribute("oiio:ColorSpace", "sRGB")
        spec.attribute("oiio:UnassociatedAlpha", 1)
        with _Writer(temporary) as output:
            _must(output, output.open(str(temporary), spec))
            _must(output, output.write_image(array))

    _replace(target, write)


class _Writer:
    """Context that closes an OpenImageIO output; a failed close (a full disk) is an error too."""

    def __init__(self, path: Path) -> None:
        import OpenImageIO as oiio

        self.output = oiio.ImageOutput.create(str(path))
        if self.output is None:
            raise LoadError(f"expected a file type OpenImageIO can write, got {oiio.geterror()}")

    def __enter__(self) -> Any:
        return self.output

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        closed = self.output.close()
        if kind is None:
            _must(self.output, closed)


def _must(output: Any, done: bool) -> None:
    if not done:
        raise LoadError(output.geterror() or "unknown error of OpenImageIO")


def _replace(target: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a new file beside `target`, then rename it over `target`; on any error only the old stays."""
    temporary = target.with_name(f".{uuid.uuid4().hex}{target.suffix}")
    try:
        # Exclusive creation: nobody else's file or link of that name is written through; the umask decides the rights.
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        write(temporary)
        os.replace(temporary, target)
    except LoadError as error:
        raise LoadError(
            f"{target}: expected to write the image, got {str(error).replace(str(temporary), str(target))}; "
            "check the disk's space and the folder's rights"
        ) from None
    except OSError as error:
        raise LoadError(
            f"{target}: expected to write the image, got {error.strerror}; "
            "check the disk's space and the folder's rights"
        ) from None
    finally:
        temporary.unlink(missing_ok=True)


def read_image(path: str | os.PathLike[str]) -> list[dict[str, np.ndarray]]:
    """Read every part and channel of an image file, as stored.

    Args:
        path: Any file OpenImageIO reads.

    Returns:
        Per part, channel name to array of shape (height, width): uint8 or uint16 codes of files that hold such,
        float32 else; ids int32 with -1 as written. A `.ids` part is joined to the part it belongs to.

    Raises:
        LoadError: If the file is missing or cannot be read whole.
    """
    return [channels for _, channels in _read_parts(Path(path))]


def _read_parts(path: Path) -> list[tuple[str, dict[str, np.ndarray]]]:
    import OpenImageIO as oiio

    if not path.is_file():
        got = "a folder" if path.is_dir() else "no such file"
        raise LoadError(f"{path}: expected an image file, got {got}; check the name")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise LoadError(f"{path}: expected an image OpenImageIO can read, got {oiio.geterror()}; check the file")
    parts: list[tuple[str, dict[str, np.ndarray]]] = []
    try:
        while source.seek_subimage(len(parts), 0):
            parts.append(_read_part(path, source, len(parts)))
    finally:
        source.close()
    joined: list[tuple[str, dict[str, np.ndarray]]] = []
    for name, channels in parts:
        if joined and name == joined[-1][0] + _IDS:
            joined[-1][1].update(channels)
        else:
            joined.append((name, channels))
    return joined


def _read_part(path: Path, source: Any, index: int) -> tuple[str, dict[str, np.ndarray]]:
    spec = source.spec()
    kind = str(spec.format) if str(spec.format) in ("uint8", "uint16", "uint") else "float"
    if spec.channelformats and len({str(f) for f in spec.channelformats}) > 1:
        kind = "float"
    pixels = source.read_image(index, 0, 0, spec.nchannels, kind)
    if pixels is None or source.has_error:
        raise LoadError(f"{path}: expected a whole image, got {source.geterror()}; write or fetch the file again")
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)
    channels = {name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(spec.channelnames)}
    for name in ID_CHANNELS & channels.keys():
        if channels[name].dtype == np.uint32:
            channels[name] = channels[name].view(np.int32)
    return str(spec.getattribute("oiio:subimagename") or ""), channels


def read_png(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a picture as 8-bit codes, shape (height, width, 4); grey is repeated, a missing alpha is 255.

    Raises:
        LoadError: If the file is missing, cannot be read whole, or does not hold 8- or 16-bit codes.
    """
    channels = read_image(path)[0]
    planes = list(channels.values())
    if planes[0].dtype == np.uint16:
        planes = [((plane.astype(np.uint32) * 255 + 32767) // 65535).astype(np.uint8) for plane in planes]
    if planes[0].dtype != np.uint8 or len(planes) > 4:
        raise LoadError(f"{path}: expected an 8- or 16-bit picture, got {planes[0].dtype}; use read_image for layers")
    opaque = np.full_like(planes[0], 255)
    grey = len(planes) < 3
    color = [planes[0]] * 3 if grey else planes[:3]
    alpha = planes[-1] if len(planes) in (2, 4) else opaque
    return np.stack([*color, alpha], axis=-1)
