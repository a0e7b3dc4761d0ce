"""What stands and hangs in the hall of `hundred_lights`: lanterns, urns, pedestals, the armillary sphere. Metres."""

from __future__ import annotations

import numpy as np

from .shapes import Shape, bevelled_box, join, lathe, sphere, torus

__all__ = ["armillary_rings", "lantern", "pedestal", "urn"]


def _tilted(shape: Shape, about_x: float, about_z: float) -> Shape:
    cx, sx, cz, sz = np.cos(about_x), np.sin(about_x), np.cos(about_z), np.sin(about_z)
    x = np.array([[1, 0, 0, 0], [0, cx, -sx, 0], [0, sx, cx, 0], [0, 0, 0, 1.0]])
    z = np.array([[cz, -sz, 0, 0], [sz, cz, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return shape.moved(z @ x)


def lantern(chain: float) -> Shape:
    """Bronze lantern around the origin under a chain of that length: foot, four bars, cap, ring and rod."""
    foot = lathe(
        [(0, -0.30), (0.05, -0.29), (0.03, -0.24), (0.13, -0.20), (0.17, -0.17), (0.17, -0.14), (0, -0.14)], 24
    )
    cap = lathe(
        [(0, 0.16), (0.19, 0.16), (0.19, 0.19), (0.15, 0.22), (0.06, 0.30), (0.05, 0.34), (0.02, 0.37), (0.02, 0.42)],
        24,
    )
    rod = lathe([(0.0, 0.40), (0.012, 0.40), (0.012, chain), (0.0, chain)], 8)
    bar = bevelled_box(0.018, 0.31, 0.018, 0.004)
    places = 0.145 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) / 2.0**0.5
    return join(foot, cap, rod, *(bar.at(x, -0.145, z) for x, z in places))


def urn() -> Shape:
    """Tall vase with foot, shoulder, neck, lip and two ring handles; 1.15 m high."""
    t = np.linspace(0.0, 1.0, 24)
    belly = 0.07 + 0.27 * np.sin(np.pi * np.clip(t * 0.92 + 0.04, 0.0, 1.0) ** 1.35) ** 0.9
    body = list(zip(belly, 0.16 + 0.72 * t, strict=True))
    foot = [(0.0, 0.0), (0.20, 0.0), (0.20, 0.05), (0.15, 0.08), (0.085, 0.12)]
    neck = [
        (0.095, 0.93),
        (0.105, 1.02),
        (0.16, 1.09),
        (0.19, 1.12),
        (0.19, 1.15),
        (0.15, 1.15),
        (0.09, 1.02),
        (0, 0.98),
    ]
    handle = _tilted(torus(0.13, 0.022, 32, 10), np.pi / 2, 0.0)
    return join(lathe(foot + body + neck, 48), handle.at(0.27, 0.86, 0.0), handle.at(-0.27, 0.86, 0.0))


def pedestal(height: float, width: float) -> Shape:
    """Square pedestal with plinth and moulded top."""
    top = height - 0.07
    parts = [bevelled_box(width * 1.25, 0.12, width * 1.25, 0.02), bevelled_box(width * 1.1, 0.06, width * 1.1, 0.02)]
    shaft = bevelled_box(width, height - 0.2, width, 0.025).at(0.0, 0.15, 0.0)
    cap = [bevelled_box(width * 1.12, 0.05, width * 1.12, 0.02), bevelled_box(width * 1.28, 0.07, width * 1.28, 0.02)]
    return join(parts[0], parts[1].at(0.0, 0.12, 0.0), shaft, cap[0].at(0.0, top - 0.05, 0.0), cap[1].at(0.0, top, 0.0))


def armillary_rings(radius: float) -> list[Shape]:
    """Three nested sets of rings around the origin, each of which turns by itself, then the stand below them."""

    def hoop(r: float, width: float) -> Shape:
        w, h = 0.7 * width, 0.028
        return lathe([(r - h, -w), (r + h, -w), (r + h, w), (r - h, w), (r - h, -w)], 128)

    r = radius
    outer = join(_tilted(hoop(r, 0.10), np.pi / 2, 0.0), hoop(r * 0.995, 0.14))
    middle = join(
        hoop(0.86 * r, 0.09),
        _tilted(hoop(0.86 * r, 0.06), np.pi / 2, 0.0),
        _tilted(hoop(0.86 * r, 0.06), np.pi / 2, np.pi / 2),
        *(hoop(0.86 * r * np.cos(a), 0.04).at(0.0, 0.86 * r * np.sin(a), 0.0) for a in (-0.41, 0.41)),
    )
    inner = join(
        _tilted(hoop(0.66 * r, 0.07), 0.41, 0.0),
        _tilted(torus(0.5 * r, 0.018, 96, 10), np.pi / 2, 0.6),
        *(sphere(0.05, 24, 12).at(0.5 * r * np.cos(a), 0.0, 0.5 * r * np.sin(a)) for a in (0.4, 2.6, 4.7)),
    )
    foot = [(0.0, -0.55), (0.42, -0.55), (0.42, -0.50), (0.24, -0.43), (0.10, -0.34), (0.07, -0.24), (0.13, -0.19)]
    stem = [(0.13, -0.15), (0.06, -0.10), (0.05, 0.0), (0.0, 0.02)]
    stand = lathe(foot + stem, 48).at(0.0, -r - 0.02, 0.0)
    return [outer, middle, inner, stand]
