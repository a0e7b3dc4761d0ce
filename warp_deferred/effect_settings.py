"""Settings of the optional effects: one class each, its `rung` from the neutral `off` to the reference."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .records import Record

__all__ = ["AntiAliasingSettings", "ShadowSettings"]


class AntiAliasingSettings(Record):
    """Light averaged over the pixel's square, in place of light at its centre.

    The samples are averaged with equal weights in linear radiance before exposure and tone mapping: `color`, `display`,
    `diffuse`, `specular` and `alpha` (then the share of the pixel that is covered). The other outputs stay those of the
    pixel's centre, and asking for one of them takes one more run of the sample part. A sample that is very bright
    stays very bright in the average.
    """

    rung: Literal["off", "samples_4", "samples_16", "samples_64"] = "off"
    """samples_N: N points in every pixel, well spread; time grows by what precedes the picture, memory does not."""


class ShadowSettings(Record):
    """Shadows of lights that declare `casts_shadow`.

    The maps of one frame are depth-only views, drawn with the cameras' views by the same launches. A light past its
    kind's capacity lights without a shadow, and `explain` counts it.
    """

    rung: Literal["off", "hard", "pcf", "pcss", "ray_traced"] = "pcf"
    """hard: one texel a light; pcf: a smooth 4 x 4 filter; pcss: a filter as wide as the penumbra; ray_traced: rays to
    the light's own disc (reference). Against the reference: hard and pcf differ by at most 1 within a penumbra, or 4
    texels where that is wider, of a shadow's edge, and not at all elsewhere; pcss differs by at most 0.1 in the mean
    over the penumbra of a straight edge up to 32 texels wide either way."""
    when: Literal["called_for", "always"] = "called_for"
    """always: compile the lookup in although no light casts; it then changes no bit."""
    directional_size: int = Field(2048, ge=64, le=8192, multiple_of=64)
    """Side of each cascade's map [texel]; 4 bytes a texel."""
    spot_size: int = Field(1024, ge=64, le=8192, multiple_of=64)
    """Side of a spot light's map [texel]."""
    point_size: int = Field(512, ge=128, le=4096, multiple_of=64)
    """Side of each of the six maps of a point light, or of a spot light wider than 75 degrees [texel]."""
    directional_lights: int = Field(2, ge=0, le=16)
    """Directional lights that have maps, the first ones in order; `cascades` maps each, for every camera."""
    spot_lights: int = Field(32, ge=0, le=4096)
    """Spot lights that have a map, the first ones in order."""
    point_lights: int = Field(16, ge=0, le=1024)
    """Point lights that have maps, the first ones in order."""
    cascades: Literal[1, 2, 4] = 4
    """Maps a directional light has, each for a farther slice of what the camera sees."""
    distance_m: float = Field(0.0, ge=0.0)
    """Depth up to which directional lights cast shadows [m]; 0: as far as the scene reaches, in steps of sqrt 2."""
    split_blend: float = Field(0.85, ge=0.0, le=1.0)
    """Where cascades end: 0 spaces them evenly, 1 by equal ratios, in between blends the two."""
    directional_angle_deg: float = Field(0.2666, gt=0.0, le=20.0)
    """Angular radius of directional lights for pcss and ray_traced [degrees]; that of the sun."""
    cull: Literal["none", "back", "front"] = "none"
    """Faces that cast no shadow; none: either side of a surface stops light, back: faster where meshes are closed."""
    keep_maps: bool = True
    """Whether a map stays from frame to frame while neither its view nor a caster in it moves; no pixel differs."""
    samples: int = Field(256, ge=1, le=4096)
    """Rays a pixel and light of the rung ray_traced; the standard error is 0.5 / sqrt(samples) at most."""
