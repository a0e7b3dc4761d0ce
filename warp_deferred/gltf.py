"""glTF 2.0 and GLB files to a `Scene`: meshes, instances, materials, cameras, lights.

Each primitive becomes one `Mesh`, shared by all nodes that show it; node transforms are multiplied out in float64.
Cameras are found wherever they hang in the hierarchy, perspective and orthographic; lights are those of
KHR_lights_punctual. Skins, morph targets and animations are not played: the scene gets a note for each.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from .camera import Camera
from .gltf_file import GltfFile
from .gltf_materials import GltfMaterials
from .gltf_nodes import walk_nodes
from .lights import DirectionalLight, PointLight, SpotLight
from .load_report import LoadReport
from .materials import Material
from .mesh_repair import repaired_mesh
from .scene import Mesh, Scene

__all__ = ["load_gltf"]

_POINTS_AND_LINES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Extensions a file may require although they are not (or only partly) rendered: the geometry is right without them.
_TOLERATED = ("KHR_lights_punctual", "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp")


def load_gltf(path: Path, report: LoadReport) -> Scene:
    """Read a .gltf or .glb file.

    Raises:
        LoadError: If the file is damaged, requires an extension that changes its geometry, or asks for too much.
    """
    file = GltfFile(path, report)
    _check_extensions(file)
    scene = Scene(path.name)
    meshes = _GltfMeshes(file)
    for index, node, world in walk_nodes(file):
        place = f"/nodes/{index}"
        name = str(node.get("name", ""))
        with report.at(place):
            if "mesh" in node:
                for mesh, material in meshes.primitives(node["mesh"], f"{place}/mesh"):
                    scene.add(mesh, transform=world, material=material, name=name or mesh.name)
            if "camera" in node:
                camera = _camera(file, node["camera"], world, name, f"{place}/camera")
                scene.cameras += [] if camera is None else [camera]
            light = node.get("extensions", {}).get("KHR_lights_punctual")
            if light is not None:
                _add_light(scene, file, light["light"], world, name, place)
    for section, what in (("skins", "skins"), ("animations", "animations")):
        if file.items(section):
            report.note(f"{what} are not played; the scene is shown as it stands in its nodes")
    return scene


def _check_extensions(file: GltfFile) -> None:
    required = file.json.get("extensionsRequired", [])
    for name in required if isinstance(required, list) else [required]:
        if name not in _TOLERATED and not str(name).startswith("KHR_materials_"):
            mend = "export the file without it (for compression: decompress it, with gltf-transform for one)"
            raise file.report.error("/extensionsRequired", f"none but {', '.join(_TOLERATED)}", repr(name), mend)


class _GltfMeshes:
    """Makes each primitive's `Mesh` once."""

    def __init__(self, file: GltfFile) -> None:
        self._file, self._report = file, file.report
        self._materials = GltfMaterials(file)
        self._made: dict[int, list[tuple[Mesh, Material]]] = {}

    def primitives(self, index: int, where: str) -> list[tuple[Mesh, Material]]:
        """Return (mesh, material) of every primitive of a mesh that has triangles."""
        source = self._file.item("meshes", index, where)
        if index not in self._made:
            found = source.get("primitives", [])
            made = []
            for k, primitive in enumerate(found):
                place = f"/meshes/{index}/primitives/{k}"
                name = str(source.get("name", "")) or f"mesh {index}"
                with self._report.at(place):
                    mesh = self._mesh(primitive, place, f"{name}/{k}" if len(found) > 1 else name)
                    if mesh is not None:
                        made.append((mesh, self._materials.material(primitive.get("material"), f"{place}/material")))
            self._made[index] = made
        return self._made[index]

    def _mesh(self, primitive: dict[str, Any], place: str, name: str) -> Mesh | None:
        mode = primitive.get("mode", _TRIANGLES)
        if mode in _POINTS_AND_LINES:
            self._report.note(f"mesh {name!r}: {_POINTS_AND_LINES[mode]} are not rendered")
            return None
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            raise self._report.error(f"{place}/mode", "a whole number from 0 to 6", repr(mode))
        attributes = primitive["attributes"]
        if "POSITION" not in attributes:
            got = "only " + (", ".join(attributes) or "nothing")
            raise self._report.error(f"{place}/attributes", "POSITION", got, "a mesh needs positions")
        arrays = {}
        for key, widths in (("POSITION", (3,)), ("NORMAL", (3,)), ("TEXCOORD_0", (2,)), ("COLOR_0", (3, 4))):
            if key in attributes:
                where = f"{place}/attributes/{key}"
                arrays[key] = self._file.accessor(attributes[key], where, widths, keep_integers=False)
                if len(arrays[key]) != len(arrays["POSITION"]):
                    raise self._report.error(
                        where, f"{len(arrays['POSITION'])} elements, as POSITION has", len(arrays[key])
                    )
        if primitive.get("targets"):
            self._report.note("morph targets are not played; meshes keep their base shape")
        colors = arrays.get("COLOR_0")
        if colors is not None:
            colors = self._colors(colors, attributes["COLOR_0"])
        return repaired_mesh(
            self._report,
            name,
            arrays["POSITION"],
            self._triangles(primitive, place, mode, len(arrays["POSITION"])),
            normals=arrays.get("NORMAL"),
            uvs=arrays.get("TEXCOORD_0"),
            colors=colors,
            # glTF 2.0, section 3.7.2.1: without normals a client must calculate flat ones.
            smooth=False,
        )

    def _colors(self, colors: np.ndarray, index: int) -> np.ndarray:
        """Return (n, 4) linear colours; whole numbers that lack the mark `normalized` are taken as if they had it."""
        accessor = self._file.items("accessors")[index]
        if not accessor.get("normalized") and accessor["componentType"] in (5121, 5123):
            colors = colors / np.float32(255.0 if accessor["componentType"] == 5121 else 65535.0)
        if colors.shape[1] == 3:
            colors = np.concatenate([colors, np.ones((len(colors), 1), np.float32)], axis=1)
        return np.maximum(colors, 0.0)

    def _triangles(self, primitive: dict[str, Any], place: str, mode: int, vertex_count: int) -> np.ndarray:
        """Return (m, 3) indices of a list, strip or fan; a number of corners that leaves a rest loses the rest."""
        if "indices" in primitive:
            corners = self._file.accessor(primitive["indices"], f"{place}/indices", (1,), keep_integers=True)
            corners = corners.astype(np.int64)
        else:
            corners = np.arange(vertex_count, dtype=np.int64)
        if mode == _TRIANGLES:
            if len(corners) % 3:
                self._report.repair(
                    f"{place}: {len(corners)} corners are no whole number of triangles; the rest is cut"
                )
            return corners[: len(corners) // 3 * 3].reshape(-1, 3)
        if len(corners) < 3:
            return np.zeros((0, 3), np.int64)
        if mode == _FAN:
            first = np.broadcast_to(corners[0], len(corners) - 2)
            return np.stack([corners[1:-1], corners[2:], first], axis=1)
        strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        # Every second triangle of a strip turns the other way (glTF 2.0, section 3.7.2.1).
        strip[1::2] = strip[1::2][:, [0, 2, 1]]
        return strip


def _camera(file: GltfFile, index: Any, world: np.ndarray, name: str, where: str) -> Camera | None:
    source = file.item("cameras", index, where)
    with file.report.at(f"/cameras/{index}"):
        name = name or str(source.get("name", ""))
        kind = source["type"]
        fields: dict[str, Any]
        if kind == "perspective":
            lens = source["perspective"]
            fields = {"vertical_fov": lens["yfov"], "near": lens["znear"]}
            if "zfar" in lens:
                file.report.note(f"camera {name or index!r}: its far plane is ignored; perspective views have none")
        elif kind == "orthographic":
            lens = source["orthographic"]
            extent = 2.0 * abs(lens["ymag"])
            fields = {"projection": kind, "vertical_extent": extent, "near": lens["znear"], "far": lens["zfar"]}
        else:
            raise file.report.error(f"/cameras/{index}/type", "perspective or orthographic", repr(kind))
        Camera(**fields)
        if not abs(np.linalg.det(world[:3, :3])) > 0.0:
            file.report.repair(f"camera {name or index!r} is left out: its node is scaled to nothing")
            return None
        return Camera.from_matrix(world, name=name, **fields)


def _add_light(scene: Scene, file: GltfFile, index: Any, world: np.ndarray, name: str, place: str) -> None:
    """Add a KHR_lights_punctual light that shines along its node's -Z from its node's origin; scale has no effect."""
    with file.report.at("/extensions/KHR_lights_punctual"):
        lights = file.json["extensions"]["KHR_lights_punctual"]["lights"]
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(lights):
        pointer = f"{place}/extensions/KHR_lights_punctual/light"
        raise file.report.error(pointer, f"an index below {len(lights)}", repr(index))
    source, pointer = lights[index], f"/extensions/KHR_lights_punctual/lights/{index}"
    with file.report.at(pointer):
        kind = source["type"]
        fields = {
            "color": tuple(source.get("color", (1.0, 1.0, 1.0))),
            "intensity": source.get("intensity", 1.0),
            "name": name or str(source.get("name", "")),
        }
        if kind in ("point", "spot"):
            fields["position"] = tuple(world[:3, 3].tolist())
            fields["range"] = source.get("range", math.inf)
        if kind in ("spot", "directional"):
            length = float(np.linalg.norm(world[:3, 2]))
            if not length > 0.0:
                file.report.repair(f"light {fields['name'] or index!r} is left out: its node is scaled to nothing")
                return
            fields["direction"] = tuple((-world[:3, 2] / length).tolist())
        if kind == "point":
            scene.lights.add(PointLight(**fields))
        elif kind == "spot":
            cone = source.get("spot", {})
            inner, outer = cone.get("innerConeAngle", 0.0), cone.get("outerConeAngle", math.pi / 4)
            scene.lights.add(SpotLight(inner_angle=inner, outer_angle=outer, **fields))
        elif kind == "directional":
            scene.lights.add(DirectionalLight(**fields))
        else:
            raise file.report.error(f"{pointer}/type", "point, spot or directional", repr(kind))
