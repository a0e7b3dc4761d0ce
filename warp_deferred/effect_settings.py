"""Settings of the optional effects: one class each, its `rung` from the neutral `off` to the reference.

`when` tells what may put an effect into the plan: "called_for" leaves it to the scene, "always" runs it although the
scene does not call for it. `rung="off"` keeps it out whatever calls for it.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .records import Record

__all__ = [
    "AmbientVisibilitySettings",
    "AntiAliasingSettings",
    "BloomSettings",
    "BlurSettings",
    "DepthOfFieldSettings",
    "MotionBlurSettings",
    "ScaleSettings",
    "ShadowSettings",
]


class AmbientVisibilitySettings(Record):
    """How much of the constant ambient light each surface point sees.

    All rungs estimate the same number: the cosine-weighted share of the hemisphere in which nothing stands nearer than
    the radius. Those below `ray_traced` know only the depths in the picture.
    """

    rung: Literal["off", "ssao", "gtao_half", "gtao", "ray_traced"] = "gtao"
    """ssao: points around the surface tested against depth; gtao: horizons in depth; gtao_half: the same at half size;
    ray_traced: rays against all triangles (reference). Root mean square errors against it, over the scene `corner`, are
    at most: ssao 0.17, gtao_half 0.12, gtao 0.11; its own, with 256 rays, is a quarter of gtao's at most."""
    when: Literal["called_for", "always"] = "called_for"
    """called_for: where ambient light is not zero; always: wherever something is lit."""
    radius_m: float | None = Field(None, ge=0.0)
    """How far something may stand and still block light [m]; 0: nothing does. Left out: a 20th of the diagonal of the
    scene's box, taken when the scene is loaded."""
    power: float = Field(1.0, ge=0.0, le=16.0)
    """Exponent applied to the visibility: 1 is physical, more is darker, 0 turns all into 1."""
    slices: int = Field(2, ge=1, le=8)
    """gtao: planes through the line of sight in which horizons are searched; time grows in proportion."""
    steps: int = Field(3, ge=1, le=8)
    """gtao: depths looked at on each side of a slice; time grows in proportion."""
    samples: int = Field(16, ge=1, le=64)
    """ssao: points tested a pixel; time grows in proportion."""
    rays: int = Field(256, ge=1, le=65536)
    """ray_traced: rays a pixel; time grows in proportion, the error falls with it."""
    bias: float = Field(0.01, ge=0.0, le=0.5)
    """ssao and ray_traced: how far tests start above the surface, as a share of the radius."""


class AntiAliasingSettings(Record):
    """Light averaged over the pixel's square, in place of light at its centre.

    The samples are averaged with equal weights in linear radiance before exposure and tone mapping: `color`, `display`,
    `diffuse`, `specular` and `alpha` (then the share of the pixel that is covered). The other outputs stay those of the
    pixel's centre, and asking for one of them takes one more run of the sample part. A sample that is very bright
    stays very bright in the average. The cheapest rung, fxaa, takes no samples: it looks for edges in the picture and
    changes `display` alone.

    Share of the error of `off` that is left in `display`, against 256 samples, at most:

    | | fxaa | samples_2 | samples_4 | samples_8 | samples_16 | samples_32 | samples_64 |
    |---|---|---|---|---|---|---|---|
    | straight edges of any slope, root mean square of linear light | 0.7 | 0.75 | 0.45 | 0.3 | 0.2 | 0.14 | 0.1 |
    | the same, mean FLIP | 0.78 | 0.75 | 0.57 | 0.42 | 0.32 | 0.24 | 0.2 |
    | built-in scenes, root mean square of linear light | 0.95 | 0.8 | 0.6 | 0.4 | 0.3 | 0.2 | 0.15 |
    | the same, mean FLIP | 1.3 | 0.85 | 0.7 | 0.5 | 0.43 | 0.32 | 0.27 |

    FLIP grows like the error to the power of 0.7. Above 1: fxaa takes fine details for stairs and softens them, so
    that pictures full of them look smoother, but not more like the truth.
    """

    rung: Literal[
        "off", "fxaa", "samples_2", "samples_3", "samples_4", "samples_5", "samples_6", "samples_7", "samples_8",
        "samples_10", "samples_12", "samples_14", "samples_16", "samples_20", "samples_24", "samples_28", "samples_32",
        "samples_40", "samples_48", "samples_56", "samples_64",
    ] = "off"  # fmt: skip
    """fxaa: one pass over the picture, 8 bytes a pixel, and 4 of memory; edges along an axis stay sharp, details that
    the pixels' centres miss stay missing. samples_N: N points in every pixel, well spread; time grows by what precedes
    the picture, in proportion to N, and memory does not."""


class BloomSettings(Record):
    """Light that the lens scatters around what is bright; how much is the camera's `bloom`.

    The lens takes the share s from the bright part b of every pixel's exposed radiance c and spreads it over the
    picture by a sum of Gaussians B, all of whose weights add up to 1: display shows c - s b + s B(b). With threshold 0
    b is all of c, and this is (1 - s) c + s B(c). Light is moved, not made; what would leave the picture is mirrored
    back at its edge.

    Errors against `exact` are stated for fireflies=0, as sums of absolute differences of B over the picture,
    divided by the sum of B: mip_chain at most 0.15, and nowhere more than 0.3 of the largest B; neighbourhood at most
    1.6 (2 would be light in wholly different places).
    """

    rung: Literal["off", "neighbourhood", "mip_chain", "exact"] = "mip_chain"
    """neighbourhood: mean of a square window at half size, which shows as a square around small lamps, two launches;
    mip_chain: a pyramid of half sizes, a third more pixels, two launches on CUDA; exact: every Gaussian summed at
    full size in float32, thousands of operations a pixel (reference)."""
    when: Literal["called_for", "always"] = "called_for"
    """called_for: where a camera's lens has bloom; always: wherever `display` is asked for."""
    threshold: float = Field(1.0, ge=0.0, le=65504.0)
    """Exposed radiance, taken of the brightest channel, above which light is scattered [1 is white]; 0: all light is,
    and the effect runs in every frame."""
    knee: float = Field(0.5, ge=0.0, le=1.0)
    """Half the width of the soft start around the threshold, as a share of it [1]; 0: a hard start. Free."""
    radius: float = Field(0.07, gt=0.0, le=0.5)
    """Standard deviation of the widest Gaussian of mip_chain and exact as a share of the picture's height [1]; rounded
    to the next level, each twice as wide as the one before. A doubling costs two steps over few pixels."""
    falloff: float = Field(0.7, gt=0.0, le=2.0)
    """Weight of each Gaussian in relation to the next narrower one [1]; the glow falls off like the distance to the
    power log2(falloff) - 2. Free."""
    fireflies: float = Field(16.0, ge=0.0, le=65504.0)
    """Exposed luminance at which a pixel counts half when neighbours are averaged first, so that a lone bright one does
    not flicker [1 is white]; what it counts less is lost. 0: plain averages. Not in exact. A division a pixel."""
    window: int = Field(3, ge=1, le=8)
    """neighbourhood: half the width of the window [2 px]; (2 window + 1) squared reads for every four pixels."""


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
    """Whether a map stays from frame to frame while neither its view nor a caster in it moves; no pixel differs. From
    sample to sample of one frame it stays in any case."""
    samples: int = Field(256, ge=1, le=2048)
    """Places on a light's disc that rung ray_traced looks at from each pixel; where neighbours see differently, 16 more
    between them. On a straight edge the root mean square error is at most 0.001 for 256, 0.003 for 64, 0.01 for 16;
    where the edge runs along the lattice, 31.7 degrees off the disc's axes, three times that. Time grows in proportion:
    1.4 rays a sample where a light is wholly seen or hidden, twice that in a penumbra."""


class BlurSettings(Record):
    """A Gaussian over the whole image, before exposure and tone mapping; `color` is the blurred image, too.

    Radiance is clamped to [0, 65504] before, and beyond its edge an image continues as it ends. A uniform image stays
    as it is to the bit.
    """

    rung: Literal["off", "gaussian"] = "off"
    """gaussian: two launches of 6 sigma_px + 1 taps each."""
    sigma_px: float = Field(2.0, ge=0.0, le=64.0)
    """Standard deviation [px of the rendered image, before up-scaling], 0 to 64; 0 changes nothing. Weights end at
    three of it. Time grows with it."""
    when: Literal["called_for", "always"] = "called_for"
    """always: be in the plan although `sigma_px` is 0; the image is then copied to the bit."""


class ScaleSettings(Record):
    """Render fewer pixels than are shown, and scale `display` up.

    Sides are rounded up to whole pixels, and the field of view stays. `display` keeps the renderer's size; every other
    output has a value for each rendered pixel, which is another number of pixels, and is refused. Settings in pixels
    (`blur.sigma_px`, light tiles) mean rendered ones. A uniform picture stays as it is to the bit, and no pixel leaves
    the range of the four rendered ones around it. Bound against `off`, filter `edge`, for pictures of 240 x 160 and
    more: RMSE of at most 10 codes at five_sixths, 12 at two_thirds and 18 at half with
    `anti_aliasing.rung=samples_16`. Without anti-aliasing the two pictures are jagged in different places, and nothing
    is promised.
    """

    rung: Literal["off", "half", "two_thirds", "five_sixths"] = "off"
    """Rendered share of each side: half is a quarter of the pixels, two_thirds four ninths of them, five_sixths seven
    tenths, off all."""
    filter: Literal["edge", "nearest"] = "edge"
    """edge: 16 pixels weighed along the edges they show; nearest: the pixel below, as debug views always do."""

    def rendered(self, length: int) -> int:
        """Rendered pixels of a side of that many shown ones."""
        parts = {"off": (1, 1), "half": (1, 2), "two_thirds": (2, 3), "five_sixths": (5, 6)}
        of, whole = parts[self.rung]
        return -(-of * length // whole)


class DepthOfFieldSettings(Record):
    """Blur of what lies before and behind the plane in focus, through the lens opening of a perspective camera.

    A thin lens of diameter A focused at f spreads a point at view depth z over a circle of A * s * |1/z - 1/f| pixels
    across, s being the projection's pixels per unit of x/z. `lens_samples` looks through points of that very lens; the
    rungs below it blur one image taken through its middle, so what that one does not see they have to guess.

    Error against `lens_samples`, as the root mean square difference of x / (1 + x) over a picture of circles of at most
    16 pixels radius: `gather` at most 0.025 and at most half of what `off` makes, `plane_lerp` at most 0.05 and less
    than `off`. (0.02 and 0.04 were stated first; the built-in scene `focus` came to 0.020 and 0.042 at 320 x 180, 0.019
    and 0.023 at 960 x 540, where `off` has 0.051 and 0.057.) A picture taken with anti-aliasing comes nearer.
    """

    rung: Literal["off", "plane_lerp", "gather", "lens_samples"] = "gather"
    """plane_lerp: mix with an equally blurred copy by distance from the plane in focus; gather: circles of confusion,
    what lies before the plane in focus apart from what lies behind it; lens_samples: so many views through points of
    the lens (reference), which costs so many frames. `gather` costs 1.3 images of memory: three layers and
    1.3 reduced images of a quarter of the pixels, and the circles."""
    when: Literal["called_for", "always"] = "called_for"
    """always: run although no camera has an aperture; changes no bit then. lens_samples takes no samples then."""
    max_radius_px: float = Field(32.0, ge=1.0, le=64.0)
    """Largest radius of a circle [px], 1 to 64; larger ones are drawn this large. Of gather; time grows slowly with
    it, for the taps of a large circle are taken from reduced images."""
    texels: int = Field(5, ge=2, le=8)
    """Texels from the middle of a circle to its rim, at most, 2 to 8: the least reduced image that allows it is read,
    about 3 n^2 texels for a circle of n. Of gather."""
    blur_radius_px: int = Field(8, ge=1, le=32)
    """Radius of the equal blur [px], 1 to 32; time grows with it. Of plane_lerp."""
    power: float | None = Field(None, ge=0.0, le=1e6)
    """Share of the blurred copy: power * |z - f| / z, at most 1; 0 to 1e6. None: 1 is reached where the lens's circle
    has the blur's radius. Of plane_lerp; a camera without an aperture stays sharp."""
    samples: Literal[4, 8, 16, 32, 64, 128, 256] = 64
    """Points of the lens. Of lens_samples; time grows with it, memory does not."""


class MotionBlurSettings(Record):
    """Blur of what moves, by itself or with the camera, while the shutter is open.

    The shutter closes at the frame's own time and opens a share `Camera.shutter` of a frame earlier. Poses in between
    are interpolated from those of the frame before: places along a line, rotations along the shortest arc. What is
    declared to move is told by `explain`: transforms or poses bound as device arrays, a scene that can be animated, or
    transforms or cameras that have changed between two frames of the renderer. Points bound to meshes are taken as
    they are. The first frame, and the first one of another plan, has no frame before: nothing moves in it.

    Error against `shutter_samples`, stated before it was measured, as the root mean square difference of x / (1 + x)
    over a picture of motions of at most 16 pixels: `velocity_gather` at most 0.03 and less than what `off` makes. (The
    built-in scene `motion` came to 0.012 at 640 x 360 with anti-aliasing, where `off` has 0.021.)
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
    samples: Literal[4, 8, 16, 32, 64, 128, 256] = 64
    """Times within the shutter's. Of shutter_samples; time grows with it, memory does not."""
