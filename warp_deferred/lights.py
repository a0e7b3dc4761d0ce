"""Lights: value objects for one light, and array groups that hold all lights of a scene.

Point and spot intensity is in candela, directional illuminance in lux. The global order of lights is point, spot,
directional, each by index: shading accumulates in this order and nothing else decides it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from .checks import check_array, input_error
from .records import Record

__all__ = ["DirectionalLight", "LightGroup", "Lights", "PointLight", "SpotLight", "is_device_array"]

Vector = tuple[float, float, float]
ATTENUATIONS = ("inverse_square", "polynomial")


class _Light(Record):
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear Rec. 709 colour; multiplies the intensity."""
    intensity: float = Field(1.0, ge=0.0, json_schema_extra={"mend": "a light cannot take light away"})
    """Luminous intensity [cd] of a point or spot light, illuminance [lx] of a directional one."""
    casts_shadow: bool = False
    """Whether the light calls for a shadow map."""
    world: int = Field(-1, ge=-1)
    """The world this light belongs to; -1 lights all."""
    name: str = ""
    """Name, as in the file it came from."""

    @model_validator(mode="after")
    def _color_positive(self) -> Any:
        if min(self.color) < 0.0:
            raise input_error(
                f"{type(self).__name__}.color", "values >= 0", self.color, "a light cannot take light away"
            )
        return self


class _LocalLight(_Light):
    position: Vector = (0.0, 0.0, 0.0)
    """World position [m]."""
    range: float = Field(
        math.inf, gt=0.0, allow_inf_nan=True, json_schema_extra={"mend": "leave it out for a light without limit"}
    )
    """Distance from which on the light is exactly 0 [m]; infinite lights are in every tile."""
    attenuation: Literal["inverse_square", "polynomial"] = "inverse_square"
    """Fall-off: 1/d² with KHR_lights_punctual's window, or 1 / (constant + linear d + quadratic d²) inside `range`."""
    coefficients: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """(constant, linear [1/m], quadratic [1/m²]) of the polynomial fall-off."""
    source_radius: float = Field(0.01, gt=0.0)
    """Size of the source [m]: squared distance is at least its square."""

    @model_validator(mode="after")
    def _coefficients(self) -> Any:
        if math.isnan(self.range):
            raise input_error(
                f"{type(self).__name__}.range", "a value > 0 [m]", self.range, "leave it out for a light without limit"
            )
        if min(self.coefficients) < 0.0 or (self.attenuation == "polynomial" and not sum(self.coefficients) > 0.0):
            raise input_error(
                f"{type(self).__name__}.coefficients",
                "values >= 0, not all 0",
                self.coefficients,
                "(1, 0, 0) is no fall-off",
            )
        return self


class PointLight(_LocalLight):
    """Light from a point in all directions."""


class SpotLight(_LocalLight):
    """Light from a point into a cone, fading between the inner and the outer angle."""

    direction: Vector = (0.0, -1.0, 0.0)
    """World direction the light shines in; any length but 0."""
    inner_angle: float = Field(0.0, ge=0.0, le=math.pi / 2)
    """Angle from the axis where fading starts [rad]."""
    outer_angle: float = Field(math.pi / 4, gt=0.0, le=math.pi / 2)
    """Angle from the axis where the light ends [rad]."""

    @model_validator(mode="after")
    def _cone(self) -> SpotLight:
        if not math.hypot(*self.direction) > 0.0:
            raise input_error("SpotLight.direction", "a vector other than 0", self.direction)
        if not self.inner_angle < self.outer_angle:
            raise input_error(
                "SpotLight.inner_angle", f"a value < outer_angle = {self.outer_angle:g} [rad]", self.inner_angle
            )
        return self


class DirectionalLight(_Light):
    """Parallel light, as from the sun."""

    direction: Vector = (0.0, -1.0, 0.0)
    """World direction the light shines in; any length but 0."""

    @model_validator(mode="after")
    def _direction(self) -> DirectionalLight:
        if not math.hypot(*self.direction) > 0.0:
            raise input_error("DirectionalLight.direction", "a vector other than 0", self.direction)
        return self


def is_device_array(value: Any) -> bool:
    """Tell whether `value` lives outside NumPy: a Warp, torch, JAX or CuPy array, which is never read back."""
    return not isinstance(value, np.ndarray) and (
        hasattr(value, "__cuda_array_interface__") or hasattr(value, "__dlpack__")
    )


_DIRECTIONAL = {
    "color": (3, np.float32), "intensity": (0, np.float32), "casts_shadow": (0, np.bool_), "world": (0, np.int32),
    "direction": (3, np.float32),
}  # fmt: skip
_POINT = {
    "color": (3, np.float32), "intensity": (0, np.float32), "casts_shadow": (0, np.bool_), "world": (0, np.int32),
    "position": (3, np.float64), "range": (0, np.float32), "attenuation": (0, np.int32),
    "coefficients": (3, np.float32), "source_radius": (0, np.float32),
}  # fmt: skip
_ANGLES = {"direction": (3, np.float32), "inner_angle": (0, np.float32), "outer_angle": (0, np.float32)}


class LightGroup:
    """All lights of one kind, field by field, as arrays.

    Every field of the light class (but `name`) is an attribute in the plural sense: `group.position` is (n, 3),
    `group.intensity` (n,). Reading gives a read-only NumPy array, or the device array that was handed in. Assigning
    a NumPy array of the same length checks it and marks the group changed; assigning a Warp, torch or JAX array of
    the same length binds it: the renderer copies it on the device before every frame and never reads it back.
    """

    #: kind -> field -> (columns; 0 for a scalar, dtype)
    FIELDS: ClassVar[dict[str, dict[str, tuple[int, type]]]] = {
        "point": _POINT,
        "spot": _POINT | _ANGLES,
        "directional": _DIRECTIONAL,
    }
    DYNAMIC: ClassVar[tuple[str, ...]] = ("position", "direction", "color", "intensity", "range")

    def __init__(self, kind: str, on_change: Callable[[bool], None]) -> None:
        self._kind, self._on_change, self._count = kind, on_change, 0
        self._arrays: dict[str, np.ndarray] = {}
        self._bound: dict[str, Any] = {}
        for name, (columns, dtype) in self.FIELDS[kind].items():
            self._arrays[name] = np.zeros((0, columns) if columns else 0, dtype)

    def __len__(self) -> int:
        return self._count

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self.FIELDS[self._kind]:
            raise AttributeError(f"{self._kind} lights have no field {name!r}")
        if name in self._bound:
            return self._bound[name]
        view = self._arrays[name].view()
        view.flags.writeable = False
        return view

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_"):
            object.__setattr__(self, name, value)
            return
        qualified = f"Lights.{self._kind}.{name}"
        if name not in self.FIELDS[self._kind]:
            raise input_error(qualified, "one of " + ", ".join(self.FIELDS[self._kind]), name)
        columns, dtype = self.FIELDS[self._kind][name]
        shape = (self._count, columns) if columns else (self._count,)
        if is_device_array(value):
            if name not in self.DYNAMIC:
                raise input_error(
                    qualified,
                    "a NumPy array (only " + ", ".join(self.DYNAMIC) + " may live on a device)",
                    type(value).__name__,
                )
            got = tuple(value.shape)
            if got not in (shape, (self._count,)):
                raise input_error(
                    qualified, f"shape {shape}", f"<shape {got}>", "counts change with Lights.add and Lights.clear"
                )
            # No change to count: what is bound is copied before every frame anyway, the host's arrays stay as they are.
            self._bound[name] = value
            return
        array = self._checked(qualified, name, value, shape, dtype)
        self._bound.pop(name, None)
        self._arrays[name] = array
        self._on_change(name in ("attenuation", "casts_shadow", "world", "outer_angle"))

    def _checked(self, qualified: str, name: str, value: Any, shape: tuple[int, ...], dtype: type) -> np.ndarray:
        if name == "attenuation":
            value = [
                ATTENUATIONS.index(v) if isinstance(v, str) and v in ATTENUATIONS else v
                for v in np.asarray(value).tolist()
            ]
        array = check_array(qualified, value, shape, dtype, finite=name != "range").copy()
        low = {"color": 0.0, "intensity": 0.0, "coefficients": 0.0, "world": -1, "attenuation": 0}.get(name)
        if low is not None and array.size and array.min() < low:
            raise input_error(qualified, f"values >= {low:g}", f"<{array.min()}>")
        if name in ("range", "source_radius") and array.size and not (array > 0).all():
            raise input_error(qualified, "values > 0 [m]", f"<{array[~(array > 0)][0]}>")
        if name == "direction" and array.size and not (np.abs(array).max(axis=1) > 0).all():
            raise input_error(qualified, "vectors other than 0", "<(0, 0, 0)>")
        return array

    @property
    def bound(self) -> dict[str, Any]:
        """The device arrays bound to fields, by field."""
        return self._bound

    def _append(self, light: Record) -> None:
        if self._bound:
            raise input_error(
                f"Lights.{self._kind}",
                "no bound device arrays while lights are added",
                tuple(self._bound),
                "assign NumPy arrays first",
            )
        for name, (columns, dtype) in self.FIELDS[self._kind].items():
            value = getattr(light, name)
            if name == "attenuation":
                value = ATTENUATIONS.index(value)
            row = np.asarray(value, dtype).reshape((1, columns) if columns else 1)
            self._arrays[name] = np.concatenate([self._arrays[name], row])
        self._count += 1

    def _extend(self, count: int, values: dict[str, Any], default: Record) -> None:
        fields = self.FIELDS[self._kind]
        for name in values:
            if name not in fields:
                raise input_error(f"Lights.{self._kind}.{name}", "one of " + ", ".join(fields), name)
        new = {}
        for name, (columns, dtype) in fields.items():
            shape = (count, columns) if columns else (count,)
            if name in values:
                value = (
                    np.broadcast_to(np.asarray(values[name]), shape)
                    if name != "attenuation"
                    else np.broadcast_to(np.asarray(values[name], object), shape)
                )
                new[name] = self._checked(f"Lights.{self._kind}.{name}", name, value, shape, dtype)
            else:
                value = getattr(default, name)
                new[name] = np.broadcast_to(
                    np.asarray(ATTENUATIONS.index(value) if name == "attenuation" else value, dtype), shape
                )
        for name, array in new.items():
            self._arrays[name] = np.concatenate([self._arrays[name], array])
        self._count += count

    def _clear(self) -> None:
        self._count = 0
        self._bound.clear()
        for name in self._arrays:
            self._arrays[name] = self._arrays[name][:0]


class Lights:
    """The lights of a scene: three groups of arrays, and `add` for one light at a time."""

    KINDS: ClassVar[tuple[str, ...]] = ("point", "spot", "directional")

    def __init__(self) -> None:
        #: Counts changes of counts and of fields that select kernels; the renderer looks up its plan again.
        self.structure_revision = 0
        #: Counts every change; the renderer uploads again.
        self.revision = 0
        self.point = LightGroup("point", self._changed)
        self.spot = LightGroup("spot", self._changed)
        self.directional = LightGroup("directional", self._changed)

    def _changed(self, structure: bool) -> None:
        self.revision += 1
        self.structure_revision += int(structure)

    def __len__(self) -> int:
        return len(self.point) + len(self.spot) + len(self.directional)

    def groups(self) -> Iterator[tuple[str, LightGroup]]:
        """Yield (kind, group) in the global order of lights."""
        return ((kind, getattr(self, kind)) for kind in self.KINDS)

    def add(self, *lights: PointLight | SpotLight | DirectionalLight) -> None:
        """Append lights to their groups.

        Raises:
            InputError: If something is not a light.
        """
        for light in lights:
            kind = {PointLight: "point", SpotLight: "spot", DirectionalLight: "directional"}.get(type(light))
            if kind is None:
                raise input_error("Lights.add", "a PointLight, SpotLight or DirectionalLight", type(light).__name__)
            getattr(self, kind)._append(light)
        self._changed(True)

    def extend(self, kind: Literal["point", "spot", "directional"], count: int, **fields: Any) -> None:
        """Append `count` lights of one kind at once; each field is an array of that length or one value for all."""
        default = {"point": PointLight, "spot": SpotLight, "directional": DirectionalLight}[kind]()
        getattr(self, kind)._extend(count, fields, default)
        self._changed(True)

    def clear(self) -> None:
        """Remove every light."""
        for _, group in self.groups():
            group._clear()
        self._changed(True)

    @property
    def casts_shadow(self) -> bool:
        """Whether any light declares a shadow."""
        return any(bool(np.any(group.casts_shadow)) for _, group in self.groups())

    def infinite_count(self) -> int:
        """Count the point and spot lights without a range: they are in every tile's mask."""
        groups = (self.point, self.spot)
        return sum(int(np.isinf(g.range).sum()) for g in groups if "range" not in g.bound)

    def bound(self) -> list[tuple[str, str, Any]]:
        """List the device arrays bound to fields as (kind, field, array)."""
        return [
            (kind, name, array) for kind, group in self.groups() for name, array in itertools.chain(group.bound.items())
        ]
