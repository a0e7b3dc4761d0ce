"""From the command line's texts to checked values; everything that can be wrong is found before any long work."""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .channels import OUTPUTS, check_outputs
from .checks import check_choice, check_range, input_error
from .debug_views import DEBUG_VIEWS
from .errors import DeviceError, LoadError
from .images import check_target

if TYPE_CHECKING:
    from .camera import Camera
    from .scene import Scene

__all__ = [
    "check_moves",
    "check_outs",
    "check_view",
    "check_wishes",
    "choose_camera",
    "choose_device",
    "frame_path",
    "parse_frames",
    "parse_layers",
    "parse_size",
    "parse_vector",
    "view_legend",
    "wanted_outputs",
]

_PLACEHOLDER = re.compile(r"%0?\d*d|\{frame(?::0?\d+d?)?\}")
_EXR_OUTPUTS = ("color", "alpha", "depth")
_MAX_SIZE = 16384


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) of a text such as 1280x720."""
    match = re.fullmatch(r"\s*(\d{1,9})\s*[xX]\s*(\d{1,9})\s*", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= n <= _MAX_SIZE for n in size):
        raise input_error("--size", f"WIDTHxHEIGHT, each from 1 to {_MAX_SIZE} px", text, "such as --size 1280x720")
    return size


def parse_vector(label: str, text: str) -> tuple[float, float, float]:
    """Return the three finite numbers of a text such as 0,1.5,4."""
    try:
        numbers = tuple(float(word) for word in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(math.isfinite(n) for n in numbers):
        raise input_error(label, "three finite numbers x,y,z [m]", text, f"such as {label}=0,1.5,4")
    return numbers


def parse_frames(text: str) -> range:
    """Return the frames of a text such as 0:120 (120 frames, 0 to 119)."""
    match = re.fullmatch(r"\s*(\d{1,9}):(\d{1,9})\s*", text)
    frames = range(int(match[1]), int(match[2])) if match else range(0)
    if not frames:
        raise input_error("--frames", "FIRST:END with END beyond FIRST", text, "0:120 gives the 120 frames 0 to 119")
    return frames


def parse_layers(text: str | None, *, label: str = "--layers") -> tuple[str, ...]:
    """Return the output names of a text such as normal,albedo."""
    if text is None:
        return ()
    return check_outputs(label, [word.strip() for word in text.split(",") if word.strip()])


def check_outs(outs: Sequence[str], *, moving: bool) -> list[Path]:
    """Return the files to write, each proved writable; with `moving` each name must have a place for the frame."""
    paths = []
    for out in outs:
        if moving and not _PLACEHOLDER.search(Path(out).name):
            stem, suffix = Path(out).stem, Path(out).suffix
            mend = f"such as {Path(out).with_name(f'{stem}.%04d{suffix}')}" if stem else ""
            raise input_error("--out", "a name with a place for the frame number (%d, %04d or {frame})", out, mend)
        paths.append(check_target(frame_path(out, 0) if moving else out))
    if len({path.absolute() for path in paths}) != len(paths):
        raise input_error("--out", "each file once", ", ".join(map(str, paths)), "leave the repeated one out")
    return [Path(out) for out in outs]


def frame_path(out: str | Path, frame: int) -> Path:
    """Put a frame number in the place a file name keeps for it: `%04d` or `{frame}` (also `{frame:04d}`)."""
    path = Path(out)

    def number(match: re.Match[str]) -> str:
        digits = re.search(r"\d+", match[0])
        if digits is None:
            return str(frame)
        return f"{frame:{digits[0]}d}"

    return path.with_name(_PLACEHOLDER.sub(number, path.name))


def wanted_outputs(paths: Sequence[Path], layers: Sequence[str]) -> tuple[str, ...]:
    """Return the outputs that the files need: a PNG the display, an EXR colour, alpha, depth and the layers."""
    suffixes = {path.suffix.lower() for path in paths}
    names: set[str] = set()
    if ".png" in suffixes:
        names.add("display")
    if ".exr" in suffixes:
        names.update(_EXR_OUTPUTS, layers)
    elif layers:
        raise input_error("--layers", "an .exr among the outputs to keep them", str(paths[0]), "add -o NAME.exr")
    unkept = [name for name in layers if not OUTPUTS[name].exr]
    if unkept:
        raise input_error("--layers", "outputs that an .exr keeps", unkept[0], "write a .png for the display")
    return tuple(name for name in OUTPUTS if name in names)


def check_view(name: str, outputs: Sequence[str]) -> str:
    """Return the name of a debug view that a .png is there to show."""
    check_choice("--view", name, [*DEBUG_VIEWS, "picture"])
    if "display" not in outputs:
        raise input_error("--view", "a .png among the outputs to show it", name, "add -o NAME.png")
    return name


def check_wishes(
    budget_ms: float | None,
    max_error: float | None,
    preset: str | None,
    view: str | None,
    outputs: Sequence[str],
) -> None:
    """Refuse budgets and errors that are no number above zero, and what cannot stand together with them."""
    wishes = {"--budget-ms": budget_ms, "--max-error": max_error}
    for label, value in wishes.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise input_error(label, "a number > 0", value, f"such as {label} {'1.0' if 'ms' in label else '0.02'}")
    given = [label for label, value in wishes.items() if value is not None]
    if given and preset is not None:
        raise input_error(
            "--preset", f"none beside {given[0]}", preset, "a budget chooses every rung that --set does not"
        )
    if given and "display" not in outputs:
        raise input_error(given[0], "a .png among the outputs", ", ".join(outputs), "add -o NAME.png")
    if given and view not in (None, "picture"):
        raise input_error("--view", f"none beside {given[0]}", view, "errors are those of the picture")


def view_legend(name: str) -> str:
    """Return what the colours of a debug view mean."""
    return f"{name}: {DEBUG_VIEWS[name].doc}" if name in DEBUG_VIEWS else "picture: exposed and tone mapped"


def choose_device(name: str | None) -> str:
    """Return the Warp device of that name, or cuda:0 if there is one and else cpu.

    Raises:
        DeviceError: If there is no such device.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR  # Warp's banner and remarks would mix with ours
    with _silent_stderr():
        wp.init()
    known = [str(device) for device in wp.get_devices()]
    if name is None:
        return "cuda:0" if "cuda:0" in known else "cpu"
    wanted = "cuda:0" if name == "cuda" else name
    if wanted not in known:
        raise DeviceError(
            f"--device: expected one of {', '.join(known)}, got {name!r}; leave it out to take the fastest there is"
        )
    return wanted


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Drop what native code writes to stderr: without a driver Warp says so there, past its own log level."""
    try:
        kept = os.dup(2)
    except OSError:  # no stderr at all
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        sys.stderr.flush()
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(nowhere)
        os.close(kept)


def parse_points(
    eye: str | None, target: str | None
) -> tuple[tuple[float, float, float] | None, tuple[float, float, float] | None]:
    """Return the points of --eye and --target, both or neither, before anything is loaded."""
    if (eye is None) != (target is None):
        missing = "--target" if target is None else "--eye"
        raise input_error(missing, "a point x,y,z beside the other one", "<nothing>", f"add {missing} x,y,z")
    if eye is None:
        return None, None
    return parse_vector("--eye", eye), parse_vector("--target", target)


def choose_camera(
    scene: Scene,
    name: str | None,
    eye: tuple[float, float, float] | None,
    target: tuple[float, float, float] | None,
    vertical_fov_deg: float | None,
    exposure: float | None,
) -> Camera:
    """Return the camera the options describe, starting from the scene's own."""
    from .camera import Camera

    camera = _named(scene, name) if name is not None else scene.camera or Camera()
    if vertical_fov_deg is not None:
        fov = math.radians(
            check_range("--vertical-fov-deg", vertical_fov_deg, 1e-3, 179.0, unit="degrees", mend="50 is usual")
        )
        camera = camera.replace(vertical_fov=fov, intrinsics=None, projection="perspective", near=_near(camera))
    if eye is not None:
        pose = Camera.look_at(eye, target)
        camera = camera.replace(position=pose.position, rotation=pose.rotation)
    return camera if exposure is None else camera.replace(exposure=exposure)


def _near(camera: Camera) -> float:
    """An orthographic near plane may lie at or behind the eye; a perspective one may not."""
    return camera.near if camera.near > 0.0 else 0.05


def _named(scene: Scene, name: str) -> Camera:
    cameras = scene.cameras
    names = [camera.name or str(i) for i, camera in enumerate(cameras)]
    if not cameras:
        raise input_error("--camera", "a scene with cameras", name, "use --eye and --target")
    if name in names:
        return cameras[names.index(name)]
    if name.isdigit() and int(name) < len(cameras):
        return cameras[int(name)]
    check_choice("--camera", name, [*dict.fromkeys([*names, *map(str, range(len(cameras)))])])
    raise AssertionError  # unreachable: check_choice raises for what is not listed


def check_moves(scene: Scene, source: str) -> None:
    """Refuse --frames for a scene that stands still."""
    if scene.animate is None:
        raise LoadError(
            f"{source}: expected a scene that moves for --frames, got one without animation; leave --frames out"
        )
