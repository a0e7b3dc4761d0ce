"""Where views lie: rectangles of the pixel arena, their tiles, bins and blocks, and the packing of a `View`.

The layout depends on sizes only, so its tables are made once per plan; cameras are packed into the pinned upload block
every frame with nothing but Python floats.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Sequence

import numpy as np
import warp as wp

from .camera import IDENTITY, Camera
from .checks import check_count
from .errors import CapacityError
from .kernels import structs

__all__ = ["MAX_SIZE", "ViewLayout", "ViewPacker", "ViewSize", "block_grid"]

MAX_SIZE = 16384
MAX_PIXELS = 2**31 - 1
#: Coarse light tiles are this many tiles a side, by tile size: about 128 px.
COARSE_SHIFT = {8: 3, 16: 3, 32: 2, 64: 2}
PROJECTIONS = {"perspective": 0, "orthographic": 1}
CULL_MODES = {"none": 0, "back": 1, "front": 2}


@dataclasses.dataclass(frozen=True)
class ViewSize:
    """Size of a view [px], what it keeps (keys with ids, or depth only), and the size its picture is scaled up to."""

    width: int
    height: int
    depth_only: bool = False
    #: Size of the picture where it is another; 0: as rendered.
    shown_width: int = 0
    shown_height: int = 0

    def __post_init__(self) -> None:
        check_count("width", self.width, 1, MAX_SIZE, "images are 1 to 16384 pixels a side")
        check_count("height", self.height, 1, MAX_SIZE, "images are 1 to 16384 pixels a side")

    @property
    def shown(self) -> tuple[int, int]:
        """Width and height of the picture [px]."""
        return self.shown_width or self.width, self.shown_height or self.height


class ViewLayout:
    """Offsets and tables of a list of views.

    Attributes:
        sizes: The views' sizes, in order.
        pixels: Pixels of the arena of 64-bit keys.
        depth_pixels: Pixels of the arena of 32-bit depth keys.
        shown_pixels: Pixels of the pictures, scaled up or as rendered.
        blocks: (b, 4) int32: view, x, y of each 8 x 8 block of views that keep ids, 0.
        tiles: (t, 4) int32: view, x, y and coarse tile of each light tile.
        coarse_tiles: (c, 4) int32: view, x, y, 0 of each coarse light tile.
        bin_tiles: (n, 4) int32: view, x, y, 0 of each raster bin.
        shown_bins: Bins up to the last one of a view that keeps ids: those of shadow maps come after them.
        depth_bins: Bins before the first one of a view that keeps depth only.
    """

    def __init__(self, sizes: tuple[ViewSize, ...], tile_size: int) -> None:
        self.sizes, self.tile_size = sizes, tile_size
        self.tile_shift = tile_size.bit_length() - 1
        self.coarse_shift = COARSE_SHIFT[tile_size]
        coarse = tile_size << self.coarse_shift
        pixels = sum(s.width * s.height for s in sizes if not s.depth_only)
        depth_pixels = sum(s.width * s.height for s in sizes if s.depth_only)
        if max(pixels, depth_pixels) > MAX_PIXELS:
            raise CapacityError(
                f"views: expected at most {MAX_PIXELS} pixels over all views, got {max(pixels, depth_pixels)}; "
                "render fewer views at a time"
            )
        self.pixels, self.depth_pixels = pixels, depth_pixels
        self.shown_pixels = sum(s.shown[0] * s.shown[1] for s in sizes if not s.depth_only)
        self.fields: list[tuple[int, ...]] = []
        self.shown_bins = self.depth_bins = 0
        offsets = {False: 0, True: 0}
        tables: dict[str, list[np.ndarray]] = {"blocks": [], "tiles": [], "coarse": [], "bins": []}
        counts = {"tiles": 0, "coarse": 0, "bins": 0}
        for v, s in enumerate(sizes):
            light = not s.depth_only
            tiles_x, coarse_x = _cells(s.width, tile_size), _cells(s.width, coarse)
            bins_x = _cells(s.width, 16)
            self.fields.append(
                (
                    offsets[s.depth_only],
                    s.width,
                    counts["tiles"],
                    tiles_x,
                    counts["coarse"],
                    coarse_x,
                    counts["bins"],
                    bins_x,
                )
            )
            tables["bins"].append(block_grid(v, s, 16))
            if not light and offsets[True] == 0:
                self.depth_bins = counts["bins"]
            if light:
                tables["blocks"].append(block_grid(v, s, 8))
                tiles = block_grid(v, s, tile_size)
                tiles[:, 3] = counts["coarse"] + (tiles[:, 2] // coarse) * coarse_x + tiles[:, 1] // coarse
                tables["tiles"].append(tiles)
                tables["coarse"].append(block_grid(v, s, coarse))
            offsets[s.depth_only] += s.width * s.height
            for name in counts:
                counts[name] = sum(len(t) for t in tables[name])
            if light:
                self.shown_bins = counts["bins"]
        joined = {k: np.concatenate(t) if t else np.zeros((0, 4), np.int32) for k, t in tables.items()}
        self.blocks, self.tiles = joined["blocks"], joined["tiles"]
        self.coarse_tiles, self.bin_tiles = joined["coarse"], joined["bins"]

    @property
    def has_depth_views(self) -> bool:
        """Whether some view keeps depth only."""
        return self.depth_pixels > 0


def _cells(length: int, size: int) -> int:
    return -(-length // size)


def block_grid(view: int, s: ViewSize, size: int) -> np.ndarray:
    """(b, 4) int32: view, x, y, 0 of each square of `size` pixels of a view, row by row."""
    y, x = np.mgrid[0 : _cells(s.height, size), 0 : _cells(s.width, size)].astype(np.int32)
    table = np.zeros((x.size, 4), np.int32)
    table[:, 0], table[:, 1], table[:, 2] = view, x.reshape(-1) * size, y.reshape(-1) * size
    return table


def _struct_format(dtype: np.dtype) -> str:
    codes = {"f8": "d", "f4": "f", "i4": "i", "i8": "q"}
    text, position = "<", 0
    for name in dtype.names:
        field, offset = dtype.fields[name][:2]
        text += "x" * (offset - position)
        base, count = (field.subdtype[0], int(np.prod(field.subdtype[1]))) if field.subdtype else (field, 1)
        text += f"{count}{codes[base.str[1:]]}"
        position = offset + field.itemsize
    return text + "x" * (dtype.itemsize - position)


class ViewPacker:
    """Writes cameras as `View` structs into a buffer, without NumPy in the way."""

    def __init__(self, layout: ViewLayout, cull: str) -> None:
        dtype = np.dtype(structs.View.numpy_dtype())
        self.layout, self.size = layout, dtype.itemsize
        self._pack = struct.Struct(_struct_format(dtype)).pack_into
        self._cull = CULL_MODES[cull]

    def write(
        self, buffer: memoryview, cameras: list[Camera], ranges: list[tuple[int, ...]], depth_clamp: bool = False
    ) -> None:
        """Pack one camera a view.

        Args:
            buffer: At least `size` bytes a view.
            cameras: One camera a view.
            ranges: For each view (pair_offset, shared_instances, own_first, own_count, shared_clusters,
                own_cluster_first, own_cluster_count), from `DeviceScene.view_ranges`.
            depth_clamp: Clamp orthographic depth instead of clipping it.
        """
        layout = self.layout
        for v, camera in enumerate(cameras):
            size = layout.sizes[v]
            offset, pitch, *tables = layout.fields[v]
            fx, fy, cx, cy = camera.pixel_projection(*size.shown)
            if size.shown_width:
                # The picture's field of view, also where rounding gave the rendered one another aspect.
                sx, sy = size.width / size.shown_width, size.height / size.shown_height
                fx, fy, cx, cy = fx * sx, fy * sy, cx * sx, cy * sy
            self._pack(
                buffer, v * self.size, *camera.position, offset, *camera.rotation, fx, -fy, cx, cy, camera.near,
                camera.far, 2.0**camera.exposure, camera.aperture if camera.has_lens else 0.0, camera.focus_distance,
                PROJECTIONS[camera.projection], self._cull, int(depth_clamp), int(size.depth_only), camera.world, pitch,
                size.width, size.height, *tables, *ranges[v], 0, camera.shutter, camera.bloom, 0,
            )  # fmt: skip

    def slot_rows(self, first: int, worlds: Sequence[int], ranges: Sequence[tuple[int, ...]], cull: str) -> np.ndarray:
        """Views of shadow maps, all but where they stand: the device writes that before every frame.

        Args:
            first: View of the first map.
            worlds: World of each map.
            ranges: For each map what `write` takes for a view.
            cull: Faces that are dropped.

        Returns:
            The structs.
        """
        rows = bytearray(self.size * len(worlds))
        for k, (world, own) in enumerate(zip(worlds, ranges, strict=True)):
            size = self.layout.sizes[first + k]
            offset, pitch, *tables = self.layout.fields[first + k]
            self._pack(
                rows, k * self.size, 0.0, 0.0, 0.0, offset, *IDENTITY, 1.0, -1.0, 0.5 * size.width, 0.5 * size.height,
                1.0, 1.0, 1.0, 0.0, 1.0, 0, CULL_MODES[cull], 1, 1, world, pitch, size.width, size.height, *tables,
                *own, 1, 0.0, 0.0, 0,
            )  # fmt: skip
        return np.frombuffer(rows, np.dtype(structs.View.numpy_dtype()))


def table_array(table: np.ndarray, device: wp.Device) -> wp.array:
    """Upload an (n, 4) int32 table; one zero row where it is empty."""
    rows = table if len(table) else np.zeros((1, 4), np.int32)
    return wp.array(rows, dtype=wp.vec4i, device=device)
