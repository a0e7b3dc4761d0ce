"""MuJoCo Warp's batch renderer: rays against a tree of the triangles, as in Newton, with lights of MuJoCo's model.

Written against mujoco-warp 4.0.0.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Scene

from ..timing import Timing
from .base import Session, geometry_of, light_table, time_warp
from .cases import KINDS, PeerCase

__all__ = ["MuJoCoWarp"]


class MuJoCoWarp:
    """The renderer of MuJoCo's Warp port."""

    name = "mujoco_warp"
    title = "MuJoCo Warp"
    kinds = tuple(KINDS)
    computes = (
        "one primary ray a pixel; depth and object ids, or the shaded picture in 8 bits and depth; Lambert under all "
        "lights, looped over at each pixel, inverse-square attenuation; one shadow ray a light and pixel"
    )
    leaves_out = (
        "range of lights, so that no light can be left out but where its cone ends; normals and albedo as images; "
        "ambient light here, colour management and tone curve; a shadow is hard, and a normal more than 37 "
        "degrees off its face gives way to the face's"
    )
    method = "device time of its own launches, captured into a CUDA graph and replayed"
    wins = "As Newton's cameras, it can win where pixels are few and triangles many."

    def available(self, device: wp.Device) -> str | None:
        """Say why it cannot be imported."""
        missing = [name for name in ("mujoco", "mujoco_warp") if importlib.util.find_spec(name) is None]
        return f"no module {' and '.join(missing)}; pip install mujoco-warp" if missing else None

    def version(self) -> str:
        """Version of the package."""
        return f"mujoco-warp {importlib.metadata.version('mujoco-warp')}"

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Build the model and the render context."""
        return _MuJoCoSession(case, scene, cameras, device)


def _model(case: PeerCase, scene: Scene, cameras: list[Camera]) -> Any:
    """MuJoCo's model of the scene: one mesh that collides with nothing, the lights, the cameras."""
    import mujoco

    geometry, spec = geometry_of(scene), mujoco.MjSpec()
    spec.visual.headlight.active = 0
    mesh = spec.add_mesh(name="terrain", uservert=geometry.positions.ravel(), userface=geometry.triangles.ravel())
    mesh.usernormal, mesh.userfacenormal = geometry.normals.ravel(), geometry.triangles.ravel()
    # A height field encloses no volume.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "terrain", "contype": 0, "conaffinity": 0}
    spec.worldbody.add_geom(**shape, rgba=[*geometry.albedo, 1.0])
    for camera in cameras:
        place = spec.worldbody.add_camera(pos=camera.position, fovy=math.degrees(camera.vertical_fov))
        place.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
        place.alt.xyaxes = camera.rotation[:6]
        place.resolution = [case.width, case.height]
    table = light_table(scene)
    for k in range(len(table)):
        spot = table.cosines[k, 0] > -1.0
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_SPOT if spot else mujoco.mjtLightType.mjLIGHT_POINT,
            pos=table.position[k],
            dir=table.direction[k] if spot else (0.0, -1.0, 0.0),
            cutoff=math.degrees(math.acos(table.cosines[k, 1])) if spot else 180.0,
            diffuse=table.color[k] / np.pi,
            specular=(0.0, 0.0, 0.0),
            attenuation=(0.0, 0.0, 1.0),
            castshadow=bool(table.casts[k]),
        )
    return spec.compile()


class _MuJoCoSession:
    """A case opened by MuJoCo Warp."""

    note = ""

    def __init__(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> None:
        import mujoco
        import mujoco_warp

        self.case, self.device, self.render = case, device, mujoco_warp.render
        model = _model(case, scene, cameras)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self.lit = case.kind != "gbuffer"
        with wp.ScopedDevice(device):
            self.model, self.data = mujoco_warp.put_model(model), mujoco_warp.put_data(model, data)
            self.context = mujoco_warp.create_render_context(
                model,
                render_rgb=self.lit,
                render_depth=True,
                render_seg=not self.lit,
                use_shadows=case.shadowed > 0,
                use_ambient_lighting=False,
                use_textures=False,
                enable_specular=False,
                enable_emission=False,
            )

    def _frame(self) -> None:
        with wp.ScopedDevice(self.device):
            self.render(self.model, self.data, self.context)

    def time(self, repeats: int) -> Timing:
        """Time replays of one render."""
        return time_warp(self, self.device, self._frame, repeats)

    def _views(self, values: wp.array) -> np.ndarray:
        return values.numpy()[0].reshape(self.case.views, self.case.height, self.case.width)

    def depth(self) -> np.ndarray | None:
        """Depth along the camera's axis; it is 0 where no ray hits."""
        self._frame()
        depth = self._views(self.context.depth_data)
        return np.where(depth > 0.0, depth, np.inf).astype(np.float32)

    def picture(self) -> np.ndarray | None:
        """The packed colours; None for a G-buffer."""
        if not self.lit:
            return None
        self._frame()
        packed = self._views(self.context.rgb_data)[0]
        return np.stack([packed >> shift & 0xFF for shift in (16, 8, 0)], axis=-1).astype(np.uint8)

    def close(self) -> None:
        """Drop model and context."""
        self.model = self.data = self.context = None
