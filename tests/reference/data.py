"""Plain data the reference renders: no validation, no sharing, float64 throughout.

Right-handed world, +Y up, metres and radians. Pixel origin top left, centres at +0.5. A view looks down its own -Z.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["Instance", "Light", "Material", "Mesh", "Scene", "Texture", "View"]


@dataclass(frozen=True, eq=False)
class Texture:
    """An image: `pixels` uint8 (height, width, 1 to 4), row 0 at v = 0; `wrap` for u and v: repeat, clamp or mirror."""

    pixels: np.ndarray
    srgb: bool = True
    wrap: tuple[str, str] = ("repeat", "repeat")
    linear_filter: bool = True


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface answers light; `alpha_cutoff` None means that alpha decides nothing."""

    model: str = "ggx"
    base_color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    metallic: float = 0.0
    roughness: float = 0.5
    specular: tuple[float, float, float] = (0.04, 0.04, 0.04)
    shininess: float = 32.0
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_color_texture: Texture | None = None
    metallic_roughness_texture: Texture | None = None
    emissive_texture: Texture | None = None
    occlusion_texture: Texture | None = None
    occlusion_strength: float = 1.0
    alpha_cutoff: float | None = None
    two_sided: bool = False


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles (m, 3) over vertices: positions (n, 3) [m]; maybe normals (n, 3), uvs (n, 2), linear colours (n, 4)."""

    positions: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    colors: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Instance:
    """A mesh in the world; `transform` (4, 4) object to world, column vectors; `material` indexes the scene's."""

    mesh: Mesh
    material: int = 0
    transform: np.ndarray = field(default_factory=lambda: np.eye(4))
    world: int = -1
    label: int = 0


@dataclass(frozen=True, eq=False)
class Light:
    """A point, spot or directional light.

    `radiance` is colour times intensity: candela for point and spot, lux for directional. `coefficients` (constant,
    linear, quadratic) choose polynomial fall-off; None is the inverse square with the window of KHR_lights_punctual.
    `direction` is where the light shines to.
    """

    kind: str
    radiance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, -1.0, 0.0)
    range: float = np.inf
    coefficients: tuple[float, float, float] | None = None
    source_radius: float = 0.01
    inner_angle: float = 0.0
    outer_angle: float = np.pi / 4
    world: int = -1


@dataclass(frozen=True, eq=False)
class Scene:
    """All there is; `lights` in the order point, spot, directional."""

    instances: tuple[Instance, ...] = ()
    materials: tuple[Material, ...] = (Material(),)
    lights: tuple[Light, ...] = ()
    ambient: tuple[float, float, float] = (0.0, 0.0, 0.0)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class View:
    """A camera and the image it makes.

    `rotation` (3, 3) has the rows right, up, backward. `projection` is (fx, fy, cx, cy): pixels per unit slope for
    perspective, pixels per metre for orthographic. `cull` is back, none or front and spares two-sided materials.
    """

    width: int
    height: int
    projection: tuple[float, float, float, float]
    eye: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    orthographic: bool = False
    near: float = 0.05
    far: float = 1000.0
    world: int = -1
    cull: str = "back"
    depth_clamp: bool = False
