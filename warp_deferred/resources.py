"""What passes share while a plan is built: device scene, staged frame values, tables, channels and the program."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
import warp as wp

from .device_scene import DeviceScene
from .kernels import structs
from .light_store import LightStore
from .program import Program
from .views import ViewLayout, table_array

__all__ = ["FrameBlock", "Resources", "Ring"]


class Ring:
    """Pinned copies of a block of bytes, so that the host can write the next frame while the device reads the last.

    Pinning takes milliseconds, so plans whose blocks are of one size share a ring.
    """

    BYTES = 1 << 19

    def __init__(self, size: int, device: wp.Device) -> None:
        self.size, self._device = size, device
        pinned = device.is_cuda
        # One pinned allocation for all slots: enough that a host far ahead of the device still does not wait.
        slots = min(1024, max(4, self.BYTES // size)) if pinned else 1
        self._ring = wp.zeros(slots * size, dtype=wp.uint8, device="cpu", pinned=pinned)
        self._slots = [self._ring[k * size : (k + 1) * size] for k in range(slots)]
        whole = memoryview(self._ring.numpy()).cast("B")
        self._memory = [whole[k * size : (k + 1) * size] for k in range(slots)]
        self._events: list[wp.Event | None] = [None] * slots
        self._next = 0

    def begin(self) -> memoryview:
        """Return the host memory of the next copy, waiting if the device still reads it."""
        event = self._events[self._next]
        if event is not None:
            wp.synchronize_event(event)
        return self._memory[self._next]

    def upload(self, block: wp.array) -> None:
        """Send the copy written since `begin`."""
        wp.copy(block, self._slots[self._next], count=self.size)
        if self._device.is_cuda:
            event = self._events[self._next] or wp.Event(self._device)
            wp.get_stream(self._device).record_event(event)
            self._events[self._next] = event
            self._next = (self._next + 1) % len(self._slots)


class FrameBlock:
    """Everything the host changes every frame, in one block and one copy: frame values, a flag, then cameras' views.

    Behind them on the device lie the views of shadow maps, which kernels write.

    Attributes:
        uploaded: The views as the host or `poses` gave them, then the shadow maps'.
        values: Frame values.
        bright: One int32 that kernels set once bloom has work; the copy itself sets it back to 0.
        sampling: Whether the pass that is being built runs once a sample; then `views` are those of the sample.
        middle: Cameras' views at the sample's time, before jitter and lens moved them: what maps are fitted to.
        ring: The host's copies.
    """

    def __init__(self, views: int, slots: int, device: wp.Device, rings: Iterable[Ring] = ()) -> None:
        view_size = np.dtype(structs.View.numpy_dtype()).itemsize
        value_size = np.dtype(structs.FrameValues.numpy_dtype()).itemsize
        self.values_offset, flag_offset = 0, value_size
        # Views hold float64.
        self.views_offset = -(-(flag_offset + 4) // 8) * 8
        self.size = self.views_offset + views * view_size
        self.device = device
        self._block = wp.zeros(self.size + slots * view_size, dtype=wp.uint8, device=device)
        self.uploaded = wp.array(
            ptr=self._block.ptr + self.views_offset, dtype=structs.View, shape=(views + slots,), device=device,
            copy=False,
        )  # fmt: skip
        self._first_slot = views
        self.values = wp.array(
            ptr=self._block.ptr + self.values_offset, dtype=structs.FrameValues, shape=(1,), device=device, copy=False
        )
        self.bright = wp.array(ptr=self._block.ptr + flag_offset, dtype=wp.int32, shape=(1,), device=device, copy=False)
        self._moved: wp.array | None = None
        self.sampling = False
        self.middle = self.uploaded
        self.ring = next((ring for ring in rings if ring.size == self.size), None) or Ring(self.size, device)

    @property
    def views(self) -> wp.array:
        """Views for the pass that is being built: moved ones in the sample part of a frame of several samples."""
        return self._moved if self.sampling and self._moved is not None else self.uploaded

    @property
    def bytes(self) -> int:
        """Device memory held."""
        own = [array for array in (self._moved, self.middle) if array is not None and array is not self.uploaded]
        return self.size + sum(array.capacity for array in own)

    def split(self) -> None:
        """Give the sample part views of its own."""
        self._moved = wp.zeros_like(self.uploaded)

    def move_middle(self) -> None:
        """Give the sample part cameras' views that move with time alone."""
        self.middle = wp.zeros(self._first_slot, dtype=structs.View, device=self.device)

    def begin(self) -> memoryview:
        """Return the host memory of the next block, waiting if the device still reads it."""
        return self.ring.begin()

    def write_slots(self, rows: np.ndarray) -> None:
        """Send what does not change from frame to frame about the views of shadow maps."""
        given = wp.array(rows, dtype=structs.View, device="cpu", copy=False)
        for views in (self.uploaded, self._moved):
            if views is not None:
                wp.copy(views, given, dest_offset=self._first_slot)

    def upload(self) -> None:
        """Send the block written since `begin`."""
        self.ring.upload(self._block)


@dataclasses.dataclass
class Resources:
    """What a pass may use in `prepare` and `run`.

    Attributes:
        device: Where the plan runs.
        scene: Geometry, materials, instances.
        lights: Light source and staging.
        frame: Views and frame values.
        layout: Where views lie.
        blocks: Table of 8 x 8 pixel blocks.
        tiles: Table of light tiles.
        coarse_tiles: Table of coarse light tiles.
        bin_tiles: Table of raster bins.
        channels: Arrays by channel name.
        program: Where launches go.
    """

    device: wp.Device
    scene: DeviceScene
    lights: LightStore
    frame: FrameBlock
    layout: ViewLayout
    blocks: wp.array
    tiles: wp.array
    coarse_tiles: wp.array
    bin_tiles: wp.array
    channels: dict[str, wp.array]
    program: Program

    @classmethod
    def make(
        cls,
        scene: DeviceScene,
        lights: LightStore,
        layout: ViewLayout,
        program: Program,
        slots: int = 0,
        others: Iterable[Resources] = (),
    ) -> Resources:
        """Upload the layout's tables, or take those of another plan that has them; the last `slots` views are maps."""
        device = scene.device
        same = next((other for other in others if other.layout is layout), None)
        if same is not None:
            tables = [same.blocks, same.tiles, same.coarse_tiles, same.bin_tiles]
        else:
            parts = (layout.blocks, layout.tiles, layout.coarse_tiles, layout.bin_tiles)
            tables = [table_array(part, device) for part in parts]
        frame = FrameBlock(len(layout.sizes) - slots, slots, device, [other.frame.ring for other in others])
        return cls(device, scene, lights, frame, layout, *tables, {}, program)

    def channel(self, name: str, dtype: type) -> wp.array:
        """The array of a channel, or a one-element array where the plan has none (never touched by the kernel)."""
        if name in self.channels:
            return self.channels[name]
        return wp.zeros(1, dtype=dtype, device=self.device)
