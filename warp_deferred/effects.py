"""Optional effects: when each is called for, and where in the frame it stands.

A rule looks at host-side facts alone: the request's features, lens, settings and outputs. What depends on the device
is the pass's own `active`. The module of an effect's pass, and with it its kernels, is imported only once its rule
says yes, so what a scene does not call for costs not even an import.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from .sampling import lens_samples, pixel_samples, sample_count, shutter_samples
from .shadow_slots import beyond_capacity

if TYPE_CHECKING:
    from .passes.base import Pass, Request

__all__ = ["EFFECTS", "Effect", "Verdict", "called_for"]


class Verdict(NamedTuple):
    """Whether an effect is called for, and why or why not."""

    runs: bool
    reason: str


@dataclasses.dataclass(frozen=True)
class Effect:
    """One optional pass.

    Attributes:
        name: Name of the pass; `bloom` is class `BloomPass`.
        after: Name of the pass it comes after; effects after the same one keep the table's order; empty: first of all.
        rule: Decides by a request.
        module: File below passes/ it is in, where that is not its name; its settings, if any, bear its name.
        quiet: Part of another effect, so `explain` need not say why it does not run.
        before: Name of the pass it comes right before, behind the user's own; `after` then says nothing.
    """

    name: str
    after: str
    rule: Callable[[Request], Verdict]
    module: str = ""
    quiet: bool = False
    before: str = ""

    def load(self) -> type[Pass]:
        """Import the pass."""
        module = importlib.import_module(f".passes.{self.module or self.name}", __package__)
        return getattr(module, "".join(word.capitalize() for word in self.name.split("_")) + "Pass")

    def verdict(self, request: Request) -> Verdict:
        """Ask the settings, which can turn it off or force it on, then the rule."""
        settings: Any = getattr(request.settings, self.name, None)
        if getattr(settings, "rung", "") == "off":
            return Verdict(False, f"{self.name}.rung is off")
        verdict = self.rule(request)
        if not verdict.runs and getattr(settings, "when", "called_for") == "always":
            return Verdict(True, f"{self.name}.when is always ({verdict.reason})")
        return verdict


def _sampled(request: Request) -> Verdict:
    rungs = [f"anti_aliasing.rung={request.settings.anti_aliasing.rung}"] * (pixel_samples(request) > 1)
    rungs += ["depth_of_field.rung=lens_samples"] * (lens_samples(request) > 1)
    rungs += ["motion_blur.rung=shutter_samples"] * (shutter_samples(request) > 1)
    return Verdict(bool(rungs), ", ".join(rungs) or "no rung takes several samples a pixel")


def _ambient_visibility(request: Request) -> Verdict:
    if "ambient_visibility" in request.outputs:
        return Verdict(True, "ambient_visibility asked for")
    # Ambient light is part of the image, not of the outputs `diffuse` and `specular`.
    shown = "display" in request.outputs and request.settings.display.view in ("picture", "invalid")
    if not shown and "color" not in request.outputs and not any(p.image for p in request.passes):
        return Verdict(False, "no output asked for shows ambient light")
    return Verdict(request.features.ambient, f"ambient light is {'not ' * request.features.ambient}zero")


def _points(request: Request) -> Verdict:
    count = request.features.bound_meshes
    reason = f"{count} mesh{'es take' if count > 1 else ' takes'} points from arrays"
    return Verdict(count > 0, reason if count else "no mesh takes its points from an array")


def _shadow(request: Request) -> Verdict:
    count = sum(request.features.casters)
    if not count:
        return Verdict(False, "no light casts a shadow")
    if not request.lit:
        return Verdict(False, "no lit output asked for")
    left = beyond_capacity(request.features.casters, request.settings.shadow)
    reason = f"{count} light{'s cast' if count > 1 else ' casts'} shadows"
    reason += f"; {left} past the capacity, without" * (left > 0)
    if request.settings.shadow.rung != "ray_traced" and sample_count(request) > 1:
        moving = shutter_samples(request) > 1
        reason += "; samples draw anew what the shutter moves" if moving else "; samples share the maps"
    return Verdict(True, reason)


def _ray_scene(request: Request) -> Verdict:
    tracing = [
        f"{name}.rung is ray_traced"
        for name in ("shadow", "ambient_visibility")
        if getattr(request.settings, name).rung == "ray_traced" and called_for(request, name)
    ]
    return Verdict(bool(tracing), " and ".join(tracing) or "nothing traces rays")


def _ray_instances(request: Request) -> Verdict:
    return Verdict(_ray_scene(request).runs and shutter_samples(request) > 1, "the shutter moves instances")


def _depth_of_field(request: Request) -> Verdict:
    if not request.lens.aperture:
        return Verdict(False, "no camera has an aperture")
    if request.settings.depth_of_field.rung == "lens_samples":
        return Verdict(False, "lens_samples moves the views instead")
    return Verdict(True, "a camera has an aperture")


def _lens_samples(request: Request) -> Verdict:
    return Verdict(lens_samples(request) > 1, "a camera has an aperture and depth_of_field.rung is lens_samples")


def _motion(request: Request) -> Verdict:
    if "motion" in request.outputs:
        return Verdict(True, "motion asked for")
    blur = next(effect for effect in EFFECTS if effect.name == "motion_blur").verdict(request)
    if blur.runs and request.settings.motion_blur.rung != "shutter_samples":
        return Verdict(True, "motion_blur reads it")
    return Verdict(False, "nothing reads it")


def _motion_blur(request: Request) -> Verdict:
    if not request.lens.shutter:
        return Verdict(False, "no camera has an open shutter")
    if not request.moving:
        return Verdict(False, "nothing is declared moving")
    if request.settings.motion_blur.rung == "shutter_samples":
        return Verdict(False, "shutter_samples moves views and instances instead")
    return Verdict(True, f"a camera has an open shutter, and {request.moving}")


def _shutter_samples(request: Request) -> Verdict:
    runs = shutter_samples(request) > 1
    return Verdict(runs, f"motion_blur.rung is shutter_samples, a camera has an open shutter, and {request.moving}")


def _bloom(request: Request) -> Verdict:
    if "display" not in request.outputs:
        return Verdict(False, "display was not asked for")
    if request.settings.display.view != "picture":
        return Verdict(False, f"display.view is {request.settings.display.view}")
    return Verdict(request.lens.bloom, f"{'a' if request.lens.bloom else 'no'} camera's lens has bloom")


def _smoothed(request: Request) -> Verdict:
    rung = request.settings.anti_aliasing.rung
    if rung == "fxaa" and "display" not in request.outputs:
        return Verdict(False, "no output asked for is a picture")
    if request.settings.display.view != "picture":
        return Verdict(False, f"display.view is {request.settings.display.view}")
    return Verdict(rung == "fxaa", f"anti_aliasing.rung={rung}")


def _blur(request: Request) -> Verdict:
    sigma = request.settings.blur.sigma_px
    return Verdict(sigma > 0.0, f"blur.sigma_px is {sigma:g}")


def _debug_view(request: Request) -> Verdict:
    view = request.settings.display.view
    return Verdict("display" in request.outputs and view != "picture", f"display.view is {view}")


def _scale(request: Request) -> Verdict:
    rung = request.settings.scale.rung
    return Verdict("display" in request.outputs and rung != "off", f"scale.rung is {rung}")


#: Every optional effect, in frame order.
EFFECTS: tuple[Effect, ...] = (
    Effect("points", "", _points, quiet=True),
    Effect("ambient_visibility", "resolve", _ambient_visibility),
    Effect("start_samples", "", _sampled, "sampling", quiet=True),
    Effect("begin_sample", "", _sampled, "sampling", quiet=True),
    Effect("ray_scene", "", _ray_scene, quiet=True),
    Effect("ray_instances", "", _ray_instances, "ray_scene", quiet=True),
    Effect("shadow", "", _shadow),
    Effect("shutter_samples", "begin_sample", _shutter_samples, "motion_blur", quiet=True),
    Effect("lens_samples", "begin_sample", _lens_samples, "depth_of_field", quiet=True),
    Effect("accumulate", "shade", _sampled, "sampling"),
    Effect("average", "accumulate", _sampled, "sampling", quiet=True),
    Effect("motion", "average", _motion),
    Effect("depth_of_field", "average", _depth_of_field),
    Effect("motion_blur", "average", _motion_blur),
    Effect("bloom", "", _bloom, before="display"),
    Effect("anti_aliasing", "display", _smoothed),
    Effect("blur", "average", _blur),
    Effect("debug_view", "display", _debug_view, quiet=True),
    # What works on the picture itself belongs above: this one changes its size.
    Effect("scale", "display", _scale),
)


def called_for(request: Request, name: str) -> bool:
    """Whether an effect is called for, for passes that read what it writes."""
    return any(effect.verdict(request).runs for effect in EFFECTS if effect.name == name)
