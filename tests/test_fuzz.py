"""Files that promise more than they hold are refused in time and memory; finds of the fuzzer stay mended."""

from __future__ import annotations

import copy
import json
import random
import struct
import zlib

import fuzz
import numpy as np
import pytest
from fuzz import FINDS, Loader, damaged, gltf_document, seeds, small_png

import warp_deferred as wd
from warp_deferred.loading import LoadWarning
from warp_deferred.polygons import triangulate_polygon


@pytest.fixture(scope="module")
def loader():
    loader = Loader()
    yield loader
    loader.stop()


@pytest.fixture(scope="module")
def small_loader():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fuzz, "BYTES", 200 << 20)
        loader = Loader()
        yield loader
        loader.stop()


def bomb(side: int) -> bytes:
    """A PNG of one colour: a thousandth of its pixels' size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, row = zlib.compressobj(9), bytes(1 + 3 * side)
    rows = b"".join([packer.compress(row) for _ in range(side)] + [packer.flush()])
    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def document_with(**changes) -> bytes:
    """The seed document with accessors changed: number -> fields; those without a bufferView have no bytes."""
    document, data = gltf_document()
    document = copy.deepcopy(document)
    for place, fields in changes.items():
        number = int(place[1:])
        kept = document["accessors"][number] if "sparse" in document["accessors"][number] else {}
        document["accessors"][number] = kept | fields
    return fuzz.glb(document, data)


def with_image(image: bytes) -> bytes:
    document, data = gltf_document()
    data += bytes(-len(data) % 4)
    document["bufferViews"][3] = {"buffer": 0, "byteOffset": len(data), "byteLength": len(image)}
    document["buffers"] = [{"byteLength": len(data) + len(image)}]
    return fuzz.glb(document, data + image)


def star(corners: int) -> bytes:
    """A polygon that crosses itself everywhere: hardly ever an ear."""
    points = [f"v {i * 7919 % 1999} {i * i % 1999} 0" for i in range(corners)]
    return ("\n".join(points) + "\nf " + " ".join(str(i + 1) for i in range(corners)) + "\n").encode()


PROMISES = {
    "positions.glb": lambda: document_with(a0={"componentType": 5126, "count": 1 << 28, "type": "VEC3"}),
    "indices.glb": lambda: document_with(a2={"componentType": 5125, "count": 3 << 26, "type": "SCALAR"}),
    "sparse.glb": lambda: document_with(a3={"count": 1 << 27}),
    "vertices.ply": lambda: fuzz.PLY_BINARY.replace(b"element vertex 3", b"element vertex 3000000000"),
    "faces.ply": lambda: fuzz.PLY_BINARY.replace(b"element face 1", b"element face 3000000000"),
    "lines.ply": lambda: fuzz.PLY.replace("element vertex 4", "element vertex 3000000000").encode(),
    "faces.stl": lambda: bytes(80) + struct.pack("<I", 2**32 - 1) + fuzz.STL[84:],
    "deep.gltf": lambda: b"[" * 1_000_000,
    "deep.toml": lambda: b"a = " + b"[" * 100_000,
    "not_a_number.gltf": lambda: json.dumps(gltf_document()[0] | {"scene": float("nan")}).encode(),
}
BOUNDED = {
    "image.glb": lambda: with_image(bomb(16384)),
    "polygon.obj": lambda: star(1500),
    "index.obj": lambda: fuzz.OBJ.replace("f -1 -2 -3", f"f -1 -2 -{'3' * 400}").encode(),
}


@pytest.mark.parametrize("name", [*PROMISES, *BOUNDED])
def test_files_that_promise_too_much_take_little_time_and_memory(name, loader, tmp_path):
    path = tmp_path / name
    path.write_bytes((PROMISES | BOUNDED)[name]())
    outcome, seconds = loader.load(path)
    assert outcome == ("refused" if name in PROMISES else "loaded"), (outcome, seconds)


def graph(children: list[list[int]], **fields) -> bytes:
    """A document of nodes that each show a mesh and have these children."""
    document, data = gltf_document()
    nodes = [{"mesh": 0} | ({"children": found} if found else {}) for found in children]
    return fuzz.glb(document | {"nodes": nodes, "scenes": [{"nodes": [0]}]} | fields, data)


GRAPHS = {
    "cycle": ("refused", lambda: graph([[1], [2], [0]])),
    "own child": ("refused", lambda: graph([[0]])),
    "shared children": ("refused", lambda: graph([[k + 1, k + 1] for k in range(26)] + [[]])),
    "two parents": ("loaded", lambda: graph([[1, 2], [3], [3], []])),
    "chain": ("loaded", lambda: graph([[k + 1] for k in range(4999)] + [[]])),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_l14_node_graphs_take_2_s_and_200_mb_at_most(name, small_loader, tmp_path):
    path = tmp_path / "a.glb"
    path.write_bytes(GRAPHS[name][1]())
    assert small_loader.load(path)[0] == GRAPHS[name][0]


def test_an_image_that_unpacks_to_a_thousand_times_its_size_is_left_out(tmp_path):
    path = tmp_path / "a.glb"
    path.write_bytes(with_image(bomb(8192)))
    with pytest.warns(LoadWarning, match=r"8192x8192 pixels in \d+ bytes.*times its size"):
        scene = wd.load(path)
    assert scene.instances[0].material.base_color_texture is None


def test_a_count_without_bytes_is_named(tmp_path):
    path = tmp_path / "a.glb"
    path.write_bytes(PROMISES["positions.glb"]())
    with pytest.raises(wd.LoadError, match=r"/accessors/0/count: expected at most \d+ elements without a bufferView"):
        wd.load(path)


def test_polygons_that_cross_themselves_become_triangles_all_the_same():
    rng = np.random.default_rng(4)
    triangles = triangulate_polygon(np.c_[rng.integers(0, 99, (300, 2)), np.zeros(300)].astype(float))
    assert len(triangles) == 298 and {i for t in triangles for i in t} == set(range(300))


@pytest.mark.parametrize("path", sorted(FINDS.glob("*")), ids=lambda path: path.name)
def test_finds_of_the_fuzzer_stay_mended(path, loader):
    assert loader.load(path)[0] in ("loaded", "refused")


def test_a_little_fuzzing_finds_nothing(loader, tmp_path):
    rng, outcomes = random.Random(20240607), []
    for k in range(250):
        suffix, data = seeds()[k % len(seeds())]
        path = tmp_path / f"file.{suffix}"
        path.write_bytes(damaged(suffix, data, rng))
        outcomes.append(loader.load(path)[0])
        assert outcomes[-1] in ("loaded", "refused"), (k, outcomes[-1])
    assert outcomes.count("refused") > 50 and outcomes.count("loaded") > 20


HANGS = 'print("ready", flush=True)\nimport sys, time\nfor line in sys.stdin: {}'


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("time.sleep(60)", "no answer within"),
        ("sys.exit(3)", "the process ended"),
        ("print('[\"loaded\", 2.5]', flush=True)", "loaded, but in more than 2 s"),
        ("print('[\"memory\", 0.1]', flush=True)", "memory"),
    ],
)
def test_what_hangs_ends_or_takes_too_long_is_a_find(body, words, monkeypatch, tmp_path):
    monkeypatch.setattr(fuzz, "WORKER", HANGS.format(body))
    monkeypatch.setattr(fuzz, "PATIENCE", 0.5)
    loader = Loader()
    (tmp_path / "a.obj").write_bytes(b"x")
    assert loader.load(tmp_path / "a.obj")[0].startswith(words)
    loader.stop()
    assert small_png(2).startswith(b"\x89PNG")
