"""The pixel police of `Settings(check_finite=True)`: which pass wrote the first number that is not finite, and where.

Behind every pass the plan looks at the channels it writes: floats, vectors of floats and half4 images; ids, bits and
structs cannot be looked at. Outputs, the HDR image, sums of samples and the channels of a user's own passes are written
whole. Of the others some are filled in places, and hold what shared the memory before elsewhere: they are looked at
with `Renderer(share_memory=False)`, where they hold 0 there. Background depth is +inf by definition and so are a few
numbers made of it. Imported only where the setting is on.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from .channels import OUTPUTS
from .errors import Error
from .kernels import finite_check as kernels
from .passes.base import Buffer, Pass, Request
from .passes.image import all_writes
from .resources import Resources

__all__ = ["INFINITE", "FiniteCheck"]

#: Channels in which +inf is a value: background depth, what is nearest in a tile without surfaces, the far plane of
#: shadow maps of points and spots.
INFINITE = frozenset(
    {"depth", "mask_bounds", "mask_coarse_bounds", "visibility_pyramid", "lens_nearest", "shadow_rows"}
)
#: Channels of bounds, in which both infinities are values, and of 64-bit words that are no half4 images.
NO_NUMBERS = frozenset({"shadow_bounds", "keys", "slice_keys"})


#: Channels a plan can have looked at; ours write some dozens.
SLOTS = 1024


class FiniteCheck:
    """Looks at what the passes of one plan write; a slot for each pass and channel, in the order they run.

    Args:
        request: What the plan is for.
        resources: Its buffers.
    """

    def __init__(self, request: Request, resources: Resources) -> None:
        self._resources, self._whole = resources, not request.share_memory
        self._names: list[tuple[str, str]] = []
        self._first = wp.zeros(SLOTS, dtype=wp.int64, device=resources.device)
        self._values = wp.zeros(SLOTS, dtype=wp.float32, device=resources.device)
        # Reading back allocates nothing, so that frames that must not allocate can be looked at as well.
        self._host = wp.zeros(SLOTS, dtype=wp.int64, device="cpu", pinned=resources.device.is_cuda)

    def add(self, stage: Pass) -> None:
        """Add launches that look at what a pass has written, to the section of that pass."""
        program = self._resources.program
        for name, buffer in all_writes(stage).items():
            rows = self._rows(stage, name, buffer)
            if rows is None:
                continue
            slot = len(self._names)
            if slot == SLOTS:
                raise Error(f"check_finite: expected at most {SLOTS} channels, got more; turn it off for this plan")
            self._names.append((stage.name, name))
            look, keep = kernels.make_finite_check_kernels(rows.dtype == wp.float16)
            infinite = int(name in INFINITE)
            block = kernels.BLOCK_DIM
            program.launch(look, rows.shape[0], [rows, self._values, infinite, slot], [self._first], block_dim=block)
            program.launch(keep, 1, [rows, self._first, slot], [self._values], block_dim=block)

    def _rows(self, stage: Pass, name: str, buffer: Buffer) -> wp.array | None:
        """Rows of numbers of a channel, (count, components); None where it is not looked at."""
        array = self._resources.channels.get(name)
        if array is None or buffer.dtype is None or buffer.count == 0:
            return None
        ours = type(stage).__module__.startswith("warp_deferred.")
        whole = name in OUTPUTS or name == stage.target or name.startswith("sum_") or not ours
        if name in NO_NUMBERS or not (whole or self._whole):
            return None
        if buffer.dtype is wp.uint64 and ours:
            kind, columns = wp.float16, 4
        elif buffer.dtype is wp.float32:
            kind, columns = wp.float32, 1
        elif getattr(buffer.dtype, "_wp_scalar_type_", None) is wp.float32 and len(buffer.dtype._shape_) == 1:
            kind, columns = wp.float32, buffer.dtype._length_
        else:
            return None
        if columns > int(kernels.COLUMNS):
            return None
        return wp.array(ptr=array.ptr, dtype=kind, shape=(buffer.count, columns), device=array.device, copy=False)

    def begin(self) -> None:
        """Forget the frame before."""
        self._first.zero_()
        self._values.zero_()

    def end(self) -> None:
        """Wait for the frame and raise if something in it was not finite.

        Raises:
            Error: Names pass, channel, view, pixel and value.
        """
        wp.copy(self._host, self._first)
        wp.synchronize_device(self._resources.device)
        first = self._host.numpy()
        for slot, (stage, name) in enumerate(self._names):
            if first[slot]:
                row, column = divmod(int(kernels.LAST) - int(first[slot]), int(kernels.COLUMNS))
                value, place = float(self._values.numpy()[slot]), self._place(name, row)
                raise Error(
                    f"{stage}.{name}: expected finite numbers, got {value} in component {column} of {place}; "
                    "no pass before it wrote such a number: if the pass is yours, bound what it writes, else report it "
                    "with the scene; check_finite=False renders on"
                )

    def _place(self, name: str, row: int) -> str:
        """Where a row of a channel is, in words."""
        layout = self._resources.layout
        if self._resources.channels[name].size == layout.pixels:
            for view, (size, fields) in enumerate(zip(layout.sizes, layout.fields, strict=True)):
                inside = row - fields[0]
                if not size.depth_only and 0 <= inside < size.width * size.height:
                    return f"view {view}, pixel ({inside % size.width}, {inside // size.width})"
        return f"element {row}"

    @property
    def checked(self) -> list[Any]:
        """(pass, channel) of everything that is looked at, in order."""
        return list(self._names)
