"""pygfx: a scene graph for Python on WebGPU (Vulkan, Metal, Direct3D), forward shading.

Written against pygfx 0.17.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
import time
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Scene

from ..timing import CPU_BUDGET_S, MIN_REPEATS, WARM_UP_S, Timing
from .base import Session, geometry_of, light_table
from .cases import PeerCase

__all__ = ["PyGfx"]

#: Far plane [m]; the terrain ends before it.
FAR = 60.0


def _adapter() -> dict[str, Any]:
    """What WebGPU draws on, in the words of its driver."""
    from pygfx.renderers.wgpu import get_shared

    return dict(get_shared().adapter.info)


class PyGfx:
    """pygfx's own renderer, into a texture."""

    name = "pygfx"
    title = "pygfx (WebGPU)"
    kinds = ("lit", "shadowed", "frame")
    computes = (
        "forward shading of all lights at each fragment, looped over; Phong material without specular reflection; "
        "shadow maps of 1024x1024, drawn anew; the picture is drawn into a texture of its own and copied to the target"
    )
    leaves_out = (
        "culling of lights, a G-buffer, depth, ids or normals as arrays, tone curve; the picture stays in a texture of "
        "WebGPU, and a copy to CUDA or the host is not in the time"
    )
    method = "wall-clock time of a render that is waited for: WebGPU's commands are recorded anew for every frame"
    wins = "One light in a forward pass needs no G-buffer; what Python does for each frame is in its time, though."

    def available(self, device: wp.Device) -> str | None:
        """Say why it cannot draw, or not on the device's side of the machine."""
        missing = [name for name in ("pygfx", "wgpu") if importlib.util.find_spec(name) is None]
        if missing:
            return f"no module {' and '.join(missing)}; pip install pygfx"
        try:
            adapter = _adapter()
        except Exception as error:  # whatever a driver comes up with is a reason
            return f"no WebGPU adapter: {(str(error).strip() or type(error).__name__).splitlines()[0]}"
        software = adapter["adapter_type"] == "CPU"
        if device.is_cuda and software:
            return f"WebGPU draws on the CPU here ({adapter['device']}); bring a Vulkan loader and the GPU's driver"
        return None if device.is_cuda or software else f"WebGPU draws on a GPU here ({adapter['device']})"

    def version(self) -> str:
        """Version of the package and what it draws on."""
        adapter = _adapter()
        return f"pygfx {importlib.metadata.version('pygfx')}, {adapter['device']}, {adapter['backend_type']}"

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Build the scene graph and draw it once."""
        return _PyGfxSession(case, scene, cameras, device)


def _lights(scene: Scene) -> list[Any]:
    """Point and spot lights, and ambient light."""
    import pygfx

    table = light_table(scene)
    # Ambient light is an irradiance there, π times the radiance.
    lights: list[Any] = [pygfx.AmbientLight(pygfx.Color.from_physical(*scene.environment.ambient), math.pi)]
    for k in range(len(table)):
        intensity = float(table.color[k].max())
        color = pygfx.Color.from_physical(*(table.color[k] / max(intensity, 1e-9)).tolist())
        shared = {"cast_shadow": bool(table.casts[k]), "distance": float(table.range[k]), "decay": 2}
        if table.cosines[k, 0] > -1.0:
            outer, inner = (math.acos(float(table.cosines[k, place])) for place in (1, 0))
            light = pygfx.SpotLight(color, intensity, angle=outer, penumbra=1.0 - inner / outer, **shared)
            light.target.local.position = table.position[k] + table.direction[k]
        else:
            light = pygfx.PointLight(color, intensity, **shared)
        light.local.position = table.position[k]
        lights.append(light)
    return lights


class _PyGfxSession:
    """A case opened by pygfx."""

    note = ""

    def __init__(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> None:
        import pygfx

        self.case, self.device = case, device
        geometry = geometry_of(scene)
        shape = pygfx.Geometry(
            positions=geometry.positions, normals=geometry.normals, indices=geometry.triangles.astype(np.uint32)
        )
        color = pygfx.Color.from_physical(*geometry.albedo)
        mesh = pygfx.Mesh(shape, pygfx.MeshPhongMaterial(color=color, specular="#000000", side="front"))
        mesh.cast_shadow = mesh.receive_shadow = case.shadowed > 0
        background = pygfx.Color.from_physical(*scene.environment.background)
        self.scene = pygfx.Scene()
        self.scene.add(pygfx.Background.from_color(background), mesh, *_lights(scene))
        (camera,) = cameras
        # An aspect of 1 makes the angle the vertical one of any picture that is wider than high.
        angle = math.degrees(camera.vertical_fov)
        self.camera = pygfx.PerspectiveCamera(angle, aspect=1.0, depth_range=(camera.near, FAR))
        self.camera.local.position = camera.position
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(camera.rotation).reshape(3, 3).T
        matrix[:3, 3] = camera.position
        self.camera.local.matrix = matrix
        self.target = pygfx.Texture(dim=2, size=(case.width, case.height, 1), format="rgba8unorm")
        self.renderer = pygfx.WgpuRenderer(self.target, pixel_ratio=1.0, pixel_filter="nearest", ppaa="none")
        self.word = self.renderer.device.create_buffer(size=4, usage="COPY_SRC")
        self.frame()

    def frame(self) -> None:
        """Draw, and wait until it is drawn: by reading four bytes, for the queue's own way is broken in wgpu 0.32."""
        self.renderer.render(self.scene, self.camera)
        self.renderer.device.queue.read_buffer(self.word)

    def time(self, repeats: int) -> Timing:
        """Time frames by the wall's clock."""
        started = time.perf_counter()
        while self.device.is_cuda and time.perf_counter() - started < WARM_UP_S:
            self.frame()
        values: list[float] = []
        started = time.perf_counter()
        while len(values) < repeats:
            begun = time.perf_counter()
            self.frame()
            values.append((time.perf_counter() - begun) * 1e3)
            if len(values) >= MIN_REPEATS and time.perf_counter() - started > CPU_BUDGET_S:
                break
        return Timing.of(values)

    def depth(self) -> np.ndarray | None:
        """None: its depth buffer is its own."""
        return None

    def picture(self) -> np.ndarray | None:
        """The picture as it is shown."""
        self.frame()
        return np.asarray(self.renderer.snapshot())[..., :3].copy()

    def close(self) -> None:
        """Drop the scene graph and the renderer."""
        self.scene = self.renderer = self.target = self.camera = self.word = None
