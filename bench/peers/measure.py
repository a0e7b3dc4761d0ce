"""Bench `peers`: this renderer and others on the same scenes, in one run on one device."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Renderer, Scene, Settings
from warp_deferred.images import write_png

from ..effects import reason
from ..record import Record
from ..timing import REPEATS
from .base import Peer, srgb
from .cases import PeerCase, narrowed
from .mujoco_warp import MuJoCoWarp
from .newton import SensorCamera, SensorTiledCamera
from .nvdiffrast import NvDiffRast
from .opengl import OpenGL
from .ours import OURS
from .pygfx import PyGfx

__all__ = ["DEPTH_TOLERANCE", "PEERS", "agreement", "run"]

PEERS: tuple[Peer, ...] = (SensorTiledCamera(), SensorCamera(), OpenGL(), NvDiffRast(), MuJoCoWarp(), PyGfx())
#: Share of the depth by which two depths of one pixel may differ and still agree.
DEPTH_TOLERANCE = 1e-3
QUICK_REPEATS = 3

Row = dict[str, Any]


def run(
    device: wp.Device,
    *,
    quick: bool,
    settings: Settings,
    note: Any,
    only: str = "",
    images: str = "",
    keep: Callable[[Record], Any] | None = None,
) -> Record:
    """Time every case by every peer that is there.

    What fails, whatever the reason, is reported by name, and the others go on.

    Args:
        device: Where to run.
        quick: Tiny cases and few repeats.
        settings: Settings of ours; the size of shadow maps is the case's, since peers have the same.
        note: Function of a text that tells how far it is.
        only: Part of the names of cases to run; all of them if left out.
        images: Folder for a picture of what each row times; none is written if left out.
        keep: Called with what is there after each case, so that nothing measured is lost.

    Returns:
        What each peer is (`peers`), who is missing and what failed (`skipped`), and one row a case and peer: its time,
        how many times ours that is (`ratio`), and the share of pixels whose depth agrees with ours.
    """
    result: Record = {"peers": [], "skipped": [], "rows": []}

    def skip(text: str) -> None:
        note(f"skipped {text}")
        result["skipped"].append(text)

    present = []
    for peer in PEERS:
        if why := peer.available(device):
            skip(f"{peer.title}: {why}")
        else:
            present.append(peer)
    result["peers"] = [_told(peer) for peer in (*OURS, *present)]
    repeats = QUICK_REPEATS if quick else REPEATS
    for case in narrowed(only, device.is_cuda, quick=quick):
        note(case.title)
        result["rows"] += _case(case, present, device, settings, repeats, Path(images) if images else None, skip)
        # Once it has run, a peer may know more of itself.
        result["peers"] = [_told(peer) for peer in (*OURS, *present)]
        if keep:
            keep(result)
    return result


def _told(peer: Peer) -> dict[str, str]:
    """What a peer is, for the record."""
    names = ("name", "title", "computes", "leaves_out", "method", "wins")
    return {name: getattr(peer, name) for name in names} | {"version": peer.version()}


def _case(
    case: PeerCase, present: list[Peer], device: wp.Device, settings: Settings, repeats: int, images: Path | None,
    skip: Callable[[str], None],
) -> list[Row]:  # fmt: skip
    """Rows of one case, ours first."""
    scene = case.build()
    scene.settings = settings.replace(shadow=settings.shadow.replace(spot_size=case.map_size))
    cameras = case.cameras(scene)
    reference = _reference(case, scene, cameras, device)
    rows: list[Row] = []
    base: float | None = None
    for peer in (*OURS, *present):
        if case.kind not in peer.kinds:
            continue
        try:
            row = _row(case, peer, scene, cameras, device, repeats, reference, images)
        except Exception as error:
            skip(f"{case.name}, {peer.title}: {reason(error)}")
            continue
        base = row["time.ms"] if base is None and peer.name == "ours" else base
        if base is not None:
            row["ratio"] = round(row["time.ms"] / base, 4)
        rows.append(row)
    return rows


def _reference(case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> np.ndarray:
    """View depth by ours, outside all clocks."""
    renderer = Renderer(scene, width=case.width, height=case.height, device=device, outputs=("depth",))
    return renderer.render(cameras).numpy("depth").copy()


def _row(
    case: PeerCase, peer: Peer, scene: Scene, cameras: list[Camera], device: wp.Device, repeats: int,
    reference: np.ndarray, images: Path | None,
) -> Row:  # fmt: skip
    session = peer.open(case, scene, cameras, device)
    try:
        timing = session.time(repeats)
        depth = session.depth()
        if images is not None:
            _write(images / f"peers_{case.name}_{peer.name}.png", session.picture(), depth)
    finally:
        session.close()
    row: Row = {
        "case": case.name, "kind": case.kind, "title": case.title, "width": case.width, "height": case.height,
        "views": case.views, "triangles": scene.triangle_count, "lights": case.lights, "shadowed": case.shadowed,
        "peer": peer.name, "peer_title": peer.title,
    }  # fmt: skip
    row |= timing.metrics("time") | ({"note": session.note} if session.note else {})
    if depth is not None:
        row["depth.agrees"] = round(agreement(depth, reference), 6)
    return row


def agreement(depth: np.ndarray, reference: np.ndarray) -> float:
    """Share of pixels at which two depths differ by at most `DEPTH_TOLERANCE` of ours, or both show the background.

    Args:
        depth: View depth [m], +inf on the background.
        reference: The same by ours, of the same shape.

    Raises:
        ValueError: If the shapes differ.
    """
    if depth.shape != reference.shape:
        raise ValueError(f"depth: expected the shape {reference.shape}, got {depth.shape}")
    surface = np.isfinite(depth) & np.isfinite(reference)
    near = np.where(surface, np.abs(np.subtract(depth, reference, where=surface, out=np.zeros_like(depth))), 0.0)
    agrees = np.where(surface, near <= DEPTH_TOLERANCE * reference, np.isinf(depth) & np.isinf(reference))
    return float(agrees.mean())


def _write(path: Path, picture: np.ndarray | None, depth: np.ndarray | None) -> None:
    """Write a picture; where there is none the depth of the first view, near is bright."""
    if picture is None:
        if depth is None:
            return
        picture = np.repeat(srgb(1.0 / (1.0 + depth[0].astype(np.float64)))[..., None], 3, axis=-1)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.ascontiguousarray(picture))
