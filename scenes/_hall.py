"""The hall of `hundred_lights`: floor, arcades, aisles, vault and apse, as stone and nothing else.

A nave of square bays runs along -z between two rows of columns; its axis is x = 0. Sizes are in metres throughout.
Colours of vertices darken stone where it meets stone, as dust and age do: it gives corners their weight where no
shadow or ambient occlusion does.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .shapes import Shape, arch, bevelled_box, box, coffered_vault, column, join, lathe, plane, sphere, surface, torus

__all__ = ["APSE_RADIUS", "BAY", "BAYS", "NAVE", "bay_centres", "column_places", "floor", "rose_window", "stonework"]

BAY, BAYS = 3.6, 8
"""Length of a bay, and their number."""
FRONT = 3.6
"""z of the first pair of columns."""
BACK = FRONT - BAY * BAYS
"""z of the last pair of columns."""
NAVE = 3.6
"""Distance of the columns from the axis."""
AISLE = 7.2
"""Distance of the outer walls from the axis."""
COLUMN, SHAFT = 4.6, 0.36
"""Height of a column and radius of its foot."""
CORNICE = 6.75
"""Underside of the cornice; the aisles' ceilings lie there too."""
SPRING = 7.15
"""Height at which the vault springs."""
VAULT = 3.3
"""Radius of the vault."""
END = BACK - 0.9
"""z of the end wall."""
APSE_RADIUS = 2.7
"""Inner radius of the apse."""
_CREAM, _SLATE = np.array([0.46, 0.42, 0.36]), np.array([0.055, 0.06, 0.075])
_DEEP, _VERDE = np.array([0.20, 0.05, 0.04]), np.array([0.13, 0.17, 0.15])


def column_places() -> np.ndarray:
    """(18, 3) feet of the columns, left then right in each row, from the front."""
    z = FRONT - BAY * np.arange(BAYS + 1)
    return np.array([[side * NAVE, 0.0, depth] for depth in z for side in (-1.0, 1.0)])


def bay_centres() -> np.ndarray:
    """(8,) z of the middles of the bays, from the front."""
    return FRONT - BAY * (np.arange(BAYS) + 0.5)


def _worn(shape: Shape, low: float, high: float, dark: float = 0.45) -> Shape:
    """Darken towards the heights `low` and `high`, over a third of a metre."""
    y = shape.positions[:, 1]
    edge = np.minimum(np.clip((y - low) / 0.35, 0.0, 1.0), np.clip((high - y) / 0.35, 0.0, 1.0))
    return dataclasses.replace(shape, colors=np.repeat((dark + (1.0 - dark) * edge)[:, None], 3, axis=1))


def _tiles(
    x: np.ndarray, z: np.ndarray, size: float, cut: float, colors: np.ndarray, rng: np.random.Generator
) -> Shape:
    """Eight-sided tiles around (x, z), each of one colour and tipped by a hair, so that each catches light apart."""
    h, c = size / 2.0, size / 2.0 - cut
    ring = np.array([[h, -c], [c, -h], [-c, -h], [-h, -c], [-h, c], [-c, h], [c, h], [h, c]])
    if cut == 0.0:
        ring = ring[1::2]
    sides = len(ring)
    places = np.stack([x, z], -1)[:, None] + ring
    positions = np.stack([places[..., 0], np.zeros(places.shape[:2]), places[..., 1]], -1).reshape(-1, 3)
    tip = rng.normal(0.0, 0.004, (len(x), 2))
    normals = np.column_stack([tip[:, 0], np.ones(len(x)), tip[:, 1]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fan = np.array([[0, k, k + 1] for k in range(1, sides - 1)])
    triangles = (sides * np.arange(len(x))[:, None, None] + fan).reshape(-1, 3)
    shade = colors * rng.uniform(0.82, 1.12, (len(x), 1))
    return Shape(
        positions, np.repeat(normals, sides, axis=0), positions[:, [0, 2]], triangles, np.repeat(shade, sides, axis=0)
    )


def _cabochons(x: np.ndarray, z: np.ndarray, cut: float, color: np.ndarray, rng: np.random.Generator) -> Shape:
    """Small squares on their points that fill the gaps between eight-sided tiles."""
    square = _tiles(np.zeros(len(x)), np.zeros(len(x)), cut * 2.0**0.5, 0.0, np.tile(color, (len(x), 1)), rng)
    c = 0.5**0.5
    turned = square.moved(np.array([[c, 0, c, 0], [0, 1, 0, 0], [-c, 0, c, 0], [0, 0, 0, 1.0]]))
    centre = np.repeat(np.stack([x, np.zeros(len(x)), z], -1), 4, axis=0)
    positions = turned.positions + centre
    # Half of an outermost square would lie in the same plane as the band beside it, and flicker.
    positions[:, 0] = np.clip(positions[:, 0], x.min(), x.max())
    return dataclasses.replace(turned, positions=positions)


def floor(rng: np.random.Generator) -> Shape:
    """Nave in cream octagons with dark cabochons and a red runner, dark bands under the columns, checkered aisles."""
    size, cut = 0.9, 0.24
    rows = np.arange(-2, round((FRONT - END) / size) + 6)
    zs = FRONT - size * (rows + 0.5)
    xs = size * (np.arange(6) - 2.5)
    x, z = (a.ravel() for a in np.meshgrid(xs, zs))
    lane = np.round(np.abs(x) / size - 0.5).astype(int)
    color = np.where((lane == 2)[:, None], _VERDE, _CREAM)
    color = np.where(((lane == 0) & (np.round(z / size).astype(int) % 4 == 0))[:, None], _DEEP, color)
    pieces = [_tiles(x, z, size, cut, color, rng)]
    gx, gz = (a.ravel() for a in np.meshgrid(size * (np.arange(7) - 3), np.append(zs - size / 2, zs[0] + size / 2)))
    pieces.append(_cabochons(gx, gz, cut, _SLATE, rng))
    length = len(zs) * size
    middle = 0.5 * (zs[0] + zs[-1])
    for side in (-1.0, 1.0):
        band = plane(1.8, length, columns=12, rows=int(length / 0.15)).at(side * 3.6, 0.0, middle)
        pieces.append(_contact(dataclasses.replace(band, colors=np.tile(_SLATE * 2.0, (len(band.positions), 1)))))
        ax, az = (a.ravel() for a in np.meshgrid(side * (4.5 + size * (np.arange(3) + 0.5)), zs))
        even = (np.round(ax / size - 0.5) + np.round(az / size)).astype(int) % 2 == 0
        pieces.append(_tiles(ax, az, size, 0.0, np.where(even[:, None], _CREAM * 0.6, _SLATE), rng))
    return join(*pieces)


def _contact(shape: Shape) -> Shape:
    """Darken a floor around the feet of the columns."""
    flat = shape.positions[:, None, [0, 2]] - column_places()[None, :, [0, 2]]
    away = np.abs(flat).max(axis=-1).min(axis=1) - 0.48
    return dataclasses.replace(shape, colors=shape.colors * (0.3 + 0.7 * np.clip(away / 0.4, 0.0, 1.0))[:, None])


def _half_ring(radius: float, tube: float, sides: int = 8, segments: int = 32) -> Shape:
    """Moulding around a half-round opening in the plane z = 0, springing at y = 0."""
    a, t = np.linspace(0.0, np.pi, segments + 1)[None], np.linspace(-np.pi, np.pi, sides + 1)[:, None]
    out = np.stack([np.cos(t) * np.cos(a), np.cos(t) * np.sin(a), np.sin(t) * np.ones_like(a)], -1)
    centre = np.stack([np.cos(a), np.sin(a), np.zeros_like(a)], -1) * radius
    return surface(centre + tube * out, out)


def _voussoirs(inner: float, outer: float, depth: float, count: int, rng: np.random.Generator) -> Shape:
    """Ring of wedge stones around an arch, pale and red in turn, springing at y = 0, `depth` thick along z."""
    a = np.linspace(0.0, np.pi, 2 * count + 1).reshape(-1)
    pieces = []
    for k in range(count):
        # Two facets a stone; a hair of a gap between stones shows as a joint.
        angle = a[2 * k : 2 * k + 3] + np.array([0.006, 0.0, -0.006])
        out = np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], -1)
        edge = np.array([0.0, 0.0, depth / 2])
        under = surface(np.stack([out * inner + edge, out * inner - edge]), np.stack([-out] * 2))
        over = surface(np.stack([out * outer - edge, out * outer + edge]), np.stack([out] * 2))
        front = np.stack([out * outer + edge, out * inner + edge])
        normal = np.broadcast_to([0.0, 0.0, 1.0], front.shape)
        flip = np.array([1.0, 1.0, -1.0])
        stone = join(under, over, surface(front, normal), surface(front[::-1] * flip, normal * flip))
        shade = np.array([1.0, 1.0, 1.0]) if k % 2 == 0 else np.array([0.60, 0.30, 0.22])
        pieces.append(stone.tinted(shade * rng.uniform(0.85, 1.0)))
    return join(*pieces)


def rose_window() -> tuple[Shape, list[Shape]]:
    """Stone tracery and panes of a round window in the plane z = 0; the panes are a heart and rings of petals."""
    upright = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])

    def pane(radius: float) -> Shape:
        return sphere(radius, 24, 12).moved(np.diag([1.0, 1.0, 0.12, 1.0]))

    tracery, petals, buds = [torus(1.12, 0.10, 64, 12), torus(0.98, 0.05, 64, 10), torus(0.33, 0.05, 40, 10)], [], []
    for k in range(12):
        c, s = np.cos(np.pi * k / 6), np.sin(np.pi * k / 6)
        tracery.append(torus(0.185, 0.032, 28, 8).at(0.76 * c, 0.0, 0.76 * s))
        petals.append(pane(0.175).at(0.76 * c, 0.76 * s, 0.0))
        c, s = np.cos(np.pi * (k + 0.5) / 6), np.sin(np.pi * (k + 0.5) / 6)
        buds.append(pane(0.075).at(0.48 * c, 0.48 * s, 0.0))
    return join(*tracery).moved(upright), [join(*petals[::2]), join(*petals[1::2]), join(*buds), pane(0.31)]


def _rib() -> Shape:
    """Band across the vault above a pair of columns: an arch piece cut to the vault's own curve."""
    a = np.linspace(0.0, np.pi, 41)
    inner, outer, half = VAULT - 0.16, VAULT + 0.05, 0.24
    across = np.stack([np.cos(a), np.sin(a), np.zeros_like(a)], -1)
    edge = np.array([0.0, 0.0, half])
    under = surface(np.stack([across * inner + edge, across * inner - edge]), np.stack([-across] * 2))
    flip = np.array([1.0, 1.0, -1.0])
    front = np.stack([across * inner + edge, across * outer + edge])[:, ::-1]
    normal = np.broadcast_to([0.0, 0.0, 1.0], front.shape)
    return join(under, surface(front, normal), surface(front[:, ::-1] * flip, normal * flip))


def _apse() -> Shape:
    """Half-round niche behind the end wall, under a half dome, both seen from inside."""
    a = np.linspace(0.0, np.pi, 49)
    out = np.stack([np.cos(a), np.zeros_like(a), -np.sin(a)], -1)
    rise = np.array([0.0, 1.0, 0.0])
    heights = np.linspace(0.0, COLUMN, 10)
    drum = np.stack([out * APSE_RADIUS + rise * y for y in heights])[:, ::-1]
    t = np.linspace(0.0, np.pi / 2, 25)
    dome_out = np.cos(t)[:, None, None] * out + np.sin(t)[:, None, None] * rise
    dome = (dome_out * APSE_RADIUS + rise * COLUMN)[:, ::-1]
    return join(
        _worn(surface(drum, np.broadcast_to(-out[::-1], drum.shape)), 0.0, 99.0, 0.35),
        surface(dome, -dome_out[:, ::-1]),
    )


def _ashlar(width: float, height: float, rows: int, columns: int, rng: np.random.Generator) -> Shape:
    """Wall of hewn blocks in running bond, facing +z: each block has its own shade and leans by a hair."""
    pieces = []
    for row in range(rows):
        cuts = np.linspace(0.0, width, columns + 1)
        if row % 2:
            cuts = np.concatenate([[0.0], cuts[:-1] + 0.5 * width / columns, [width]])
        pieces.append(np.stack([cuts[:-1], cuts[1:], np.full(len(cuts) - 1, row), np.full(len(cuts) - 1, row + 1)], -1))
    x0, x1, y0, y1 = (np.concatenate(pieces) * [1.0, 1.0, height / rows, height / rows]).T
    count = len(x0)
    corners = np.stack([np.stack([x, y, np.zeros(count)], -1) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], 1)
    normals = np.column_stack([rng.normal(0.0, 0.035, (count, 2)), np.ones(count)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = (4 * np.arange(count)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    flat = corners.reshape(-1, 3) - [width / 2, 0.0, 0.0]
    shade = np.repeat(rng.uniform(0.72, 1.0, (count, 1)) * [1.0, 0.99, 0.97], 4, axis=0)
    return Shape(flat, np.repeat(normals, 4, axis=0), flat[:, :2], triangles, shade)


def _aisle_wall(rng: np.random.Generator) -> Shape:
    """One bay of the outer wall, facing +z: a blind arch on two half piers before a wall of hewn blocks."""
    width, depth = BAY, 0.3
    blind = arch(2.5, width, CORNICE - 3.4, depth, segments=28).at(0.0, 3.4, depth / 2)
    piers = [box(0.55, 3.4, depth, cells=8).at(side * (width - 0.55) / 2, 0.0, depth / 2) for side in (-1.0, 1.0)]
    sill = bevelled_box(width, 0.55, depth + 0.12, 0.03).at(0.0, 0.0, (depth + 0.12) / 2)
    imposts = [
        bevelled_box(0.6, 0.14, depth + 0.1, 0.02).at(side * (width - 0.5) / 2, 3.3, 0.2) for side in (-1.0, 1.0)
    ]
    ring = _half_ring(1.25, 0.07).at(0.0, 3.4, depth)
    return join(
        _worn(join(blind, *piers, sill, *imposts, ring), -0.1, CORNICE + 0.1, 0.4),
        _ashlar(width, CORNICE, 18, 6, rng),
    )


def _ceilings() -> Shape:
    """Ceilings of the aisles with a beam at each column, and the walls that close the hall behind the camera."""
    length = FRONT - END + 4.0
    middle = 0.5 * (FRONT + 4.0 + END)
    turn = np.diag([1.0, -1.0, 1.0, 1.0])
    pieces = []
    for side in (-1.0, 1.0):
        x = side * 0.5 * (NAVE + AISLE)
        pieces.append(plane(AISLE - NAVE + 1.0, length, columns=4, rows=40).moved(turn).at(x, CORNICE, middle))
        for place in column_places()[::2]:
            pieces.append(bevelled_box(AISLE - NAVE, 0.4, 0.5, 0.04).at(x, CORNICE - 0.4, place[2]))
        # Above the arcade: the cornice in two steps, from which the vault springs.
        pieces.append(bevelled_box(0.95, 0.22, length, 0.05).at(side * NAVE, CORNICE - 0.02, middle))
        pieces.append(bevelled_box(1.15, 0.22, length, 0.06).at(side * NAVE, CORNICE + 0.19, middle))
    return join(*pieces)


def _end_wall() -> Shape:
    """Wall behind the last columns, with the opening of the apse, its moulding, and the aisles' ends."""
    wall = arch(2 * APSE_RADIUS, 2 * NAVE + 0.4, SPRING + VAULT + 0.6 - COLUMN, 0.5, segments=48).at(0.0, COLUMN, END)
    jambs = [box(NAVE + 0.2 - APSE_RADIUS, COLUMN, 0.5, cells=8) for _ in range(2)]
    x = 0.5 * (NAVE + 0.2 + APSE_RADIUS)
    pieces = [wall, jambs[0].at(-x, 0.0, END), jambs[1].at(x, 0.0, END)]
    pieces.append(_half_ring(APSE_RADIUS + 0.16, 0.15, 12, 64).at(0.0, COLUMN, END + 0.25))
    pieces.append(_half_ring(APSE_RADIUS + 0.42, 0.07, 10, 64).at(0.0, COLUMN, END + 0.25))
    for side in (-1.0, 1.0):
        pieces.append(bevelled_box(0.7, 0.3, 0.8, 0.04).at(side * (APSE_RADIUS + 0.25), COLUMN - 0.3, END))
        pieces.append(box(AISLE - NAVE, CORNICE, 0.4, cells=10).at(side * 0.5 * (NAVE + AISLE), 0.0, END))
    return _worn(join(*pieces), -0.1, 99.0, 0.4)


def _dais() -> Shape:
    """Four round steps in front of the apse, with rounded noses."""
    steps = []
    for k in range(4):
        r, y = 3.0 - 0.34 * k, 0.15 * k
        nose = [(r - 0.03 + 0.03 * np.cos(t), y + 0.12 + 0.03 * np.sin(t)) for t in np.linspace(0.0, np.pi / 2, 5)]
        steps.append(_worn(lathe([(r, y), *nose, (0.0, y + 0.15)], 96), y - 0.25, 99.0, 0.4))
    return join(*steps).at(0.0, 0.0, END + 0.6)


def stonework(rng: np.random.Generator) -> list[tuple[str, Shape, list[np.ndarray]]]:
    """List (name, shape, places) of all stone but the floor; a place is (x, y, z, turn about y [rad])."""
    columns = column_places()
    shaft = _worn(column(COLUMN, SHAFT), 0.0, COLUMN, 0.5)
    span = BAY - 2 * SHAFT - 0.12
    bay_arch = join(
        arch(span, BAY, CORNICE - COLUMN, 0.72, segments=32),
        _half_ring(span / 2 + 0.36, 0.045).at(0.0, 0.0, 0.36),
        _half_ring(span / 2 + 0.36, 0.045).at(0.0, 0.0, -0.36),
        _voussoirs(span / 2 - 0.02, span / 2 + 0.33, 0.78, 17, rng),
    )
    quarter = np.pi / 2
    arches = [np.array([side * NAVE, COLUMN, z, quarter]) for z in bay_centres() for side in (-1.0, 1.0)]
    walls = [np.array([side * AISLE, 0.0, z, -side * quarter]) for z in bay_centres() for side in (-1.0, 1.0)]
    ribs = [np.array([0.0, SPRING, z, 0.0]) for z in columns[::2, 2]]
    vault = coffered_vault(VAULT, BAY * BAYS, around=9, along=3 * BAYS).at(0.0, SPRING, 0.5 * (FRONT + BACK))
    origin = [np.zeros(4)]
    return [
        ("columns", shaft, [np.append(place, 0.0) for place in columns]),
        ("arcade", bay_arch, arches),
        ("aisle walls", _aisle_wall(rng), walls),
        ("ribs", _rib(), ribs),
        ("vault", vault, origin),
        ("ceilings", _ceilings(), origin),
        ("end wall", _end_wall(), origin),
        ("apse", _apse().at(0.0, 0.0, END), origin),
        ("dais", _dais(), origin),
    ]
