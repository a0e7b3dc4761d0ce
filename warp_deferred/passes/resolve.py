"""Resolve: visibility keys to G-buffer, depth and layers."""

from __future__ import annotations

import warp as wp

from ..effects import called_for
from ..kernels import resolve as kernels
from ..kernels import structs
from ..kernels.depth_encoding import DEPTH_CODECS
from ..kernels.resolve import LAYER_NAMES
from ..program import FIRST
from ..resources import Resources
from .base import Buffer, Pass, Request

__all__ = [
    "ResolvePass", "depth_buffers", "depth_format", "gbuffer_buffers", "gbuffer_codec", "make_gbuffer", "needs_gbuffer",
]  # fmt: skip

LAYER_TYPES = {
    "normal": wp.vec3, "position": wp.vec3, "albedo": wp.vec3, "alpha": wp.float32, "instance_id": wp.int32,
    "semantic_id": wp.int32, "material_id": wp.int32, "triangle_id": wp.int32,
}  # fmt: skip
GBUFFER_FIELDS = {
    "depth16": wp.uint16, "depth32": wp.uint32,
    "normal": wp.uint32, "normal_wide": wp.uint32, "albedo": wp.uint32, "extra": wp.uint32,
    "full_normal": wp.vec4, "full_albedo": wp.vec4, "full_extra": wp.vec4,
}  # fmt: skip
#: Effects that read linear depth themselves.
DEPTH_READERS = ("ambient_visibility", "depth_of_field", "motion_blur")


def needs_gbuffer(request: Request) -> bool:
    """Whether some pass reads the G-buffer: lighting, or what looks at surfaces by itself."""
    return request.lit or "ambient_visibility" in request.outputs


def gbuffer_codec(request: Request) -> tuple[str, str, bool]:
    """Arguments of `make_gbuffer_codec` for a request."""
    settings = request.settings.gbuffer
    if settings.rung == "full":
        return ("full", "float32", request.features.extra)
    return ("compact", settings.normal, request.features.extra)


def depth_format(request: Request) -> str:
    """Format of the depth that lighting reads; without lighting nobody reads codes."""
    settings = request.settings.gbuffer
    return settings.depth if request.lit and settings.rung == "compact" else "float32"


def depth_buffers(request: Request, layout: object) -> dict[str, Buffer]:
    """The channel of depth that lighting reads."""
    dtype = DEPTH_CODECS[depth_format(request)]
    name = "depth" if dtype is wp.float32 else f"gbuffer_depth{8 * wp.types.type_size_in_bytes(dtype)}"
    return {name: Buffer(dtype, max(layout.pixels, 1))}


def gbuffer_buffers(request: Request, layout: object) -> dict[str, Buffer]:
    """Channels of the G-buffer under the request's codec, depth apart."""
    rung, normal, extra = gbuffer_codec(request)
    if rung == "full":
        names = ["full_normal", "full_albedo"] + ["full_extra"] * extra
    else:
        names = ["normal", "albedo"] + ["extra"] * extra
        names += ["normal_wide"] * (normal in ("xy16", "oct32")) + ["full_normal"] * (normal == "float32")
    return {f"gbuffer_{n}": Buffer(GBUFFER_FIELDS[n], max(layout.pixels, 1)) for n in names}


def make_gbuffer(resources: Resources) -> structs.GBuffer:
    """Struct over the G-buffer channels of a plan; missing ones are one element long and never touched."""
    result = structs.GBuffer()
    result.depth = resources.channel("depth", wp.float32)
    for name, dtype in GBUFFER_FIELDS.items():
        setattr(result, name, resources.channel(f"gbuffer_{name}", dtype))
    return result


class ResolvePass(Pass):
    """Surface attributes of every pixel."""

    name = "resolve"
    doc = "turn keys into surface attributes"

    @property
    def layers(self) -> tuple[str, ...]:
        """Layers asked for."""
        return tuple(n for n in LAYER_NAMES if n in self.request.outputs)

    @property
    def resolves(self) -> bool:
        """Whether more than depth is wanted."""
        return needs_gbuffer(self.request) or bool(self.layers)

    @property
    def linear(self) -> bool:
        """Whether linear depth is wanted beside a depth of codes."""
        coded = needs_gbuffer(self.request) and depth_format(self.request) != "float32"
        asked = "depth" in self.request.outputs
        return coded and (asked or any(called_for(self.request, name) for name in DEPTH_READERS))

    def called_for(self) -> str | None:
        """Some output shows a surface."""
        if self.request.lit:
            return "an output is lit"
        if needs_gbuffer(self.request):
            return "ambient visibility looks at surfaces"
        names = [n for n in (*LAYER_NAMES, "depth") if n in self.request.outputs]
        return f"{', '.join(names)} asked for" if names else None

    def rung(self) -> str:
        """Codec."""
        if not needs_gbuffer(self.request):
            return "layers only"
        rung, normal, _ = gbuffer_codec(self.request)
        depth = depth_format(self.request)
        return rung if rung == "full" else f"{rung}, {normal}" + f", {depth}" * (depth != "float32")

    def reads(self) -> tuple[str, ...]:
        """Keys and pairs."""
        return ("keys", "pairs") if self.request.candidates else ("keys",)

    def writes(self) -> dict[str, Buffer]:
        """Depth, G-buffer, layers."""
        count = max(self.layout.pixels, 1)
        result = {name: Buffer(LAYER_TYPES[name], count) for name in self.layers}
        if self.linear or "depth" in self.request.outputs:
            result["depth"] = Buffer(wp.float32, count)
        if needs_gbuffer(self.request):
            result |= depth_buffers(self.request, self.layout) | gbuffer_buffers(self.request, self.layout)
            if self.request.features.emissive:
                result["emission"] = Buffer(wp.vec3, count)
        return result

    def prepare(self, resources: Resources) -> None:
        """Fetch the kernel, build the structs."""
        features = self.request.features
        codec = gbuffer_codec(self.request) if needs_gbuffer(self.request) else None
        self.kernel = kernels.make_resolve_kernel(
            codec,
            self.layers,
            features.textured,
            features.colors,
            features.emissive and codec is not None,
            depth_format(self.request),
            self.linear,
        )
        self.gbuffer = make_gbuffer(resources)
        self.out = structs.Layers()
        for name, dtype in LAYER_TYPES.items():
            setattr(self.out, name, resources.channel(name, dtype))
        self.out.emissive = resources.channel("emission", wp.vec3)

    def run(self, resources: Resources) -> None:
        """Attributes, and depth alone where nothing else is wanted."""
        frame, channels, program = resources.frame, resources.channels, resources.program
        threads = len(self.layout.blocks) * 64
        if self.resolves:
            pairs = resources.channel("pairs", structs.Pair)
            inputs = [
                frame.views,
                resources.blocks,
                resources.scene.geometry,
                resources.scene.materials,
                pairs,
                channels["keys"],
                FIRST,
            ]
            program.launch(self.kernel, threads, inputs, [self.gbuffer, self.out], block_dim=kernels.BLOCK_DIM, band=64)
        if "depth" in channels and not needs_gbuffer(self.request):
            inputs = [frame.views, resources.blocks, channels["keys"], FIRST]
            program.launch(
                kernels.depth_layer_kernel, threads, inputs, [channels["depth"]], block_dim=kernels.BLOCK_DIM, band=64
            )

    def bytes_moved(self) -> int:
        """Keys in, channels out; a triangle's vertices are counted once a triangle, up to one a pixel."""
        written = sum(wp.types.type_size_in_bytes(b.dtype) for b in self.writes().values()) * self.layout.pixels
        triangles = min(self.request.candidates * 128, self.layout.pixels)
        return self.layout.pixels * 8 + written + triangles * (12 + 36)
