"""What docs/accuracy.md says of each stage in words: what is exact, what is bounded and why, what is only measured.

Figures that runs give stand in tables, not here; figures here are derived, or stated and held by the tests named.
"""

from __future__ import annotations

import dataclasses

__all__ = ["EVERYWHERE", "WORDS", "Words"]


@dataclasses.dataclass(frozen=True)
class Words:
    """What is known of a stage's accuracy.

    Attributes:
        exact: What is the same bits, or the same set, whatever the rung.
        bounded: What has a bound, with its derivation or source.
        measured: What has none.
    """

    exact: str
    bounded: str
    measured: str


EVERYWHERE = (
    "**Exact at every rung of every stage**: which pixels a triangle covers (integer edge functions on vertices "
    "snapped to 1/256 px, top-left rule: `tests/test_hard_cases_raster.py`), which triangle is seen (nearest depth, "
    "ties to the smaller id), all ids, light masks (a light may be tested in vain, never missed), and every result "
    "against order: of triangles, of host threads, of atomics, of views in a batch (`tests/test_invariance.py`). "
    "Modules are compiled without fused multiply-adds, but for lighting's where `shade.arithmetic` asks for them, so "
    "that `+ - * /` and square roots agree bit for bit between CPU and CUDA; `pow`, `exp` and `sin` may differ by 2 "
    "units in the last place, hardware texture filtering by about 1e-3 of the texels' contrast. Snapping itself moves "
    "a vertex by up to 1/512 px; attributes come from the "
    "unsnapped ones."
)

WORDS: dict[str, Words] = {
    "depth": Words(
        "Depth in the key and in the output is one float32 number, whatever lighting reads; which triangle is seen is "
        "decided by it. With `float32`, the default, it is the G-buffer's, too.",
        "The coarser formats: as in the next ladder, whose bounds hold for these scenes as well. `float32`: within a "
        "triangle depth is (e0 z0 + e1 z1 + e2 z2) / area from exact integer edge values and terms ≥ 0, so that "
        "nothing cancels: three conversions, products, sums, the reciprocal, its product and the division that makes "
        "metres of it are at most eight roundings of 2^-24 in sequence, 4.8e-7 of the depth. The vertices' own depths "
        "carry the rounding of their transform, 2^-24 of their distance from the eye a step.",
        "A few whole triangles are off by more, up to about 1e-4: presumably float32 rounds one of their vertices to "
        "the neighbouring 1/256 px, which moves depth by its slope there. Where pixels show another triangle than the "
        "twin's, they are left out and counted: `pixels.other` in the JSON.",
    ),
    "depth_format": Words(
        "The background, the near plane, and the order of depths: a nearer surface never comes back farther. Outputs, "
        "and effects that look at depth themselves (ambient visibility, depth of field, motion blur). Light masks miss "
        "no light: culling reads the codes that shading reads.",
        "Of z = near / depth unorm keeps L = 2^16 - 1 or 2^24 - 1 steps: off by at most the share depth / (2 L near) "
        "of the depth, and what is beyond 2 L near planes comes back at L of them. ufloat16 keeps 12 significant bits "
        "of z: 2^-12 / (1 - 2^-12), 2.45e-4 of the depth, anywhere (`tests/kernels/test_depth_encoding.py`). Shadow "
        "look-ups lift a point by what this may be off its plane, so that planes do not shadow themselves at any "
        "format (`test_s1_a_lit_plane_does_not_shadow_itself`).",
        "The picture, with shadow maps on: a point that is lifted farther moves the edges of shadows by as much. What "
        "the format saves is memory traffic, 2 bytes a pixel of 16 at 16 bits and none at 24; where ambient visibility "
        "runs, as it does by default under ambient light, float32 is stored beside it and nothing is saved.",
    ),
    "arithmetic": Words(
        "Which lights are summed and in which order.",
        "A closed form (a Lambertian plane under one light) is met within 1e-5 of the radiance, a white furnace within "
        "1e-6 (`tests/test_analytic.py`).",
        "The whole chain from vertices to radiance. At `full` what is left is float32 arithmetic and the snap of "
        "vertices, through positions that are rebuilt from depth; `fused`, `fast` and `half_sums` are `full` but for "
        "that one thing; at `compact` it is the 8-bit square roots of albedo. In `hundred_lights` a lamp hangs 16 cm "
        "off polished metal: a millimetre of depth moves its highlight, and one pixel carries nearly all of the error "
        "at every rung.",
    ),
    "fast_math": Words(
        "Everything but lighting: coverage, ids, depth, masks, all other passes; and which lights reach a pixel's "
        "tile. Repeats on one device.",
        "Nothing as a whole. A fused product and sum rounds once, not twice. Fast operations have bounds of their own: "
        "division within 2 units in the last place, square roots within 3 (CUDA Programming Guide, mathematical "
        "functions), but a power goes through a logarithm whose absolute error an exponent of thousands multiplies.",
        "The radiance that comes of it. Warp hands fast arithmetic to CUDA alone, and its CPU compiler fused nothing "
        "where it was tried: there the rungs are the same bits, and times differ by noise "
        "(`tests/passes/test_precision.py`).",
    ),
    "accumulation": Words(
        "Which lights are summed and in which order; a sum of `float32` is not rounded to half before the last light.",
        "Light is never negative, so that every partial sum is at most the whole one, and each rounding moves it by at "
        "most 2^-11 of that or, below 2^-14, by 2^-25: n lights that arrive, n times as much "
        "(`test_half_sums_are_off_by_what_rounding_each_light_may_move`). A light of less than 2^-12 of the sum so far "
        "is lost. Sums end at 65504.",
        "The picture. Roundings of many lights mostly cancel. Sums stay in registers here, where halves save nothing; "
        "a renderer that adds light by light into a render target halves the target's traffic.",
    ),
    "normals": Words(
        "A zero or non-finite normal is stored as +Z; the axes come back exactly from the octahedral codecs.",
        "Largest angle by plain rounding: oct16 0.940°, oct24 0.0583°, oct32 0.00359° (Cigolle et al. 2014, JCGT 3-2; "
        "measured over dense sets and held within 2 % by `tests/kernels/test_encoding.py`). rgb8: half a step in each "
        "of three components, √3 · 0.5 / 127 = 0.391°. xy16: z is rebuilt from 1 - x² - y², whose error is that of x "
        "and y, so that at the horizon the angle is its root: √(2 · hypot(0.5 / 16383, 0.5 / 32767)) = 0.474°, and "
        "below 0.004° away from it.",
        "What an angle does to radiance depends on the highlight's width. Boxes have normals that most codecs store "
        "exactly: `many_lights` shows no error at all.",
    ),
    "gbuffer": Words(
        "Depth, ids and emitted radiance are the same at both rungs.",
        "`compact` rounds the square root of albedo to 8 bits: at most √a / 255 + 1 / 260100 off for an albedo a. "
        "Roughness, metalness and occlusion are off by at most 1 / 510; exponents of Phong by 1.8 % (256 steps over 13 "
        "octaves). Normals as in the ladder above, `oct24` by default.",
        "The radiance that comes of it; errors of more than the picture's mean are highlights that move by a fraction "
        "of their width.",
    ),
    "radiance": Words(
        "`color` as an output is float32 whatever the rung.",
        "Half has 11 significant bits: |error| ≤ 2^-11 · radiance + 2^-25, radiance clamped to 65504; at most 1 code "
        "of `display` (`test_half_radiance_stays_within_half_precision`).",
        "Nothing.",
    ),
    "tile_size": Words(
        "All of it: every tile size gives the same bits, by design. Lights are summed in one order, a light that "
        "reaches a pixel is in its tile's mask, one that does not adds nothing. The error below is 0, not small "
        "(`test_c1_tiles_give_the_bits_of_brute_force`).",
        "Nothing needs a bound.",
        "Time alone.",
    ),
    "light_culling": Words(
        "All of it: `tiles` and `tiles_depth` give the bits of `brute_force`, by the same test.",
        "Nothing needs a bound; spheres are inflated by the bound of their own rounding, so that no light is missed.",
        "Time alone.",
    ),
    "shadow": Words(
        "A plane alone never shadows itself at any angle; a light that casts nothing changes no bit.",
        "As stated in the settings, quoted below. The edge of a shadow is off by at most k t sin a for texels of size "
        "t and an angle a between the normal and the map's axis (`kernels/shadow_lookup.py` derives it).",
        "The mean over a picture: it depends on how much of it is penumbra. In `corner` the light casts for this "
        "ladder alone. `pcf` widens every edge by texels and may be farther from the truth than `hard` where texels "
        "are larger than penumbrae. `ray_traced` samples the light's disc; its own standard error stands behind ± in "
        "the table.",
    ),
    "ambient_visibility": Words(
        "Any plane has visibility exactly 1 at the gtao rungs; the background too.",
        "As stated in the settings, quoted below, over the scene `corner` at its own size. There is no bound for any "
        "scene: what the camera does not see blocks nothing at the rungs below `ray_traced`.",
        "Every other scene. The reference casts 256 rays a pixel, and its standard error stands behind ±.",
    ),
    "bloom": Words(
        "Weights add up to 1: light is moved, not made. A picture without anything above the threshold keeps its bits.",
        "As stated in the settings, quoted below, for `fireflies=0`, which is held here.",
        "The picture; here all light scatters (`bloom.threshold=0`), which is the hard case. The reference is a sum of "
        "Gaussians cut off at five standard deviations, in float32: it does not sample.",
    ),
    "anti_aliasing": Words(
        "One sample is `off` to the bit. Ids and depth stay those of the pixel's centre.",
        "As stated in the settings, quoted below, against 256 samples.",
        "FLIP of `fxaa` may exceed that of `off` where a scene is full of details. The reference is the highest rung, "
        "64 samples, whose own error stands behind ±.",
    ),
    "scale": Words(
        "A uniform picture stays as it is to the bit; no pixel leaves the range of the four rendered ones around it.",
        "As stated in the settings, quoted below, with 16 samples. Here four are taken at every rung, so that the "
        "pictures are not jagged in different places.",
        "Codes of `display`.",
    ),
    "depth_of_field": Words(
        "Without an aperture nothing changes to the bit.",
        "As stated in the settings, quoted below, for circles of at most 16 pixels radius. It does not hold for every "
        "picture: small ones taken without anti-aliasing, as those of a CPU here, may exceed it, since `lens_samples` "
        "smooths edges out of focus that one view leaves jagged. The table is what was measured.",
        "What one view through the middle of the lens does not see has to be guessed. The reference takes 64 points of "
        "the lens, and small bright things show them: mind its own error behind ±.",
    ),
    "motion_blur": Words(
        "Where nothing moves nothing changes to the bit.",
        "As stated in the settings, quoted below, for motions of at most 16 pixels.",
        "Fast rotation, and what a moving thing uncovers. `shutter_samples` shares the frame's shadow maps among its "
        "samples, and so it does for the reference.",
    ),
}  # fmt: skip
