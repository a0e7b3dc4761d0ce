"""Settings: how accurately, not what. Each stage has one class with its `rung`; the neutral rung is always `off`."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from .effect_settings import (
    AmbientVisibilitySettings,
    AntiAliasingSettings,
    BloomSettings,
    BlurSettings,
    DepthOfFieldSettings,
    MotionBlurSettings,
    ScaleSettings,
    ShadowSettings,
)
from .records import Record

__all__ = [
    "AmbientVisibilitySettings", "DisplaySettings", "GBufferSettings", "LightCullingSettings", "RasterSettings",
    "Settings", "ShadeSettings",
]  # fmt: skip


class RasterSettings(Record):
    """Visibility."""

    bin_capacity: int = Field(1 << 22, ge=0, le=1 << 28)
    """Entries in the per-tile lists of large triangles; what does not fit is drawn by the atomic path."""
    large_capacity: int = Field(1 << 18, ge=0, le=1 << 26)
    """Large triangles kept for binning; what does not fit is drawn by the atomic path."""
    bins: Literal["auto", "on", "off"] = "auto"
    """Whether large triangles are binned to screen tiles; auto: on CUDA, where lanes wait for one another."""
    cull: Literal["back", "none", "front"] = "back"
    """Which faces of one-sided materials are dropped."""


class GBufferSettings(Record):
    """What the resolve stores per pixel."""

    rung: Literal["compact", "full"] = "compact"
    """compact: 16 bytes a pixel; full: float32 everywhere."""
    normal: Literal["rgb8", "xy16", "oct16", "oct24", "oct32", "float32"] = "oct24"
    """Normal codec of the compact G-buffer; `full` always keeps float32."""
    depth: Literal["unorm16", "ufloat16", "unorm24", "float32"] = "float32"
    """Depth that lighting reads, in the compact G-buffer; `full` always keeps float32. Codes of the reversed depth z =
    near / depth: unorm16, unorm24 at equal steps, off by the share depth / (2^17 near) or depth / (2^25 near); ufloat16
    by the share 2.5e-4 anywhere, in 16 bits. Outputs and effects that look at depth themselves keep float32."""


class LightCullingSettings(Record):
    """Which lights a tile considers."""

    rung: Literal["tiles", "tiles_depth", "brute_force"] = "tiles_depth"
    """2D tiles; tiles with depth bounds; every light everywhere (reference)."""
    tile_size: Literal[8, 16, 32, 64] = 16
    """Side of a screen tile [px]."""
    mask_budget_bytes: int = Field(256 << 20, ge=1, le=(1 << 33) - 4)
    """Memory for light masks [byte], 1 to 8 GiB less 4; where all would take more, tiles are culled and shaded in bands
    with the same image, at five launches for each band past the first. A band is at least one row of coarse tiles, 64
    to 256 pixels high, which may exceed it."""


class ShadeSettings(Record):
    """Lighting."""

    radiance: Literal["half", "float32"] = "half"
    """Format of the radiance behind `display`; `color` is float32 whenever it is asked for."""
    accumulation: Literal["half", "float32"] = "float32"
    """Sums of diffuse and of specular light while lights are added. half: rounded after each light, as in a renderer
    that adds into half4 targets, off by at most 2^-11 of the sum for each light that arrives; here it saves nothing."""
    arithmetic: Literal["fast", "fused", "precise"] = "precise"
    """How lighting may round. fused: products and sums at once; fast: CUDA's approximate division, root and power, too;
    the CPU has no such thing. Coverage, ids, depth, masks and other passes are always precise; what fused or fast gives
    is not the same bits on every device."""


class DisplaySettings(Record):
    """From radiance to the picture."""

    tone_mapping: Literal["off", "reinhard", "aces", "pbr_neutral", "agx"] = "pbr_neutral"
    """Curve from scene to display radiance."""
    view: Literal[
        "picture", "normal", "depth", "position", "albedo", "diffuse", "specular", "alpha", "ambient_visibility",
        "instance_id", "semantic_id", "material_id", "triangle_id", "light_count", "tiles", "clusters", "wireframe",
        "shadow_atlas", "invalid",
    ] = "picture"  # fmt: skip
    """What the output `display` shows: the picture, or a buffer of the frame by the colours of `debug_views.py`. What a
    buffer does not need is then not run."""


class Settings(Record):
    """All stages' settings, immutable; `with_values(["display.tone_mapping=aces"])` reads the command line's form."""

    raster: RasterSettings = RasterSettings()
    """Visibility."""
    gbuffer: GBufferSettings = GBufferSettings()
    """G-buffer codecs."""
    light_culling: LightCullingSettings = LightCullingSettings()
    """Tiles and light masks."""
    shadow: ShadowSettings = ShadowSettings()
    """Shadows."""
    shade: ShadeSettings = ShadeSettings()
    """Lighting."""
    ambient_visibility: AmbientVisibilitySettings = AmbientVisibilitySettings()
    """How much of the ambient light each surface point sees."""
    bloom: BloomSettings = BloomSettings()
    """Light the lens scatters."""
    display: DisplaySettings = DisplaySettings()
    """Tone mapping."""
    anti_aliasing: AntiAliasingSettings = AntiAliasingSettings()
    """Samples a pixel."""
    blur: BlurSettings = BlurSettings()
    """A Gaussian over the image."""
    scale: ScaleSettings = ScaleSettings()
    """Rendered size."""
    depth_of_field: DepthOfFieldSettings = DepthOfFieldSettings()
    """Blur of what is out of focus."""
    motion_blur: MotionBlurSettings = MotionBlurSettings()
    """Blur of what moves while the shutter is open."""
    check_finite: bool = False
    """Whether every pass's numbers are looked at, and a frame with one that is not finite is an error that names pass,
    output, view, pixel and value: a debugging aid, which waits for each frame."""

    preset: Literal["none", "draft", "balanced", "high", "reference"] = "none"
    """A rung for every ladder at once, chosen from measurements: presets.py tells each one's price and error. What is
    set beside it, field by field, goes before it. draft: for time; balanced: to where more of it buys little; high: to
    where it buys next to nothing; reference: every ladder's most accurate rung, seconds a frame."""

    @property
    def stages(self) -> list[str]:
        """Names of the fields that hold a stage's settings."""
        return [name for name in type(self).model_fields if isinstance(getattr(self, name), Record)]

    @model_validator(mode="after")
    def _take_preset(self) -> Settings:
        if self.preset == "none":
            return self
        from .presets import PRESETS

        for stage, fields in PRESETS[self.preset].items():
            given = getattr(self, stage)
            own = {name: getattr(given, name) for name in given.model_fields_set}
            filled = type(given)(**(_numbers(fields) | own))
            # Neither counts as set by hand: another preset may take their place.
            filled.__pydantic_fields_set__.intersection_update(own)
            self.__dict__[stage] = filled
        return self

    def with_values(self, assignments: list[str]) -> Settings:
        """Return a copy with `stage.field=value` assignments applied.

        Raises:
            InputError: If a stage, a field or a value is not known.
        """
        from .checks import check_choice, input_error

        result = self
        for text in assignments:
            path, equals, value = text.partition("=")
            stage, dot, field = path.strip().partition(".")
            if not equals or not dot:
                raise input_error("--set", "stage.field=value, such as light_culling.tile_size=32", text)
            check_choice("Settings", stage, self.stages)
            current: Any = getattr(result, stage)
            check_choice(f"Settings.{stage}", field, type(current).model_fields)
            result = result.replace(**{stage: current.replace(**_numbers({field: value.strip()}))})
        return result


def _numbers(fields: dict[str, str]) -> dict[str, Any]:
    """Whole numbers as such: a choice among them is not made by a text."""
    return {name: int(word) if word.lstrip("-").isdigit() else word for name, word in fields.items()}
