"""Scenes and comparisons that whole-pipeline tests share. Small, deterministic, made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import warp_deferred as wd
from warp_deferred.plan import Plan

__all__ = [
    "LAYERS",
    "assert_matches",
    "assert_same",
    "bits",
    "box",
    "gallery",
    "grid",
    "images",
    "room",
    "sphere",
    "tilt",
]

#: Every output but `display`.
LAYERS = (
    "color", "diffuse", "specular", "alpha", "depth", "normal", "position", "albedo", "instance_id", "semantic_id",
    "material_id", "triangle_id", "light_count",
)  # fmt: skip
IDS = ("instance_id", "semantic_id", "material_id", "triangle_id", "alpha")
#: What the float64 reference computes: exact surfaces, and ambient light that nothing blocks.
FULL = wd.Settings().with_values(["gbuffer.rung=full", "ambient_visibility.rung=off"])


def grid(cells: int = 1, size: float = 1.0, uv: tuple[float, float] = (0.0, 1.0), **fields: Any) -> wd.Mesh:
    """Return a square in the plane z = 0, facing +z, of `cells` squared quads; uv runs from uv[0] to uv[1]."""
    n = cells + 1
    t = np.linspace(0.0, 1.0, n)
    x, y = (a.reshape(-1) for a in np.meshgrid(t, t))
    positions = np.stack([(x - 0.5) * size, (y - 0.5) * size, np.zeros(n * n)], axis=1)
    uvs = np.stack([uv[0] + x * (uv[1] - uv[0]), uv[0] + (1.0 - y) * (uv[1] - uv[0])], axis=1)
    corner = (np.arange(cells)[:, None] * n + np.arange(cells)[None, :]).reshape(-1)
    first = np.stack([corner, corner + 1, corner + n + 1], axis=1)
    second = np.stack([corner, corner + n + 1, corner + n], axis=1)
    triangles = np.stack([first, second], axis=1).reshape(-1, 3)
    return wd.Mesh(positions, triangles, uvs=uvs, **fields)


def sphere(rings: int = 8, radius: float = 1.0, *, colored: bool = False) -> wd.Mesh:
    """Return a sphere with smooth normals and uvs, maybe with vertex colours."""
    segments = 2 * rings
    v, u = (
        a.reshape(-1) for a in np.meshgrid(np.linspace(0, 1, rings + 1), np.linspace(0, 1, segments + 1), indexing="ij")
    )
    theta, phi = v * np.pi, u * 2.0 * np.pi
    unit = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)], axis=1)
    n = segments + 1
    corner = (np.arange(rings)[:, None] * n + np.arange(segments)[None, :]).reshape(-1)
    upper = np.stack([corner, corner + n, corner + 1], axis=1)
    lower = np.stack([corner + 1, corner + n, corner + n + 1], axis=1)
    triangles = np.concatenate([lower[:-segments], upper[segments:]])
    colors = np.concatenate([0.5 + 0.5 * unit, np.ones((len(unit), 1))], axis=1) if colored else None
    return wd.Mesh(unit * radius, triangles, normals=unit, uvs=np.stack([u, v], axis=1), colors=colors)


def box(size: float = 1.0) -> wd.Mesh:
    """Return a cube of 12 triangles with one normal a face, made by the renderer."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return wd.Mesh(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def tilt(x_deg: float = 0.0, y_deg: float = 0.0, scale: Any = 1.0, move: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the matrix that scales, turns about x, then about y, then moves."""
    a, b = np.radians([x_deg, y_deg])
    turn_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    turn_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    matrix = np.eye(4)
    matrix[:3, :3] = turn_y @ turn_x @ np.diag(np.broadcast_to(scale, 3))
    matrix[:3, 3] = move
    return matrix


def _texture(seed: int, size: tuple[int, int], channels: int, **fields: Any) -> wd.Texture:
    """Return smooth noise: blocks of random colour, so that filtering matters and rounding does not."""
    noise = np.random.default_rng(seed).integers(30, 226, (size[1] // 2, size[0] // 2, channels), dtype=np.uint8)
    return wd.Texture(noise.repeat(2, axis=0).repeat(2, axis=1), **fields)


def _leaf() -> wd.Texture:
    """Return an image whose alpha is a disc."""
    y, x = np.mgrid[0:16, 0:16] - 7.5
    pixels = np.full((16, 16, 4), (60, 160, 40, 0), np.uint8)
    pixels[..., 3] = np.where(x * x + y * y < 42.0, 255, 0)
    return wd.Texture(pixels, wrap=("clamp", "clamp"))


def add_lights(scene: wd.Scene) -> None:
    """Add each kind of light with each fall-off, with and without a range."""
    scene.lights.add(
        wd.PointLight(position=(-1.5, 2.0, 1.5), color=(1.0, 0.7, 0.5), intensity=9.0, range=5.0),
        wd.PointLight(position=(2.5, 3.0, 2.0), color=(0.5, 0.7, 1.0), intensity=6.0),
        wd.PointLight(
            position=(0.0, 1.0, 2.0), intensity=1.5, range=3.0, attenuation="polynomial", coefficients=(1.0, 0.5, 0.8)
        ),
        wd.SpotLight(
            position=(1.5, 3.0, 1.0), direction=(-0.5, -2.0, -0.6), color=(1.0, 0.9, 0.3), intensity=25.0, range=8.0,
            inner_angle=0.2, outer_angle=0.45,
        ),
        wd.SpotLight(
            position=(-2.0, 2.5, -0.5), direction=(1.0, -1.5, 0.3), intensity=3.0, attenuation="polynomial",
            coefficients=(0.2, 0.3, 0.4), outer_angle=1.0,
        ),
        wd.DirectionalLight(direction=(-0.3, -1.0, -0.4), color=(0.9, 0.95, 1.0), intensity=0.8),
    )  # fmt: skip


def gallery(*, lights: bool = True) -> wd.Scene:
    """Return a scene with every feature a material, an instance or a light can have, and a camera that sees it all."""
    scene = wd.Scene("gallery")
    floor = wd.Material(model="lambert", base_color=(0.9, 0.9, 0.8, 1.0), base_color_texture=_texture(1, (32, 32), 3))
    scene.add(grid(4, 8.0, (0.0, 6.0)), transform=tilt(-90.0), material=floor, label=7)
    metal = wd.Material(
        base_color=(0.9, 0.8, 0.7, 1.0), metallic=0.9, roughness=0.8, emissive=(0.2, 0.1, 0.3), occlusion_strength=0.7,
        metallic_roughness_texture=_texture(2, (16, 8), 3, srgb=False),
        emissive_texture=_texture(3, (8, 8), 3, wrap=("mirror", "clamp")),
        occlusion_texture=_texture(4, (8, 16), 1, srgb=False),
    )  # fmt: skip
    ball = sphere(8, 0.6)
    scene.add(ball, transform=tilt(20.0, 30.0, 1.0, (-1.2, 0.6, 0.2)), material=metal, label=2)
    # Mirrored and stretched: facing and normals must follow.
    shiny = wd.Material(model="phong", base_color=(0.2, 0.5, 0.9, 1.0), specular=(0.2, 0.2, 0.1), shininess=24.0)
    scene.add(ball, transform=tilt(0.0, 40.0, (-1.0, 1.6, 0.7), (0.4, 0.9, -0.9)), material=shiny)
    glossy = wd.Material(model="blinn_phong", specular=(0.3, 0.3, 0.3), shininess=60.0)
    colored = sphere(6, 0.45, colored=True)
    scene.add(colored, transform=tilt(0.0, 0.0, 1.0, (1.5, 0.45, 0.6)), material=glossy, label=4)
    glowing = wd.Material(model="ggx", base_color=(0.7, 0.2, 0.2, 1.0), roughness=0.3, emissive=(0.05, 0.0, 0.0))
    scene.add(box(0.5), transform=tilt(0.0, 25.0, (1.0, 0.6, 1.0), (0.2, 0.15, 1.1)), material=glowing)
    leaf = wd.Material(model="lambert", base_color_texture=_leaf(), alpha_mode="mask", two_sided=True)
    scene.add(grid(1, 1.0), transform=tilt(0.0, 200.0, 1.0, (2.0, 1.2, -0.6)), material=leaf, label=5)
    scene.add(grid(2, 1.1), transform=tilt(10.0, 20.0, 1.0, (-2.2, 1.0, -1.0)), material=leaf, label=5)
    wraps = wd.Material(
        model="lambert", base_color_texture=_texture(5, (8, 8), 4, wrap=("clamp", "mirror")), two_sided=True
    )
    scene.add(grid(1, 1.4, (-1.0, 2.0)), transform=tilt(0.0, 10.0, 1.0, (-0.2, 1.9, -2.0)), material=wraps)
    scene.environment = wd.Environment(ambient=(0.06, 0.07, 0.09), background=(0.02, 0.03, 0.05))
    if lights:
        add_lights(scene)
    scene.camera = wd.Camera.look_at((0.6, 1.9, 4.6), (0.0, 0.7, 0.0), vertical_fov_deg=45.0)
    return scene


def room() -> wd.Scene:
    """Return the gallery in a textured room that surrounds the camera and crosses its near plane."""
    scene = gallery()
    walls = wd.Material(model="lambert", base_color=(0.7, 0.7, 0.75, 1.0), two_sided=True)
    scene.add(box(1.0), transform=tilt(0.0, 15.0, (9.0, 6.0, 11.0), (0.0, 2.0, 0.0)), material=walls)
    # A slab that passes through the eye's near plane and behind it.
    scene.add(grid(1, 1.0), transform=tilt(-80.0, -8.0, (0.5, 12.0, 1.0), (-0.6, 1.5, 4.6)), material=walls)
    return scene


def images(frame: wd.Frame, view: int = 0) -> dict[str, np.ndarray]:
    """Return the host copies of one view's outputs."""
    return {name: frame.numpy(name)[view] for name in frame.outputs}


def bits(array: np.ndarray) -> np.ndarray:
    """Return the bits of an array, so that NaN and signed zero are told apart."""
    return np.ascontiguousarray(array).view(np.uint8)


def assert_same(one: dict[str, np.ndarray], two: dict[str, np.ndarray], names: Any = None) -> None:
    """Fail unless the named outputs agree to the bit."""
    for name in names or one:
        a, b = one[name], two[name]
        assert a.shape == b.shape and a.dtype == b.dtype, name
        if not np.array_equal(bits(a), bits(b)):
            where = np.argwhere((a != b).reshape(*a.shape[:2], -1).any(axis=2))
            count = a.shape[0] * a.shape[1]
            raise AssertionError(f"{name}: {len(where)} of {count} pixels differ, first at (y, x) = {where[:1]}")


def unsure(reference: dict[str, np.ndarray]) -> np.ndarray:
    """Return where float32 may decide coverage or order otherwise: a vertex may snap to the next 1/256 px."""
    with np.errstate(invalid="ignore"):
        near = reference["z_gap"] < 1e-4 * np.maximum(reference["z"], 1e-3)
    return (reference["edge_distance"] < 1.5) | near | (reference["alpha_margin"] < 2e-3)


def assert_matches(
    actual: dict[str, np.ndarray],
    reference: dict[str, np.ndarray],
    bounds: dict[str, tuple[float, float, float]],
    *,
    unsure_share: float = 0.002,
) -> None:
    """Fail unless an image agrees with the reference.

    Ids and coverage are exact but where the reference is unsure itself, which at most `unsure_share` of the pixels may
    show. `bounds` gives for each other output (usual error, share of the pixels that may exceed it, worst error):
    relative for depth, relative to max(|value|, 1) for radiance, absolute for the rest.
    """
    same = np.ones(reference["depth"].shape, bool)
    for name in IDS:
        same &= actual[name] == reference[name]
    assert np.all(same | unsure(reference)), f"{(~same & ~unsure(reference)).sum()} sure pixels have another id"
    assert (~same).mean() <= unsure_share, f"{(~same).mean():.4f} of the pixels have another id"
    seen = same & (reference["instance_id"] >= 0)
    assert np.isinf(actual["depth"][actual["instance_id"] < 0]).all()
    for name, image in actual.items():
        if name not in IDS and name != "depth":
            assert np.isfinite(image).all(), name
    for name, (usual, share, worst) in bounds.items():
        mask = seen if name == "depth" else same
        a, b = actual[name][mask].astype(float), reference[name][mask].astype(float)
        scale = {"depth": np.abs(b), "position": 1.0, "normal": 1.0, "albedo": 1.0}.get(
            name, np.maximum(np.abs(b), 1.0)
        )
        error = (np.abs(a - b) / scale).reshape(len(a), -1).max(axis=1)
        assert error.max(initial=0.0) <= worst, f"{name}: error {error.max():.3g} > {worst:.3g}"
        over = float((error > usual).mean())
        assert over <= share, f"{name}: {over:.5f} of the pixels exceed {usual:.3g}, more than {share:.5f}"


class Spy:
    """Counts, while entered, what a frame must not do: modules loaded, kernels made, memory allocated, plans built."""

    def __init__(self) -> None:
        self.loaded: list[str] = []
        self.kernels: list[str] = []
        self.allocated: list[tuple[str, int]] = []
        self.plans = 0

    def __enter__(self) -> Spy:
        from warp._src import context

        self._patch = pytest.MonkeyPatch()
        self._wrap(context.ModuleExec, "__init__", lambda s, handle, *a, **k: self.loaded.append(str(a[1:3])))
        self._wrap(
            context.Kernel, "__init__", lambda s, func, *a, **k: self.kernels.append(getattr(func, "__name__", "?"))
        )
        for name, kind in vars(context).items():
            if name.endswith("Allocator") and isinstance(kind, type) and name != "Allocator":
                self._wrap(kind, "allocate", lambda s, size: self.allocated.append((type(s).__name__, size)))
        self._wrap(Plan, "__init__", lambda *a, **k: setattr(self, "plans", self.plans + 1))
        return self

    def _wrap(self, owner: type, name: str, note: Any) -> None:
        inner = getattr(owner, name)

        def outer(*args: Any, **fields: Any) -> Any:
            note(*args, **fields)
            return inner(*args, **fields)

        self._patch.setattr(owner, name, outer)

    def __exit__(self, *error: object) -> None:
        self._patch.undo()

    def assert_nothing(self) -> None:
        """Fail if anything was counted."""
        seen = {"modules": self.loaded, "kernels": self.kernels, "allocations": self.allocated, "plans": self.plans}
        assert not any(seen.values()), seen


def spied(renderer: Any, *cameras: Any) -> Any:
    """Render a frame that must make nothing new; read it back afterwards, which on CUDA allocates on the host."""
    with Spy() as spy:
        frame = renderer.render(*cameras)
    spy.assert_nothing()
    return frame
