"""A small glTF writer for the loading tests, and the place of the real models."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
ASSETS = Path(__file__).resolve().parents[2].parent / "shared" / "assets"


class GltfWriter:
    """Collects a glTF document and its one buffer, and writes it as GLB or as JSON with a data URI."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.json: dict = {"asset": {"version": "2.0"}, "nodes": [], "meshes": [], "accessors": [], "bufferViews": []}
        self.data = bytearray()

    def add(self, section: str, item: dict) -> int:
        self.json.setdefault(section, []).append(item)
        return len(self.json[section]) - 1

    def view(self, data: bytes, **fields) -> int:
        self.data += bytes(-len(self.data) % 4)
        start = len(self.data)
        self.data += data
        return self.add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data), **fields})

    def array(self, values, **fields) -> int:
        values = np.asarray(values)
        width = values.shape[1] if values.ndim == 2 else 1
        view = self.view(np.ascontiguousarray(values).tobytes())
        item = {
            "bufferView": view,
            "componentType": COMPONENTS[values.dtype.str[1:]],
            "count": len(values),
            "type": KINDS[width],
        }
        return self.add("accessors", item | fields)

    def primitive(self, positions=TRIANGLE, indices=None, material=None, mode=None, **attributes) -> dict:
        found = {"attributes": {"POSITION": self.array(np.asarray(positions, np.float32))}}
        for name, values in attributes.items():
            found["attributes"][name] = values if isinstance(values, int) else self.array(values)
        if indices is not None:
            found["indices"] = self.array(np.asarray(indices).reshape(-1))
        if material is not None:
            found["material"] = material
        if mode is not None:
            found["mode"] = mode
        return found

    def mesh(self, *primitives: dict, **fields) -> int:
        return self.add("meshes", {"primitives": list(primitives), **fields})

    def node(self, **fields) -> int:
        return self.add("nodes", fields)

    def image(self, pixels: np.ndarray) -> int:
        return self.add("images", {"bufferView": self.view(png(pixels)), "mimeType": "image/png"})

    def texture(self, image: int, **sampler) -> int:
        fields = {"source": image}
        if sampler:
            fields["sampler"] = self.add("samplers", sampler)
        return self.add("textures", fields)

    def write(self, name: str = "model.glb") -> Path:
        path = self.folder / name
        document = dict(self.json)
        if "buffers" not in document:
            document["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(document).encode()
        if name.endswith(".gltf"):
            path.write_bytes(text)
            return path
        text += b" " * (-len(text) % 4)
        data = bytes(self.data) + bytes(-len(self.data) % 4)
        total = 12 + 8 + len(text) + 8 + len(data)
        path.write_bytes(
            struct.pack("<4sII", b"glTF", 2, total)
            + struct.pack("<I4s", len(text), b"JSON")
            + text
            + struct.pack("<I4s", len(data), b"BIN\0")
            + data
        )
        return path


def png(pixels: np.ndarray, **options) -> bytes:
    """Encode a PNG with Pillow, independently of the library under test."""
    image = pytest.importorskip("PIL.Image").fromarray(np.asarray(pixels))
    file = io.BytesIO()
    image.save(file, "PNG", **options)
    return file.getvalue()


@pytest.fixture
def gltf(tmp_path) -> GltfWriter:
    return GltfWriter(tmp_path)


@pytest.fixture
def write_png(tmp_path):
    """Write pixels as a PNG file beside the model and return its path."""

    def write(name: str, pixels: np.ndarray) -> Path:
        path = tmp_path / name
        path.write_bytes(png(pixels))
        return path

    return write


@pytest.fixture
def asset():
    """Return the path of a real model; skip where the folder of models is not there."""

    def find(name: str) -> Path:
        if not (ASSETS / name).is_file():
            pytest.skip(f"no {name}: the folder shared/assets is not beside the repository")
        return ASSETS / name

    return find


@pytest.fixture
def load_quietly():
    """Load a file and turn any LoadWarning into an error: what is loaded so needs no repair."""
    import warnings

    import warp_deferred as wd
    from warp_deferred.loading import LoadWarning

    def load(path):
        with warnings.catch_warnings():
            warnings.simplefilter("error", LoadWarning)
            return wd.load(path)

    return load
