"""What `effects` times, frozen: each effect on the scene that shows it, and whole frames with several of them.

A case says which rung its errors are taken against, how to take back what calls for its effect, so that the price of
not calling for it can be measured, and how to leave the effect in the plan with nothing to do on the device. Effects
themselves are not listed here: they are found in `Settings`, and one without a case, or a case whose scene is not
there, is reported by name. Two cases are no ladders: tone mapping is a choice of curves, and a pass of a user's own is
there or not.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable

import numpy as np

from warp_deferred import Camera, DirectionalLight, Environment, Pass, Scene, Settings, effect_settings, load

from .cases import FrameCase
from .fog import make_fog

__all__ = [
    "EFFECT_CASES", "QUICK_SIZE", "CompositeCase", "EffectCase", "case_size", "composite_cases", "ladders",
    "without_case",
]  # fmt: skip

QUICK_SIZE = (64, 36)


def ladders() -> dict[str, tuple[str, ...]]:
    """Rungs of every effect there is, by its name: `off` first, then from cheap to dear."""
    found = {}
    for name, field in Settings.model_fields.items():
        kind = field.annotation
        if getattr(kind, "__module__", "") == effect_settings.__name__ and "rung" in kind.model_fields:
            rungs = typing.get_args(kind.model_fields["rung"].annotation)
            if rungs and rungs[0] == "off":
                found[name] = rungs
    return found


def _lens(**fields: float) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        scene.camera = (scene.camera or Camera()).replace(**fields)

    return change


def _no_ambient(scene: Scene) -> None:
    scene.environment = Environment(ambient=(0.0, 0.0, 0.0), background=scene.environment.background)


def _cast(scene: Scene, casts: bool) -> None:
    for _, group in scene.lights.groups():
        if len(group):
            group.casts_shadow = np.full(len(group), casts)


_HALL, _HILLS = "hundred_lights", "terrain?triangles=2000&lights=20"


@dataclasses.dataclass(frozen=True)
class EffectCase:
    """An effect on its own scene.

    Attributes:
        name: Name of the case: the effect's, or that with more words.
        source: Built-in scene with its parameters.
        reference: The rung whose picture the others' are compared with; empty where no rung is nearer to the truth
            than another.
        effect: Stage of `Settings`; the case's name if left out.
        field: Its setting that is gone through.
        leaves_out: Rungs that are not gone through.
        small: The scene in few triangles, for quick runs; `source` if left out.
        change: What is changed after the scene is built, so that it calls for the effect.
        free: Takes back what calls for it; None where only its settings do.
        free_settings: Settings that take back what calls for it.
        idle: Leaves it called for with nothing to do on the device; None where nothing is decided there.
        settings: Settings in force at every rung, as on the command line.
        small_settings: More of them, for quick runs.
        passes: Makes passes of a user's own, which all rungs but the first have; there is no setting then.
        moving: Whether the scene must move from frame to frame for the effect to have work.
        size: Size of the picture a strip is cut from [px].
        centre: Middle of the cut, as shares of width and height.
        sheet_centre: Middle of the cut on the sheet of all effects, where the picture is divided; `centre` if left out.
        zoom: How large one pixel is shown in a strip [px].
        gain: Factor on differences from the reference, in a strip.
        draws: Whether it has a strip.
    """

    name: str
    source: str
    reference: str = ""
    effect: str = ""
    field: str = "rung"
    leaves_out: tuple[str, ...] = ()
    small: str = ""
    change: Callable[[Scene], None] | None = None
    free: Callable[[Scene], None] | None = None
    free_settings: tuple[str, ...] = ()
    idle: Callable[[Scene], None] | None = None
    settings: tuple[str, ...] = ()
    small_settings: tuple[str, ...] = ()
    passes: Callable[[], list[Pass]] | None = None
    moving: bool = False
    size: tuple[int, int] = (480, 270)
    centre: tuple[float, float] = (0.5, 0.5)
    sheet_centre: tuple[float, float] | None = None
    zoom: int = 1
    gain: int = 4
    draws: bool = True

    def build(self) -> Scene:
        """Build the scene and change it."""
        scene = load(self.source)
        if self.change is not None:
            self.change(scene)
        return scene

    @property
    def stage(self) -> str:
        """Stage of `Settings`, or the name of what is no stage."""
        return self.effect or self.name

    @property
    def has_cause(self) -> bool:
        """Whether something besides its rung calls for the effect."""
        return self.free is not None or bool(self.free_settings)

    def rungs(self) -> tuple[str, ...]:
        """What is gone through, the frame without the effect first; empty if this version has no such effect."""
        if self.passes is not None:
            return ("off", *(stage.name for stage in self.passes()))
        kind = Settings.model_fields.get(self.stage)
        known = kind.annotation.model_fields.get(self.field) if kind else None
        return tuple(r for r in typing.get_args(known.annotation) if r not in self.leaves_out) if known else ()

    def at(self, settings: Settings, rung: str) -> Settings:
        """Change the rung."""
        if self.passes is not None:
            return settings
        return settings.replace(**{self.stage: getattr(settings, self.stage).replace(**{self.field: rung})})

    def default(self, settings: Settings) -> str:
        """The rung in force, or the first that does something where that is `off`."""
        rung = getattr(getattr(settings, self.stage, None), self.field, "off")
        return rung if rung != "off" else self.rungs()[1]

    def quick(self) -> EffectCase:
        """The case of a quick run."""
        return dataclasses.replace(self, source=self.small or self.source, settings=self.settings + self.small_settings)


_SCALED = {"size": (480, 270), "centre": (0.22, 0.42), "zoom": 2}
#: Numbers of samples between those that are shown: they cost in proportion.
_BETWEEN = tuple(
    f"samples_{n}" for n in (2, 3, 5, 6, 7, 8, 10, 12, 14, 20, 24, 28, 32, 40, 48, 56)
)  # fmt: skip
#: The case of each effect, in the order of the page.
EFFECT_CASES: dict[str, EffectCase] = {
    case.name: case
    for case in (
        # Frames are replayed: maps that are kept where nothing moves would never be drawn.
        EffectCase(
            "shadow",
            "shadows",
            "ray_traced",
            free=lambda scene: _cast(scene, False),
            settings=("shadow.keep_maps=false",),
            small_settings=(
                "shadow.directional_size=256",
                "shadow.spot_size=256",
                "shadow.point_size=128",
                "shadow.samples=16",
            ),
            size=(720, 405),
            centre=(0.55, 0.55),
            zoom=2,
        ),
        EffectCase(
            "shadow_cascades",
            "terrain?triangles=500000&lights=1000",
            effect="shadow",
            small="terrain?triangles=2000&lights=20",
            change=lambda scene: _moonlit(scene),
            free=lambda scene: _cast(scene, False),
            settings=("shadow.keep_maps=false", "shadow.cascades=4", "shadow.directional_size=2048"),
            small_settings=("shadow.directional_size=256",),
            leaves_out=("ray_traced",),
            draws=False,
        ),
        EffectCase("ambient_visibility", "corner", "ray_traced", free=_no_ambient, centre=(0.5, 0.6), zoom=2),
        EffectCase(
            "ambient_visibility_terrain",
            "terrain?triangles=500000&lights=1000",
            effect="ambient_visibility",
            small=_HILLS,
            free=_no_ambient,
            leaves_out=("ray_traced",),
            draws=False,
        ),
        # Twenty stops down nothing exceeds the threshold: bloom is in the plan, and skipped on the device.
        EffectCase(
            "bloom", "glow", "exact", free=_lens(bloom=0.0), idle=_lens(exposure=-20.0), centre=(0.5, 0.42), zoom=2
        ),
        EffectCase("depth_of_field", "focus", "lens_samples", free=_lens(aperture=0.0), centre=(0.28, 0.42), zoom=2),
        EffectCase(
            "motion_blur",
            "motion",
            "shutter_samples",
            free=_lens(shutter=0.0),
            moving=True,
            centre=(0.45, 0.45),
            sheet_centre=(0.36, 0.45),
            zoom=2,
        ),
        EffectCase(
            "anti_aliasing",
            _HALL,
            "samples_64",
            small=_HILLS,
            centre=(0.22, 0.42),
            zoom=3,
            leaves_out=_BETWEEN,
        ),
        EffectCase("scale", _HALL, "off", small=_HILLS, **_SCALED),
        EffectCase(
            "scale_samples_16",
            _HALL,
            "off",
            effect="scale",
            small=_HILLS,
            settings=("anti_aliasing.rung=samples_16",),
            **_SCALED,
        ),
        EffectCase("blur", "glow", free_settings=("blur.sigma_px=0",)),
        EffectCase("tone_mapping", "glow", effect="display", field="tone_mapping", centre=(0.5, 0.42), zoom=2),
        EffectCase("custom_pass", _HALL, small=_HILLS, passes=lambda: [make_fog()]),
    )
}


def without_case() -> list[str]:
    """Effects of `Settings` that no case measures."""
    measured = {case.stage for case in EFFECT_CASES.values()}
    return [effect for effect in ladders() if effect not in measured]


def case_size(device_is_cuda: bool, quick: bool) -> tuple[int, int]:
    """Size at which effects are timed and their errors taken [px]."""
    return QUICK_SIZE if quick else (1920, 1080) if device_is_cuda else (320, 180)


@dataclasses.dataclass(frozen=True)
class CompositeCase(FrameCase):
    """A whole frame with several effects.

    Attributes:
        needs: Effects without which it is not the frame that is meant.
        change: What is changed after the scene is built.
        settings: Settings, as on the command line; effects that are not needed are turned off.
    """

    needs: tuple[str, ...] = ()
    change: Callable[[Scene], None] | None = None
    settings: tuple[str, ...] = ()

    def build(self) -> Scene:
        """Build the scene and change it."""
        scene = load(self.source)
        if self.change is not None:
            self.change(scene)
        return scene

    def assignments(self) -> list[str]:
        """Settings, and `off` for every effect the frame does not need: its name says all that is in it."""
        return [*self.settings, *(f"{name}.rung=off" for name in ladders() if name not in self.needs)]


def _moonlit(scene: Scene) -> None:
    """Add a shadowed directional light and a lens that blooms; the terrain's ambient light is not zero anyway."""
    scene.lights.add(
        DirectionalLight(direction=(0.7, -0.6, -0.4), color=(0.55, 0.7, 1.0), intensity=0.5, casts_shadow=True)
    )
    _lens(bloom=0.1)(scene)


def composite_cases(device_is_cuda: bool, *, quick: bool) -> tuple[CompositeCase, ...]:
    """List the frames with several effects that are timed on a kind of device."""
    wide, face = (2048, 512) if device_is_cuda and not quick else (256, 128)
    maps = (f"shadow.directional_size={wide}", f"shadow.point_size={face}", "shadow.cascades=4", "shadow.rung=pcf",
            "shadow.keep_maps=false")  # fmt: skip
    rest = ("ambient_visibility.rung=gtao", "bloom.rung=mip_chain")
    triangles, lights, casting = (500_000, 1000, 16) if device_is_cuda and not quick else (2000, 20, 2)
    sizes = {"1080p": (1920, 1080), "4k": (3840, 2160)} if device_is_cuda and not quick else {"small": (160, 90)}
    source = f"terrain?triangles={triangles}&lights="
    effects = ("shadow", "ambient_visibility", "bloom")
    text = f"terrain, {triangles // 1000} k triangles"
    cases = []
    for name, (width, height) in sizes.items():
        title = f"{text}, {lights} lights, one shadowed directional light, gtao, bloom, {width}x{height}"
        case = CompositeCase(f"composite_{name}", title, f"{source}{lights}", width, height)
        cases.append(dataclasses.replace(case, needs=effects, change=_moonlit, settings=maps + rest))
    name, (width, height) = next(iter(sizes.items()))
    title = f"{text}, {casting} shadowed point lights, {width}x{height}"
    case = CompositeCase(f"shadowed_points_{name}", title, f"{source}{casting}&mean=1", width, height)
    cases.append(dataclasses.replace(case, needs=("shadow",), change=lambda s: _cast(s, True), settings=maps))
    kept = dataclasses.replace(cases[-1], name=f"kept_points_{name}", title=f"{title}, maps kept")
    cases.append(dataclasses.replace(kept, settings=(*maps, "shadow.keep_maps=true")))
    return tuple(cases)
