"""A rendered frame: named outputs on the device, without copies, and their way into files.

Arrays have the shape (view, height, width) and the Warp type their channel names; `vec3` and `vec4ub` outputs export
through DLPack as float32 and uint8 with a last axis of 3 and 4, so `np.from_dlpack(frame["normal"])` (CPU) and
`torch.from_dlpack(frame["color"])` read them in place.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .channels import OUTPUTS
from .checks import check_choice, check_count, input_error
from .errors import Error, LoadError
from .images import check_target, write_exr, write_png

if TYPE_CHECKING:
    import warp as wp

    from .camera import Camera

__all__ = ["Frame", "view_path"]


class Frame:
    """What `Renderer.render` returns. Valid until the renderer renders again; `copy()` keeps it."""

    def __init__(
        self,
        arrays: Mapping[str, wp.array],
        cameras: Sequence[Camera] = (),
        generation_check: Callable[[], bool] | None = None,
    ) -> None:
        """Wrap the renderer's own arrays.

        Args:
            arrays: Output name to device array of shape (view, height, width).
            cameras: One camera per view.
            generation_check: Returns whether the arrays still hold this frame; None: they always do.
        """
        self._arrays = {name: arrays[name] for name in OUTPUTS if name in arrays}
        if not self._arrays or len(self._arrays) != len(arrays):
            raise input_error("Frame.arrays", f"outputs among {', '.join(OUTPUTS)}", list(arrays))
        shapes = {tuple(array.shape) for array in self._arrays.values()}
        if len(shapes) != 1 or len(next(iter(shapes))) != 3:
            raise input_error("Frame.arrays", "one shape (view, height, width) for all", f"<shapes {sorted(shapes)}>")
        self._shape: tuple[int, int, int] = next(iter(shapes))
        self.cameras = tuple(cameras)
        self._valid = generation_check or (lambda: True)

    def __repr__(self) -> str:
        return f"Frame({len(self)} x {self.width} x {self.height}, {', '.join(self._arrays)})"

    def __len__(self) -> int:
        return self._shape[0]

    def __iter__(self) -> Iterator[str]:
        # Without it Python would iterate by whole numbers through __getitem__.
        return iter(self._arrays)

    def __contains__(self, name: object) -> bool:
        return name in self._arrays

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs it holds."""
        return tuple(self._arrays)

    @property
    def width(self) -> int:
        """Width of every view [px]."""
        return self._shape[2]

    @property
    def height(self) -> int:
        """Height of every view [px]."""
        return self._shape[1]

    def __getitem__(self, name: str) -> wp.array:
        """Return one output's device array, shape (view, height, width), without a copy.

        Raises:
            InputError: If the output was not asked for or does not exist.
            Error: If the renderer has rendered again since.
        """
        if name not in self._arrays:
            check_choice("Frame", name, OUTPUTS)
            raise input_error(
                f"Frame[{name!r}]",
                f"one of the outputs asked for ({', '.join(self._arrays)})",
                name,
                f"ask for it with Renderer(..., outputs=({', '.join(repr(n) for n in (*self._arrays, name))}))",
            )
        if not self._valid():
            raise Error(
                f"Frame[{name!r}]: expected a frame that is still valid, got one the renderer has drawn over; "
                "a frame is valid until the next render; use frame.copy() to keep it"
            )
        return self._arrays[name]

    def numpy(self, name: str) -> np.ndarray:
        """Return a copy of one output on the host, shape (view, height, width) or (view, height, width, components).

        Any thread may call it; `frame[name].numpy()`, Warp's own, is not for several threads on CUDA (`turns.py`).
        """
        from .turns import host_copy

        return host_copy(self[name])

    def copy(self) -> Frame:
        """Return a frame of its own memory, which stays valid."""
        import warp as wp

        return Frame({name: wp.clone(self[name]) for name in self._arrays}, self.cameras)

    def save(self, path: str | os.PathLike[str], view: int | None = None) -> list[Path]:
        """Write the frame to a file, whole or not at all.

        `.exr`: all outputs but `display`, each view a part of one file. `.png`: `display`, one file per view; with
        several views `out.png` becomes `out.0.png`, `out.1.png`, ...

        Args:
            path: File name that ends in .exr or .png.
            view: The only view to write; all if left out.

        Returns:
            The files written.

        Raises:
            InputError: If the outputs the file needs were not asked for, or there is no such view.
            LoadError: If the suffix is another, or the file cannot be written.
        """
        target = check_target(path)
        views = range(len(self)) if view is None else [check_count("Frame.save.view", view, 0, len(self) - 1)]
        if target.suffix.lower() == ".png":
            return self._save_png(target, views)
        names = [name for name in self._arrays if OUTPUTS[name].exr]
        if not names:
            raise input_error(
                f"Frame.save({str(target)!r})",
                "outputs that an EXR file keeps",
                list(self._arrays),
                'ask for them with Renderer(..., outputs=("color", "alpha", "depth"))',
            )
        layers = {name: self.numpy(name) for name in names}
        parts = []
        for index in views:
            part: dict[str, Any] = {}
            for name, array in layers.items():
                exr = OUTPUTS[name].exr
                part |= (
                    {exr[i]: array[index, ..., i] for i in range(len(exr))} if len(exr) > 1 else {exr[0]: array[index]}
                )
            parts.append(part)
        attributes = [self._attributes(index) for index in views]
        write_exr(target, parts, attributes, [f"view{index}" for index in views])
        return [target]

    def _save_png(self, target: Path, views: Sequence[int]) -> list[Path]:
        if "display" not in self._arrays:
            raise input_error(
                f"Frame.save({str(target)!r})",
                "the output 'display', which is what a PNG shows",
                list(self._arrays),
                'ask for it with Renderer(..., outputs=("display", ...)), or save as .exr',
            )
        pictures = self.numpy("display")
        paths = [target if len(views) == 1 else view_path(target, index) for index in views]
        for file in paths:
            check_target(file)
        for index, file in zip(views, paths, strict=True):
            write_png(file, pictures[index])
        return paths

    def _attributes(self, view: int) -> dict[str, Any]:
        """Header entries that let a reader place the view: pose and projection, as texts of exact numbers."""
        from . import __version__

        entries: dict[str, Any] = {"Software": f"warp-deferred {__version__}"}
        if view < len(self.cameras):
            camera = self.cameras[view]
            entries |= {
                "camera_name": camera.name,
                "camera_projection": camera.projection,
                "camera_position": " ".join(repr(float(x)) for x in camera.position),
                "camera_world_to_camera_rotation": " ".join(repr(float(x)) for x in camera.rotation),
                "camera_fx_fy_cx_cy": " ".join(
                    repr(float(x)) for x in camera.pixel_projection(self.width, self.height)
                ),
                "camera_exposure_stops": repr(camera.exposure),
            }
        return entries


def view_path(path: Path, view: int) -> Path:
    """Return the name of one view's file: `out.png` becomes `out.3.png`."""
    if not path.suffix:
        raise LoadError(f"{path}: expected a file name with a suffix, got none; add .png")
    return path.with_name(f"{path.stem}.{view}{path.suffix}")
