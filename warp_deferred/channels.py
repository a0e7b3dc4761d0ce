"""The one table of named outputs: what each holds, its space and unit, its background, its names in OpenEXR files.

Importing it imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from .checks import check_choice, input_error

__all__ = ["ID_CHANNELS", "OUTPUTS", "Channel", "check_outputs"]


@dataclass(frozen=True)
class Channel:
    """One named output of the renderer, an array of shape (view, height, width)."""

    name: str
    """The name it is asked for by."""
    dtype: str
    """Name of the Warp type of one pixel: `getattr(warp, dtype)`; a text, so that this table needs no Warp."""
    space: str
    """Space or encoding of the numbers."""
    unit: str
    """Unit, or 1 for pure numbers."""
    background: float
    """Value of every component where no surface is (of `color` and `display` only if the background is black)."""
    exr: tuple[str, ...]
    """Names of its components in an OpenEXR file; none: it is not kept there."""
    doc: str
    """What it is, in one line."""

    @property
    def components(self) -> int:
        """Numbers per pixel."""
        return {"vec2": 2, "vec3": 3, "vec4ub": 4}.get(self.dtype, 1)

    @property
    def is_integer(self) -> bool:
        """Whether it holds ids or counts, which are compared exactly and stored as OpenEXR UINT."""
        return self.dtype == "int32"


def _layer(name: str, suffixes: str) -> tuple[str, ...]:
    return tuple(f"{name}.{letter}" for letter in suffixes)


_INF = float("inf")
_RADIANCE = "W/(m^2 sr), photometric: cd/m^2"
_TABLE = (
    Channel("color", "vec3", "linear Rec. 709", _RADIANCE, 0.0, ("R", "G", "B"), "Radiance before exposure and bloom."),
    Channel("display", "vec4ub", "sRGB, 8 bits", "1", 0.0, (), "Exposed, tone mapped, encoded picture; R G B A."),
    Channel(
        "diffuse", "vec3", "linear Rec. 709", _RADIANCE, 0.0, _layer("diffuse", "RGB"), "Outgoing diffuse radiance."
    ),
    Channel(
        "specular", "vec3", "linear Rec. 709", _RADIANCE, 0.0, _layer("specular", "RGB"), "Outgoing specular radiance."
    ),
    Channel("alpha", "float32", "coverage", "1", 0.0, ("A",), "Coverage: 1 on a surface, 0 on the background."),
    Channel("depth", "float32", "view", "m", _INF, ("Z",), "Linear view depth; +inf on the background."),
    Channel("normal", "vec3", "world", "1", 0.0, _layer("normal", "XYZ"), "Unit shading normal; 0 on the background."),
    Channel("position", "vec3", "world", "m", 0.0, _layer("position", "XYZ"), "Surface point; 0 on the background."),
    Channel("albedo", "vec3", "linear Rec. 709", "1", 0.0, _layer("albedo", "RGB"), "Base colour of the surface."),
    Channel(
        "motion",
        "vec2",
        "image",
        "px",
        0.0,
        _layer("motion", "XY"),
        "Position less that of the frame before, y down; on the background, of what is infinitely far.",
    ),
    Channel(
        "ambient_visibility",
        "float32",
        "share",
        "1",
        1.0,
        ("ambient_visibility.V",),
        "Share of ambient light that reaches the surface; 1 on the background.",
    ),
    Channel("instance_id", "int32", "index", "1", -1.0, ("instance_id",), "Index of the instance; -1: background."),
    Channel("semantic_id", "int32", "label", "1", -1.0, ("semantic_id",), "Label of the instance; -1: background."),
    Channel("material_id", "int32", "index", "1", -1.0, ("material_id",), "Index of the material; -1: background."),
    Channel("triangle_id", "int32", "index", "1", -1.0, ("triangle_id",), "Mesh-local triangle; -1: background."),
    Channel("light_count", "int32", "count", "1", 0.0, ("light_count",), "Lights that reach the pixel."),
)

OUTPUTS: dict[str, Channel] = {channel.name: channel for channel in _TABLE}
"""All outputs by name, in the order they are documented and written."""

ID_CHANNELS = frozenset(name for channel in _TABLE if channel.is_integer for name in channel.exr)
"""Names of the OpenEXR channels that hold our signed integers."""


def check_outputs(label: str, names: str | Iterable[str]) -> tuple[str, ...]:
    """Return output names without repeats, in the table's order.

    Args:
        label: Name of the argument for messages.
        names: Names of outputs; one name may come as a plain text.

    Raises:
        InputError: If a name is not an output or none is given.
    """
    listed = [names] if isinstance(names, str) else list(names)
    if not listed:
        raise input_error(label, "at least one output", "<nothing>", "known outputs: " + ", ".join(OUTPUTS))
    wanted = {check_choice(label, name, OUTPUTS) for name in listed}
    return tuple(name for name in OUTPUTS if name in wanted)
