"""Bench `host`: what one `render` with a new camera costs the thread that calls it."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Renderer, Settings, load

from .cases import frame_cases
from .probe import open_scene, plan_of
from .record import Record
from .timing import Timing, time_calls

__all__ = ["run"]

CALLS = 1000
QUICK_CALLS = 20
#: Frames queued before the device is waited for, outside the clock, in the figures that say so.
AHEAD = 3


def run(device: wp.Device, *, quick: bool, settings: Settings, note: Any) -> Record:
    """Time calls of `render` on the first frame case.

    On CUDA a call queues an upload and a graph; on the CPU it renders the frame, so that the figure is the frame's.

    Args:
        device: Where to run.
        quick: A small case and few calls.
        settings: Settings.
        note: Function of a text that tells how far it is.
    """
    case = frame_cases(device.is_cuda, quick=quick)[0]
    note(case.title)
    scene = load(case.source)
    renderer = open_scene(scene, (case.width, case.height), device, ("display",))
    plan_of(renderer, settings)
    calls = QUICK_CALLS if quick else CALLS if device.is_cuda else 100
    eyes = [_eye(k) for k in range(calls)]
    cameras = [_look(eye) for eye in eyes]
    for camera in cameras[:10]:
        renderer.render(camera)
    wp.synchronize_device(device)
    figures = {
        "render": (
            "`render(camera)`, a new camera each call",
            time_calls(device, lambda k: renderer.render(cameras[k]), calls),
        ),
        "render_free_device": (
            f"the same, device waited for after every {AHEAD} calls",
            time_calls(device, lambda k: renderer.render(cameras[k]), calls, ahead=AHEAD),
        ),
        "look_at_render": (
            "`render(Camera.look_at(...))`, the camera made in the call",
            time_calls(device, lambda k: renderer.render(_look(eyes[k])), calls),
        ),
        "back_to_back": (
            "time of a frame in a long row of them",
            _back_to_back(renderer, cameras, device),
        ),
    }
    shared = {"case": case.name, "title": case.title, "width": case.width, "height": case.height}
    rows = [shared | {"figure": n, "text": text} | _metrics(timing) for n, (text, timing) in figures.items()]
    return {"rows": rows}


def _eye(k: int) -> tuple[float, float, float]:
    """A point on a small circle around the case's own eye, never the same twice."""
    angle = 2.0 * math.pi * k / CALLS
    return (0.5 * math.sin(angle), 3.0 + 0.1 * math.cos(angle), 9.0)


def _look(eye: tuple[float, float, float]) -> Camera:
    return Camera.look_at(eye, (0.0, 0.0, 0.0), vertical_fov_deg=60.0)


def _back_to_back(renderer: Renderer, cameras: list[Camera], device: wp.Device) -> Timing:
    """Milliseconds a frame, in ten stretches of frames."""
    values = []
    for part in np.array_split(np.arange(len(cameras)), min(10, len(cameras))):
        begun = time.perf_counter()
        for k in part:
            renderer.render(cameras[k])
        wp.synchronize_device(device)
        values.append((time.perf_counter() - begun) / len(part) * 1e3)
    return Timing.of(values)


def _metrics(timing: Timing) -> dict[str, float]:
    values = (("us", timing.median), ("us_p5", timing.p5), ("us_p95", timing.p95))
    return {f"host.{name}": round(value * 1e3, 3) for name, value in values} | {"calls": timing.repeats}
