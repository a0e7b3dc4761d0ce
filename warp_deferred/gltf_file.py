"""The container of a glTF 2.0 asset: GLB chunks, JSON, buffers and images by URI, accessors as NumPy arrays.

The JSON is read here and not through trimesh, which decodes glTF well but leaves no way to tell which of its meshes
came from which primitive, reads no cameras but the first, no lights and no samplers, and passes indices and offsets
that lie outside their buffers. Reading the accessors takes a page of NumPy and lets every bound be checked.
Source: glTF 2.0 specification, sections 3.6 (buffers, accessors) and 4 (GLB), Khronos 2021.

URIs are trusted with nothing: `data:` and relative paths that stay inside the file's own folder, no network, no
absolute paths, nothing expanded but %xx.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np

from .load_report import LoadReport

__all__ = ["GltfFile", "local_file"]

_COMPONENTS = {
    5120: np.dtype("<i1"),
    5121: np.dtype("<u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
#: More elements than this in one accessor are refused before memory is asked for.
_MAX_COUNT = 1 << 28
#: The same where no bytes are there to back them: accessors without a buffer view, which are zeros but for sparse ones.
_MAX_ZEROS = 1 << 20
_GLB = struct.Struct("<4sII")
_CHUNK = struct.Struct("<II")
_JSON_CHUNK, _BIN_CHUNK = 0x4E4F534A, 0x004E4942


def local_file(folder: Path, uri: str) -> Path:
    """Return the path of a file that a URI names inside `folder`.

    Raises:
        ValueError: With the reason, if it is no relative path, leaves the folder, or is no regular file.
    """
    if re.match(r"[A-Za-z][A-Za-z0-9+.\-]*:", uri):
        raise ValueError("it is not a relative path (nothing is fetched, and no absolute path is followed)")
    path = urllib.parse.unquote(uri)
    if not path or "\0" in path or path.startswith(("/", "\\")):
        raise ValueError("it is not a relative path")
    root = folder.resolve()
    target = (root / path.replace("\\", "/")).resolve()
    if not target.is_relative_to(root):
        raise ValueError("it leads out of the file's own folder")
    if not target.is_file():
        raise FileNotFoundError("there is no such file")
    return target


class GltfFile:
    """An opened glTF or GLB file.

    Attributes:
        report: Where errors, notes and repairs about this file go.
        json: The root object.
    """

    def __init__(self, path: Path, report: LoadReport) -> None:
        self.report, self._folder = report, path.parent
        data = path.read_bytes()
        self._binary: memoryview | None = None
        text = self._read_glb(data) if data[:4] == b"glTF" else data
        self.json = self._parse(text, path)
        self._buffers: dict[int, memoryview] = {}
        self._arrays: dict[int, np.ndarray] = {}
        self._sections: dict[str, list[dict[str, Any]]] = {}

    def _read_glb(self, data: bytes) -> bytes:
        mend = "copy or export the file again"
        if len(data) < 20:
            raise self.report.error("(GLB)", "a header of 20 bytes", f"{len(data)} bytes", mend)
        _, version, length = _GLB.unpack_from(data)
        if version != 2:
            raise self.report.error("(GLB)", "version 2", f"version {version}", "convert the file to glTF 2.0")
        if length > len(data):
            raise self.report.error("(GLB)", f"{length} bytes", f"only {len(data)}: it is cut short", mend)
        offset, text = _GLB.size, None
        while offset + _CHUNK.size <= length:
            size, kind = _CHUNK.unpack_from(data, offset)
            offset += _CHUNK.size
            if offset + size > length:
                raise self.report.error("(GLB)", f"a chunk of {size} bytes at byte {offset}", "the file's end", mend)
            if kind == _JSON_CHUNK and text is None:
                text = data[offset : offset + size]
            elif kind == _BIN_CHUNK and self._binary is None:
                self._binary = memoryview(data)[offset : offset + size]
            offset += size + (-size) % 4
        if text is None:
            raise self.report.error("(GLB)", "a JSON chunk", "none", mend)
        return text

    def _parse(self, text: bytes, path: Path) -> dict[str, Any]:
        def constant(word: str) -> float:
            raise ValueError(f"{word} is not JSON")

        try:
            root = json.loads(text.decode("utf-8-sig").rstrip("\0 \n\r\t"), parse_constant=constant)
        except (ValueError, RecursionError) as error:
            kind = "glTF JSON in UTF-8" if path.suffix.lower() == ".gltf" else "a GLB header or glTF JSON"
            got = "nesting without end" if isinstance(error, RecursionError) else str(error)
            raise self.report.error("", kind, got, "check that the file is whole and is glTF") from None
        if not isinstance(root, dict):
            raise self.report.error("", "a JSON object", type(root).__name__, "check that the file is glTF")
        with self.report.at("/asset"):
            version = str(root.get("asset", {}).get("version", "2.0"))
        if version.split(".")[0] != "2":
            raise self.report.error("/asset/version", "2.0", version, "convert the file to glTF 2.0")
        return root

    def items(self, section: str) -> list[dict[str, Any]]:
        """Return one of the root's arrays of objects; empty if the file has none."""
        if section not in self._sections:
            found = self.json.get(section, [])
            if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
                mend = "export the file again"
                raise self.report.error(f"/{section}", "a list of objects", type(found).__name__, mend)
            self._sections[section] = found
        return self._sections[section]

    def item(self, section: str, index: Any, where: str) -> dict[str, Any]:
        """Return an object of one of the root's arrays; `where` is the place that refers to it."""
        found = self.items(section)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(found):
            raise self.report.error(where, f"an index below {len(found)} into /{section}", repr(index), "correct it")
        return found[index]

    def read_uri(self, uri: Any, where: str) -> bytes:
        """Return the bytes of a `data:` URI or of a file in the same folder.

        Raises:
            LoadError: If the URI is of a kind that is not followed, or broken.
            FileNotFoundError: If it names a file that is not there.
        """
        if not isinstance(uri, str):
            raise self.report.error(where, "a text", repr(uri))
        if uri.startswith("data:"):
            head, comma, body = uri.partition(",")
            try:
                if not comma:
                    raise ValueError("no comma")
                if head.endswith(";base64"):
                    return base64.b64decode(urllib.parse.unquote(body), validate=True)
                return urllib.parse.unquote_to_bytes(body)
            except (ValueError, binascii.Error) as error:
                raise self.report.error(where, "a data URI in base64", str(error), "export the file again") from None
        try:
            return local_file(self._folder, uri).read_bytes()
        except ValueError as error:
            raise self.report.error(
                where,
                "a data URI or a relative path inside the file's folder",
                f"{uri!r}: {error}",
                "put the data beside the file and name it by a relative path",
            ) from None

    def _buffer(self, index: Any, where: str) -> memoryview:
        buffer = self.item("buffers", index, where)
        if index not in self._buffers:
            place = f"/buffers/{index}"
            if "uri" in buffer:
                try:
                    data = memoryview(self.read_uri(buffer["uri"], f"{place}/uri"))
                except OSError as error:
                    mend = "put the buffer's file beside the glTF"
                    raise self.report.error(f"{place}/uri", "a file", f"{buffer['uri']!r}: {error}", mend) from None
            elif index == 0 and self._binary is not None:
                data = self._binary
            else:
                raise self.report.error(place, "a uri or a binary chunk", "neither", "export the file again")
            with self.report.at(place):
                length = int(buffer["byteLength"])
            if not 0 <= length <= len(data):
                raise self.report.error(place, f"{length} bytes", f"{len(data)}: it is cut short", "copy it again")
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def view(self, index: Any, where: str) -> tuple[memoryview, int]:
        """Return (bytes, stride; 0 for packed) of a buffer view."""
        view = self.item("bufferViews", index, where)
        place = f"/bufferViews/{index}"
        with self.report.at(place):
            start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
            stride = int(view.get("byteStride", 0))
            data = self._buffer(view["buffer"], f"{place}/buffer")
        if start < 0 or length < 0 or stride < 0 or start + length > len(data):
            got = f"bytes {start} to {start + length} of a buffer of {len(data)}"
            raise self.report.error(place, "a range inside its buffer", got, "the file is damaged; export it again")
        return data[start : start + length], stride

    def accessor(self, index: Any, where: str, widths: tuple[int, ...], *, keep_integers: bool = False) -> np.ndarray:
        """Decode an accessor.

        Args:
            index: Its index.
            where: The place that refers to it.
            widths: Components an element may have there; (1,) gives a flat array.
            keep_integers: Whether whole numbers stay what they are; otherwise float32, scaled to 0..1 or -1..1 where
                the accessor is marked normalized.

        Raises:
            LoadError: If its type is unknown or unfit, or its bytes lie outside their buffer.
        """
        accessor = self.item("accessors", index, where)
        place = f"/accessors/{index}"
        with self.report.at(place):
            kind, component = accessor["type"], accessor["componentType"]
            if _WIDTHS.get(kind) not in widths:
                names = " or ".join(k for k, w in _WIDTHS.items() if w in widths)
                raise self.report.error(f"{place}/type", f"{names} (for {where})", repr(kind), "export the file again")
            if component not in _COMPONENTS:
                listed = ", ".join(map(str, _COMPONENTS))
                raise self.report.error(f"{place}/componentType", f"one of {listed}", repr(component))
            if index not in self._arrays:
                self._arrays[index] = self._decode(accessor, place, _COMPONENTS[component], _WIDTHS[kind])
        values = self._arrays[index]
        if keep_integers:
            if values.dtype.kind == "f":
                raise self.report.error(f"{place}/componentType", f"whole numbers (for {where})", component)
        elif values.dtype.kind != "f":
            scale = np.float32(np.iinfo(values.dtype).max) if accessor.get("normalized") else np.float32(1.0)
            values = np.maximum(values.astype(np.float32) / scale, np.float32(-1.0 if scale != 1.0 else -np.inf))
        return values[:, 0] if widths == (1,) else values

    def _decode(self, accessor: dict[str, Any], place: str, dtype: np.dtype, width: int) -> np.ndarray:
        count = accessor["count"]
        if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= _MAX_COUNT:
            raise self.report.error(f"{place}/count", f"a whole number from 0 to {_MAX_COUNT}", repr(count))
        if "bufferView" in accessor:
            offset = int(accessor.get("byteOffset", 0))
            values = self._strided(accessor["bufferView"], place, offset, count, dtype, width)
        else:
            if count > _MAX_ZEROS:
                expected = f"at most {_MAX_ZEROS} elements without a bufferView"
                raise self.report.error(f"{place}/count", expected, count, "name the buffer view that holds them")
            values = np.zeros((count, width), dtype)
        sparse = accessor.get("sparse")
        if sparse:
            values = values.copy()
            changed = int(sparse["count"])
            where, new = sparse["indices"], sparse["values"]
            kind = _COMPONENTS[where["componentType"]]
            rows = self._strided(
                where["bufferView"], f"{place}/sparse", int(where.get("byteOffset", 0)), changed, kind, 1
            )
            if kind.kind == "f" or (changed and (int(rows.min()) < 0 or int(rows.max()) >= count)):
                raise self.report.error(f"{place}/sparse/indices", f"whole numbers from 0 to {count - 1}", "others")
            values[rows[:, 0]] = self._strided(
                new["bufferView"], f"{place}/sparse", int(new.get("byteOffset", 0)), changed, dtype, width
            )
        return values

    def _strided(self, view: Any, place: str, offset: int, count: int, dtype: np.dtype, width: int) -> np.ndarray:
        """Return (count, width) elements of a buffer view, without a copy."""
        data, stride = self.view(view, f"{place}/bufferView")
        size = dtype.itemsize * width
        stride = stride or size
        if offset < 0 or count < 0 or stride < size:
            raise self.report.error(place, f"an offset >= 0 and a stride >= {size}", f"{offset} and {stride}")
        if count and offset + (count - 1) * stride + size > len(data):
            got = f"{count} elements of {stride} bytes from byte {offset} in a view of {len(data)} bytes"
            raise self.report.error(place, "elements inside its buffer view", got, "the file is cut short or damaged")
        if not count:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))
