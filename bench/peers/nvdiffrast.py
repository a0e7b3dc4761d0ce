"""nvdiffrast: a rasterizer in CUDA for learning; rasterize and interpolate, no light."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Scene

from ..timing import Timing, warm_up
from .base import Session, geometry_of, perspective, view_matrix
from .cases import PeerCase

__all__ = ["NvDiffRast"]

#: Far plane [m]; the terrain ends before it.
FAR = 60.0


class NvDiffRast:
    """The CUDA rasterizer of nvdiffrast."""

    name = "nvdiffrast"
    title = "nvdiffrast (CUDA)"
    kinds = ("gbuffer",)
    computes = (
        "`rasterize` of vertices that are in clip space already: barycentrics, depth z/w and triangle id, and the "
        "barycentrics' screen derivatives, 32 bytes a pixel; `interpolate` of the normal, 12 bytes a pixel"
    )
    leaves_out = (
        "the transform of vertices (not in its time), culling of back faces, materials, any lighting; its derivatives "
        "and gradients, which it is made for, ours has not"
    )
    method = (
        "torch CUDA events around rasterize and interpolate, queued without waiting between frames; rasterize waits "
        "for the device itself, to see whether its buffers were large enough, and that is in the time"
    )
    wins = (
        "It cuts its work by pixels, and takes large triangles for granted: slivers and triangles that fill the screen "
        "are as cheap as their pixels (see the table of triangles)."
    )

    def available(self, device: wp.Device) -> str | None:
        """Say why it cannot run."""
        if not device.is_cuda:
            return "it has no CPU path"
        for name in ("torch", "nvdiffrast"):
            if importlib.util.find_spec(name) is None:
                return f"no module {name}; see github.com/NVlabs/nvdiffrast"
        try:
            importlib.import_module("nvdiffrast.torch")
        except Exception as error:  # an extension that was built for another torch, say
            return f"nvdiffrast.torch cannot be imported: {type(error).__name__}: {str(error).splitlines()[0]}"
        return None

    def version(self) -> str:
        """Version of the package and of torch."""
        import nvdiffrast
        import torch

        return f"nvdiffrast {nvdiffrast.__version__}, torch {torch.__version__}"

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Upload triangles and transform the vertices."""
        return _RastSession(case, scene, cameras, device)


class _RastSession:
    """A case opened by nvdiffrast: all views in one call."""

    note = ""

    def __init__(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> None:
        import nvdiffrast.torch as dr
        import torch

        self.case, self.device, self.torch, self.rast = case, device, torch, dr
        self.place = torch.device("cuda", device.ordinal)
        geometry = geometry_of(scene)
        self.context = dr.RasterizeCudaContext(device=self.place)
        self.triangles = self._tensor(geometry.triangles)
        self.normals = self._tensor(geometry.normals)[None]
        points = np.concatenate([geometry.positions, np.ones((len(geometry.positions), 1), np.float32)], axis=1)
        self.projections = [perspective(c, case.width, case.height, FAR) for c in cameras]
        whole = [p @ view_matrix(c) for p, c in zip(self.projections, cameras, strict=True)]
        # In float64, as the others keep the camera's place; a frame would do this on the device.
        self.clip = self._tensor(np.stack([(points @ m.T).astype(np.float32) for m in whole]))

    def _tensor(self, array: np.ndarray) -> Any:
        return self.torch.as_tensor(np.ascontiguousarray(array), device=self.place)

    def frame(self) -> tuple[Any, Any]:
        """Rasterize and interpolate all views."""
        with self.torch.no_grad():
            size = (self.case.height, self.case.width)
            fragments, _ = self.rast.rasterize(self.context, self.clip, self.triangles, size, grad_db=False)
            normals, _ = self.rast.interpolate(self.normals, fragments, self.triangles)
        return fragments, normals

    def time(self, repeats: int) -> Timing:
        """Time frames between two CUDA events each."""
        torch = self.torch
        with torch.cuda.device(self.place):
            warm_up(self.device, self.frame)
            torch.cuda.synchronize()
            pairs = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(repeats)]
            for start, end in pairs:
                start.record()
                self.frame()
                end.record()
            torch.cuda.synchronize()
        return Timing.of([start.elapsed_time(end) for start, end in pairs])

    def depth(self) -> np.ndarray | None:
        """View depth made of z/w, outside the clock; row 0 at the top."""
        fragments = self.frame()[0].cpu().numpy()[:, ::-1].astype(np.float64)
        slope, offset = self.projections[0][2, 2:]
        surface = fragments[..., 3] > 0.0
        # z/w = offset / depth - slope.
        return np.where(surface, offset / (np.where(surface, fragments[..., 2], 0.0) + slope), np.inf).astype(
            np.float32
        )

    def picture(self) -> np.ndarray | None:
        """None: it shades nothing."""
        return None

    def close(self) -> None:
        """Drop the tensors, and what torch keeps of them."""
        self.context = self.triangles = self.normals = self.clip = None
        self.torch.cuda.empty_cache()
