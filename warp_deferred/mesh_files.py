"""OBJ, PLY and STL files to a `Scene`, through trimesh's readers.

trimesh's file readers are called directly and hand over raw arrays: its `Trimesh` class would merge, reorder and turn
colours into bytes before the bad values could be counted. OBJ text is checked first (see `obj_text`).

Texture coordinates count v from the bottom in OBJ and PLY; they are turned over, since v = 0 is the top row here.
OBJ and PLY without normals get smooth ones (scans and sculptures), STL gets each face's own (its files share no
vertices, and are mostly machine parts). Surfaces are two-sided, for none of the three formats knows culling.
Vertex colours are display colours by custom and decoded from sRGB.
"""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .load_report import LoadReport
from .materials import Material
from .mesh_repair import linear_from_srgb, repaired_mesh
from .normals import smooth_normals
from .obj_materials import file_texture, read_mtl
from .obj_text import MATERIAL_FILE, MATERIAL_NAME, ObjText
from .polygons import triangulate_polygon
from .scene import Mesh, Scene

__all__ = ["load_obj", "load_ply", "load_stl"]

_PLAIN = Material(base_color=(0.8, 0.8, 0.8, 1.0), roughness=0.6, two_sided=True)
#: White, where vertex colours say the rest.
_COLORED = _PLAIN.replace(base_color=(1.0, 1.0, 1.0, 1.0))


def load_obj(path: Path, report: LoadReport) -> Scene:
    """Read a Wavefront OBJ file and the material files it names: one instance per object and material."""
    from trimesh.exchange import obj

    source = ObjText(path.read_bytes(), report)
    materials = read_mtl(path.parent, source.libraries, report) if source.materials else {}
    names = _Names(len(source.materials))
    with (
        report.at("", "OBJ lines with as many numbers as their kind asks for", foreign=True),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", DeprecationWarning)
        raw = obj.load_obj(io.BytesIO(source.text.encode()), resolver=names, split_objects=True)
    scene = Scene(path.name)
    # trimesh hands the groups over last first.
    for group_name, group in reversed(raw.get("geometry", {}).items()):
        visual, colors = group.get("visual"), group.get("vertex_colors")
        number = source.material_number(getattr(getattr(visual, "material", None), "name", None))
        key = "" if number is None else source.materials[number]
        name = str(group_name).replace(MATERIAL_NAME.format(number), key) if number is not None else str(group_name)
        material = materials.get(key)
        if material is None:
            if key and source.libraries:
                report.note(f"material {key!r} is in none of the material files; grey is used")
            material = _PLAIN if colors is None else _COLORED
        mesh = _mesh(
            report,
            path.stem if name == names.file_name else name,
            group["vertices"],
            group["faces"],
            normals=group.get("vertex_normals"),
            uvs=None if visual is None else visual.uv,
            colors=colors,
        )
        scene.add(mesh, material=material)
    return scene


class _Names:
    """Stands in for the folder of an OBJ file: its only file defines the numbered materials' names, nothing else."""

    file_name = "?"

    def __init__(self, material_count: int) -> None:
        self._count = material_count

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def get(self, name: str) -> bytes:
        """Return the made-up material file."""
        if name != MATERIAL_FILE:
            raise FileNotFoundError(name)
        return "".join(f"newmtl {MATERIAL_NAME.format(k)}\n" for k in range(self._count)).encode()


def load_ply(path: Path, report: LoadReport) -> Scene:
    """Read a Stanford PLY file: one mesh, its colours, and the texture that a TextureFile comment names."""
    from trimesh.exchange import ply

    data = path.read_bytes()
    header = data[: max(data.find(b"end_header"), 0)]
    if not data.startswith(b"ply") or not header:
        raise report.error("", "a PLY header from 'ply' to 'end_header'", f"{data[:20]!r}", "check the file")
    _check_ply_counts(data, header, report)
    # Corner uvs need vertices cut apart; with vertex uvs nothing may be, or colours and normals lose their vertices.
    corner_uvs = re.search(rb"property\s+list\s+\w+\s+\w+\s+texcoord", header) is not None
    expected = "the elements its header announces (lists of one length, if binary)"
    with report.at("", expected, foreign=True), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        raw = ply.load_ply(io.BytesIO(data), skip_materials=True, fix_texture=corner_uvs)
        scene = Scene(path.name)
        if raw.get("faces") is None or not len(raw["faces"]):
            if "vertices" in raw:
                report.note("points without faces are not rendered")
            return scene
        positions = np.asarray(raw["vertices"]).reshape(-1, 3)
        visual = raw.get("visual")
        uvs = None if visual is None else visual.uv
        faces = _ply_triangles(raw, positions, uvs is not None)
        colors = raw.get("vertex_colors")
        normals = raw.get("vertex_normals")
        if colors is None and raw.get("face_colors") is not None and len(raw["face_colors"]) == len(faces):
            # A vertex has one colour: faces of their own colour need corners of their own.
            positions, colors = positions[faces.reshape(-1)], np.repeat(raw["face_colors"], 3, axis=0)
            uvs = None if uvs is None else uvs[faces.reshape(-1)]
            faces, normals = np.arange(len(positions)).reshape(-1, 3), None
        mesh = _mesh(report, path.stem, positions, faces, normals=normals, uvs=uvs, colors=colors)
    material = _PLAIN if mesh.colors is None else _COLORED
    image = re.search(rb"comment\s+TextureFile\s+([^\r\n]+)", header, re.IGNORECASE)
    if image and mesh.uvs is not None:
        texture = file_texture(path.parent, image[1].decode("utf-8", "replace").strip(), report)
        material = _COLORED.replace(base_color_texture=texture) if texture is not None else material
    scene.add(mesh, material=material)
    return scene


def _check_ply_counts(data: bytes, header: bytes, report: LoadReport) -> None:
    """Refuse a header that announces more elements than there are lines, or bytes if binary, to hold them."""
    announced = sum(int(count) for count in re.findall(rb"element\s+\w+\s+(\d{1,18})", header))
    body = data[len(header) + len(b"end_header") :]
    there = len(body) if b"format ascii" not in header else body.count(b"\n") + body.count(b"\r")
    if announced > there:
        unit = "bytes" if b"format ascii" not in header else "lines"
        raise report.error("", f"{announced} elements, as its header announces", f"{there} {unit}", "copy it again")


def _ply_triangles(raw: dict[str, Any], positions: np.ndarray, has_uvs: bool) -> np.ndarray:
    """Return (m, 3) triangles; polygons are cut here, for trimesh would cut concave ones into a fan."""
    faces = raw["faces"]
    lists = raw.get("metadata", {}).get("_ply_raw", {}).get("face", {}).get("data")
    if isinstance(lists, dict) and not has_uvs:
        lists = next((lists[key] for key in ("vertex_index", "vertex_indices") if key in lists), faces)
        faces = lists if np.asarray(lists).dtype.kind == "O" else faces
    if getattr(faces, "ndim", 1) == 2 and faces.shape[1] == 3:
        return np.asarray(faces, np.int64)
    triangles: list[np.ndarray] = []
    for polygon in faces:
        corners = np.asarray(polygon, np.int64).reshape(-1)
        if len(corners) < 3:
            continue
        inside = bool((corners >= 0).all() and (corners < len(positions)).all())
        points = positions[corners] if inside else np.full((len(corners), 3), np.nan)
        triangles.append(corners[triangulate_polygon(points.astype(np.float64))])
    return np.concatenate(triangles) if triangles else np.zeros((0, 3), np.int64)


def load_stl(path: Path, report: LoadReport) -> Scene:
    """Read a binary or ASCII STL file: one mesh per solid; the file's own normals are not used, faces have theirs."""
    from trimesh.exchange import stl

    data = path.read_bytes()
    with report.at("", "a binary STL of 84 + 50 n bytes, or ASCII solids", foreign=True), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        raw = stl.load_stl(io.BytesIO(data))
    solids = {path.stem: raw} if "vertices" in raw else raw.get("geometry", {})
    text = data.lower()
    if not solids and not (b"endsolid" in text or (len(data) == 84 and data[80:] == bytes(4))):
        got = f"{len(data)} bytes that are neither"
        raise report.error("", "a binary STL of 84 + 50 n bytes, or ASCII solids", got, "copy or export the file again")
    scene = Scene(path.name)
    for name, solid in solids.items():
        mesh = repaired_mesh(report, str(name) or path.stem, solid["vertices"], solid["faces"], smooth=False)
        scene.add(mesh, material=_PLAIN)
    return scene


def _mesh(
    report: LoadReport,
    name: str,
    positions: np.ndarray,
    faces: np.ndarray,
    *,
    normals: Any = None,
    uvs: Any = None,
    colors: Any = None,
) -> Mesh:
    """Build a smooth mesh from a reader's arrays: v turned over, colours made linear, normals across seams."""
    count = len(positions)
    if uvs is not None:
        uvs = np.asarray(uvs, np.float64)[:, :2] * (1.0, -1.0) + (0.0, 1.0) if len(uvs) == count else None
    if normals is not None and np.shape(normals) != (count, 3):
        normals = None
    colors = None if colors is None or len(colors) != count else _linear_colors(np.asarray(colors))
    mesh = repaired_mesh(report, name, positions, faces, normals=normals, uvs=uvs, colors=colors, smooth=True)
    if mesh.normals is None and mesh.uvs is not None and len(mesh.triangles):
        # Texture seams cut vertices apart; averaged alone, each side would show the seam in the shading.
        mesh.normals = smooth_normals(mesh.positions, mesh.triangles)
    return mesh


def _linear_colors(colors: np.ndarray) -> np.ndarray:
    """Return (n, 4) linear colours from (n, 3 or 4) display colours; whole numbers are shares of their type's range."""
    values = colors.astype(np.float64)
    if colors.dtype.kind in "iu":
        values /= np.iinfo(colors.dtype).max
    rgb = linear_from_srgb(np.maximum(values[:, :3], 0.0))
    alpha = values[:, 3:4] if values.shape[1] > 3 else np.ones((len(values), 1))
    return np.concatenate([rgb, alpha], axis=1)
