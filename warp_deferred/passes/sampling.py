"""Sampling: the passes that open, close and average the samples of a frame that takes several a pixel."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..kernels import sampling as kernels
from ..program import FIRST
from ..resources import Resources
from ..sampling import sample_count, sample_table
from .base import Buffer, Pass
from .image import float_image, image_bytes, make_image

__all__ = ["AccumulatePass", "AveragePass", "BeginSamplePass", "StartSamplesPass"]

PARTS = {"diffuse": wp.vec3, "specular": wp.vec3, "alpha": wp.float32}


class StartSamplesPass(Pass):
    """Before the first sample."""

    name = "start_samples"
    doc = "set the counter of samples to zero"
    scope = "frame_start"

    def writes(self) -> dict[str, Buffer]:
        """The counter."""
        return {"sample_counter": Buffer(wp.int32, 1)}

    def prepare(self, resources: Resources) -> None:
        """Upload the table of samples, and make views that a sample may move."""
        count = sample_count(self.request)
        table = sample_table(self.request, centre=resources.program.samples > count)
        rows = np.ascontiguousarray(table).view(np.dtype(kernels.Sample.numpy_dtype()))[:, 0]
        resources.channels["sample_table"] = wp.array(rows, dtype=kernels.Sample, device=resources.device)
        resources.frame.split()

    def run(self, resources: Resources) -> None:
        """One memset."""
        resources.program.call(resources.channels["sample_counter"].zero_)


class BeginSamplePass(Pass):
    """First in each sample."""

    name = "begin_sample"
    doc = "move the views to the sample"

    def reads(self) -> tuple[str, ...]:
        """The counter."""
        return ("sample_counter",)

    def writes(self) -> dict[str, Buffer]:
        """The views live with the frame block."""
        return {"sample_views": Buffer(None, 0)}

    def run(self, resources: Resources) -> None:
        """One launch."""
        channels, frame = resources.channels, resources.frame
        inputs = [frame.uploaded, channels["sample_table"], channels["sample_counter"]]
        resources.program.launch(
            kernels.begin_sample_kernel, self.request.cameras, inputs, [frame.views], block_dim=kernels.BLOCK_DIM
        )


class _SumsPass(Pass):
    """What both ends of the sums share."""

    @property
    def parts(self) -> tuple[str, ...]:
        """Outputs that are averaged, besides the image."""
        return tuple(name for name in PARTS if name in self.request.outputs)

    def sums(self) -> dict[str, Buffer]:
        """One float32 sum a pixel and component, whatever the number of samples."""
        types = ({"image": wp.vec3} if self.source else {}) | {name: PARTS[name] for name in self.parts}
        return {f"sum_{n}": Buffer(t, max(self.layout.pixels, 1), carried=True) for n, t in types.items()}

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernels, build the structs."""
        flags = [name in self.parts for name in PARTS]
        self.kernels = kernels.make_sampling_kernels(not float_image(self.request), bool(self.source), *flags)
        self.image = make_image(resources, self.request, self.source)
        self.shown, self.summed = kernels.Parts(), kernels.Parts()
        for name, dtype in PARTS.items():
            setattr(self.shown, name, resources.channel(name if name in self.parts else "", dtype))
            setattr(self.summed, name, resources.channel(f"sum_{name}", dtype))
        self.summed_image = resources.channel("sum_image", wp.vec3)

    def _launch(self, resources: Resources, index: int, inputs: list, outputs: list) -> None:
        resources.program.launch(
            self.kernels[index], self.layout.pixels, [*inputs, FIRST], outputs, block_dim=kernels.BLOCK_DIM, band=64
        )

    def _bytes(self, reads: int, writes: int) -> int:
        parts = sum(wp.types.type_size_in_bytes(PARTS[name]) for name in self.parts)
        image = (reads + writes - 1) * 12 + image_bytes(self.request) if self.source else 0
        return self.layout.pixels * (image + (reads + writes) * parts)


class AccumulatePass(_SumsPass):
    """Last in each sample."""

    name = "accumulate"
    doc = "add the sample to the sums"
    image = "read"
    scope = "accumulate"

    def rung(self) -> str:
        """Samples a pixel."""
        return f"{sample_count(self.request)} samples"

    def reads(self) -> tuple[str, ...]:
        """What shading gave, and the counter."""
        return ("sample_counter", "sample_views", *self.parts)

    def writes(self) -> dict[str, Buffer]:
        """The sums."""
        return self.sums()

    def run(self, resources: Resources) -> None:
        """Add, then count the sample."""
        channels = resources.channels
        table, counter = channels["sample_table"], channels["sample_counter"]
        self._launch(resources, 0, [table, counter, self.image, self.shown], [self.summed_image, self.summed])
        resources.program.launch(kernels.end_sample_kernel, 1, [table], [counter], block_dim=kernels.BLOCK_DIM)

    def bytes_moved(self) -> int:
        """The sample in, sums in and out."""
        return self._bytes(2, 1)


class AveragePass(_SumsPass):
    """After the last sample."""

    name = "average"
    doc = "divide the sums by their number"
    image = "rewrite"
    scope = "average"

    def reads(self) -> tuple[str, ...]:
        """The sums."""
        return tuple(self.sums())

    def writes(self) -> dict[str, Buffer]:
        """Averages, over what the last sample left there."""
        return {n: Buffer(PARTS[n], max(self.layout.pixels, 1)) for n in self.parts}

    def run(self, resources: Resources) -> None:
        """One launch."""
        count = float(sample_count(self.request))
        self._launch(resources, 1, [self.summed_image, self.summed, count], [self.image, self.shown])

    def bytes_moved(self) -> int:
        """Sums in, averages out."""
        return self._bytes(1, 1)
