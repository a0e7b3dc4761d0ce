"""Ours, as the peers are timed: device time of graph replays."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from warp_deferred import Camera, Renderer, Scene
from warp_deferred.plan import Plan

from ..timing import Timing, time_program
from .base import Session
from .cases import KINDS, PeerCase

__all__ = ["OURS", "Ours"]

#: Passes that make the G-buffer.
GBUFFER = ("clusters", "raster", "resolve")
#: What peers hand out, too, where a G-buffer is the product and not a step.
LAYERS = ("depth", "normal", "albedo", "instance_id")


@dataclasses.dataclass(frozen=True)
class Ours:
    """This renderer, in one of the ways it can do a case.

    Attributes:
        name: Key in results.
        title: What it is called, in words.
        kinds: Kinds of cases it is shown for.
        method: How its time is taken.
        computes: What it computes, in words.
        outputs: What is asked of the renderer.
        passes: Passes that are timed; all of them if empty.
        keep_maps: Whether shadow maps stay from frame to frame.
    """

    name: str
    title: str
    kinds: tuple[str, ...]
    computes: str
    method: str = "device time of CUDA graph replays"
    outputs: tuple[str, ...] = ("display",)
    passes: tuple[str, ...] = ()
    keep_maps: bool = False
    leaves_out: str = ""
    wins: str = ""

    def available(self, device: wp.Device) -> str | None:
        """Say nothing: it is here."""
        return None

    def version(self) -> str:
        """Say nothing: the record's header has the commit."""
        return ""

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Render one frame, so that all is compiled, uploaded and captured."""
        shadow = scene.settings.shadow.replace(keep_maps=self.keep_maps)
        settings = scene.settings.replace(shadow=shadow)
        renderer = Renderer(
            scene, width=case.width, height=case.height, device=device, outputs=self.outputs, settings=settings
        )
        renderer.render(cameras)
        return OurSession(renderer, cameras, self.passes)


class OurSession:
    """A case opened by ours."""

    def __init__(self, renderer: Renderer, cameras: list[Camera], passes: tuple[str, ...]) -> None:
        self.renderer, self.cameras, self.passes = renderer, cameras, passes
        self.note = ""

    @property
    def plan(self) -> Plan:
        """The plan of the last frame."""
        return self.renderer.plan

    def time(self, repeats: int) -> Timing:
        """Time replays of the whole frame, or of the G-buffer's passes as a graph of their own."""
        return time_program(self.plan.resources.program, self.passes or None, repeats=repeats)

    def depth(self) -> np.ndarray | None:
        """View depth of a whole frame; None where it is not asked for."""
        frame = self.renderer.render(self.cameras)
        return frame.numpy("depth") if "depth" in self.renderer.outputs else None

    def picture(self) -> np.ndarray | None:
        """The first view as it is shown; None for a G-buffer."""
        if self.passes or "display" not in self.renderer.outputs:
            return None
        return self.renderer.render(self.cameras).numpy("display")[0, ..., :3].copy()

    def close(self) -> None:
        """Drop the renderer and all it holds."""
        self.renderer = None


OURS = (
    Ours(
        "ours",
        "ours: G-buffer",
        ("gbuffer",),
        "clear, culling, visibility and the compact G-buffer of 16 bytes a pixel: depth, oct24 normal, albedo, model, "
        "roughness, metallic; ids stay in the 64-bit keys",
        passes=GBUFFER,
    ),
    Ours(
        "ours_layers",
        "ours: layers handed out",
        ("gbuffer",),
        "the same as outputs of 32 bytes a pixel: float32 depth, normal and albedo, int32 instance ids",
        outputs=LAYERS,
    ),
    Ours(
        "ours",
        "ours",
        tuple(kind for kind in KINDS if kind != "gbuffer"),
        "the whole frame from clear to `display`: G-buffer, lights culled by tile, shading, shadow maps (1024x1024 on "
        "CUDA, 512x512 on the CPU) drawn anew and filtered over 4x4 texels, exposure, tone curve, sRGB",
    ),
    Ours(
        "ours_kept",
        "ours, shadow maps kept",
        ("shadowed", "frame"),
        "the same, with maps kept from frame to frame: nothing moves here, so that none is drawn",
        keep_maps=True,
    ),
)
