"""Ladders of `python -m bench accuracy`, frozen: which rungs a stage has, what selects them, which scenes show it.

A ladder changes one stage and holds the rest fixed: every optional effect that is not on it is off, and all else is at
its default, but for what `fixed` says. Rungs are named from cheap to reference and read from `Settings`, so that a rung
that comes later is measured, too. There is no ladder for textures: no setting of this version chooses how they are
filtered. Depth and arithmetic also have a ladder each whose reference is the float64 twin.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable

import numpy as np

from warp_deferred import Camera, Scene, Settings, load
from warp_deferred.checks import check_choice, input_error

from .effect_cases import ladders as effect_ladders

__all__ = ["LADDERS", "SCENES", "TWIN", "Ladder", "Rung", "Stand", "narrowed", "stand_size", "twin_size"]

#: Name of the reference of the twin's ladders, which no setting selects.
TWIN = "float64_twin"


@dataclasses.dataclass(frozen=True)
class Stand:
    """A scene that ladders are measured on.

    Attributes:
        title: What it is there for, in words.
        source: Built-in scene with its parameters.
        small: The scene on the CPU; `source` if left out.
        tiny: The scene of a quick run; `small` if left out.
        step: Seconds from one frame to the next where it moves: slow scenes are shown faster, so that motions span
            some pixels.
    """

    title: str
    source: str
    small: str = ""
    tiny: str = ""
    step: float = 8.0 / 30.0

    def chosen(self, device_is_cuda: bool, quick: bool) -> str:
        """The scene for a kind of device."""
        small = self.small or self.source
        return self.tiny or small if quick else self.source if device_is_cuda else small

    def build(self, source: str, change: Callable[[Scene], None] | None = None) -> Scene:
        """Build the scene and change it."""
        scene = load(source)
        scene.camera = scene.camera or scene.cameras[0]
        if change is not None:
            change(scene)
        return scene


#: Scenes by name; the first four carry every ladder they can.
SCENES: dict[str, Stand] = {
    "many_lights": Stand(
        "many lights", "many_lights?lights=1000&mean=5", "many_lights?lights=100&mean=5&triangles=10000",
        "many_lights?lights=20&mean=5&triangles=2000",
    ),
    "hundred_lights": Stand("fine geometry", "hundred_lights", tiny="terrain?triangles=2000&lights=20"),
    "spheres_50k": Stand("glossy normals", "spheres_50k"),
    "shadows": Stand("soft shadows", "shadows"),
    "terrain_400k": Stand("shadows over fine triangles", "terrain_400k", "terrain_400k?triangles=20000"),
    "corner": Stand("contacts", "corner"),
    "glow": Stand("brighter than white", "glow"),
    "focus": Stand("out of focus", "focus"),
    "motion": Stand("in motion", "motion", step=1.0 / 30.0),
}  # fmt: skip
_FOUR = ("many_lights", "hundred_lights", "spheres_50k", "shadows")


@dataclasses.dataclass(frozen=True)
class Rung:
    """A rung: its name, and the settings that select it, as on the command line; none for the float64 twin."""

    name: str
    settings: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Ladder:
    """A stage's rungs from cheap to reference, and how their errors and times are taken.

    Attributes:
        name: Key in results.
        title: Heading of its part of the page.
        rungs: Rungs, cheap to reference; a first rung `off` is the frame without the stage.
        reference: The rung that the others' errors are taken against.
        scenes: Names of scenes that show it, the one whose picture is cut out first.
        measure: Name of the stage's own error, see measures.py.
        passes: Passes whose time is the stage's; none: what a frame takes more than at rung `off`, or the whole frame.
        fixed: Settings held at every rung.
        change: What is changed in a scene, such as its lens.
        exact: Whether every rung must give the same bits.
        quarter: Settings that give the reference a quarter of its samples, where it samples.
        moving: Whether the scene must move from frame to frame.
        twin: Whether the reference is the float64 renderer of the tests.
    """

    name: str
    title: str
    rungs: tuple[Rung, ...]
    reference: str
    scenes: tuple[str, ...]
    measure: str
    passes: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    change: Callable[[Scene], None] | None = None
    exact: bool = False
    quarter: tuple[str, ...] = ()
    moving: bool = False
    twin: bool = False

    def __post_init__(self) -> None:
        """Refuse a ladder that cannot be climbed, before minutes of measuring."""
        label, names = f"ladder {self.name}", [rung.name for rung in self.rungs]
        check_choice(f"{label}.reference", self.reference, [*names, *([TWIN] if self.twin else [])])
        for name in self.scenes:
            check_choice(f"{label}.scenes", name, SCENES)
        if not self.scenes or len(set(names)) != len(names):
            raise input_error(label, "at least one scene, and rungs of different names", names)
        for rung in self.rungs:
            self.at(rung.name)

    def rung(self, name: str) -> Rung:
        """Look a rung up.

        Raises:
            InputError: If there is none of that name.
        """
        check_choice(f"ladder {self.name}", name, [rung.name for rung in self.rungs])
        return next(rung for rung in self.rungs if rung.name == name)

    def at(self, name: str, more: tuple[str, ...] = (), base: Settings | None = None) -> Settings:
        """Settings of a rung: other effects off, then what is fixed, the rung's own, and `more`.

        Raises:
            InputError: If there is no such rung, or a setting of it does not exist.
        """
        off = [f"{effect}.rung=off" for effect in effect_ladders()]
        return (base or Settings()).with_values([*off, *self.fixed, *self.rung(name).settings, *more])

    @property
    def has_off(self) -> bool:
        """Whether the first rung is the frame without the stage, so that the stage costs what a frame takes more."""
        return self.rungs[0].name == "off" and self.reference != "off"


def _rungs(stage: str, field: str = "rung", last: str = "") -> tuple[Rung, ...]:
    """Rungs of a stage as `Settings` lists them; `last` names one that belongs at the end."""
    kind = Settings.model_fields[stage].annotation
    values = [str(value) for value in typing.get_args(kind.model_fields[field].annotation)]
    values.sort(key=lambda value: value == last)
    return tuple(Rung(value, (f"{stage}.{field}={value}",)) for value in values)


def _lens(**fields: float) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        # A scene made for the effect has a lens of its own.
        lens = {name: value for name, value in fields.items() if not name.startswith("focus")}
        if not any(getattr(scene.camera, name) for name in lens):
            scene.camera = (scene.camera or Camera()).replace(**fields)

    return change


_SAMPLES = ("off", "fxaa", *(f"samples_{2**k}" for k in range(1, 7)))


def _casting(scene: Scene) -> None:
    """Let directional lights cast where no light does."""
    lights = scene.lights
    if not any(np.any(group.casts_shadow) for _, group in lights.groups() if len(group)) and len(lights.directional):
        lights.directional.casts_shadow = np.full(len(lights.directional), True)


def _precision() -> tuple[Ladder, ...]:
    """Ladders of how numbers are kept and rounded, all but those of one codec's bits."""
    depth, lighting = _rungs("gbuffer", "depth"), ("resolve", "light_culling", "shade")
    shown, shadows = ("shadows", "spheres_50k", "hundred_lights", "many_lights"), ("shadow.rung=pcf",)
    sums, arithmetic = _rungs("shade", "accumulation"), _rungs("shade", "arithmetic")
    # What differs by roundings alone must not be rounded again on its way.
    held = ("gbuffer.rung=full", "shade.radiance=float32")
    against = (
        Rung("compact", ("gbuffer.rung=compact",)), Rung("half_sums", sums[0].settings),
        *(rung for rung in arithmetic if rung.name != "precise"), Rung("full", ()),
    )  # fmt: skip
    return (
        # Shadows are on: coarse depth lights surfaces from where they are not, which maps notice first.
        Ladder("depth", "Depth as stored", depth, TWIN, shown, "relative_depth", lighting, shadows, twin=True),
        Ladder("depth_format", "Depth formats", depth, "float32", shown, "relative_depth", lighting, shadows),
        Ladder("arithmetic", "Float32 against the float64 twin", against, TWIN, ("corner", *_FOUR),
               "relative_radiance", ("resolve", "lights", "light_culling", "shade"), held, twin=True),
        Ladder("fast_math", "Fused and fast arithmetic", arithmetic, "precise", _FOUR, "stored_radiance", ("shade",),
               held),
        Ladder("accumulation", "Sums of light", sums, "float32", _FOUR, "stored_radiance", ("shade",), held),
    )  # fmt: skip


def _all() -> tuple[Ladder, ...]:
    """Every ladder, in the order of the page; what moves stands last."""
    return (
        *_precision(),
        Ladder("normals", "Normal codecs", _rungs("gbuffer", "normal"), "float32",
               ("spheres_50k", "many_lights", "hundred_lights", "shadows"), "degrees", ("resolve", "shade")),
        Ladder("gbuffer", "G-buffer formats", _rungs("gbuffer"), "full",
               ("spheres_50k", "many_lights", "hundred_lights", "shadows"), "relative_radiance", ("resolve", "shade"),
               ("shade.radiance=float32",)),
        Ladder("radiance", "Radiance formats", _rungs("shade", "radiance"), "float32",
               ("hundred_lights", "many_lights", "spheres_50k", "shadows"), "stored_radiance", ("shade", "display")),
        Ladder("tile_size", "Light tiles", tuple(reversed(_rungs("light_culling", "tile_size"))), "8", _FOUR,
               "exact_radiance", ("light_culling", "shade"), exact=True),
        Ladder("light_culling", "Light culling", _rungs("light_culling"), "brute_force", _FOUR, "exact_radiance",
               ("light_culling", "shade"), exact=True),
        # Frames are replayed: maps that are kept where nothing moves would never be drawn.
        Ladder("shadow", "Shadows", _rungs("shadow"), "ray_traced",
               ("shadows", "spheres_50k", "terrain_400k", "corner"), "direct_visibility",
               fixed=("shadow.keep_maps=false",), quarter=("shadow.samples=64",), change=_casting),
        Ladder("ambient_visibility", "Ambient visibility", _rungs("ambient_visibility"), "ray_traced",
               ("corner", *_FOUR), "visibility", quarter=("ambient_visibility.rays=64",)),
        Ladder("bloom", "Bloom", _rungs("bloom"), "exact", ("glow", "many_lights", "hundred_lights", "shadows"),
               "scattered_light", fixed=("bloom.threshold=0", "bloom.fireflies=0"), change=_lens(bloom=0.2)),
        # Numbers of samples between powers of two cost in proportion.
        Ladder("anti_aliasing", "Anti-aliasing",
               tuple(rung for rung in _rungs("anti_aliasing") if rung.name in _SAMPLES), "samples_64",
               ("hundred_lights", "many_lights", "spheres_50k", "shadows"), "display_light",
               quarter=("anti_aliasing.rung=samples_16",)),
        Ladder("scale", "Rendered size", _rungs("scale", last="off"), "off",
               ("hundred_lights", "many_lights", "spheres_50k", "shadows"), "codes",
               fixed=("anti_aliasing.rung=samples_4",)),
        Ladder("depth_of_field", "Depth of field", _rungs("depth_of_field"), "lens_samples",
               ("focus", "hundred_lights", "spheres_50k", "shadows"), "compressed_radiance",
               quarter=("depth_of_field.samples=16",), change=_lens(aperture=0.1, focus_distance=6.0)),
        Ladder("motion_blur", "Motion blur", _rungs("motion_blur"), "shutter_samples",
               ("motion", "hundred_lights", "spheres_50k", "shadows"), "compressed_radiance",
               quarter=("motion_blur.samples=16",), change=_lens(shutter=0.5), moving=True),
    )  # fmt: skip


#: Every ladder by name.
LADDERS: dict[str, Ladder] = {ladder.name: ladder for ladder in _all()}


def narrowed(only: str) -> dict[str, Ladder]:
    """Ladders that `--only` asks for: all of them, LADDER, or LADDER.RUNG beside `off` and the reference.

    Raises:
        InputError: If there is no such ladder or no such rung.
    """
    if not only:
        return dict(LADDERS)
    name, dot, rung = only.partition(".")
    ladder = LADDERS[check_choice("--only", name, list(LADDERS))]
    if dot:
        wanted = {ladder.rung(rung).name, ladder.reference}
        kept = tuple(r for r in ladder.rungs if r.name in wanted or (ladder.has_off and r.name == "off"))
        ladder = dataclasses.replace(ladder, rungs=kept)
    return {name: ladder}


def stand_size(device_is_cuda: bool, quick: bool) -> tuple[int, int]:
    """Size at which ladders are measured [px]."""
    return (64, 36) if quick else (1920, 1080) if device_is_cuda else (240, 135)


def twin_size(quick: bool) -> tuple[int, int]:
    """Size of the pictures of the float64 twin [px], which is NumPy on one core whatever the device."""
    return (48, 27) if quick else (160, 90)
