"""Meshes made from formulas: what the built-in scenes are assembled from.

A `Shape` is plain arrays in float64; `join` welds many into one and `Shape.mesh` hands them to the renderer. All shapes
stand on y = 0 around the y axis unless they say otherwise, are counter-clockwise seen from outside, and carry normals
that are smooth where the surface is round and broken where it has an edge.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from warp_deferred.scene import Mesh

__all__ = [
    "Shape",
    "arch",
    "bevelled_box",
    "box",
    "coffered_vault",
    "column",
    "grid",
    "join",
    "lathe",
    "plane",
    "sphere",
    "surface",
    "torus",
    "translation",
]


@dataclasses.dataclass(frozen=True)
class Shape:
    """A triangle mesh that can still be moved and joined.

    Attributes:
        positions: (n, 3) float64 [m].
        normals: (n, 3) float64 unit vectors.
        uvs: (n, 2) float64.
        triangles: (m, 3) int64, counter-clockwise seen from outside.
        colors: (n, 3) float64 linear colour, or None for white.
    """

    positions: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    triangles: np.ndarray
    colors: np.ndarray | None = None

    def moved(self, matrix: np.ndarray) -> Shape:
        """Apply a (4, 4) matrix of column vectors; a mirroring one turns the triangles round."""
        linear = matrix[:3, :3]
        sign = np.linalg.det(linear)
        normals = self.normals @ np.linalg.inv(linear)
        triangles = self.triangles if sign > 0.0 else self.triangles[:, ::-1]
        positions = self.positions @ linear.T + matrix[:3, 3]
        return dataclasses.replace(self, positions=positions, normals=_unit(normals), triangles=triangles)

    def at(self, x: float, y: float, z: float, *, turn: float = 0.0, scale: float = 1.0) -> Shape:
        """Scale, turn about the y axis [rad], then put the origin at (x, y, z) [m]."""
        return self.moved(translation(x, y, z, turn=turn, scale=scale))

    def tinted(self, color: Sequence[float]) -> Shape:
        """Give every vertex one linear colour."""
        return dataclasses.replace(self, colors=np.broadcast_to(np.asarray(color, float), self.positions.shape))

    def volume(self) -> float:
        """Enclosed volume of a closed shape [m³]; negative if it is inside out."""
        a, b, c = np.moveaxis(self.positions[self.triangles], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    def mesh(self, name: str = "") -> Mesh:
        """Hand the arrays to the renderer."""
        colors = None if self.colors is None else np.column_stack([self.colors, np.ones(len(self.colors))])
        return Mesh(self.positions, self.triangles, normals=self.normals, uvs=self.uvs, colors=colors, name=name)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def translation(x: float, y: float, z: float, *, turn: float = 0.0, scale: float = 1.0) -> np.ndarray:
    """Matrix that scales, turns about the y axis [rad] and moves to (x, y, z) [m]; (4, 4) float64."""
    c, s = np.cos(turn) * scale, np.sin(turn) * scale
    return np.array([[c, 0.0, s, x], [0.0, scale, 0.0, y], [-s, 0.0, c, z], [0.0, 0.0, 0.0, 1.0]])


def join(*shapes: Shape) -> Shape:
    """Put shapes into one; where only some have colours, the others are white."""
    first = np.cumsum([0] + [len(s.positions) for s in shapes])
    colored = any(s.colors is not None for s in shapes)
    colors = [s.colors if s.colors is not None else np.ones_like(s.positions) for s in shapes] if colored else None
    return Shape(
        np.concatenate([s.positions for s in shapes]),
        np.concatenate([s.normals for s in shapes]),
        np.concatenate([s.uvs for s in shapes]),
        np.concatenate([s.triangles + offset for s, offset in zip(shapes, first[:-1], strict=True)]),
        np.concatenate(colors) if colors is not None else None,
    )


def surface(positions: np.ndarray, normals: np.ndarray) -> Shape:
    """Span a net of rows and columns with two triangles a cell; cells shrunk to a line or point are left out.

    Args:
        positions: (rows, columns, 3) [m]; seen from the front, columns run to the right and rows upwards.
        normals: Same shape, any length.
    """
    rows, columns = positions.shape[:2]
    v, u = np.meshgrid(np.linspace(1.0, 0.0, rows), np.linspace(0.0, 1.0, columns), indexing="ij")
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel()
    d, c = corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    triangles = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    points = positions.reshape(-1, 3)
    p, q, r = np.moveaxis(points[triangles], 1, 0)
    double_area = np.linalg.norm(np.cross(q - p, r - p), axis=-1)
    triangles = triangles[double_area > 1e-12 * max(np.ptp(points, axis=0).max(), 1e-30) ** 2]
    return Shape(points, _unit(normals.reshape(-1, 3)), np.stack([u.ravel(), v.ravel()], -1), triangles)


def grid(x: np.ndarray, z: np.ndarray, height: np.ndarray, slope_x: np.ndarray, slope_z: np.ndarray) -> Shape:
    """Height field over the crossings of `x` (columns) and `z` (rows) [m], facing up.

    Args:
        x: (columns,) increasing.
        z: (rows,) increasing.
        height: (rows, columns) y [m].
        slope_x: dy/dx, same shape.
        slope_z: dy/dz, same shape.
    """
    xs, zs = np.meshgrid(x, z)
    positions = np.stack([xs, height, zs], -1)
    normals = np.stack([-slope_x, np.ones_like(height), -slope_z], -1)
    # Seen from above with x to the right, z runs down the page: rows upwards means the last one first.
    return surface(positions[::-1], normals[::-1])


def plane(width: float, depth: float, *, columns: int = 1, rows: int = 1) -> Shape:
    """Level rectangle around the origin, facing up."""
    x, z = np.linspace(-width / 2, width / 2, columns + 1), np.linspace(-depth / 2, depth / 2, rows + 1)
    flat = np.zeros((rows + 1, columns + 1))
    return grid(x, z, flat, flat, flat)


def box(width: float, height: float, depth: float, *, cells: int = 1) -> Shape:
    """Box that stands on y = 0, with sharp edges and `cells` x `cells` cells on each face."""
    half = np.array([width, height, depth]) / 2.0
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            across, up = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * sign
            normal = np.eye(3)[axis] * sign
            s = np.linspace(-1.0, 1.0, cells + 1)
            points = (normal + s[:, None, None] * up + s[None, :, None] * across) * half
            faces.append(surface(points, np.broadcast_to(normal, points.shape)))
    return join(*faces).at(0.0, height / 2.0, 0.0)


def bevelled_box(width: float, height: float, depth: float, bevel: float) -> Shape:
    """Box that stands on y = 0 with chamfered edges; normals run on across the chamfers, which so look round.

    Args:
        width: Size along x [m].
        height: Size along y [m].
        depth: Size along z [m].
        bevel: Width that a chamfer takes off each face [m].
    """
    half = np.array([width, height, depth]) / 2.0
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    # Vertex 3 c + a: corner c as the face across axis a sees it, inset along the two other axes.
    inset = (half - bevel)[None, None] + np.eye(3)[None] * bevel
    positions = (corners[:, None] * inset).reshape(-1, 3)
    normals = (corners[:, None] * np.eye(3)[None]).reshape(-1, 3)
    quads, triangles = [], [[3 * c, 3 * c + 1, 3 * c + 2] for c in range(8)]
    bit = (4, 2, 1)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for side in (0, bit[a]):
            quads.append([3 * (side + k) + a for k in (0, bit[b], bit[b] + bit[c], bit[c])])
        for k in (0, bit[b], bit[b] + bit[c], bit[c]):
            quads.append([3 * k + b, 3 * (k + bit[a]) + b, 3 * (k + bit[a]) + c, 3 * k + c])
    triangles += [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]
    faces = np.array(triangles)
    p, q, r = np.moveaxis(positions[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(q - p, r - p), p + q + r) < 0.0
    faces[inward] = faces[inward, ::-1]
    uvs = positions[:, [0, 2]] / (2.0 * half[[0, 2]]) + 0.5
    return Shape(positions, normals, uvs, faces).at(0.0, height / 2.0, 0.0)


def lathe(
    profile: Sequence[Sequence[float]],
    segments: int = 48,
    *,
    crease: float = 0.6,
    flutes: int = 0,
    flute_depth: float = 0.0,
    fluted: tuple[float, float] = (0.0, 0.0),
) -> Shape:
    """Turn a profile about the y axis.

    Args:
        profile: (k, 2) points (radius, height) [m] in the order in which the outside lies to the right: from bottom to
            top. Starting and ending on the axis closes the shape; so does ending where it started. Doubled points
            are dropped.
        segments: Facets around.
        crease: Angle between two pieces of the profile from which on their edge stays sharp [rad].
        flutes: Number of hollow grooves around, 0 for none.
        flute_depth: Depth of a groove as a share of the radius.
        fluted: Heights between which the grooves run [m].
    """
    points = np.asarray(profile, float)
    points = points[np.append(True, np.abs(np.diff(points, axis=0)).max(axis=1) > 1e-9)]
    steps = np.diff(points, axis=0)
    across = _unit(np.stack([steps[:, 1], -steps[:, 0]], -1))
    closed = np.allclose(points[0], points[-1]) and points[0, 0] > 0.0
    before = np.concatenate([across[-1:] if closed else across[:1], across])
    after = np.concatenate([across, across[:1] if closed else across[-1:]])
    sharp = np.einsum("ij,ij->i", before, after) < np.cos(crease)
    mean = _unit(before + after)
    strips = []
    edges = np.flatnonzero(sharp[1:-1]) + 1
    for start, stop in zip([0, *edges], [*edges, len(points) - 1], strict=True):
        normal = mean[start : stop + 1].copy()
        normal[0] = after[start] if sharp[start] else normal[0]
        normal[-1] = before[stop] if sharp[stop] else normal[-1]
        strips.append(_turned(points[start : stop + 1], normal, segments, flutes, flute_depth, fluted))
    return join(*strips)


def _turned(points, normal, segments, flutes, flute_depth, fluted) -> Shape:
    """One smooth strip of a lathe; grooves bend its normals by the slope of the radius around the axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    angle[-1] = 0.0
    radius = np.repeat(points[:, :1], segments + 1, axis=1)
    slope = np.zeros_like(radius)
    if flutes:
        inside = ((points[:, 1] >= fluted[0]) & (points[:, 1] <= fluted[1]))[:, None]
        sine, cosine = np.sin(0.5 * flutes * angle)[None], np.cos(0.5 * flutes * angle)[None]
        wave = np.abs(sine)
        # On the ridge between two grooves the slope has both signs: none is taken, and the normal points straight out.
        turn = 0.5 * flutes * cosine * np.where(wave > 1e-9, np.sign(sine), 0.0)
        slope = np.where(inside, -flute_depth * radius * turn, 0.0)
        radius = np.where(inside, radius * (1.0 - flute_depth * wave), radius)
    c, s = np.cos(angle)[None], -np.sin(angle)[None]
    height = np.broadcast_to(points[:, 1:], radius.shape)
    positions = np.stack([radius * c, height, radius * s], -1)
    # Tangent around the axis is (-sin, 0, -cos) of the angle; the radius growing along it tips the normal back.
    tip = np.divide(slope, radius, out=np.zeros_like(slope), where=radius > 0.0) * normal[:, :1]
    across = normal[:, :1]
    normals = np.stack([across * c - tip * s, np.broadcast_to(normal[:, 1:], radius.shape), across * s + tip * c], -1)
    return surface(positions, normals)


def sphere(radius: float = 1.0, segments: int = 32, rings: int = 16) -> Shape:
    """Sphere around the origin with its exact normals."""
    t = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    profile = np.stack([np.cos(t), np.sin(t)], -1)
    profile[[0, -1], 0] = 0.0
    shape = _turned(profile * radius, profile, segments, 0, 0.0, (0.0, 0.0))
    return dataclasses.replace(shape, normals=_unit(shape.positions))


def torus(radius: float, tube: float, segments: int = 64, sides: int = 12) -> Shape:
    """Ring around the y axis: the tube's centre runs at `radius` [m], the tube is `tube` thick in radius [m]."""
    t = np.linspace(-np.pi, np.pi, sides + 1)
    t[-1] = -np.pi
    normal = np.stack([np.cos(t), np.sin(t)], -1)
    return _turned(normal * tube + [radius, 0.0], normal, segments, 0, 0.0, (0.0, 0.0))


def column(height: float, radius: float, *, flutes: int = 18, segments: int = 72) -> Shape:
    """Column with plinth, torus base, fluted shaft with entasis, and a capital under a square slab.

    Args:
        height: From the floor to the top of the slab [m].
        radius: Of the shaft at its foot [m].
        flutes: Grooves around the shaft.
        segments: Facets around; a multiple of four per flute keeps the grooves round.
    """
    r, plinth, slab = radius, 0.45 * radius, 0.42 * radius
    bead = [(np.sin(t), -np.cos(t)) for t in np.linspace(0.0, np.pi, 9)]
    base = [(0.0, plinth), (1.18 * r, plinth)]
    base += [(1.18 * r + 0.17 * r * x, plinth + 0.17 * r * (1.0 + y)) for x, y in bead]
    base += [(1.14 * r, plinth + 0.42 * r)]
    base += [(1.10 * r + 0.09 * r * x, plinth + 0.51 * r + 0.09 * r * y) for x, y in bead]
    foot, neck = plinth + 0.66 * r, height - slab - 0.85 * r
    # Entasis: the shaft swells by a fiftieth a third of the way up and narrows by a sixth (Vitruvius III, 3).
    s = np.linspace(0.0, 1.0, 14)
    shaft_radius = r * (1.0 - s**1.6 / 6.0 + 0.02 * np.sin(np.pi * np.minimum(1.5 * s, 1.0)))
    shaft = [(1.06 * r, plinth + 0.60 * r), (1.04 * r, foot - 0.01)]
    shaft += [(w, foot + q * (neck - foot)) for w, q in zip(shaft_radius, s, strict=True)]
    top = shaft_radius[-1]
    capital = [(top, neck + 0.02)]
    capital += [(top + 0.07 * r * x, neck + 0.09 * r + 0.07 * r * y + 0.02) for x, y in bead]
    capital += [(top, neck + 0.22 * r)]
    swell = np.linspace(0.0, np.pi / 2, 9)
    capital += [
        (top + 0.52 * r * np.sin(t) ** 1.3, neck + 0.22 * r + 0.55 * r * (1.0 - np.cos(t)) ** 0.8) for t in swell
    ]
    capital += [(top + 0.52 * r, height - slab), (0.0, height - slab)]
    turned = lathe(base + shaft + capital, segments, flutes=flutes, flute_depth=0.09, fluted=(foot + 0.05, neck - 0.05))
    foot_slab = bevelled_box(2.75 * r, plinth, 2.75 * r, 0.05 * r)
    return join(foot_slab, turned, bevelled_box(2.9 * r, slab, 2.9 * r, 0.05 * r).at(0.0, height - slab, 0.0))


def arch(span: float, width: float, height: float, depth: float, *, segments: int = 24) -> Shape:
    """Piece of wall with a half-round opening: springs at y = 0, runs along x, is `depth` thick along z.

    Args:
        span: Width of the opening [m]; it rises by half of it.
        width: Whole width, at least `span` [m].
        height: Top of the wall, above span / 2 [m].
        depth: Thickness [m].
        segments: Facets of the opening.
    """
    t = np.linspace(np.pi, 0.0, segments + 1)
    r = span / 2.0
    x = np.concatenate([[-width / 2], r * np.cos(t), [width / 2]])
    low = np.concatenate([[0.0], r * np.sin(t), [0.0]])
    low[[1, -2]] = 0.0
    high = np.full_like(x, height)

    def wall(z: float, sign: float) -> Shape:
        points = np.stack([np.stack([x, y, np.full_like(x, z)], -1) for y in (low, high)])
        normals = np.broadcast_to([0.0, 0.0, sign], points.shape)
        return surface(points, normals) if sign > 0.0 else surface(points[:, ::-1], normals)

    def strip(xs: np.ndarray, ys: np.ndarray, normals: np.ndarray) -> Shape:
        points = np.stack([np.stack([xs, ys, np.full_like(xs, z)], -1) for z in (depth / 2, -depth / 2)])
        return surface(points, np.stack([normals, normals]))

    across = np.stack([-np.cos(t), -np.sin(t), np.zeros_like(t)], -1)
    down, up = np.array([[0.0, -1.0, 0.0]] * 2), np.broadcast_to([0.0, 1.0, 0.0], (len(x), 3))
    ends = np.array([[-1.0, 0.0, 0.0]] * 2)
    pieces = [wall(depth / 2, 1.0), wall(-depth / 2, -1.0), strip(x[-2:0:-1], low[-2:0:-1], across[::-1])]
    pieces += [strip(x[1::-1], low[1::-1], down), strip(x[:-3:-1], low[:-3:-1], down)] if width > span else []
    pieces += [strip(x, high, up), strip(x[[0, 0]], np.array([0.0, height]), ends)]
    pieces += [strip(x[[-1, -1]], np.array([height, 0.0]), -ends)]
    return join(*pieces)


def coffered_vault(
    radius: float, length: float, *, around: int = 9, along: int = 16, depth: float = 0.18, steps: int = 2
) -> Shape:
    """Half-round vault along z, seen from below, with sunken square panels; springs at y = 0.

    Args:
        radius: Inner radius [m].
        length: Along z, around the origin [m].
        around: Panels from springing to springing.
        along: Panels along the length.
        depth: How far a panel lies behind the ribs [m].
        steps: Frames, one inside the other, in which it gets there.
    """
    edges = np.concatenate([[0.0], np.repeat(0.11 + 0.11 * np.arange(steps), 2) + np.tile([0.0, 0.025], steps)])
    sunk = np.concatenate([[0], np.repeat(np.arange(steps), 2) + np.tile([0, 1], steps)])
    cell, level = np.concatenate([edges, 1.0 - edges[:0:-1]]), np.concatenate([sunk, sunk[:0:-1]])

    def stations(count: int) -> tuple[np.ndarray, np.ndarray]:
        places = (np.arange(count)[:, None] + cell).ravel()
        return np.append(places, count) / count, np.append(np.tile(level, count), 0)

    u, level_u = stations(around)
    v, level_v = stations(along)
    out = radius + depth / steps * np.minimum(level_u[:, None], level_v[None])
    angle, z = (np.pi * u)[:, None], (length * (v - 0.5))[None] + np.zeros_like(out)
    # Seen from below with z to the right, -x is up: rows run from +x over the crown to -x.
    points = np.stack([out * np.cos(angle), out * np.sin(angle), z], -1)
    corner = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], 2).reshape(-1, 4, 3)
    reach = np.linalg.norm(corner[..., :2], axis=-1)
    # A frame's corner cell has one sunken or one raised vertex: the cut must run through it to keep both faces flat.
    odd = np.abs(reach - np.median(reach, axis=1, keepdims=True)).argmax(axis=1)
    corner = np.where((odd % 2 == 1)[:, None, None], np.roll(corner, -1, axis=1), corner)
    flat = corner[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)
    normals = _unit(np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]))
    triangles = np.arange(3 * len(flat)).reshape(-1, 3)
    flat = flat.reshape(-1, 3)
    return Shape(flat, np.repeat(normals, 3, axis=0), flat[:, [2, 1]], triangles)
