"""From raw arrays of a file to a `Mesh`: bad faces dropped, bad attributes replaced, everything counted.

The rules (the upload boundary lets nothing non-finite or out of range pass):
a face with an index outside the vertices or a corner at a non-finite position is dropped; a non-finite colour becomes
white, a uv (0, 0), a normal the zero vector, which means the face's own normal. Faces without area stay: the
rasteriser draws nothing for them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .load_report import LoadReport
from .scene import Mesh

__all__ = ["linear_from_srgb", "repaired_mesh"]

FLOAT32_MAX = float(np.finfo(np.float32).max)


def linear_from_srgb(values: Any) -> np.ndarray:
    """Decode sRGB to linear light, both 0 to 1 (IEC 61966-2-1; the linear piece below 0.04045 is value / 12.92)."""
    v = np.asarray(values, np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.0) + 0.055) / 1.055) ** 2.4)


def repaired_mesh(
    report: LoadReport,
    name: str,
    positions: np.ndarray,
    triangles: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    uvs: np.ndarray | None = None,
    colors: np.ndarray | None = None,
    smooth: bool = False,
) -> Mesh:
    """Build a mesh from a file's arrays, dropping and replacing what cannot be used.

    Args:
        report: Where repairs are counted.
        name: Name of the mesh, for messages and the mesh itself.
        positions: (n, 3) floats [m]; float64 far from zero keeps its precision.
        triangles: (m, 3) whole numbers.
        normals: (n, 3) floats of any length, or None.
        uvs: (n, 2) floats, v = 0 at the top, or None.
        colors: (n, 4) linear floats, or None.
        smooth: How missing normals are made, as in `Mesh`.

    Returns:
        The mesh; vertices that no face uses are left out where one of them is not finite or they outnumber the rest.
    """
    count = len(positions)
    faces = np.asarray(triangles, np.int64).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        usable = (np.abs(positions) <= FLOAT32_MAX).all(axis=1)
    inside = ((faces >= 0) & (faces < count)).all(axis=1)
    if not inside.all():
        report.repair(f"mesh {name!r}: dropped {_count(~inside, 'face')} with an index outside its {count} vertices")
        faces = faces[inside]
    if not usable.all():
        whole = usable[faces].all(axis=1)
        if not whole.all():
            report.repair(f"mesh {name!r}: dropped {_count(~whole, 'face')} with a vertex that is not finite")
        faces = faces[whole]
    normals = _replaced(report, name, "normal", normals, 0.0)
    uvs = _replaced(report, name, "uv", uvs, 0.0)
    colors = _replaced(report, name, "colour", colors, 1.0)

    used = np.zeros(count, bool)
    used[faces] = True
    if not usable.all() or 2 * int(used.sum()) < count:
        new_index = np.cumsum(used) - 1
        faces = new_index[faces]
        positions = positions[used]
        normals, uvs, colors = (None if a is None else a[used] for a in (normals, uvs, colors))
    return Mesh(positions, faces, normals=normals, uvs=uvs, colors=colors, smooth=smooth, name=name)


def _replaced(report: LoadReport, name: str, what: str, values: np.ndarray | None, default: float) -> np.ndarray | None:
    """Return the attribute as float32 with each row that is not finite set to `default`."""
    if values is None:
        return None
    with np.errstate(invalid="ignore"):
        good = (np.abs(values) <= FLOAT32_MAX).all(axis=1)
    if good.all():
        return values
    report.repair(
        f"mesh {name!r}: replaced {_count(~good, what)} that {'is' if (~good).sum() == 1 else 'are'} not finite"
    )
    return np.where(good[:, None], values, default)


def _count(mask: np.ndarray, noun: str) -> str:
    number = int(mask.sum())
    return f"{number} {noun}" + ("" if number == 1 else "s")
