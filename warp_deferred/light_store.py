"""Lights on the device: the scene's own numbers in global order, uploaded when they change, and the staged copy."""

from __future__ import annotations

import numpy as np
import warp as wp

from .device_arrays import as_float_array
from .errors import CapacityError
from .kernels import lights as light_kernels
from .kernels import structs
from .lights import Lights

__all__ = ["LightStore"]

MAX_STAGED = 2**31 - 1
#: field of LightSource -> (dtype, columns, NumPy type)
FIELDS = {
    "position": (wp.vec3d, 3, np.float64),
    "direction": (wp.vec3, 3, np.float32),
    "color": (wp.vec3, 3, np.float32),
    "intensity": (wp.float32, 0, np.float32),
    "range": (wp.float32, 0, np.float32),
    "source_radius": (wp.float32, 0, np.float32),
    "coefficients": (wp.vec3, 3, np.float32),
    "angles": (wp.vec2, 2, np.float32),
    "kind": (wp.int32, 0, np.int32),
    "world": (wp.int32, 0, np.int32),
}
STAGING = {
    "position": light_kernels.stage_position_kernel,
    "direction": light_kernels.stage_vector_kernel,
    "color": light_kernels.stage_vector_kernel,
    "intensity": light_kernels.stage_scalar_kernel,
    "range": light_kernels.stage_scalar_kernel,
}


class LightStore:
    """Source and staged lights for up to `capacity` lights and `views` views."""

    def __init__(self, capacity: int, views: int, device: wp.Device) -> None:
        if capacity * views > MAX_STAGED:
            raise CapacityError(
                f"lights: expected lights x views of at most {MAX_STAGED}, got {capacity} x {views}; "
                "render fewer views at a time"
            )
        self.capacity, self.device = capacity, device
        self.source = structs.LightSource()
        self._arrays: dict[str, wp.array] = {}
        self._host: dict[str, np.ndarray] = {}
        for name, (dtype, columns, kind) in FIELDS.items():
            array = wp.zeros(capacity, dtype=dtype, device=device)
            self._arrays[name] = array
            self._host[name] = np.zeros((capacity, columns) if columns else capacity, kind)
            setattr(self.source, name, array)
        self.staged = structs.Lights()
        self.staged.position = wp.zeros(capacity * views, dtype=wp.vec4, device=device)
        for name in ("color", "axis", "shape", "polynomial"):
            setattr(self.staged, name, wp.zeros(capacity, dtype=wp.vec4, device=device))
        self.staged.capacity = capacity
        self._revision = -1
        self._owner: Lights | None = None

    @property
    def bytes(self) -> int:
        """Device memory held."""
        staged = [self.staged.position, self.staged.color, self.staged.axis, self.staged.shape, self.staged.polynomial]
        return sum(a.capacity for a in [*self._arrays.values(), *staged])

    def update(self, lights: Lights) -> None:
        """Upload what the host holds if it changed, then copy bound device arrays over it on the device."""
        if self._owner is not lights or self._revision != lights.revision:
            self._upload(lights)
            self._owner, self._revision = lights, lights.revision
        start = 0
        for kind, group in lights.groups():
            count = len(group)
            for name, value in group.bound.items():
                shape = (count, FIELDS[name][1]) if FIELDS[name][1] else (count,)
                values = as_float_array(f"Lights.{kind}.{name}", value, self.device, shape)
                wp.launch(
                    STAGING[name], dim=count, inputs=[values, start], outputs=[self._arrays[name]], device=self.device,
                    block_dim=light_kernels.BLOCK_DIM,
                )  # fmt: skip
            start += len(group)

    def _upload(self, lights: Lights) -> None:
        host, start = self._host, 0
        for k, (kind, group) in enumerate(lights.groups()):
            rows = slice(start, start + len(group))
            for name in FIELDS:
                if name not in ("angles", "kind") and name in group.FIELDS[kind] and name not in group.bound:
                    host[name][rows] = getattr(group, name)
            host["kind"][rows] = k
            if kind != "directional":
                host["kind"][rows] += 4 * (np.asarray(group.attenuation) == 1)
            if kind == "spot":
                host["angles"][rows] = np.stack([group.inner_angle, group.outer_angle], axis=1)
            start += len(group)
        for name, array in self._arrays.items():
            array.assign(wp.array(host[name], dtype=array.dtype, device="cpu", copy=False))
