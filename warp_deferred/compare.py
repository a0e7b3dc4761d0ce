"""Compare two images: finiteness first, then errors per channel, FLIP, and a picture of the difference.

Order matters: FLIP takes NaN for black and OpenImageIO's own comparison lets NaN and infinities pass, so an image that
holds what it must not fails before any error is averaged. Ids must agree exactly; other channels may differ by
`threshold` at every pixel and by more at a share `tolerance` of the pixels.

FLIP (Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images"; for linear radiance HDR-FLIP,
Andersson et al. 2021) comes from OpenImageIO; on 8-bit pictures it agrees with the authors' evaluator.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from .channels import ID_CHANNELS
from .checks import check_range, input_error
from .images import read_image, write_png

__all__ = ["ChannelDifference", "Comparison", "compare", "difference_picture", "write_difference"]

Part = Mapping[str, np.ndarray]

COLOR = ("R", "G", "B")
FLIP_LIMIT = 1 << 26
"""Pixels above which FLIP is left out: it needs about 200 bytes for each."""


@dataclass(frozen=True)
class ChannelDifference:
    """How one channel of one part differs. Errors of 8- and 16-bit codes are shares of the full range."""

    part: int
    """Index of the part (view)."""
    name: str
    """Name of the channel."""
    exact: bool
    """Whether it holds ids, where any difference counts."""
    max_error: float
    """Largest absolute difference over pixels finite in both; for ids 1 where any differs, else 0."""
    rmse: float
    """Root of the mean squared difference; for ids of the indicator of being different."""
    psnr: float
    """20 log10(peak / rmse) [dB]; peak is 1 for codes and ids, else the reference's largest absolute value."""
    share_over: float
    """Share of pixels that differ by more than the threshold (ids: at all), or differ in being finite."""
    worst: tuple[int, int]
    """(x, y) of the largest difference [px]."""


@dataclass(frozen=True)
class Comparison:
    """The result of `compare`."""

    channels: list[ChannelDifference]
    """Every channel of every part."""
    problems: list[str]
    """NaN, infinities out of place, ids that differ: each alone makes the comparison fail."""
    threshold: float
    """Largest absolute difference a pixel may have."""
    tolerance: float
    """Share of pixels that may differ by more."""
    flip: float | None
    """Mean FLIP error of the colour, worst part: 0 equal, 1 as different as can be; None: see `flip_note`."""
    flip_note: str
    """Which FLIP it is, or why there is none."""
    share_over: float
    """Share of pixels with any channel over its threshold, worst part."""
    max_error: float = field(default=0.0)
    """Largest `max_error` of all channels but ids."""
    rmse: float = field(default=0.0)
    """Largest `rmse` of all channels but ids."""
    psnr: float = field(default=math.inf)
    """Smallest `psnr` of all channels but ids [dB]."""

    @property
    def ok(self) -> bool:
        """Whether the images agree within the tolerances."""
        return not self.problems and self.share_over <= self.tolerance

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinite decibels become None."""
        result = asdict(self) | {"ok": self.ok}
        for row in (result, *result["channels"]):
            row["psnr"] = row["psnr"] if math.isfinite(row["psnr"]) else None
        return result


def compare(
    actual: Part | Sequence[Part] | str | os.PathLike[str],
    reference: Part | Sequence[Part] | str | os.PathLike[str],
    *,
    threshold: float = 0.0,
    tolerance: float = 0.0,
    flip: bool = True,
) -> Comparison:
    """Compare an image with a reference.

    Args:
        actual: A file, or channel name to array (height, width), or one such mapping per part.
        reference: What it should be, in the same form.
        threshold: Largest absolute difference a pixel may have, in the channel's unit; of codes in [0, 1].
        tolerance: Share of pixels that may exceed it, in [0, 1]. Ids have neither.
        flip: Whether to compute FLIP.

    Raises:
        InputError: If parts, channels or sizes differ, or a number is out of range.
        LoadError: If a file cannot be read.
    """
    threshold = check_range("compare.threshold", threshold, 0.0, mend="use 0 for exact equality")
    tolerance = check_range("compare.tolerance", tolerance, 0.0, 1.0, mend="a share: 0.001 allows one pixel in 1000")
    first, second = _parts("compare.actual", actual), _parts("compare.reference", reference)
    if len(first) != len(second):
        raise input_error("compare", f"{len(second)} parts as in the reference", f"<{len(first)} parts>")
    rows: list[ChannelDifference] = []
    problems: list[str] = []
    shares, flips, notes = [0.0], [], []
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        _same_layout(index, a, b)
        over = np.zeros(next(iter(a.values())).shape, bool)
        for name in a:
            row, wrong = _channel(index, name, a[name], b[name], threshold, problems)
            rows.append(row)
            over |= wrong
        shares.append(float(over.mean()))
        if flip:
            value, note = _flip(a, b)
            flips += [] if value is None else [value]
            notes.append(note)
    inexact = [row for row in rows if not row.exact]
    return Comparison(
        channels=rows,
        problems=problems,
        threshold=threshold,
        tolerance=tolerance,
        flip=max(flips) if flips and len(flips) == len(first) else None,
        flip_note=next((n for n in notes if n.startswith("no ")), notes[0]) if notes else "not asked for",
        share_over=max(shares),
        max_error=max((row.max_error for row in inexact), default=0.0),
        rmse=max((row.rmse for row in inexact), default=0.0),
        psnr=min((row.psnr for row in inexact), default=math.inf),
    )


def _parts(label: str, image: Any) -> list[dict[str, np.ndarray]]:
    if isinstance(image, (str, os.PathLike)):
        return read_image(image)
    parts = [image] if isinstance(image, Mapping) else list(image)
    result = [{name: np.asarray(array) for name, array in part.items()} for part in parts]
    for part in result:
        for name, array in part.items():
            if array.ndim != 2 or not array.size or array.dtype.kind not in "fiu":
                got = f"<{array.dtype} array of shape {array.shape}>"
                raise input_error(f"{label}[{name!r}]", "numbers of shape (height, width)", got)
    if not result or not all(result):
        raise input_error(label, "at least one part with one channel", "<none>")
    return result


def _same_layout(index: int, a: Part, b: Part) -> None:
    """Refuse parts whose channels, sizes or kinds of number differ."""
    if set(a) != set(b):
        lacks, extra = sorted(set(b) - set(a)), sorted(set(a) - set(b))
        words = [f"without {', '.join(lacks)}"] if lacks else []
        words += [f"with {', '.join(extra)} beside"] if extra else []
        raise input_error(
            f"compare part {index}",
            f"the reference's channels {', '.join(b)}",
            f"<{' and '.join(words)}>",
            "write both images with the same --layers",
        )
    size = {array.shape for array in (*a.values(), *b.values())}
    if len(size) != 1:
        shape_a, shape_b = next(iter(a.values())).shape, next(iter(b.values())).shape
        raise input_error(
            f"compare part {index}",
            f"the reference's size {shape_b[1]}x{shape_b[0]}",
            f"<{shape_a[1]}x{shape_a[0]}>",
            "render both at the same --size",
        )
    for name in a:
        if _scale(a[name]) != _scale(b[name]) or _is_id(name, a[name]) != _is_id(name, b[name]):
            raise input_error(
                f"compare part {index} channel {name}",
                f"numbers of the reference's kind {b[name].dtype}",
                f"<{a[name].dtype}>",
                "compare files of one type",
            )


def _scale(array: np.ndarray) -> float:
    """Return what brings 8- and 16-bit codes to [0, 1]."""
    return {np.dtype(np.uint8): 1.0 / 255.0, np.dtype(np.uint16): 1.0 / 65535.0}.get(array.dtype, 1.0)


def _is_id(name: str, array: np.ndarray) -> bool:
    return name in ID_CHANNELS or (array.dtype.kind in "iu" and array.dtype.itemsize > 2)


def _channel(
    part: int, name: str, a: np.ndarray, b: np.ndarray, threshold: float, problems: list[str]
) -> tuple[ChannelDifference, np.ndarray]:
    """Compare one channel; adds to `problems`, and returns the mask of pixels over the threshold as well."""
    exact = _is_id(name, a)
    if exact:
        error = (a != b).astype(np.float64)
        wrong = error > 0.0
        if wrong.any():
            y, x = np.argwhere(wrong)[0]
            problems.append(
                f"{name}, part {part}: {int(wrong.sum())} ids differ, first at pixel ({x}, {y}): {a[y, x]}, "
                f"reference {b[y, x]}"
            )
        peak = 1.0
    else:
        wide_a, wide_b = a.astype(np.float64) * _scale(a), b.astype(np.float64) * _scale(b)
        _finiteness(part, name, wide_a, wide_b, problems)
        both = np.isfinite(wide_a) & np.isfinite(wide_b)
        error = np.zeros(a.shape)
        error[both] = np.abs(wide_a[both] - wide_b[both])
        # Equal infinities agree; NaN, or infinity against a number, is over any threshold.
        wrong = np.where(both, error > threshold, wide_a != wide_b)
        peak = float(np.abs(wide_b[np.isfinite(wide_b)]).max(initial=0.0)) if a.dtype.kind == "f" else 1.0
    rmse = float(np.sqrt(np.mean(error**2)))
    psnr = 20.0 * math.log10((peak or 1.0) / rmse) if rmse > 0.0 else math.inf
    y, x = np.unravel_index(int(np.argmax(error)), error.shape)
    row = ChannelDifference(part, name, exact, float(error.max()), rmse, psnr, float(wrong.mean()), (int(x), int(y)))
    return row, wrong


def _finiteness(part: int, name: str, a: np.ndarray, b: np.ndarray, problems: list[str]) -> None:
    """Note NaN and infinities; only `Z` may hold +inf (the background), at the same pixels in both."""
    for label, array in (("image", a), ("reference", b)):
        for kind, mask in (
            ("NaN", np.isnan(array)),
            ("infinite", np.isinf(array) & ((array < 0.0) | (name != "Z"))),
        ):
            if mask.any():
                y, x = np.argwhere(mask)[0]
                problems.append(f"{name}, part {part}: {int(mask.sum())} {kind} in the {label}, first at ({x}, {y})")
    if name == "Z":
        differ = (a == np.inf) != (b == np.inf)
        if differ.any():
            y, x = np.argwhere(differ)[0]
            problems.append(
                f"Z, part {part}: {int(differ.sum())} pixels are background in one image only, first at ({x}, {y})"
            )


def _flip(a: Part, b: Part) -> tuple[float | None, str]:
    """Return the mean FLIP error of R, G, B and which kind it is, or None and why."""
    import OpenImageIO as oiio

    if not all(name in a for name in COLOR):
        return None, "no colour channels R, G, B"
    if not all(np.isfinite(part[name]).all() for part in (a, b) for name in COLOR):
        return None, "no FLIP of colour that is not finite"
    if a["R"].size > FLIP_LIMIT:
        return None, f"no FLIP above {FLIP_LIMIT} pixels"
    if not hasattr(oiio.ImageBufAlgo, "FLIP_diff"):
        return None, "no FLIP in this OpenImageIO; 3.2 has it"
    hdr = a["R"].dtype.kind == "f"
    buffers = []
    for part in (b, a):  # the reference comes first
        pixels = np.stack([part[name] for name in COLOR], axis=-1)
        pixels = pixels.astype(np.float32) if hdr else _linear(pixels * _scale(part["R"]))
        buffer = oiio.ImageBuf(oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "float"))
        buffer.set_pixels(buffer.roi, np.ascontiguousarray(pixels))
        buffers.append(buffer)
    result = oiio.ImageBufAlgo.FLIP_diff(buffers[0], buffers[1], int(hdr))
    if result.has_error:
        return None, f"no FLIP: {result.geterror()}"
    return float(result.get_pixels("float").mean(dtype=np.float64)), "HDR-FLIP of linear R G B" if hdr else "FLIP"


def _linear(encoded: np.ndarray) -> np.ndarray:
    """Decode sRGB (IEC 61966-2-1), which is what OpenImageIO's FLIP expects."""
    low, high = encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)


def difference_picture(actual: Part, reference: Part, gain: float | None = None) -> tuple[np.ndarray, float]:
    """Show where two parts differ: absolute difference times gain, as a picture.

    Args:
        actual: One part, channel name to array.
        reference: One part of the same channels and sizes.
        gain: Factor; left out, the power of two that brings the largest difference just under 1.

    Returns:
        Codes of shape (height, width, 3), uint8, and the gain. Colour shows as colour; of other channels, and of
        parts without colour, the largest relative difference shows as grey. What is not finite, or differs in an id,
        shows as magenta.
    """
    _same_layout(0, actual, reference)
    names = [name for name in COLOR if name in actual]
    rest = [name for name in actual if name not in COLOR]
    shape = next(iter(actual.values())).shape
    error, wrong = np.zeros((*shape, 3)), np.zeros(shape, bool)
    for name in (*names, *rest):
        a, b = actual[name], reference[name]
        if _is_id(name, a):
            wrong |= a != b
            continue
        wide_a, wide_b = a.astype(np.float64) * _scale(a), b.astype(np.float64) * _scale(b)
        both = np.isfinite(wide_a) & np.isfinite(wide_b)
        wrong |= ~both & ~(wide_a == wide_b)
        difference = np.zeros(shape)
        difference[both] = np.abs(wide_a[both] - wide_b[both])
        if name in names and len(names) == 3:
            index = COLOR.index(name)
            error[..., index] = np.maximum(error[..., index], difference)
        else:
            peak = float(np.abs(wide_b[both]).max(initial=0.0)) or 1.0
            error = np.maximum(error, (difference / peak)[..., None])
    if gain is None:
        largest = float(error.max())
        gain = 2.0 ** math.floor(-math.log2(largest)) if largest > 0.0 else 1.0
    else:
        gain = check_range("difference.gain", gain, 0.0)
    codes = (np.clip(error * gain, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    codes[wrong] = (255, 0, 255)
    return codes, gain


def write_difference(
    path: str | os.PathLike[str],
    actual: Part | str | os.PathLike[str],
    reference: Part | str | os.PathLike[str],
    gain: float | None = None,
) -> float:
    """Write `difference_picture` of all parts side by side as a PNG and return its gain.

    Raises:
        InputError: If the images' layouts differ.
        LoadError: If a file cannot be read or written.
    """
    first, second = _parts("difference.actual", actual), _parts("difference.reference", reference)
    if len(first) != len(second):
        raise input_error("difference", f"{len(second)} parts as in the reference", f"<{len(first)} parts>")
    pictures = [difference_picture(a, b, gain) for a, b in zip(first, second, strict=True)]
    # One gain for all views: the smallest, at which none saturates.
    common = min(g for _, g in pictures)
    if len({g for _, g in pictures}) > 1:
        pictures = [difference_picture(a, b, common) for a, b in zip(first, second, strict=True)]
    write_png(path, np.concatenate([codes for codes, _ in pictures], axis=1))
    return common
