"""What may be bought: the ladders of the stages that change the picture, and those that only change its time.

A rung costs time once a frame or in every sample of a pixel, which the ladder's `part` tells; rungs that take samples
themselves say how many, and those of one frame are the same ones (a sample is a place in pixel, lens and shutter at
once), so that the largest number counts. What is not here is not bought: sizes of shadow maps, radii and the like are
the user's. Normals of fewer bits than `oct24` are left out, for they cost the same bytes, and so is `float32` in a
compact G-buffer, whose other rounding errors are larger, and `fused` arithmetic, which is off by as much as `fast` is
and spares half as much. Amounts of what a rung does are rungs of their own where more of it buys accuracy: 6 to 8 steps
in place of 3 take a tenth off the error of `gtao`, more slices take nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal, get_args

from ..effect_settings import AntiAliasingSettings
from ..settings import Settings

__all__ = [
    "AMOUNTS",
    "EXACT",
    "FEW_LIGHTS",
    "INDEPENDENT",
    "LADDERS",
    "PIXEL_SAMPLES",
    "RAY_POWERS",
    "SCALES",
    "Ladder",
    "Rung",
    "held_fields",
    "ladder_of",
]


@dataclasses.dataclass(frozen=True)
class Rung:
    """A rung that may be bought.

    Attributes:
        name: Its name in reports.
        settings: Assignments that select it, as on the command line.
        samples: Samples a pixel that a frame with it takes at least.
        amounts: Assignments beside, of how much of it there is: where the user set one, this rung alone is not for
            sale.
        rays: Rays or samples of a rung that traces, where they are fewer than the settings say; else 0. Price and error
            follow from other numbers of them.
    """

    name: str
    settings: tuple[str, ...]
    samples: int = 1
    amounts: tuple[str, ...] = ()
    rays: int = 0


@dataclasses.dataclass(frozen=True)
class Ladder:
    """A stage's rungs.

    Attributes:
        name: The stage.
        rungs: From cheap to reference.
        base: Name of the rung that stands while other ladders are measured.
        needs: Name of the pass that must run at the base rung; where it does not, nothing calls for the stage.
        part: Which part of a frame its price falls in: `sample`, or `frame` for what runs once.
    """

    name: str
    rungs: tuple[Rung, ...]
    base: str
    needs: str
    part: Literal["sample", "frame"]

    @property
    def reference(self) -> Rung:
        """The rung that the others' errors are taken against."""
        return self.rungs[-1]

    @property
    def fields(self) -> frozenset[tuple[str, str]]:
        """(stage, field) of every setting its rungs choose: where the user set one, the ladder is held."""
        texts = (text for rung in self.rungs for text in rung.settings)
        return frozenset(tuple(text.partition("=")[0].split(".")) for text in texts)

    def rung(self, name: str) -> Rung:
        """Look a rung up.

        Raises:
            InputError: If there is none of that name.
        """
        from ..checks import check_choice

        check_choice(f"ladder {self.name}", name, [rung.name for rung in self.rungs])
        return next(rung for rung in self.rungs if rung.name == name)


def _sampled(stage: str, rung: str, counts: Sequence[int]) -> tuple[Rung, ...]:
    """Rungs that look through several samples, which share those of the pixel."""
    return tuple(
        Rung(f"{rung} {count}", (f"{stage}.rung={rung}", f"{stage}.samples={count}"), count) for count in counts
    )


def _traced(stage: str, field: str, counts: Sequence[int]) -> tuple[Rung, ...]:
    """Rungs that trace fewer rays than the reference."""
    return tuple(
        Rung(f"ray_traced {count}", (f"{stage}.rung=ray_traced",), amounts=(f"{stage}.{field}={count}",), rays=count)
        for count in counts
    )


def _horizons(slices: int, steps: int) -> Rung:
    """Gtao that looks along more or fewer lines, at more or fewer places."""
    stage = "ambient_visibility"
    amounts = (f"{stage}.slices={slices}", f"{stage}.steps={steps}")
    return Rung(f"gtao {slices} x {steps}", (f"{stage}.rung=gtao",), amounts=amounts)


def _plain(stage: str, *rungs: str) -> tuple[Rung, ...]:
    return tuple(Rung(rung, (f"{stage}.rung={rung}",)) for rung in rungs)


#: Share of each side that is rendered, by rung of `scale`, dear to cheap.
SCALES = {"off": 1.0, "five_sixths": 5.0 / 6.0, "two_thirds": 2.0 / 3.0, "half": 0.5}
#: Samples a pixel of the rungs of `anti_aliasing`.
PIXEL_SAMPLES = {
    rung: int(rung.partition("_")[2] or 1) for rung in get_args(AntiAliasingSettings.model_fields["rung"].annotation)
}
#: Ladders beside `scale` and `anti_aliasing`, which are measured together: an upscaled picture is as good as its
#: samples, so their errors do not add up.
LADDERS: tuple[Ladder, ...] = (
    Ladder("shadow", (*_plain("shadow", "off", "hard", "pcf", "pcss"), *_traced("shadow", "samples", (4, 16, 64)),
                      *_plain("shadow", "ray_traced")), "pcf", "shadow", "sample"),
    Ladder("ambient_visibility", (*_plain("ambient_visibility", "off", "ssao", "gtao_half", "gtao"), _horizons(1, 8),
                                  *_traced("ambient_visibility", "rays", (2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128)),
                                  *_plain("ambient_visibility", "ray_traced")), "gtao", "ambient_visibility", "sample"),
    Ladder("depth_of_field", (*_plain("depth_of_field", "off", "plane_lerp", "gather"),
                              *_sampled("depth_of_field", "lens_samples", (4, 8, 16, 32, 64))), "gather",
           "depth_of_field", "frame"),
    Ladder("motion_blur", (*_plain("motion_blur", "off", "velocity_gather"),
                           *_sampled("motion_blur", "shutter_samples", (4, 8, 16, 32, 64))), "velocity_gather",
           "motion_blur", "frame"),
    Ladder("bloom", _plain("bloom", "off", "neighbourhood", "mip_chain", "exact"), "mip_chain", "bloom", "frame"),
    Ladder("gbuffer", (*(Rung(name, ("gbuffer.rung=compact", f"gbuffer.normal={name}"))
                         for name in ("oct24", "oct32")), Rung("full", ("gbuffer.rung=full",))), "oct24",
           "shade", "sample"),
    Ladder("shade", tuple(Rung(name, (f"shade.radiance={name}",)) for name in ("half", "float32")), "half", "shade",
           "sample"),
    Ladder("arithmetic", tuple(Rung(name, (f"shade.arithmetic={name}",)) for name in ("fast", "precise")), "precise",
           "shade", "sample"),
)  # fmt: skip
#: Ladders whose reference takes a number of samples of its own: the setting that says how many.
AMOUNTS = {"shadow": "shadow.samples", "ambient_visibility": "ambient_visibility.rays"}
#: Power of the number of rays or samples by which the reference's error falls; and whose errors are independent from
#: sample to sample of the pixel, so that these average them out.
RAY_POWERS, INDEPENDENT = {"shadow": 0.8, "ambient_visibility": 0.55}, frozenset({"ambient_visibility"})
#: Lights up to which testing them against depth, or at all, may cost more than it spares.
FEW_LIGHTS = 64
#: Rungs of light culling: every one gives the same bits, so the fastest is free.
EXACT = Ladder(
    "light_culling",
    tuple(
        Rung(f"{rung}, {size} px" if rung != "brute_force" else rung,
             (f"light_culling.rung={rung}", f"light_culling.tile_size={size}"))
        for rung, size in (("tiles_depth", 8), ("tiles_depth", 16), ("tiles_depth", 32), ("tiles_depth", 64),
                           ("tiles", 16), ("brute_force", 16))
    ),
    "tiles_depth, 16 px", "light_culling", "sample",
)  # fmt: skip


def ladder_of(name: str) -> Ladder:
    """Look a ladder up, that of light culling among them.

    Raises:
        InputError: If there is none of that name.
    """
    from ..checks import check_choice

    known = {ladder.name: ladder for ladder in (*LADDERS, EXACT)}
    return known[check_choice("ladder", name, known)]


def held_fields(settings: Settings) -> frozenset[tuple[str, str]]:
    """(stage, field) of everything that was set by hand, be it to its default: what `fit` leaves alone."""
    return frozenset(
        (stage, field)
        for stage in settings.model_fields_set
        if stage in settings.stages
        for field in getattr(settings, stage).model_fields_set
    )
