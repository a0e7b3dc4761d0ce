"""OpenGL 4.3 through moderngl and EGL: what the graphics hardware does with the same triangles and lights."""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import math
import time
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Scene

from ..timing import CPU_BUDGET_S, MIN_REPEATS, WARM_UP_S, Timing
from . import opengl_shaders as shaders
from .base import LightTable, Session, geometry_of, light_table, perspective, srgb, view_matrix
from .cases import KINDS, PeerCase

__all__ = ["OpenGL"]

#: Names under which loaders are installed: the second comes without X11.
LIBRARIES = ("libGL.so.1", "libOpenGL.so.0")
#: Words by which a driver that draws on the CPU is known.
SOFTWARE = ("llvmpipe", "softpipe", "swrast")
#: Far plane [m]; the terrain ends before it.
FAR = 60.0
#: Lights from which on a depth pass before shading pays.
PREPASS_LIGHTS = 4
#: What `GL_TIME_ELAPSED` is cut to by moderngl, which reads 32 bits.
OVERFLOW = 2**32 - 1


@functools.cache
def _context() -> Any:
    """The one context of the process, or a text that says why there is none."""
    if importlib.util.find_spec("moderngl") is None or importlib.util.find_spec("glcontext") is None:
        return "no module moderngl or glcontext; pip install moderngl glcontext"
    import moderngl

    errors = []
    for library in LIBRARIES:
        try:
            context = moderngl.create_context(
                standalone=True, require=430, backend="egl", libgl=library, libegl="libEGL.so.1"
            )
            # What is bound while another framebuffer is released.
            context.extra = context.framebuffer([context.texture((1, 1), 4)])
            return context
        except Exception as error:  # whatever a driver comes up with is a reason
            errors.append(f"{library}: {(str(error).strip() or type(error).__name__).splitlines()[0]}")
    return "no OpenGL 4.3 through EGL (" + "; ".join(errors) + ")"


class OpenGL:
    """The graphics hardware's own rasterizer; on a machine without one, Mesa's on the CPU."""

    name = "opengl"
    title = "OpenGL (moderngl, EGL)"
    kinds = tuple(KINDS)
    computes = (
        "clear, then a G-buffer of 16 bytes a pixel (a depth buffer of 24 bits, three targets of 4 bytes: normal in 8 "
        "bits an axis, albedo, and the rest); or forward shading of the same lights with the same formulas, all of "
        "them looped over at each fragment, after a depth pass from 4 lights on; shadow maps of the same size, drawn "
        "anew, 9 bilinear taps over 4x4 texels; sRGB"
    )
    leaves_out = (
        "culling of triangles and of lights; ids, specular reflection, tone curve; coverage and depth are whatever the "
        "driver makes them; the picture stays in a texture, and a copy to CUDA or the host is not in the time"
    )
    method = "GL_TIME_ELAPSED queries, queued without waiting between them; wall-clock time where it draws on the CPU"
    wins = (
        "Only two TPCs of an H100, whose chip the H200 has, run vertex and fragment shaders at all (NVIDIA H100 Tensor "
        "Core GPU Architecture, white paper), so that ratios from these cards say little of a graphics card. There, "
        "one light, or a few, shaded in the same draw that finds the surface, needs no G-buffer at all; and hardware "
        "interpolates, blends and compares depths in units of its own, so that overdraw by large triangles is cheap."
    )

    def available(self, device: wp.Device) -> str | None:
        """Say why there is no context, or none on the device's side of the machine."""
        context = _context()
        if isinstance(context, str):
            return context
        drawn = context.info["GL_RENDERER"]
        if device.is_cuda and any(word in drawn for word in SOFTWARE):
            return f"OpenGL draws on the CPU here ({drawn}); name the GPU's driver in __EGL_VENDOR_LIBRARY_FILENAMES"
        if device.is_cpu and not any(word in drawn for word in SOFTWARE):
            return f"OpenGL draws on a GPU here ({drawn}), and the others on the CPU"
        return None

    def version(self) -> str:
        """Version of moderngl and the driver's own words."""
        info = _context().info
        return f"moderngl {importlib.metadata.version('moderngl')}, {info['GL_RENDERER']}, {info['GL_VERSION']}"

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Upload triangles and lights, compile the shaders."""
        return _OpenGLSession(case, scene, cameras, device)


class _OpenGLSession:
    """A case opened by OpenGL: one framebuffer, views side by side in it."""

    def __init__(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> None:
        self.case, self.device, self.context = case, device, _context()
        self.note = ""
        self.held: list[Any] = []
        geometry = geometry_of(scene)
        self.across = math.ceil(math.sqrt(case.views))
        self.down = -(-case.views // self.across)
        self.size = (self.across * case.width, self.down * case.height)
        self.projection = perspective(cameras[0], case.width, case.height, FAR)
        self.matrices = [(_bytes(view_matrix(c)), _bytes(self.projection)) for c in cameras]
        self.points = self._keep(self.context.buffer(geometry.positions.tobytes()))
        self.normals = self._keep(self.context.buffer(geometry.normals.tobytes()))
        self.indices = self._keep(self.context.buffer(geometry.triangles.tobytes()))
        self.depth_map = self._keep(self.context.depth_texture(self.size))
        self.albedo = geometry.albedo
        if case.kind == "gbuffer":
            self._open_gbuffer()
        else:
            self._open_forward(scene)
        self.frame()
        self.context.finish()
        if (error := self.context.error) != "GL_NO_ERROR":
            raise RuntimeError(f"OpenGL: {error}")

    def _keep(self, thing: Any) -> Any:
        self.held.append(thing)
        return thing

    def _draws(self, fragment: str, normals: bool) -> Any:
        """Vertex array of all triangles under a fragment shader."""
        program = self._keep(self.context.program(vertex_shader=shaders.VERTEX, fragment_shader=fragment))
        content = [(self.points, "3f", "position")] + [(self.normals, "3f", "normal")] * normals
        return self._keep(self.context.vertex_array(program, content, index_buffer=self.indices))

    def _open_gbuffer(self) -> None:
        self.images = [self._keep(self.context.texture(self.size, 4)) for _ in range(3)]
        self.target = self._keep(self.context.framebuffer(self.images, self.depth_map))
        self.shaded = self._draws(shaders.GBUFFER_FRAGMENT, normals=True)
        self.shaded.program["albedo"] = self.albedo
        self.before = self.shadows = None

    def _open_forward(self, scene: Scene) -> None:
        table = light_table(scene)
        self.images = [self._keep(self.context.texture(self.size, 4))]
        self.target = self._keep(self.context.framebuffer(self.images, self.depth_map))
        self.shaded = self._draws(shaders.FORWARD_FRAGMENT, normals=True)
        self.before = self._draws(shaders.DEPTH_FRAGMENT, normals=False) if len(table) >= PREPASS_LIGHTS else None
        casting = np.flatnonzero(table.casts)
        self.shadows = _ShadowMaps(self, table, casting) if len(casting) else None
        rows = _light_rows(table)
        if self.shadows:
            rows["to_map"][casting] = self.shadows.to_map
        self.lights = self._keep(self.context.buffer(rows.tobytes()))
        program = self.shaded.program
        program["count"], program["albedo"], program["ambient"] = len(table), self.albedo, scene.environment.ambient
        self.background = scene.environment.background
        if self.shadows:
            program["texel"], program["maps"] = 1.0 / self.shadows.map.width, 0
        else:  # the sampler still needs a depth texture that is compared
            self.unused = self._keep(self.context.depth_texture((1, 1)))
            self.unused.compare_func = "<="
            program["texel"], program["maps"] = 0.0, 0

    def frame(self) -> None:
        """Draw all views."""
        context = self.context
        context.enable_only(context.DEPTH_TEST | context.CULL_FACE)
        if self.shadows:
            self.shadows.draw()
        self.target.use()
        context.viewport = (0, 0, *self.size)
        if self.case.kind == "gbuffer":
            self.target.clear()
        else:
            self.target.clear(*(float(c) / 255.0 for c in srgb(self.background)), 1.0)
            self.lights.bind_to_storage_buffer(0)
            (self.shadows.map if self.shadows else self.unused).use(0)
        for k, (view, projection) in enumerate(self.matrices):
            row, column = divmod(k, self.across)
            context.viewport = (column * self.case.width, row * self.case.height, self.case.width, self.case.height)
            context.depth_func = "<"
            if self.before is not None:
                _draw(self.before, view, projection)
                context.depth_func = "<="
            _draw(self.shaded, view, projection)

    def time(self, repeats: int) -> Timing:
        """Time frames by the driver's own clock, or by the wall's where it draws on the CPU."""
        if self.device.is_cpu:
            return self._wall_clock(repeats)
        started = time.perf_counter()
        while time.perf_counter() - started < WARM_UP_S:
            for _ in range(5):
                self.frame()
            self.context.finish()
        queries = [self.context.query(time=True) for _ in range(repeats)]
        for query in queries:
            with query:
                self.frame()
        self.context.finish()
        values = [query.elapsed for query in queries]
        if OVERFLOW in values or 0 in values:
            raise RuntimeError("OpenGL: expected times of GL_TIME_ELAPSED below 4.29 s, got one that is none")
        return Timing.of([value * 1e-6 for value in values])

    def _wall_clock(self, repeats: int) -> Timing:
        values: list[float] = []
        started = time.perf_counter()
        while len(values) < repeats:
            begun = time.perf_counter()
            self.frame()
            self.context.finish()
            values.append((time.perf_counter() - begun) * 1e3)
            if len(values) >= MIN_REPEATS and time.perf_counter() - started > CPU_BUDGET_S:
                break
        return Timing.of(values)

    def _views(self, image: np.ndarray) -> np.ndarray:
        """Cut an image with row 0 at the bottom into views with row 0 at the top."""
        height, width = self.case.height, self.case.width
        rows = image.reshape(self.down, height, self.across, width, *image.shape[2:]).swapaxes(1, 2)
        return rows.reshape(-1, height, width, *image.shape[2:])[: self.case.views, ::-1]

    def depth(self) -> np.ndarray | None:
        """The depth buffer's, 24 bits of z/w, made linear."""
        self.frame()
        depth = self._views(np.frombuffer(self.depth_map.read(), np.float32).reshape(self.size[::-1]))
        slope, offset = self.projection[2, 2:]
        return np.where(depth < 1.0, offset / (2.0 * depth - 1.0 + slope), np.inf).astype(np.float32)

    def picture(self) -> np.ndarray | None:
        """The shaded picture; None for a G-buffer."""
        if self.case.kind == "gbuffer":
            return None
        self.frame()
        image = np.frombuffer(self.images[0].read(), np.uint8).reshape(*self.size[::-1], 4)
        return self._views(image)[0, ..., :3].copy()

    def close(self) -> None:
        """Release all that was made, newest first."""
        self.context.extra.use()
        for thing in reversed(self.held):
            thing.release()
        self.held.clear()


class _ShadowMaps:
    """Depth maps of the casting spots, side by side in one texture."""

    def __init__(self, session: _OpenGLSession, table: LightTable, casting: np.ndarray) -> None:
        self.context, side = session.context, session.case.map_size
        across = math.ceil(math.sqrt(len(casting)))
        self.map = session._keep(self.context.depth_texture((across * side, across * side)))
        self.map.compare_func, self.map.filter = "<=", (self.context.LINEAR, self.context.LINEAR)
        self.target = session._keep(self.context.framebuffer([], self.map))
        self.draws = session._draws(shaders.DEPTH_FRAGMENT, normals=False)
        self.views, places = [], []
        for place, k in enumerate(casting):
            row, column = divmod(place, across)
            angle = 2.0 * math.acos(float(table.cosines[k, 1])) + 0.01
            eye, reach = table.position[k].astype(float), float(table.range[k])
            camera = Camera.look_at(eye, eye + table.direction[k], vertical_fov=angle, near=0.02 * reach)
            matrices = view_matrix(camera), perspective(camera, 1, 1, reach)
            self.views.append(((column * side, row * side, side, side), *map(_bytes, matrices)))
            # From clip space to the place in the texture, depth in [0, 1].
            scale = np.diag([0.5 / across, 0.5 / across, 0.5, 1.0])
            scale[:3, 3] = (column + 0.5) / across, (row + 0.5) / across, 0.5
            places.append((scale @ matrices[1] @ matrices[0]).T.astype(np.float32))
        self.to_map = np.array(places)

    def draw(self) -> None:
        """Draw every map anew."""
        self.target.use()
        self.context.viewport = (0, 0, *self.map.size)
        self.target.clear(depth=1.0)
        self.context.depth_func = "<"
        self.context.disable(self.context.CULL_FACE)
        self.context.polygon_offset = 2.0, 4.0
        for viewport, view, projection in self.views:
            self.context.viewport = viewport
            _draw(self.draws, view, projection)
        self.context.polygon_offset = 0.0, 0.0
        self.context.enable(self.context.CULL_FACE)


def _light_rows(table: LightTable) -> np.ndarray:
    """Lights as the shader's struct lays them out (std430)."""
    row = np.dtype([("position", "4f4"), ("color", "4f4"), ("axis", "4f4"), ("cone", "4f4"), ("to_map", "(4,4)f4")])
    rows = np.zeros(len(table), row)
    rows["position"][:, :3], rows["position"][:, 3] = table.position, table.range
    rows["color"][:, :3], rows["color"][:, 3] = table.color, table.casts
    scale = 1.0 / np.maximum(0.001, table.cosines[:, 0] - table.cosines[:, 1])
    length = np.linalg.norm(table.direction, axis=1, keepdims=True)
    rows["axis"][:, :3], rows["axis"][:, 3] = table.direction / np.where(length > 0.0, length, 1.0), scale
    rows["cone"][:, 0] = -table.cosines[:, 1] * scale
    return rows


def _bytes(matrix: np.ndarray) -> bytes:
    return matrix.T.astype("f4").tobytes()


def _draw(array: Any, view: bytes, projection: bytes) -> None:
    array.program["view"].write(view)
    array.program["projection"].write(projection)
    array.render()
