"""Bloom of given images, without a scene: its pass over a hand-made frame, and display's own mixing as float32."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import reference
import warp as wp
from warp_deferred.kernels.color import clamp_radiance
from warp_deferred.kernels.display import make_gathered, make_scatter, quad_indices
from warp_deferred.kernels.intrinsics import load_vec4i
from warp_deferred.kernels.projection import pixel_in_block, pixel_index
from warp_deferred.kernels.structs import MODULE_OPTIONS, PIXEL_BLOCK_AREA, Bloom, View

import warp_deferred as wd
from warp_deferred.features import Features
from warp_deferred.passes.base import Lens, Request
from warp_deferred.passes.bloom import BloomPass, level_count, make_bloom, spread, weights
from warp_deferred.program import Program
from warp_deferred.resources import Resources
from warp_deferred.views import ViewLayout, ViewPacker, ViewSize

__all__ = [
    "KEEP",
    "RUNGS",
    "Blooming",
    "bloom_of",
    "gaussians_of",
    "lamps",
    "noise",
    "request_of",
    "rung",
    "shown",
]

#: Rungs, cheapest first.
RUNGS = ("neighbourhood", "mip_chain", "exact")
#: All light scatters, linearly.
KEEP = ("bloom.threshold=0", "bloom.fireflies=0")


@functools.cache
def make_mix_kernel(kind: str):
    """Kernel that stores exposed radiance after bloom, as display maps it."""
    gathered, scatter = make_gathered(kind), make_scatter(kind)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def mix_kernel(
        views: wp.array[View],
        blocks: wp.array[wp.vec4i],
        color: wp.array[wp.vec3],
        bloom: Bloom,
        out_values: wp.array[wp.vec3],
    ):
        thread = wp.tid()
        block = load_vec4i(blocks, thread // PIXEL_BLOCK_AREA)
        place = pixel_in_block(thread)
        view = views[block[0]]
        x, y = block[1] + place[0], block[2] + place[1]
        if x >= view.width or y >= view.height:
            return
        i = pixel_index(view, x, y)
        v = clamp_radiance(color[i] * view.exposure)
        x0, y0 = x - (x & 1), y - (y & 1)
        quad = gathered(view, block[0], x0, y0, quad_indices(view, x0, y0), bloom)
        gained = wp.where(
            (y & 1) == 0, wp.where((x & 1) == 0, quad.nw, quad.ne), wp.where((x & 1) == 0, quad.sw, quad.se)
        )
        out_values[i] = scatter(v, color[i], gained, view, bloom)

    return mix_kernel


def request_of(
    sizes: tuple[ViewSize, ...], *changes: str, threads: int = 1, lens: bool = True, color: bool = True
) -> Any:
    """What a plan would be asked for, without a scene on a device."""
    settings = wd.Settings().with_values(list(changes))
    outputs = frozenset({"display", "color"} if color else {"display"})
    features = Features.of(wd.Scene())
    return Request(outputs, sizes, settings, features, 1, 1, 1, 1, 0, threads, True, Lens(bloom=lens))


class Blooming:
    """The bloom pass over float32 images of any sizes, one a view; `run` does what a frame does."""

    def __init__(
        self,
        images,
        *changes,
        shares=1.0,
        exposures=0.0,
        device="cpu",
        threads=1,
        bright=1,
        half=False,
        together=None,
    ) -> None:
        images = [np.asarray(image, np.float32) for image in images]
        self.sizes = tuple(ViewSize(image.shape[1], image.shape[0]) for image in images)
        self.request = request_of(self.sizes, *changes, threads=threads, color=not half)
        self.layout = ViewLayout(self.sizes, 16)
        self.stage = BloomPass().bound(self.request, self.layout)
        self.stage.source = "radiance" if half else "color"
        self.stage.together = together
        program = Program(wp.get_device(device), threads)
        scene = SimpleNamespace(device=wp.get_device(device))
        self.resources = Resources.make(scene, None, self.layout, program)
        self.channels = self.resources.channels
        flat = np.concatenate([image.reshape(-1, 3) for image in images])
        self.channels["color"] = wp.array(flat, dtype=wp.vec3, device=device)
        words = np.ones((len(flat), 4), np.float16)
        words[:, :3] = np.clip(flat, 0.0, reference.HALF_MAX) if half else 0.0
        words = words.view(np.uint64)
        self.channels["radiance"] = wp.array(words.reshape(-1), dtype=wp.uint64, device=device)
        for name, buffer in self.stage.writes().items():
            # Garbage where nothing was written yet: all bits set is NaN in every format.
            size = buffer.count * wp.types.type_size_in_bytes(buffer.dtype)
            junk = np.full(size, 255, np.uint8)
            raw = wp.array(junk, dtype=wp.uint8, device=device)
            array = wp.array(ptr=raw.ptr, dtype=buffer.dtype, shape=(buffer.count,), device=device, copy=False)
            array._ref = raw
            self.channels[name] = array
        shares = np.broadcast_to(shares, len(images))
        exposures = np.broadcast_to(exposures, len(images))
        cameras = [wd.Camera(bloom=float(s), exposure=float(e)) for s, e in zip(shares, exposures, strict=True)]
        block = self.resources.frame.begin()[self.resources.frame.views_offset :]
        ViewPacker(self.layout, "back").write(block, cameras, [(0,) * 7] * len(cameras))
        self.resources.frame.upload()
        self.resources.frame.bright.fill_(bright)
        program.begin("bloom")
        self.stage.prepare(self.resources)
        self.stage.run(self.resources)
        program.load()

    def run(self) -> Blooming:
        """Run the pass."""
        self.resources.program.replay()
        return self

    def level(self, view: int = 0, index: int = 0) -> np.ndarray:
        """One level of a view as (height, width, 3) float32; of the exact rung the whole picture."""
        if self.stage.rung() == "exact":
            start = sum(s.width * s.height for s in self.sizes[:view])
            size = self.sizes[view]
            rows = self.channels["bloom"].numpy()[start : start + size.width * size.height]
            return rows.reshape(size.height, size.width, 3)
        row = self.stage.pyramid.rows[view * self.stage.pyramid.count + index]
        words = self.channels["bloom"].numpy()[row["first"] : row["first"] + row["width"] * row["height"]]
        return words.view(np.float16).reshape(row["height"], row["width"], 4)[..., :3].astype(np.float32)

    def seen(self, view: int = 0) -> np.ndarray:
        """Bloom at every pixel, as display reads it, in float64."""
        level = self.level(view).astype(float)
        size = self.sizes[view]
        return level if self.stage.rung() == "exact" else reference.bloom_bilinear(level, size.height, size.width)

    def mixed(self) -> list[np.ndarray]:
        """Exposed radiance of each view after bloom, as display maps it."""
        kernel = make_mix_kernel("full" if self.stage.rung() == "exact" else "levels")
        bloom = make_bloom(self.resources, self.request, self.layout)
        color = self.channels["color"]
        out = wp.zeros_like(color)
        inputs = [self.resources.frame.views, self.resources.blocks, color, bloom]
        wp.launch(kernel, len(self.layout.blocks) * 64, inputs, [out], device=color.device, block_dim=64)
        ends = np.cumsum([s.width * s.height for s in self.sizes])[:-1]
        parts = np.split(out.numpy(), ends)
        return [part.reshape(s.height, s.width, 3) for part, s in zip(parts, self.sizes, strict=True)]


def bloom_of(image, *changes, **fields) -> np.ndarray:
    """Bloom of one image as display reads it."""
    return Blooming([image], *changes, **fields).run().seen()


def shown(image, *changes, **fields) -> np.ndarray:
    """Exposed radiance of one image after bloom."""
    return Blooming([image], *changes, **fields).run().mixed()[0]


def gaussians_of(height: int, *changes: str) -> tuple[np.ndarray, np.ndarray]:
    """Weights and standard deviations [px] of the Gaussians that settings ask for."""
    settings = wd.Settings().with_values(list(changes)).bloom
    count = level_count(height, settings.radius)
    return weights(count, settings.falloff), np.array([spread(k + 1) for k in range(count)])


def rung(name: str) -> str:
    """Return the setting of a rung."""
    return f"bloom.rung={name}"


def lamps(width: int, height: int, seed: int = 3) -> np.ndarray:
    """Return a dark picture with round lamps of many sizes, a thin tube and lone bright pixels."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.0, 0.2, (height, width, 3))
    y, x = np.mgrid[0:height, 0:width]
    for _ in range(6):
        cx, cy, r = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(1.0, 6.0)
        image[(x - cx) ** 2 + (y - cy) ** 2 < r * r] = rng.uniform(2.0, 12.0, 3)
    image[height // 3, width // 5 : width // 2] = (6.0, 0.5, 3.0)
    for _ in range(5):
        image[rng.integers(height), rng.integers(width)] = rng.uniform(5.0, 40.0, 3)
    return image.astype(np.float32)


def noise(width: int, height: int, seed: int = 1) -> np.ndarray:
    """Return a picture of noise."""
    return np.random.default_rng(seed).uniform(0.0, 4.0, (height, width, 3)).astype(np.float32)
