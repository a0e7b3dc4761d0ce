"""Settings of the effects, one class each with its `rung`; collected by `settings.Settings`.

`when` tells what may put an effect into the plan: "called_for" leaves it to the scene, "always" runs it although the
scene does not call for it. `rung="off"` keeps it out whatever calls for it.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .records import Record

__all__ = ["AmbientVisibilitySettings"]


class AmbientVisibilitySettings(Record):
    """How much of the constant ambient light each surface point sees.

    All rungs estimate the same number: the cosine-weighted share of the hemisphere in which nothing stands nearer than
    the radius.
    """

    rung: Literal["off", "gtao_half", "gtao"] = "gtao"
    """gtao: horizons in depth; gtao_half: at half size."""
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
