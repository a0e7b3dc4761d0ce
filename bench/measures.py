"""Natural units of the errors of stages: what is compared with the reference rung, over which pixels, in which unit.

Each measure takes what the stage made at a rung, at the reference, and at rung `off` where the ladder has one, and
gives an error for each pixel it is about. What is float32 is compared as such: a million pixels at a time are many for
one host thread.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from warp_deferred.errors import Error
from warp_deferred.plan import Plan

from .decoding import gbuffer_depth, gbuffer_normals

__all__ = ["MEASURES", "WINDOW", "Measure", "decoded", "picture_errors", "scattered", "stage_errors", "stored"]

#: Part of the picture FLIP is taken of [px]: it needs a second for a million pixels.
WINDOW = (640, 360)
#: Codes of `display` -> linear light (IEC 61966-2-1).
_CODES = np.arange(256) / 255.0
DECODED = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)

Values = np.ndarray
#: Errors of pixels, from those of a rung, of the reference and of `off`.
Errors = Callable[[Values, Values, Values | None], Values]


@dataclasses.dataclass(frozen=True)
class Measure:
    """How a stage's own error is taken.

    Attributes:
        unit: Unit, as a column's title.
        text: What it is, in a sentence.
        errors: Errors of pixels.
        threshold: Error above which a pixel counts into the share that is off, in the unit.
        output: Output of the renderer that is compared, and of the twin; empty: the picture, or what `channel` reads.
        channel: Reads what is compared from a plan after its frame, in place of the output.
        absent: What the output is everywhere at rung `off`, where it cannot be asked for; None: it can.
    """

    unit: str
    text: str
    errors: Errors
    threshold: float
    output: str = ""
    channel: Callable[[Plan], Values] | None = None
    absent: float | None = None


def decoded(picture: np.ndarray) -> np.ndarray:
    """Linear light of a picture's R, G and B."""
    return DECODED[picture[..., :3]]


def stored(plan: Plan) -> np.ndarray:
    """Radiance as the plan keeps it between shade and display, half or float32; (pixels, 3)."""
    channels = plan.resources.channels
    if "color" in channels:
        return channels["color"].numpy().reshape(-1, 3).copy()
    return channels["radiance"].numpy().view(np.float16).reshape(-1, 4)[:, :3].astype(np.float32)


def scattered(plan: Plan) -> np.ndarray:
    """Light that bloom scatters to each pixel of the first view, as display reads it; zeros without bloom."""
    size = plan.request.sizes[0]
    stage = next((s for s in plan.passes if s.name == "bloom"), None)
    if stage is None:
        return np.zeros((size.height, size.width, 3), np.float32)
    texels = plan.resources.channels["bloom"].numpy()
    if stage.rung() == "exact":
        return texels[: size.width * size.height].reshape(size.height, size.width, 3).copy()
    row = stage.pyramid.rows[0]
    first, width, height = (int(row[name]) for name in ("first", "width", "height"))
    level = texels[first : first + width * height].view(np.float16).reshape(height, width, 4)[..., :3]
    return _enlarged(level.astype(np.float32), size.height, size.width)


def _enlarged(level: np.ndarray, height: int, width: int) -> np.ndarray:
    """A level of half the size at every pixel, bilinearly, held at the border."""
    for axis, length in enumerate((height, width)):
        place = np.clip((np.arange(length) + 0.5) / 2.0 - 0.5, 0.0, level.shape[axis] - 1.0)
        low = np.floor(place).astype(int)
        high = np.minimum(low + 1, level.shape[axis] - 1)
        share = (place - low).astype(np.float32).reshape(-1, *[1] * (2 - axis))
        level = level.take(low, axis) * (1.0 - share) + level.take(high, axis) * share
    return level


def _degrees(actual: Values, reference: Values, off: Values | None) -> Values:
    """Angle between unit normals [degrees], over pixels that show a surface; the arc tangent keeps small ones."""
    surface = (reference != 0.0).any(axis=-1)
    a, b = actual[surface].astype(np.float64), reference[surface].astype(np.float64)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))


def _relative_depth(actual: Values, reference: Values, off: Values | None) -> Values:
    both = np.isfinite(actual) & np.isfinite(reference)
    return np.abs(actual[both].astype(np.float64) - reference[both]) / reference[both]


def _relative(actual: Values, reference: Values, off: Values | None) -> Values:
    """Differences as shares of the reference's mean over the picture."""
    scale = float(np.mean(reference, dtype=np.float64))
    return np.abs(actual - reference) / np.float32(scale if scale > 0.0 else 1.0)


def _absolute(actual: Values, reference: Values, off: Values | None) -> Values:
    return np.abs(actual - reference)


def _direct(actual: Values, reference: Values, off: Values | None) -> Values:
    """Share of direct diffuse light that arrives, over pixels that some light reaches; unshadowed light is `off`'s."""
    light = off.sum(axis=-1, dtype=np.float64)
    lit = light > 0.01 * light.mean()
    return (
        np.abs(actual.sum(axis=-1, dtype=np.float64)[lit] - reference.sum(axis=-1, dtype=np.float64)[lit]) / light[lit]
    )


def _compressed(actual: Values, reference: Values, off: Values | None) -> Values:
    a, b = (np.maximum(image, np.float32(0.0)) for image in (actual, reference))
    return np.abs(a / (1.0 + a) - b / (1.0 + b))


def _light(actual: Values, reference: Values, off: Values | None) -> Values:
    return np.abs(decoded(actual) - decoded(reference))


def _codes(actual: Values, reference: Values, off: Values | None) -> Values:
    return np.abs(actual[..., :3].astype(np.float32) - reference[..., :3])


#: Measures by name.
MEASURES: dict[str, Measure] = {
    "relative_depth": Measure("share of the depth", "Difference of view depths, as `shade` reads them, over the depth.",
                              _relative_depth, 1e-5, "depth", channel=gbuffer_depth),
    "relative_radiance": Measure("share of mean radiance", "Difference of linear radiance over the picture's mean.",
                                 _relative, 0.01, "color"),
    "exact_radiance": Measure("share of mean radiance", "Difference of linear radiance over the picture's mean: 0.",
                              _relative, 0.0, "color"),
    "stored_radiance": Measure("share of mean radiance", "Difference of radiance as `display` finds it, over its mean.",
                               _relative, 0.01, channel=stored),
    "degrees": Measure("degrees", "Angle between normals as `shade` reads them.", _degrees, 0.1,
                       channel=gbuffer_normals),
    "direct_visibility": Measure("visibility", "Share of direct diffuse light that arrives, over lit pixels.", _direct,
                                 0.1, "diffuse"),
    "visibility": Measure("visibility", "Difference of ambient visibility.", _absolute, 0.1, "ambient_visibility",
                          absent=1.0),
    "scattered_light": Measure("share of mean light", "Difference of scattered light over its mean.", _relative, 0.1,
                               channel=scattered),
    "compressed_radiance": Measure("x / (1 + x) of radiance", "Difference of x / (1 + x) of linear radiance.",
                                   _compressed, 0.05, "color"),
    "display_light": Measure("linear light", "Difference of `display`, decoded to linear light.", _light, 0.05),
    "codes": Measure("codes of 255", "Difference of `display` in 8-bit codes.", _codes, 8.0),
}  # fmt: skip


def stage_errors(measure: Measure, actual: Values, reference: Values, off: Values | None) -> dict[str, float]:
    """Errors of a stage alone: `rmse`, `max`, and in `off_share` the pixels that are off by more than the threshold.

    Raises:
        Error: If an error is not finite.
    """
    if np.array_equal(actual, reference):
        return {"rmse": 0.0, "max": 0.0, "off_share": 0.0}
    errors = measure.errors(actual, reference, off)
    if not np.isfinite(errors).all():
        count = int((~np.isfinite(errors)).sum())
        raise Error(f"errors in {measure.unit}: expected finite ones, got {count} that are not; look at the output")
    return {
        "rmse": _digits(np.sqrt(np.mean(np.square(errors), dtype=np.float64))),
        "max": _digits(errors.max()),
        "off_share": _digits(np.mean(errors > measure.threshold)),
    }


def picture_errors(actual: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Errors of `display` in [0, 1]: `rmse` and `max` over the whole picture, `flip` over `WINDOW` in its middle.

    Args:
        actual: Picture (height, width, 4) uint8.
        reference: The reference rung's.
    """
    from warp_deferred.compare import compare

    if np.array_equal(actual[..., :3], reference[..., :3]):
        return {"rmse": 0.0, "max": 0.0, "flip": 0.0}
    apart = np.abs(actual[..., :3].astype(np.int16) - reference[..., :3])
    row = {"rmse": _digits(np.sqrt(np.mean(np.square(apart, dtype=np.int32), dtype=np.float64)) / 255.0)}
    row["max"] = _digits(apart.max() / 255.0)
    (height, width), (w, h) = actual.shape[:2], WINDOW
    y, x = max(0, (height - h) // 2), max(0, (width - w) // 2)
    pieces = [image[y : y + h, x : x + w] for image in (actual, reference)]
    if np.array_equal(pieces[0][..., :3], pieces[1][..., :3]):
        return row | {"flip": 0.0}
    flip = compare(*[{n: piece[..., k] for k, n in enumerate("RGB")} for piece in pieces]).flip
    return row | ({} if flip is None else {"flip": _digits(flip)})


def _digits(value: Any) -> float:
    """Four significant digits."""
    return float(f"{float(value):.4g}")
