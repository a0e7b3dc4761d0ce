"""Materials and textures, as glTF 2.0 means them, with the classic specular models beside."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from .checks import check_array, check_choice, input_error
from .records import Record

__all__ = ["Material", "Texture"]

WRAPS = ("repeat", "clamp", "mirror")
Color = tuple[float, float, float]


class Texture:
    """An image for a material, immutable once made.

    Attributes:
        pixels: Texels, uint8 (height, width, channels 1 to 4), row 0 at the top (v = 0, as in glTF).
        srgb: Whether colour channels are sRGB encoded; alpha never is. Filtering and mips work on linear values.
        wrap: (u, v) wrap modes: repeat, clamp or mirror.
        linear_filter: Whether texels are filtered; False takes the nearest one.
    """

    __slots__ = ("linear_filter", "name", "pixels", "srgb", "wrap")

    def __init__(
        self,
        pixels: Any,
        *,
        srgb: bool = True,
        wrap: tuple[str, str] = ("repeat", "repeat"),
        linear_filter: bool = True,
        name: str = "",
    ) -> None:
        array = np.asarray(pixels)
        if array.ndim == 2:
            array = array[:, :, None]
        if array.dtype != np.uint8 or array.ndim != 3 or not 1 <= array.shape[2] <= 4 or 0 in array.shape:
            raise input_error(
                "Texture.pixels", "uint8 of shape (height, width, 1 to 4)", f"<{array.dtype} {array.shape}>"
            )
        if max(array.shape[:2]) > 16384:
            raise input_error(
                "Texture.pixels", "at most 16384 texels a side", f"<{array.shape}>", "scale the image down"
            )
        self.pixels = np.ascontiguousarray(array)
        self.pixels.flags.writeable = False
        self.srgb, self.linear_filter, self.name = bool(srgb), bool(linear_filter), name
        self.wrap = tuple(check_choice("Texture.wrap", mode, WRAPS) for mode in wrap)

    def __repr__(self) -> str:
        return f"Texture({self.name!r}, {self.pixels.shape[1]}x{self.pixels.shape[0]}x{self.pixels.shape[2]})"


class Material(Record):
    """How a surface answers light.

    `ggx` follows glTF 2.0, appendix B. `lambert` is diffuse only. `phong` and `blinn_phong` add a normalised lobe of
    colour `specular`; what the lobe reflects is taken from the diffuse part, so that no energy is made.
    """

    model: Literal["lambert", "phong", "blinn_phong", "ggx"] = "ggx"
    """Specular model."""
    base_color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    """Linear colour and alpha; multiplies the texture and the vertex colour."""
    metallic: float = Field(0.0, ge=0.0, le=1.0)
    """Metalness of `ggx`."""
    roughness: float = Field(0.5, ge=0.0, le=1.0)
    """Perceptual roughness of `ggx`; used as at least 0.045."""
    specular: Color = (0.04, 0.04, 0.04)
    """Reflectance of the lobe of `phong` and `blinn_phong`."""
    shininess: float = Field(32.0, ge=1.0, le=8192.0)
    """Exponent of the lobe of `phong` and `blinn_phong`."""
    emissive: Color = (0.0, 0.0, 0.0)
    """Emitted radiance, linear; multiplies the emissive texture."""
    base_color_texture: Texture | None = None
    """sRGB colour and linear alpha."""
    metallic_roughness_texture: Texture | None = None
    """Linear: roughness in green, metalness in blue, as in glTF."""
    emissive_texture: Texture | None = None
    """sRGB emission."""
    occlusion_texture: Texture | None = None
    """Linear: ambient occlusion in red, as in glTF."""
    occlusion_strength: float = Field(1.0, ge=0.0, le=1.0)
    """How much of the occlusion texture is applied."""
    alpha_mode: Literal["opaque", "mask", "blend"] = "opaque"
    """What alpha means: nothing, a cut-out at `alpha_cutoff`, or blending."""
    alpha_cutoff: float = Field(0.5, ge=0.0)
    """Alpha from which on a masked surface is there."""
    two_sided: bool = False
    """Whether back faces are drawn, with the normal turned to the viewer."""
    name: str = ""
    """Name, as in the file it came from."""

    @model_validator(mode="after")
    def _colors(self) -> Material:
        if min(self.base_color) < 0.0 or max(self.base_color) > 1.0:
            raise input_error("Material.base_color", "values from 0 to 1", self.base_color)
        if min(self.specular) < 0.0 or max(self.specular) > 1.0:
            raise input_error("Material.specular", "values from 0 to 1", self.specular)
        if min(self.emissive) < 0.0:
            raise input_error("Material.emissive", "values >= 0", self.emissive)
        return self

    @property
    def textures(self) -> tuple[Texture | None, Texture | None, Texture | None, Texture | None]:
        """Base colour, metallic-roughness, emissive, occlusion."""
        return self.base_color_texture, self.metallic_roughness_texture, self.emissive_texture, self.occlusion_texture


def check_rgb(name: str, value: Any) -> tuple[float, float, float]:
    """Return three finite values >= 0 as a tuple."""
    array = check_array(name, value, (3,), np.float64)
    if array.min() < 0.0:
        raise input_error(name, "values >= 0", tuple(array.tolist()))
    return tuple(array.tolist())
