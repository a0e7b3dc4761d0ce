"""The one table of debug views: what `display.view` can show in place of the picture, from what, on which scale.

Importing it imports nothing heavy.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DEBUG_VIEWS", "DebugView"]


@dataclass(frozen=True)
class DebugView:
    """One buffer of the frame as a picture."""

    name: str
    """The name it is asked for by."""
    kind: str
    """How its numbers become colours; one of `kernels.debug_view.KINDS`."""
    reads: tuple[str, ...]
    """Channels it reads; those that are outputs are made though nobody asked for them."""
    doc: str
    """What the colours mean: its legend."""
    lit: bool = False
    """Whether it needs what comes from light, so that G-buffer and light masks are made."""
    mend: str = ""
    """What the frame lacks where nobody writes a channel it reads."""


_HASH = "a colour of its own for each {}, black on the background"
_HEAT = "black for 0, blue 1, cyan 2, green 4, yellow 8, orange 16, red 32, dark red for 64 and more"
_LIGHT = "{} radiance alone, exposed and tone mapped as the picture is"
_TABLE = (
    DebugView("normal", "direction", ("normal",), "red, green, blue = (x, y, z + 1) / 2 of the world normal"),
    DebugView("depth", "depth", ("depth",), "red is the view's nearest surface, blue its farthest, by equal ratios"),
    DebugView("position", "position", ("position",), "red, green, blue rise and fall along x, y, z, every 2 m"),
    DebugView("albedo", "albedo", ("albedo",), "base colour, encoded as sRGB"),
    DebugView("diffuse", "radiance", ("diffuse",), _LIGHT.format("diffuse"), lit=True),
    DebugView("specular", "radiance", ("specular",), _LIGHT.format("specular"), lit=True),
    DebugView("alpha", "share", ("alpha",), "black for 0, white for 1"),
    DebugView(
        "ambient_visibility",
        "share",
        ("ambient_visibility",),
        "black where no ambient light arrives, white where all does",
        lit=True,
        mend="no pass finds it while ambient_visibility.rung is off",
    ),
    DebugView("instance_id", "id", ("instance_id",), _HASH.format("instance")),
    DebugView("semantic_id", "id", ("semantic_id",), _HASH.format("label")),
    DebugView("material_id", "id", ("material_id",), _HASH.format("material")),
    DebugView("triangle_id", "id", ("triangle_id",), _HASH.format("triangle of a mesh")),
    DebugView("light_count", "count", ("light_count",), f"lights that reach the pixel: {_HEAT}", lit=True),
    DebugView(
        "tiles",
        "tiles",
        ("mask_words", "normal"),
        f"lights in the mask of each screen tile, darker where the surface turns away: {_HEAT}",
        lit=True,
        mend="light masks are made for scenes with lights: add one",
    ),
    DebugView("clusters", "clusters", ("keys", "pairs", "normal"), "a colour of its own for each cluster of triangles"),
    DebugView("wireframe", "wireframe", ("keys", "pairs", "normal"), "edges of all triangles in orange, over grey"),
    DebugView(
        "shadow_atlas",
        "shadow_atlas",
        ("depth_keys", "shadow_tiles"),
        "all shadow maps side by side; near is light, nothing is black",
        lit=True,
        mend="no pass of this frame draws shadow maps: it needs a light that casts shadows",
    ),
    DebugView("invalid", "invalid", (), "the picture dimmed and grey; NaN red, infinity green", lit=True),
)

DEBUG_VIEWS: dict[str, DebugView] = {view.name: view for view in _TABLE}
"""All debug views by name."""
