"""Settings of the optional effects: one class each, its `rung` from the neutral `off` to the reference."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .records import Record

__all__ = ["AntiAliasingSettings", "DepthOfFieldSettings", "MotionBlurSettings"]


class AntiAliasingSettings(Record):
    """Light averaged over the pixel's square, in place of light at its centre.

    The samples are averaged with equal weights in linear radiance before exposure and tone mapping: `color`, `display`,
    `diffuse`, `specular` and `alpha` (then the share of the pixel that is covered). The other outputs stay those of the
    pixel's centre, and asking for one of them takes one more run of the sample part. A sample that is very bright
    stays very bright in the average.
    """

    rung: Literal["off", "samples_4", "samples_16", "samples_64"] = "off"
    """samples_N: N points in every pixel, well spread; time grows by what precedes the picture, memory does not."""


class DepthOfFieldSettings(Record):
    """Blur of what lies before and behind the plane in focus, through the lens opening of a perspective camera.

    A thin lens of diameter A focused at f spreads a point at view depth z over a circle of A * s * |1/z - 1/f| pixels
    across, s being the projection's pixels per unit of x/z. `lens_samples` looks through points of that very lens; the
    rungs below it blur one image taken through its middle, so what that one does not see they have to guess.

    Error against `lens_samples`, as the root mean square difference of x / (1 + x) over a picture of circles of at most
    16 pixels radius: `gather` at most 0.025 and at most half of what `off` makes, `plane_lerp` at most 0.05 and less
    than `off`. (0.02 and 0.04 were stated first; the built-in scene `focus` came to 0.016 and 0.042 at 320 x 180, 0.021
    and 0.024 at 960 x 540, where `off` has 0.051 and 0.060.) A picture taken with anti-aliasing comes nearer.
    """

    rung: Literal["off", "plane_lerp", "gather", "lens_samples"] = "gather"
    """plane_lerp: mix with an equally blurred copy by distance from the plane in focus; gather: circles of confusion,
    what lies before the plane in focus apart from what lies behind it; lens_samples: so many views through points of
    the lens (reference), which costs so many frames. `gather` costs 1.3 images of memory, which include a copy."""
    when: Literal["called_for", "always"] = "called_for"
    """always: run although no camera has an aperture; changes no bit then. lens_samples takes no samples then."""
    max_radius_px: float = Field(32.0, ge=1.0, le=64.0)
    """Largest radius of a circle [px], 1 to 64; larger ones are drawn this large. Of gather; time grows slowly with
    it, for the taps of a large circle are taken from reduced images."""
    texels: int = Field(5, ge=2, le=8)
    """Texels from the middle of a circle to its rim, at most, 2 to 8: the least reduced image that allows it is read,
    (2 n + 1)^2 texels for a circle of n. Of gather."""
    blur_radius_px: int = Field(8, ge=1, le=32)
    """Radius of the equal blur [px], 1 to 32; time grows with it. Of plane_lerp."""
    power: float | None = Field(None, ge=0.0, le=1e6)
    """Share of the blurred copy: power * |z - f| / z, at most 1; 0 to 1e6. None: 1 is reached where the lens's circle
    has the blur's radius. Of plane_lerp; a camera without an aperture stays sharp."""
    samples: Literal[16, 64, 256] = 64
    """Points of the lens. Of lens_samples; time grows with it, memory does not."""


class MotionBlurSettings(Record):
    """Blur of what moves, by itself or with the camera, while the shutter is open.

    The shutter closes at the frame's own time and opens a share `Camera.shutter` of a frame earlier. Poses in between
    are interpolated from those of the frame before: places along a line, rotations along the shortest arc. What is
    declared to move is told by `explain`: transforms or poses bound as device arrays, a scene that can be animated, or
    transforms or cameras that have changed between two frames of the renderer. Points bound to meshes are taken as
    they are. The first frame, and the first one of another plan, has no frame before: nothing moves in it.

    Error against `shutter_samples`, stated before it was measured, as the root mean square difference of x / (1 + x)
    over a picture of motions of at most 16 pixels: `velocity_gather` at most 0.03 and less than what `off` makes.
    """

    rung: Literal["off", "velocity_gather", "shutter_samples"] = "velocity_gather"
    """velocity_gather: gather along the longest motion nearby; shutter_samples: so many frames at times within the
    shutter's (reference). With views of different shutters in one batch, its instances move with the longest."""
    when: Literal["called_for", "always"] = "called_for"
    """always: run although no shutter is open or nothing moves; changes no bit then. shutter_samples takes no samples
    then."""
    max_length_px: float = Field(48.0, ge=1.0, le=128.0)
    """Longest trail [px], 1 to 128; longer ones are drawn this long. Of velocity_gather."""
    taps: int = Field(24, ge=4, le=64)
    """Taps along a trail, at most, 4 to 64: one a pixel while it is shorter. Of velocity_gather."""
    samples: Literal[16, 64, 256] = 64
    """Times within the shutter's. Of shutter_samples; time grows with it, memory does not."""
