"""Damages small model files at random and loads them in a process with caps on time and memory.

Run from the repository's root: `python -m tests.fuzz [--seconds 60] [--seed N] [--kind glb ...] [--keep FOLDER]`.
Seed files are made here; those under tests/loading/finds are finds of earlier runs, mended since, and are damaged, too.
A file is damaged as bytes (flips, cuts, repeats, extreme numbers) or as what it is (a value of a JSON document, a word
of a text). It must load or be refused with a LoadError, within 2 s and 300 MB. Anything else is a find: it is kept in
a folder, told of, and makes the exit code 1.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import random
import select
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FINDS = ROOT / "tests/loading/finds"
#: Caps of a load: seconds, and bytes beside what the process takes by itself.
SECONDS, BYTES = 2.0, 300 << 20
#: Seconds after which a load that does not end is stopped.
PATIENCE = 10.0

#: Runs in the process: reads (length of the name, name) and answers with a line of JSON for each file.
WORKER = """
import json, os, resource, socket, subprocess, sys, time, warnings
import warp_deferred as wd, warp_deferred.loading
wd.loading._readers()
import trimesh.exchange.obj, trimesh.exchange.ply, trimesh.exchange.stl, OpenImageIO
from warp_deferred import scene_file, texture_files
cap = int(sys.argv[1])
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + cap, used + cap))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
warnings.simplefilter("ignore")
def refuse(*arguments, **fields):
    raise RuntimeError("network or shell")
socket.socket = socket.create_connection = subprocess.Popen = os.system = os.popen = refuse
print("ready", flush=True)
for line in sys.stdin:
    start, outcome = time.perf_counter(), "loaded"
    try:
        wd.load(json.loads(line))
    except wd.LoadError as error:
        outcome = "refused" if "fits in memory" not in str(error) else "memory"
    except BaseException as error:
        outcome = f"{type(error).__name__}: {error}"[:300]
    print(json.dumps([outcome, time.perf_counter() - start]), flush=True)
"""


class Loader:
    """A process that loads files one after another, started anew when one has broken it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def load(self, path: Path) -> tuple[str, float]:
        """Return what came of a file and the seconds it took: loaded, refused, or a find in words."""
        if self._process is None:
            self._start()
        process = self._process
        try:
            process.stdin.write(json.dumps(str(path)) + "\n")
            process.stdin.flush()
            ready = select.select([process.stdout], [], [], PATIENCE)[0]
            answer = process.stdout.readline() if ready else None
        except BrokenPipeError:
            answer = ""
        if answer:
            outcome, seconds = json.loads(answer)
            if outcome in ("loaded", "refused") and seconds > SECONDS:
                outcome = f"{outcome}, but in more than {SECONDS:g} s"
            return outcome, seconds
        self.stop()
        return (
            f"no answer within {PATIENCE:g} s" if answer is None else f"the process ended ({process.returncode})",
            0.0,
        )

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", WORKER, str(BYTES)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True, cwd=ROOT,
        )  # fmt: skip
        if self._process.stdout.readline().strip() != "ready":
            raise RuntimeError("expected the process that loads to start, got its end; run python -m tests.fuzz alone")

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process.stdin.close()
            self._process.stdout.close()
            self._process = None


# ---- seed files


def small_png(side: int = 4) -> bytes:
    """A PNG of so many black pixels a side."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes((1 + 3 * side) * side))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def gltf_document() -> tuple[dict, bytes]:
    """A document with a little of everything, and its binary chunk."""
    corners = struct.pack("<12f", 0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0)
    parts = [corners, struct.pack("<8f", 0, 0, 1, 0, 1, 1, 0, 1), struct.pack("<6H", 0, 1, 2, 0, 2, 3), small_png()]
    views, data = [], b""
    for part in parts:
        data += bytes(-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(part)})
        data += part
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
        {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        {
            "componentType": 5126, "count": 4, "type": "VEC3",
            "sparse": {
                "count": 2, "indices": {"bufferView": 2, "componentType": 5123},
                "values": {"bufferView": 0},
            },
        },
    ]  # fmt: skip
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1, 2]}],
        "nodes": [
            {"mesh": 0, "children": [3], "translation": [1, 2, 3], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]},
            {"camera": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1]},
            {"extensions": {"KHR_lights_punctual": {"light": 0}}},
            {"mesh": 1},
        ],
        "meshes": [{"primitives": [primitive]}, {"primitives": [{"attributes": {"POSITION": 3}, "mode": 5}]}],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 0.5]},
             "emissiveFactor": [1, 0, 0], "alphaMode": "MASK", "alphaCutoff": 0.5}
        ],
        "textures": [{"source": 0, "sampler": 0}], "samplers": [{"wrapS": 33071}], "images": [{"bufferView": 3}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}],
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensions": {"KHR_lights_punctual": {"lights": [{"type": "spot", "intensity": 3, "spot": {}}]}},
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    return document, data


def glb(document: dict, data: bytes) -> bytes:
    """Pack a document and a binary chunk."""
    text = json.dumps(document).encode()
    text, data = text + b" " * (-len(text) % 4), data + bytes(-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


OBJ = """mtllib a.mtl
o thing
v 0 0 0 1 0 0
v 1 0 0 0 1 0
v 1 1 0 0 0 1
v 0 1 0
v 0.5 0.25 0
vt 0 0
vt 1 1
vn 0 0 1
usemtl red
f 1/1/1 2/2/1 3/1/1 4/2/1 5/1/1
f -1 -2 -3
f 1//1 2//1 3//1
"""
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
end_header
0 0 0 255 0 0
1 0 0 0 255 0
1 1 0 0 0 255
0 1 0 9 9 9
3 0 1 2
4 0 1 2 3
"""
PLY_BINARY = b"""ply
format binary_little_endian 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
""" + struct.pack("<9fB3i", 0, 0, 0, 1, 0, 0, 0, 1, 0, 3, 0, 1, 2)
STL = bytes(80) + struct.pack("<I", 1) + struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
STL_ASCII = """solid thing
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid thing
"""
TOML = """[camera]
eye = [0, 1, 4]
target = [0, 0, 0]
vertical_fov_deg = 40
[[model]]
file = "model.glb"
translate = [1, 2, 3]
scale = 2
[[light]]
kind = "spot"
position = [0, 3, 0]
direction = [0, -1, 0]
[settings.display]
tone_mapping = "aces"
"""


def seeds() -> list[tuple[str, bytes]]:
    """(Suffix, bytes) of all seed files, finds of earlier runs among them."""
    document, data = gltf_document()
    inline = document | {"buffers": [{"byteLength": len(data), "uri": "data:application/octet-stream;base64,AAAA"}]}
    made = [
        ("glb", glb(document, data)), ("gltf", json.dumps(inline).encode()), ("obj", OBJ.encode()),
        ("ply", PLY.encode()), ("ply", PLY_BINARY), ("stl", STL), ("stl", STL_ASCII.encode()), ("toml", TOML.encode()),
    ]  # fmt: skip
    return made + [(path.suffix[1:], path.read_bytes()) for path in sorted(FINDS.glob("*.*")) if path.suffix != ".md"]


# ---- damage

EXTREMES = (0, -1, 1, 255, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 2**63, 10**30, 1e39, -1e39, 1e308, 0.5)
WORDS = ("nan", "inf", "-inf", "NaN", "1e999", "99999999999", "-1", "0", "", "/", "//", "../x", "\0", "[[[[", '"')


def flip(data: bytes, rng: random.Random) -> bytes:
    """Change single bytes."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        result[rng.randrange(len(result))] = rng.choice((0, 255, 127, 128, rng.randrange(256)))
    return bytes(result)


def cut(data: bytes, rng: random.Random) -> bytes:
    """Take a stretch out, or the end away."""
    start = rng.randrange(len(data))
    return data[:start] + data[start + rng.choice((1, 4, 16, len(data))) :]


def repeat(data: bytes, rng: random.Random) -> bytes:
    """Put a stretch in once more, or very often."""
    start = rng.randrange(len(data))
    piece = data[start : start + rng.choice((1, 4, 32))]
    return data[:start] + piece * rng.choice((2, 3, 1000)) + data[start:]


def overwrite(data: bytes, rng: random.Random) -> bytes:
    """Put an extreme 32-bit number somewhere."""
    start = rng.randrange(max(1, len(data) - 4))
    kind, values = rng.choice((("<I", (0, 1, 2**31, 2**32 - 1, 10**9)), ("<f", (float("nan"), float("inf"), 3e38))))
    return data[:start] + struct.pack(kind, rng.choice(values)) + data[start + 4 :]


def replace_word(data: bytes, rng: random.Random) -> bytes:
    """Put another word in the place of one of a text."""
    words = data.split(b" ")
    words[rng.randrange(len(words))] = rng.choice((*WORDS, str(rng.choice(EXTREMES)))).encode()
    return b" ".join(words)


def replace_value(value: object, rng: random.Random) -> object:
    """Change one value somewhere inside a JSON value."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.1:
            return {k: v for k, v in value.items() if k != key}
        return value | {key: replace_value(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        place = rng.randrange(len(value))
        return [*value[:place], replace_value(value[place], rng), *value[place + 1 :]]
    other = (*EXTREMES, "", "x", "../a.bin", None, True, [], {}, [0] * 5000, [[[]]])
    return rng.choice(other)


def damage_document(data: bytes, rng: random.Random) -> bytes:
    """Change values of the JSON document inside a GLB or glTF file."""
    if data[:4] != b"glTF":
        document = json.loads(data)
    else:
        size = struct.unpack_from("<I", data, 12)[0]
        document = json.loads(data[20 : 20 + size])
    for _ in range(rng.choice((1, 1, 2, 3))):
        document = replace_value(document, rng)
    if data[:4] != b"glTF":
        return json.dumps(document).encode()
    return glb(document, data[20 + size + 8 :])


BYTES_DAMAGE: tuple[Callable[[bytes, random.Random], bytes], ...] = (flip, cut, repeat, overwrite)


def damaged(suffix: str, data: bytes, rng: random.Random) -> bytes:
    """A file with one or a few damages."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        kind = rng.choice(BYTES_DAMAGE)
        try:
            if suffix in ("glb", "gltf") and rng.random() < 0.6:
                kind = damage_document
            elif suffix in ("obj", "ply", "stl", "toml") and rng.random() < 0.5:
                kind = replace_word
            data = kind(data, rng) or b"\0"
        except (ValueError, struct.error, AttributeError, RecursionError):
            data = flip(data, rng)
    return data


# ---- the run


@dataclasses.dataclass
class Tally:
    """What came of a run."""

    loaded: int = 0
    refused: int = 0
    finds: list[str] = dataclasses.field(default_factory=list)


def run(seconds: float, seed: int, kinds: list[str], keep: Path) -> Tally:
    """Damage and load files for so many seconds."""
    rng, loader, tally = random.Random(seed), Loader(), Tally()
    known = [(suffix, data) for suffix, data in seeds() if not kinds or suffix in kinds]
    document, binary = gltf_document()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name)
        (folder / "model.glb").write_bytes(glb(document, binary))
        (folder / "a.mtl").write_text("newmtl red\nKd 1 0 0\nmap_Kd a.png\n")
        (folder / "a.png").write_bytes(small_png())
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            suffix, data = rng.choice(known)
            data = damaged(suffix, data, rng)
            path = folder / f"file.{suffix}"
            path.write_bytes(data)
            outcome, _ = loader.load(path)
            if outcome in ("loaded", "refused"):
                setattr(tally, outcome, getattr(tally, outcome) + 1)
                continue
            keep.mkdir(parents=True, exist_ok=True)
            find = keep / f"{zlib.crc32(data):08x}.{suffix}"
            find.write_bytes(data)
            tally.finds.append(f"{find}: {outcome}")
            print(tally.finds[-1], flush=True)
        loader.stop()
    return tally


def main(arguments: list[str] | None = None) -> int:
    """Run and report; the exit code is 1 if there are finds."""
    parser = argparse.ArgumentParser(description="Damage model files and load them under caps of time and memory.")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to run")
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(4)), help="seed of the damages")
    parser.add_argument("--kind", nargs="+", default=[], choices=("glb", "gltf", "obj", "ply", "stl", "toml"))
    parser.add_argument("--keep", type=Path, default=Path("out/fuzz"), help="folder for finds")
    options = parser.parse_args(arguments)
    tally = run(options.seconds, options.seed, options.kind, options.keep)
    print(f"seed {options.seed}: {tally.loaded} loaded, {tally.refused} refused, {len(tally.finds)} finds")
    return 1 if tally.finds else 0


if __name__ == "__main__":
    sys.exit(main())
