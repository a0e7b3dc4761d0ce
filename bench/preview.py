"""Pictures of what the benches time, so that a wrong case shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Renderer, Scene, Settings
from warp_deferred.images import write_png

from .cases import RESOLUTIONS, TRIANGLE_CASES, frame_cases, many_lights

__all__ = ["by_number", "run"]

QUICK_SIZE = (160, 90)


def run(device: wp.Device, out: Path, *, quick: bool, settings: Settings, note: Any) -> list[Path]:
    """Write one PNG a case: frames and lights as they look, triangles in a colour of each one's own.

    Args:
        device: Where to run.
        out: Folder for the pictures; made if it is not there.
        quick: The small cases, at a small size.
        settings: Settings of all cases.
        note: Function of a text that tells how far it is.
    """
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    size = QUICK_SIZE if quick else RESOLUTIONS["1080p"]
    for case in TRIANGLE_CASES:
        note(case.title)
        scene = case.quick() if quick else case.build()
        names = ("triangle_id", "normal") if case.whole else ("triangle_id",)
        frame = _renderer(scene, size, device, names, settings).render()
        picture = by_number(frame.numpy("triangle_id")[0])
        if case.whole:  # relief, for triangles of a pixel are but noise
            light = 0.35 + 0.65 * np.clip(frame.numpy("normal")[0] @ (0.5, 0.7, 0.5), 0.0, 1.0)
            picture[..., :3] = picture[..., :3] * light[..., None]
        paths.append(_write(out / f"triangles_{case.name}.png", picture))
    for case in frame_cases(device.is_cuda, quick=quick):
        note(case.title)
        frame = _renderer(case.build(), (case.width, case.height), device, ("display",), settings).render()
        paths.append(_write(out / f"frame_{case.name}.png", frame.numpy("display")[0]))
    for lights in (10,) if quick else (10, 1000, 10_000):
        note(f"{lights:,} lights")
        frame = _renderer(many_lights(lights, 5, quick=quick), size, device, ("display",), settings).render()
        paths.append(_write(out / f"lights_{lights}.png", frame.numpy("display")[0]))
    return paths


def _renderer(
    scene: Scene, size: tuple[int, int], device: wp.Device, outputs: tuple[str, ...], settings: Settings
) -> Renderer:
    return Renderer(scene, width=size[0], height=size[1], device=device, outputs=outputs, settings=settings)


def by_number(ids: np.ndarray) -> np.ndarray:
    """Colour each number differently, -1 black: (height, width) int32 -> (height, width, 4) uint8."""
    mixed = (ids.astype(np.uint64) + 1) * 0x9E3779B1 & 0xFFFFFFFF
    channels = [48 + (mixed >> shift & 0xFF) * 207 // 255 for shift in (8, 16, 24)]
    picture = np.stack([*channels, np.full_like(mixed, 255)], axis=-1).astype(np.uint8)
    picture[ids < 0, :3] = 0
    return picture


def _write(path: Path, picture: np.ndarray) -> Path:
    write_png(path, np.ascontiguousarray(picture))
    return path
