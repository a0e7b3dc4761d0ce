"""Settings of the optional effects: one class each, its `rung` from the neutral `off` to the reference."""

from __future__ import annotations

from typing import Literal

from .records import Record

__all__ = ["AntiAliasingSettings"]


class AntiAliasingSettings(Record):
    """Light averaged over the pixel's square, in place of light at its centre.

    The samples are averaged with equal weights in linear radiance before exposure and tone mapping: `color`, `display`,
    `diffuse`, `specular` and `alpha` (then the share of the pixel that is covered). The other outputs stay those of the
    pixel's centre, and asking for one of them takes one more run of the sample part. A sample that is very bright
    stays very bright in the average.
    """

    rung: Literal["off", "samples_4", "samples_16", "samples_64"] = "off"
    """samples_N: N points in every pixel, well spread; time grows by what precedes the picture, memory does not."""
