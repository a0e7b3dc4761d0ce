"""What is timed, frozen: a figure means something only beside the same figure of the same case.

The six distributions of triangles come from fixed seeds. Flat ones are given in normalised device coordinates (x, y
from -1 to 1, y up) with a reversed depth z in (0, 1), larger is nearer; `flat_scene` sets up an orthographic camera
whose image is exactly that square and whose depth is exactly that z. Scenes with lights are built-in ones.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from warp_deferred import Camera, Material, Mesh, Scene, load

__all__ = [
    "MEANS", "RESOLUTIONS", "TRIANGLE_CASES", "FrameCase", "TriangleCase", "flat_scene", "frame_cases", "many_lights",
    "mixed", "pile", "quads", "slivers", "terrain", "terrain_scene",
]  # fmt: skip

#: Settings of all benches but `effects`, which times the optional effects: frames that stay comparable as effects come.
SPINE = ("ambient_visibility.rung=off",)
#: Name -> (width, height) [px].
RESOLUTIONS = {"720p": (1280, 720), "1080p": (1920, 1080), "4K": (3840, 2160)}
TILE_SIZES = (8, 16, 32, 64)
TILE_LIGHTS = (10, 100, 1000, 10_000)
LIGHT_COUNTS = (1, 10, 100, 1000, 3000, 10_000)
#: Lights that reach a pixel, on average.
MEANS = (5, 20, 80)
#: Most lights that are also run by brute force.
BRUTE_FORCE_LIMIT = 1000
DEPTH_RANGE = (0.05, 0.9)

Flat = tuple[np.ndarray, np.ndarray]


def quads(count: int = 100) -> Flat:
    """Quads that each fill the screen, at uniformly random depths: as much overdraw as there are quads.

    Returns:
        Positions (4 count, 3) float64 and triangles (2 count, 3) int32.
    """
    depth = np.random.default_rng(1).uniform(*DEPTH_RANGE, count)
    positions = np.empty((count, 4, 3))
    positions[:, :, 0] = (-1.0, 1.0, 1.0, -1.0)
    positions[:, :, 1] = (-1.0, -1.0, 1.0, 1.0)
    positions[:, :, 2] = depth[:, None]
    corners = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(count)[:, None, None]
    return positions.reshape(-1, 3), corners.reshape(-1, 3).astype(np.int32)


def slivers(count: int = 10_000) -> Flat:
    """Needles as long as the screen is high, three thousandths wide at one end, in every direction.

    Returns:
        Positions (3 count, 3) float64 and triangles (count, 3) int32.
    """
    rng = np.random.default_rng(2)
    angle = rng.uniform(0.0, math.pi, count)
    middle = rng.uniform(-1.0, 1.0, (count, 2))
    depth = rng.uniform(*DEPTH_RANGE, count)
    axis = np.column_stack([np.cos(angle), np.sin(angle)])
    side = 0.003 * np.column_stack([-np.sin(angle), np.cos(angle)])
    return _separate([middle - axis, middle + axis, middle + side], depth)


def mixed(count: int = 100_000) -> Flat:
    """Triangles of every size from a pixel to a quarter of the screen, the logarithm of the size uniform.

    Returns:
        Positions (3 count, 3) float64 and triangles (count, 3) int32.
    """
    rng = np.random.default_rng(4)
    middle = rng.uniform(-1.0, 1.0, (count, 2))
    angle = rng.uniform(0.0, 2.0 * math.pi, count)
    radius = np.exp(rng.uniform(math.log(0.001), math.log(0.25), count))
    return _round(middle, angle, radius, rng.uniform(*DEPTH_RANGE, count))


def pile(count: int = 1_000_000) -> Flat:
    """Small triangles heaped on the middle of the screen: few pixels, each wanted by thousands.

    Returns:
        Positions (3 count, 3) float64 and triangles (count, 3) int32.
    """
    rng = np.random.default_rng(3)
    middle = rng.normal(0.0, 0.002, (count, 2))
    angle = rng.uniform(0.0, 2.0 * math.pi, count)
    return _round(middle, angle, np.full(count, 0.004), rng.uniform(*DEPTH_RANGE, count))


def _round(middle: np.ndarray, angle: np.ndarray, radius: np.ndarray, depth: np.ndarray) -> Flat:
    """Nearly equilateral triangles inscribed in circles; corners 2.1 rad apart."""
    spokes = [angle + turn for turn in (0.0, 2.1, 4.2)]
    rim = [np.column_stack([np.cos(a), np.sin(a)]) for a in spokes]
    return _separate([middle + radius[:, None] * r for r in rim], depth)


def _separate(corners: list[np.ndarray], depth: np.ndarray) -> Flat:
    """Triangles that share no vertex, each at one depth."""
    positions = np.empty((len(depth), 3, 3))
    for k, corner in enumerate(corners):
        positions[:, k, :2] = corner
    positions[:, :, 2] = depth[:, None]
    return positions.reshape(-1, 3), np.arange(3 * len(depth), dtype=np.int32).reshape(-1, 3)


def terrain(side: int = 501) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hills over a square of 20 m.

    Args:
        side: Vertices along each edge: 2 (side - 1)² triangles.

    Returns:
        World positions (side², 3) float64 [m], triangles counter-clockwise from above, and unit normals from central
        differences of the height.
    """
    steps = np.linspace(-1.0, 1.0, side)
    u, v = steps[None, :], steps[:, None]
    height = 10.0 * (0.05 * np.sin(20.0 * u) * np.cos(17.0 * v) + 0.02 * np.sin(90.0 * u + 40.0 * v))
    grid = np.broadcast_arrays(10.0 * u, height, 10.0 * v)
    along_v, along_u = np.gradient(height, 10.0 * steps, 10.0 * steps)
    normals = np.stack([-along_u, np.ones((side, side)), -along_v], axis=-1).reshape(-1, 3)
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    vertex = np.arange(side * side, dtype=np.int32).reshape(side, side)
    a, b, c, d = vertex[:-1, :-1], vertex[1:, :-1], vertex[:-1, 1:], vertex[1:, 1:]
    triangles = np.stack([a, b, c, c, b, d], axis=-1).reshape(-1, 3)
    return np.stack(grid, axis=-1).reshape(-1, 3), triangles, normals


def terrain_scene(side: int) -> Scene:
    """Terrain under the camera of the raster table, with a material that fills all 16 bytes of the compact G-buffer."""
    positions, triangles, normals = terrain(side)
    scene = Scene(f"terrain of {len(triangles):,} triangles")
    scene.add(Mesh(positions, triangles, normals=normals, name="terrain"), material=Material(model="ggx"))
    scene.camera = Camera.look_at((0.0, 3.0, 9.0), (0.0, 0.0, 0.0), vertical_fov_deg=60.0, near=0.05)
    return scene


def flat_scene(positions: np.ndarray, triangles: np.ndarray, name: str = "") -> Scene:
    """Place triangles given in normalised device coordinates, drawn whatever their winding.

    The camera stands at z = 1 and sees one metre deep, so its linear orthographic depth, 1 at the near plane and 0 at
    the far one, is z itself; fx and fy differ, so that the square fills an image of any shape.
    """
    scene = Scene(name)
    scene.add(Mesh(positions, triangles, name=name), material=Material(model="ggx", two_sided=True))
    scene.camera = Camera(
        position=(0.0, 0.0, 1.0), projection="orthographic", near=0.0, far=1.0,
        intrinsics=(0.5, 0.5, 0.5, 0.5), image_size=(1, 1),
    )  # fmt: skip
    return scene


@dataclasses.dataclass(frozen=True)
class TriangleCase:
    """A row of the raster table.

    Attributes:
        name: Key in results.
        title: What it is, in words.
        build: Makes the scene.
        quick: Makes a small one.
        whole: Whether the G-buffer is part of the figure; else clear and visibility only.
    """

    name: str
    title: str
    build: Callable[[], Scene]
    quick: Callable[[], Scene]
    whole: bool = False


def _flat_case(name: str, title: str, make: Callable[..., Flat], small: int) -> TriangleCase:
    return TriangleCase(name, title, lambda: flat_scene(*make(), name), lambda: flat_scene(*make(small), name))


def _terrain_case(name: str, title: str, side: int, small: int) -> TriangleCase:
    return TriangleCase(name, title, lambda: terrain_scene(side), lambda: terrain_scene(small), whole=True)


#: The six rows, in order.
TRIANGLE_CASES = (
    _terrain_case("terrain_500k", "terrain, 500 k triangles", 501, 51),
    _terrain_case("terrain_10m", "terrain, 10 M triangles", 2237, 101),
    _flat_case("quads", "quads: 100 that fill the screen", quads, 10),
    _flat_case("slivers", "slivers: 10 k across the screen", slivers, 200),
    _flat_case("mixed", "mixed: 100 k of any size", mixed, 1000),
    _flat_case("pile", "pile: 1 M small ones on one spot", pile, 2000),
)


def reachable_mean(lights: int, mean: float) -> float:
    """Mean of lights at a pixel that so many lights can give: at most half of them."""
    return min(float(mean), 0.5 * lights)


def many_lights(lights: int, mean: float, *, quick: bool = False) -> Scene:
    """Build the built-in scene in which `mean` of `lights` point lights reach a pixel, on average."""
    triangles = 10_000 if quick else 100_000
    return load(f"many_lights?lights={lights}&mean={reachable_mean(lights, mean):g}&triangles={triangles}")


@dataclasses.dataclass(frozen=True)
class FrameCase:
    """A whole frame.

    Attributes:
        name: Key in results.
        title: What it is, in words.
        source: Built-in scene with its parameters.
        width: Width [px].
        height: Height [px].
    """

    name: str
    title: str
    source: str
    width: int
    height: int

    def build(self) -> Scene:
        """Build the scene."""
        return load(self.source)


def frame_cases(device_is_cuda: bool, *, quick: bool = False, huge: bool = False) -> tuple[FrameCase, ...]:
    """List the frames that are timed on a kind of device."""
    if quick:
        return (FrameCase("quick", "terrain, 2 k triangles, 20 lights", "terrain?triangles=2000&lights=20", 160, 90),)
    if not device_is_cuda:
        source = "terrain?triangles=20000&lights=200"
        return (FrameCase("terrain_360p", "terrain, 20 k triangles, 200 lights, 640x360", source, 640, 360),)
    terrain_source, title = "terrain?triangles=500000&lights=1000", "terrain, 500 k triangles, 1000 lights"
    cases = [
        FrameCase("terrain_1080p", f"{title}, 1920x1080", terrain_source, 1920, 1080),
        FrameCase("terrain_4k", f"{title}, 3840x2160", terrain_source, 3840, 2160),
        FrameCase("hundred_lights_1080p", "hundred_lights, 1920x1080", "hundred_lights", 1920, 1080),
    ]
    if huge:
        cases.append(FrameCase("terrain_16384", f"{title}, 16384x16384", terrain_source, 16384, 16384))
    return tuple(cases)
