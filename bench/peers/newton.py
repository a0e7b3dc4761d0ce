"""Newton's camera sensors: rays against a tree of the triangles, every light looped over at every pixel.

Public methods make one directional light only; the kernels take arrays of any number, which the benches hand to the
sensor's render context. Written against newton 1.8.0.
"""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import warnings
from typing import Any

import numpy as np
import warp as wp

from warp_deferred import Camera, Scene

from ..timing import Timing
from .base import Session, geometry_of, light_table, srgb, time_warp
from .cases import KINDS, PeerCase

__all__ = ["SensorCamera", "SensorTiledCamera"]

#: Numbers of light types in Newton's kernels; what is neither spot nor directional shines everywhere.
SPOT, POINT = 0, 2
#: Models that are kept: the terrain of the G-buffers, with every kind of tree, and that of all other cases.
KEPT = 4
_kept: dict[tuple[str, str, str | None], Any] = {}
#: Device -> way to build the tree that is searched fastest.
_fastest: dict[str, str | None] = {}
#: Ways to build the tree of a mesh, the builder's default first; the fastest to search is taken.
CONSTRUCTORS = (None, "sah", "cubql")
#: Measurements for that choice.
TRIALS = 5
#: Images of a G-buffer.
GBUFFER = ("forward_depth", "normal", "albedo", "shape_index")


class _Newton:
    """What both sensors have in common."""

    kinds = tuple(KINDS)
    method = "device time of its own launches, captured into a CUDA graph and replayed"
    wins = (
        "It has no cost for a view's existence but its rays, so that it can win where pixels are few and triangles "
        "many: a tree is searched in the logarithm of the triangles, a raster draws what culling leaves of them all. "
        "Its tree is built once, outside the clock; where geometry moves it must be fitted anew."
    )

    def available(self, device: wp.Device) -> str | None:
        """Say why Newton cannot be imported."""
        if importlib.util.find_spec("newton") is None:
            return "no module newton; pip install newton"
        return None

    def version(self) -> str:
        """Version of the package, and the kinds of trees that were searched fastest."""
        trees = "".join(f", {kind or 'default'} tree on {device}" for device, kind in _fastest.items())
        return f"newton {importlib.metadata.version('newton')}{trees}"


class SensorTiledCamera(_Newton):
    """The sensor whose kernels take several lights, without colours."""

    name = "newton"
    title = "Newton SensorTiledCamera"
    computes = (
        "one primary ray a pixel; depth, interpolated normal, albedo and shape index, or the shaded picture in 8 bits; "
        "Lambert under all lights, looped over at each pixel; one shadow ray a light and pixel; hemispheric ambient "
        "light. Of the trees that Warp builds, the one that is searched fastest; pixels go in tiles of 8x8"
    )
    leaves_out = (
        "colour, intensity and range of lights (attenuation is 1 / (1 + 0.02 d²), so that no light can be left out "
        "anywhere), specular reflection, tone curve; a shadow leaves 0.3 of the light. Ours has no rays here: shadows "
        "are filtered maps"
    )

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Build the model and the sensor."""
        return _TiledSession(case, scene, cameras, device)


class SensorCamera(_Newton):
    """Its successor, whose lights have colours."""

    name = "newton_sensor_camera"
    title = "Newton SensorCamera"
    computes = SensorTiledCamera.computes.replace("Lambert under", "Lambert under the colours of")
    leaves_out = (
        "range of lights (attenuation is 1 / (1 + 0.02 d²), so that no light can be left out anywhere), specular "
        "reflection, tone curve; a shadow leaves 0.3 of the light; several lights only through its render context"
    )

    def open(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> Session:
        """Build the model and the sensor."""
        return _CameraSession(case, scene, cameras, device)


def _model(scene: Scene, device: wp.Device, constructor: str | None = None) -> Any:
    """Newton's model of the scene: one static mesh; the last ones are kept, since to finalize one takes seconds."""
    import newton

    geometry = geometry_of(scene)
    key = (geometry.digest, str(device), constructor)
    if key not in _kept:
        while len(_kept) >= KEPT:
            _kept.pop(next(iter(_kept)))
        mesh = newton.Mesh(
            geometry.positions, geometry.triangles.ravel(), normals=geometry.normals, compute_inertia=False,
            is_solid=False,
        )  # fmt: skip
        builder = newton.ModelBuilder(up_axis="Y")
        builder.default_bvh_cfg.mesh_constructor = constructor
        builder.add_shape_mesh(-1, mesh=mesh, color=tuple(srgb(geometry.albedo) / 255.0))
        _kept[key] = builder.finalize(device=device)
    return _kept[key]


def _constructors(device: wp.Device) -> tuple[str | None, ...]:
    """Kinds of trees that are tried: all on CUDA, the default alone on the CPU."""
    return CONSTRUCTORS if device.is_cuda else CONSTRUCTORS[:1]


def _lights(scene: Scene, device: wp.Device) -> dict[str, Any]:
    """Arrays of the lights, by the names the kernels have for them."""
    table = light_table(scene)
    kinds = np.where(table.cosines[:, 0] > -1.0, SPOT, POINT).astype(np.int32)
    return {
        "active": wp.full(len(table), True, dtype=wp.bool, device=device),
        "type": wp.array(kinds, dtype=wp.int32, device=device),
        "cast_shadow": wp.array(table.casts, dtype=wp.bool, device=device),
        "position": wp.array(table.position, dtype=wp.vec3, device=device),
        "orientation": wp.array(table.direction, dtype=wp.vec3, device=device),
        # Attenuation without a range leaves about 1 of a light: as bright as ours is halfway to the end of its range.
        "color": wp.array(table.color * (4.0 / np.pi) / table.range[:, None] ** 2, dtype=wp.vec3, device=device),
    }


def _poses(cameras: list[Camera]) -> np.ndarray:
    """Camera-to-world transforms, (views, 7) float32: position, then quaternion x y z w."""
    rows = []
    for camera in cameras:
        axes = np.array(camera.rotation, np.float32).reshape(3, 3).T
        rows.append([*camera.position, *wp.quat_from_matrix(wp.mat33(*axes.ravel().tolist()))])
    return np.array(rows, np.float32)


class _NewtonSession:
    """A case opened by either sensor: images as their names in `update`, and the call itself."""

    note = ""

    def __init__(self, case: PeerCase, scene: Scene, cameras: list[Camera], device: wp.Device) -> None:
        self.case, self.device, self.inputs = case, device, (scene, cameras)
        self.lit = case.kind != "gbuffer"
        self.config = {"render_order": 2, "tile_width": 8, "tile_height": 8, "enable_shadows": case.shadowed > 0}
        self._build(_fastest[str(device)] if str(device) in _fastest else self._choose())
        self.images = {name: self._image(name) for name in (("color",) if self.lit else GBUFFER)}

    def _build(self, constructor: str | None) -> None:
        self.model = _model(self.inputs[0], self.device, constructor)
        self.state = self.model.state()
        self._open(*self.inputs)

    def _choose(self) -> str | None:
        """Time a G-buffer with each kind of tree, once a device, and keep the fastest."""
        times: dict[str | None, float] = {}
        choices = _constructors(self.device)
        for constructor in choices if len(choices) > 1 else ():
            try:
                self._build(constructor)
                images, plain = {name: self._image(name) for name in GBUFFER}, self._plain()
                run = functools.partial(self._update, images, plain)
                times[constructor] = time_warp(self, self.device, run, TRIALS).median
            except Exception:  # whatever it is: a kind of tree that this version or device has not
                continue
        _fastest[str(self.device)] = min(times, key=times.get) if times else None
        return _fastest[str(self.device)]

    def _plain(self) -> Any:
        """Settings without shadows: those of a G-buffer, whose kernel they share."""
        return self.sensor.RenderConfig(**self.config | {"enable_shadows": False})

    def _open(self, scene: Scene, cameras: list[Camera]) -> None:
        raise NotImplementedError

    def _update(self, images: dict[str, wp.array], config: Any = None) -> None:
        """Render; into these images, with the sensor's own settings or others."""
        raise NotImplementedError

    def _image(self, name: str) -> wp.array:
        dtype = {"normal": wp.vec3, "forward_depth": wp.float32}.get(name, wp.uint32)
        return wp.zeros(self.shape, dtype=dtype, device=self.device)

    def time(self, repeats: int) -> Timing:
        """Time replays of one update of the sensor."""
        return time_warp(self, self.device, lambda: self._update(self.images), repeats)

    def depth(self) -> np.ndarray | None:
        """Depth along the camera's axis; by the G-buffer's kernel, which is compiled already, in a lit case, too."""
        images = {name: self._image(name) for name in GBUFFER}
        self._update(images, self._plain())
        depth = self._views(images["forward_depth"])
        return np.where(self._views(images["shape_index"]) == 0xFFFFFFFF, np.inf, depth).astype(np.float32)

    def _views(self, image: wp.array) -> np.ndarray:
        return image.numpy().reshape(self.case.views, self.case.height, self.case.width)

    def picture(self) -> np.ndarray | None:
        """The packed colours; None for a G-buffer."""
        if not self.lit:
            return None
        self._update(self.images)
        packed = self._views(self.images["color"])[0]
        return np.stack([packed >> shift & 0xFF for shift in (0, 8, 16)], axis=-1).astype(np.uint8)

    def close(self) -> None:
        """Drop model and sensor."""
        self.model = self.state = self.sensor = self.inputs = None
        self.images = {}


class _TiledSession(_NewtonSession):
    def _open(self, scene: Scene, cameras: list[Camera]) -> None:
        from newton.sensors import SensorTiledCamera as Sensor

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            warnings.simplefilter("ignore", UserWarning)
            self.sensor = Sensor(self.model, default_render_config=Sensor.RenderConfig(**self.config))
        context = next(v for k, v in vars(self.sensor).items() if k.endswith("__render_context"))
        for name, array in _lights(scene, self.device).items():
            setattr(context, f"lights_{name}", array)
        case, count = self.case, len(cameras)
        self.shape = (1, count, case.height, case.width)
        angles = [camera.vertical_fov for camera in cameras]
        self.rays = self.sensor.utils.compute_camera_rays_pinhole(case.width, case.height, camera_fovs=angles)
        self.poses = wp.array(_poses(cameras).reshape(count, 1, 7), dtype=wp.transform, device=self.device)

    def _update(self, images: dict[str, wp.array], config: Any = None) -> None:
        named = {f"{name}_image": image for name, image in images.items()}
        self.sensor.update(self.state, self.poses, self.rays, render_config=config, **named)


class _CameraSession(_NewtonSession):
    def _open(self, scene: Scene, cameras: list[Camera]) -> None:
        from newton.sensors import SensorCamera as Sensor

        self.sensor = Sensor(self.model, default_render_config=Sensor.RenderConfig(**self.config))
        for name, array in _lights(scene, self.device).items():
            setattr(self.sensor._render_context, f"_lights_{name}", array)
        case, count = self.case, len(cameras)
        self.shape = (count, case.height, case.width)
        self.rays = Sensor.compute_camera_rays_pinhole(
            case.width, case.height, camera_fov=cameras[0].vertical_fov, device=self.device
        )
        self.poses = wp.array(_poses(cameras), dtype=wp.transform, device=self.device)
        self.worlds = wp.zeros(count, dtype=wp.int32, device=self.device)

    def _update(self, images: dict[str, wp.array], config: Any = None) -> None:
        named = {f"{name}_image": image for name, image in images.items()}
        self.sensor.update(self.state, self.poses, self.rays, world_indices=self.worlds, render_config=config, **named)
