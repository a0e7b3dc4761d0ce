"""A scene: meshes placed as instances, lights, an environment, cameras. Host data only; nothing here touches a device.

Three revision counters let a renderer see in constant time what changed: `structure_revision` (what exists: meshes,
instances, materials, counts) asks for a new upload and perhaps a new plan, `look_revision` (the environment) for
another look at what the scene calls for, `revision` (transforms) only for new numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pydantic import model_validator

from .camera import Camera
from .checks import check_array, check_count, input_error
from .lights import Lights, is_device_array
from .materials import Material, check_rgb
from .records import Record
from .settings import Settings

__all__ = ["Environment", "Instance", "Mesh", "PointBinding", "Scene"]


class Environment(Record):
    """Light from everywhere, and what is seen where no surface is."""

    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Constant ambient radiance, linear; diffuse only."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Radiance of the background, linear."""

    @model_validator(mode="after")
    def _positive(self) -> Environment:
        check_rgb("Environment.ambient", self.ambient)
        check_rgb("Environment.background", self.background)
        return self


class Mesh:
    """Triangles with shared vertices.

    Attributes:
        positions: (n, 3) float32 [m], relative to `origin`.
        triangles: (m, 3) int32, counter-clockwise seen from the front.
        normals: (n, 3) float32 unit vectors, or None: `smooth` decides how the renderer makes them.
        uvs: (n, 2) float32, v = 0 at the top of the image, or None.
        colors: (n, 4) float32 linear colour and alpha, or None (white).
        smooth: Whether missing normals are averaged over the faces at a vertex (weighted by angle) or each face's own.
        origin: (3,) float64 [m], taken out of positions that were handed in far from zero in float64.
    """

    __slots__ = ("colors", "name", "normals", "origin", "positions", "smooth", "triangles", "uvs")

    def __init__(
        self,
        positions: Any,
        triangles: Any,
        *,
        normals: Any = None,
        uvs: Any = None,
        colors: Any = None,
        smooth: bool = False,
        name: str = "",
    ) -> None:
        label = f"Mesh({name!r})" if name else "Mesh"
        points = check_array(f"{label}.positions", positions, (None, 3), np.float64)
        faces = check_array(f"{label}.triangles", triangles, (None, 3), np.int64)
        if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
            bad = int(((faces < 0) | (faces >= len(points))).any(axis=1).argmax())
            raise input_error(
                f"{label}.triangles",
                f"vertex indices from 0 to {len(points) - 1}",
                f"<{faces[bad].tolist()} in triangle {bad}>",
                "drop or repair these faces",
            )
        self.origin = np.zeros(3)
        if len(points):
            low, high = points.min(axis=0), points.max(axis=0)
            extent = float((high - low).max())
            # Past 64 extents from zero, float32 loses six of its 24 bits; the exact part goes into float64.
            if np.asarray(positions).dtype == np.float64 and np.abs(points).max() > 64.0 * max(extent, 1e-30):
                self.origin = np.round((low + high) / 2.0)
        self.positions = check_array(f"{label}.positions", points - self.origin, (None, 3), np.float32)
        self.triangles = faces.astype(np.int32)
        count = len(points)
        self.normals = (
            None if normals is None else self._unit(check_array(f"{label}.normals", normals, (count, 3), np.float32))
        )
        self.uvs = None if uvs is None else check_array(f"{label}.uvs", uvs, (count, 2), np.float32)
        self.colors = None if colors is None else check_array(f"{label}.colors", colors, (count, 4), np.float32)
        self.smooth, self.name = bool(smooth), name

    @staticmethod
    def _unit(normals: np.ndarray) -> np.ndarray:
        """Scale to unit length; a zero normal stays zero, and the resolve takes the face's own there."""
        wide = normals.astype(np.float64)
        length = np.linalg.norm(wide, axis=1, keepdims=True)
        return np.where(length > 0.0, wide / np.where(length > 0.0, length, 1.0), 0.0).astype(np.float32)

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        arrays = (self.positions, self.triangles, self.normals, self.uvs, self.colors)
        return sum(a.nbytes for a in arrays if a is not None)

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {len(self.positions)} vertices, {len(self.triangles)} triangles)"


class Instance:
    """A mesh placed in the world. Made by `Scene.add`; assigning a field marks the scene changed."""

    __slots__ = ("_label", "_material", "_mesh", "_name", "_scene", "_transform", "_world")

    def __init__(
        self, scene: Scene, mesh: Mesh, transform: Any, material: Material, world: int, label: int, name: str
    ) -> None:
        if not isinstance(mesh, Mesh):
            raise input_error("Instance.mesh", "a Mesh", type(mesh).__name__)
        if not isinstance(material, Material):
            raise input_error("Instance.material", "a Material", type(material).__name__)
        self._scene, self._mesh, self._material, self._name = scene, mesh, material, name
        self._world = check_count("Instance.world", world, -1, 2**31 - 1)
        self._label = check_count("Instance.label", label, -1, 2**31 - 1)
        self._transform = self._matrix(transform)

    @staticmethod
    def _matrix(transform: Any) -> np.ndarray:
        if transform is None:
            matrix = np.eye(4)
        else:
            matrix = check_array("Instance.transform", transform, (4, 4), np.float64).copy()
            if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
                raise input_error(
                    "Instance.transform",
                    "an affine matrix (last row 0 0 0 1)",
                    matrix[3].tolist(),
                    "column vectors: translation is the last column",
                )
        matrix.flags.writeable = False
        return matrix

    mesh = property(lambda self: self._mesh, doc="The mesh.")
    name = property(lambda self: self._name, doc="Name, as in the file it came from.")
    world = property(lambda self: self._world, doc="The world it stands in; -1 is in all.")

    @property
    def transform(self) -> np.ndarray:
        """Object-to-world matrix, (4, 4) float64, column vectors, read-only; assign a new one to move the instance."""
        return self._transform

    @transform.setter
    def transform(self, value: Any) -> None:
        self._transform = self._matrix(value)
        self._scene.revision += 1

    @property
    def material(self) -> Material:
        """The material."""
        return self._material

    @material.setter
    def material(self, value: Material) -> None:
        if not isinstance(value, Material):
            raise input_error("Instance.material", "a Material", type(value).__name__)
        self._material = value
        self._scene.structure_revision += 1

    @property
    def label(self) -> int:
        """Class id written to `semantic_id`."""
        return self._label

    @label.setter
    def label(self, value: int) -> None:
        self._label = check_count("Instance.label", value, -1, 2**31 - 1)
        self._scene.structure_revision += 1


class PointBinding(NamedTuple):
    """Meshes whose points come from one array.

    Attributes:
        meshes: The meshes; their vertices follow one another in the array.
        array: A device array, read before every frame, or a checked NumPy copy of the host's, (n, 3) float32.
    """

    meshes: tuple[Mesh, ...]
    array: Any

    @property
    def vertex_count(self) -> int:
        """Vertices over all its meshes."""
        return sum(len(mesh.positions) for mesh in self.meshes)


class Scene:
    """What there is to see.

    Attributes:
        lights: Point, spot and directional lights.
        cameras: All cameras; `camera` is the one `render()` uses.
        notes: Remarks from loading (repairs, things a file asked for that are not rendered), one text each.
        animate: Function of (scene, time in seconds) that moves things, or None.
    """

    def __init__(self, name: str = "") -> None:
        self.name = name
        self.structure_revision = 0
        self.look_revision = 0
        self.revision = 0
        self.lights = Lights()
        self.cameras: list[Camera] = []
        self.notes: list[str] = []
        self.animate: Any = None
        self._instances: list[Instance] = []
        self._transforms: Any = None
        self._points: dict[tuple[int, ...], PointBinding] = {}
        self._environment = Environment()
        self._camera: Camera | None = None
        self.settings = Settings()

    def __repr__(self) -> str:
        counts = f"{len(self._instances)} instances, {self.triangle_count} triangles, {len(self.lights)} lights"
        return f"Scene({self.name!r}, {counts})"

    @property
    def instances(self) -> tuple[Instance, ...]:
        """All instances, in the order of their ids."""
        return tuple(self._instances)

    @property
    def triangle_count(self) -> int:
        """Triangles over all instances."""
        return sum(len(i.mesh.triangles) for i in self._instances)

    def add(
        self,
        mesh: Mesh,
        *,
        transform: Any = None,
        material: Material | None = None,
        world: int = -1,
        label: int = 0,
        name: str = "",
    ) -> Instance:
        """Place a mesh in the world.

        Args:
            mesh: What to place; one mesh may be placed many times and is stored once.
            transform: (4, 4) object-to-world matrix, column vectors; the identity if left out.
            material: How its surface answers light; a grey dielectric if left out.
            world: The world it stands in; -1 is in all.
            label: Class id for the output `semantic_id`.
            name: Name for messages.
        """
        instance = Instance(
            self,
            mesh,
            transform,
            material or Material(base_color=(0.8, 0.8, 0.8, 1.0)),
            world,
            label,
            name or mesh.name,
        )
        self._instances.append(instance)
        self._transforms = None
        self.structure_revision += 1
        return instance

    def clear(self) -> None:
        """Remove all instances; lights, cameras and environment stay."""
        self._instances.clear()
        self._transforms = None
        self._points.clear()
        self.structure_revision += 1

    @property
    def environment(self) -> Environment:
        """Ambient light and background."""
        return self._environment

    @environment.setter
    def environment(self, value: Environment) -> None:
        if not isinstance(value, Environment):
            raise input_error("Scene.environment", "an Environment", type(value).__name__)
        self._environment = value
        self.look_revision += 1

    @property
    def camera(self) -> Camera | None:
        """The camera `render()` uses: the one assigned, or the first of `cameras`."""
        return self._camera or (self.cameras[0] if self.cameras else None)

    @camera.setter
    def camera(self, value: Camera) -> None:
        if not isinstance(value, Camera):
            raise input_error("Scene.camera", "a Camera", type(value).__name__)
        self._camera = value

    @property
    def transforms(self) -> Any:
        """The bound device array of transforms, or None."""
        return self._transforms

    def bind_transforms(self, array: Any) -> None:
        """Take all instances' object-to-world transforms from a device array, copied on the device before each frame.

        Args:
            array: Warp, torch or JAX array, float32, of shape (instances, 4, 4) (column vectors) or (instances, 7)
                (position, then quaternion x y z w; `wp.transform` has this layout); None unbinds.
                A non-finite transform hides its instance.
        """
        if array is not None:
            if not is_device_array(array):
                raise input_error(
                    "Scene.bind_transforms",
                    "a Warp, torch or JAX array",
                    type(array).__name__,
                    "assign Instance.transform for NumPy matrices",
                )
            count, shape = len(self._instances), tuple(array.shape)
            if shape[:1] != (count,) or shape[1:] not in ((), (4, 4), (7,)):
                raise input_error("Scene.bind_transforms", f"shape ({count}, 4, 4) or ({count}, 7)", f"<shape {shape}>")
        self._transforms = array
        self.revision += 1

    @property
    def point_bindings(self) -> tuple[PointBinding, ...]:
        """The meshes whose points come from arrays, in the order they were bound."""
        return tuple(self._points.values())

    def bind_points(self, meshes: Mesh | Sequence[Mesh], array: Any) -> None:
        """Take the points of meshes that deform (cloth, soft bodies, skins) from an array.

        Normals that are smooth or were given are averaged anew from the faces, with hard edges and seams where the
        mesh has them at load; bounds for culling are made anew. All instances of a mesh follow it. Another array for
        the same meshes costs nothing; binding and unbinding load the scene anew. `bounds()` and framing stay with the
        meshes' own positions.

        Args:
            meshes: A mesh of the scene, or several whose vertices follow one another in the array.
            array: Warp, torch or JAX array, float32, (vertices, 3) [m], in the space of the positions the mesh was
                made from; copied on the device before each frame, never read back. A face with a vertex that is not
                finite is not drawn. Or a NumPy array of finite numbers, copied here and now. None unbinds.

        Raises:
            InputError: If a mesh is not in the scene or is bound together with others, or the array does not fit.
        """
        bound = (meshes,) if isinstance(meshes, Mesh) else tuple(meshes) if isinstance(meshes, Sequence) else ()
        key = tuple(id(mesh) for mesh in bound)
        if key not in self._points:
            known = {id(instance.mesh) for instance in self._instances}
            if not bound or len(set(key)) != len(key) or not known.issuperset(key):
                raise input_error(
                    "Scene.bind_points.meshes", "meshes of this scene, each once", meshes, "add them first"
                )
            if not {mesh for other in self._points for mesh in other}.isdisjoint(key):
                raise input_error(
                    "Scene.bind_points.meshes", "meshes that are bound alone or together as before", meshes
                )
        if array is None:
            self.structure_revision += self._points.pop(key, None) is not None
            return
        count = sum(len(mesh.positions) for mesh in bound)
        if not is_device_array(array):
            array = check_array("Scene.bind_points", array, (count, 3), np.float32).copy()
        elif tuple(array.shape) not in ((count, 3), (count,)):
            raise input_error("Scene.bind_points", f"shape ({count}, 3)", f"<shape {tuple(array.shape)}>")
        self.structure_revision += key not in self._points
        self._points[key] = PointBinding(bound, array)

    def bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the world box of all instances as (low, high), each (3,) float64, or None for an empty scene."""
        lows, highs = [], []
        boxes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for instance in self._instances:
            mesh = instance.mesh
            if not len(mesh.triangles):
                continue
            if id(mesh) not in boxes:
                used = mesh.positions[np.unique(mesh.triangles)].astype(np.float64) + mesh.origin
                boxes[id(mesh)] = used.min(axis=0), used.max(axis=0)
            low, high = boxes[id(mesh)]
            corners = np.array(
                [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
            )
            world = corners @ instance.transform[:3, :3].T + instance.transform[:3, 3]
            lows.append(world.min(axis=0))
            highs.append(world.max(axis=0))
        return (np.min(lows, axis=0), np.max(highs, axis=0)) if lows else None
