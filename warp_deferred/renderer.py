"""The renderer: scene in, frames out. Looks plans up, packs cameras, uploads what changed, replays."""

from __future__ import annotations

import dataclasses
import functools
import operator
import os
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import warp as wp

from .camera import Camera
from .channels import OUTPUTS
from .checks import check_choice, check_count, input_error
from .device_arrays import as_float_array, find_device
from .device_scene import DeviceScene
from .effects import called_for
from .explain import Explanation, MemoryReport
from .features import Features
from .frame import Frame
from .kernels import clusters as cluster_kernels
from .light_store import LightStore
from .memory import enough_memory
from .passes.base import Lens, Pass, Request
from .plan import PASSES, Plan
from .scene import Scene
from .selection import check_passes, with_passes
from .settings import Settings
from .shadow_slots import ShadowTable, plan_slots
from .turns import in_turn
from .views import MAX_SIZE, ViewSize

__all__ = ["Renderer"]

#: Plans kept; the least recently used one goes.
MAX_PLANS = 8
#: Packing of `structs.FrameValues`.
VALUES = struct.Struct("<3fi3fi")


class Renderer:
    """Renders a scene at one size with a fixed set of outputs.

    A frame costs no allocation and no compilation once its plan exists. Changing the scene's numbers (transforms,
    lights, cameras) keeps the plan; changing what exists looks another one up or builds it.

    Args:
        scene: What to render; read anew at every `render`.
        width: Width of a view [px], 1 to 16384.
        height: Height of a view [px], 1 to 16384.
        device: Warp device name; the current default if left out.
        outputs: Names of the outputs wanted, see `warp_deferred.channels.OUTPUTS`.
        settings: How accurately; the scene's own settings if left out.
        threads: Host threads on the CPU; the number of cores if left out.
        share_memory: Let transient buffers share memory; False keeps each whole until the next frame, so that single
            passes can be looked at and timed by themselves.
        passes: Passes of your own, objects or classes of `warp_deferred.Pass`, see docs/custom-pass.md.

    Raises:
        InputError: If a size, an output, a setting or a pass does not fit.
        DeviceError: If the device is not there.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        width: int = 1280,
        height: int = 720,
        device: Any = None,
        outputs: Sequence[str] = ("display",),
        settings: Settings | None = None,
        threads: int | None = None,
        share_memory: bool = True,
        passes: Sequence[Pass | type[Pass]] = (),
    ) -> None:
        if not isinstance(scene, Scene):
            raise input_error(
                "Renderer.scene", "a Scene", type(scene).__name__, "load one with warp_deferred.load(...)"
            )
        self.scene = scene
        self.width = check_count("Renderer.width", width, 1, MAX_SIZE, "images are 1 to 16384 pixels a side")
        self.height = check_count("Renderer.height", height, 1, MAX_SIZE, "images are 1 to 16384 pixels a side")
        if isinstance(outputs, str):
            raise input_error("Renderer.outputs", "a sequence of names", outputs, f"write outputs=({outputs!r},)")
        self.outputs = frozenset(check_choice("Renderer.outputs", name, OUTPUTS) for name in outputs)
        if not self.outputs:
            raise input_error(
                "Renderer.outputs", "at least one name", "<nothing>", 'the picture is outputs=("display",)'
            )
        self.settings = settings
        self.device = find_device(device)
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        wanted = cores if threads is None else check_count("Renderer.threads", threads, 1, 256)
        self.threads = 0 if self.device.is_cuda else wanted
        self._share_memory = bool(share_memory)
        self._passes = check_passes(passes, PASSES)
        self._plans: dict[Request, Plan] = {}
        self._device_scene: DeviceScene | None = None
        self._lights: dict[tuple[int, int], LightStore] = {}
        self._seen: tuple[int, ...] = ()
        self._revision = -1
        self._scene_key = 0
        self._requests: dict[Any, tuple[Request, ShadowTable | None]] = {}
        self._generation = 0
        self._plan: Plan | None = None
        self._fast: tuple[Any, ...] | None = None
        self._packed: tuple[Any, list[Camera], bytes] | None = None
        self._moving = ""
        self._watched: tuple[int, list[Camera]] | None = None

    @property
    def settings(self) -> Settings:
        """The settings in force; assign others to render with them from the next frame on."""
        return self._settings or self.scene.settings

    @settings.setter
    def settings(self, value: Settings | None) -> None:
        if value is not None and not isinstance(value, Settings):
            raise input_error("Renderer.settings", "a Settings object", type(value).__name__)
        self._settings = value

    @property
    def plan(self) -> Plan | None:
        """The plan of the last frame: passes, buffers and program, to look at and to time; None before the first."""
        return self._plan

    @in_turn
    def prepare(
        self,
        progress: Callable[[str, int, int], None] | None = None,
        *,
        views: int = 1,
        camera: Camera | Sequence[Camera] | None = None,
    ) -> None:
        """Build the plan and compile all it needs, so that the first `render` is as quick as the next.

        Args:
            progress: Called with (kernel, done, total) before each module is compiled or loaded.
            views: Number of views a frame will have.
            camera: The camera or cameras the frame will be rendered with; the scene's, once a view, if left out.
        """
        cameras = [self.scene.camera or Camera()] * views if camera is None else self.cameras_of(camera)
        if any(c.lens_flags & 2 for c in cameras):
            self._watch(cameras, None)
        self._look_up(cameras, progress)

    @in_turn
    def render(self, camera: Camera | Sequence[Camera] | None = None, *, poses: Any = None) -> Frame:
        """Render one frame.

        Args:
            camera: A camera, several for a batch of views, or None for the scene's.
            poses: Device array (views, 4, 4) float32 of rigid camera-to-world matrices that replace the cameras'
                poses, copied on the device and never read back.

        Returns:
            The frame, valid until the next `render`.

        Raises:
            InputError: If there is no camera or an argument does not fit.
            Error: If `Settings.check_finite` is set and a pass wrote a number that is not finite.
        """
        cameras = self.cameras_of(camera)
        if any(c.lens_flags & 2 for c in cameras):
            self._watch(cameras, poses)
        plan = self._look_up(cameras, None)
        resources = plan.resources
        self._update()
        block = resources.frame.begin()
        self._write_views(plan, block[resources.frame.views_offset :], cameras)
        environment = self.scene.environment
        VALUES.pack_into(
            block,
            resources.frame.values_offset,
            *environment.ambient,
            len(self.scene.lights),
            *environment.background,
            len(cameras),
        )
        resources.frame.upload()
        if poses is not None:
            self._stage_poses(poses, len(cameras), resources)
        # Before the replay: should it fail, the frame before is drawn over all the same.
        self._generation += 1
        generation = self._generation
        plan.replay()
        return Frame(plan.shown, cameras, lambda: self._generation == generation)

    def _write_views(self, plan: Plan, block: memoryview, cameras: list[Camera]) -> None:
        """Pack the cameras, or copy the last bytes where they are the same objects: fixed views cost a copy."""
        known = self._packed
        if known is not None and known[0] is self._fast and all(map(operator.is_, cameras, known[1])):
            block[:] = known[2]
            return
        plan.packer.write(block, cameras, self._fast[4])
        self._packed = (self._fast, cameras, bytes(block))

    def _watch(self, cameras: list[Camera], poses: Any) -> None:
        """Note what is declared to move, once; it stays so, for a thing at rest moves by nothing."""
        if self._moving:
            return
        scene, known = self.scene, self._watched
        self._watched = (scene.revision, cameras)
        if scene.transforms is not None or poses is not None:
            self._moving = "transforms or poses come from an array"
        elif any(not isinstance(binding.array, np.ndarray) for binding in scene.point_bindings):
            self._moving = "points come from an array"
        elif scene.animate is not None:
            self._moving = "the scene can be animated"
        elif known is not None and (known[0] != scene.revision or known[1] != cameras):
            self._moving = "transforms or cameras have changed between frames"

    def _stage_poses(self, poses: Any, count: int, resources: Any) -> None:
        array = as_float_array("render.poses", poses, self.device, (count, 4, 4))
        wp.launch(
            cluster_kernels.stage_cameras_kernel,
            dim=count,
            inputs=[array],
            outputs=[resources.frame.uploaded],
            device=self.device,
            block_dim=cluster_kernels.BLOCK_DIM,
        )

    def cameras_of(self, camera: Camera | Sequence[Camera] | None) -> list[Camera]:
        """Return the cameras that `render(camera)` would take: the one or those given, or the scene's.

        Raises:
            InputError: If there is none.
        """
        if camera is None:
            camera = self.scene.camera
            if camera is None:
                raise input_error(
                    "render.camera", "a Camera", None, "the scene has none: pass one, or set scene.camera"
                )
        if isinstance(camera, Camera):
            return [camera]
        cameras = list(camera) if isinstance(camera, Iterable) else []
        if not cameras or not all(isinstance(c, Camera) for c in cameras):
            raise input_error("render.camera", "a Camera or a sequence of them", camera)
        return cameras

    def _look_up(self, cameras: list[Camera], progress: Callable[[str, int, int], None] | None) -> Plan:
        scene = self.scene
        seen = (scene.structure_revision, scene.lights.structure_revision, scene.look_revision)
        chosen = tuple([c.selector for c in cameras])
        if self._moving:
            chosen = (*chosen, self._moving)
        # The common case, a frame like the last one, must not hash settings or requests.
        settings = self._settings or scene.settings
        fast = self._fast
        if fast is not None and fast[0] == seen and fast[1] == chosen and fast[2] is settings:
            return fast[3]
        if self._device_scene is None or self._seen[:1] != seen[:1]:
            self._load_scene()
        if self._seen != seen:
            self._features = Features.of(scene)
            self._seen = seen
            self._requests.clear()
        key = (chosen, settings)
        if key not in self._requests:
            self._requests[key] = self._request(cameras)
        request, table = self._requests[key]
        plan = self._plans.get(request)
        if plan is None:
            plan = self._build(request, progress)
        if plan is not self._plan:
            self._plans[request] = self._plans.pop(request)
            self._plan = plan
            plan.forget()
        slots = table.slots if table else ()
        ranges = self._ranges([*(c.world for c in cameras), *(slot.world for slot in slots)])
        if table:
            plan.stage_shadows(table, ranges[len(cameras) :])
        self._fast = (seen, chosen, settings, plan, ranges[: len(cameras)])
        return plan

    def _load_scene(self) -> None:
        self._plans.clear()
        self._plan = None
        self._fast = None
        self._lights.clear()
        size = sum(m.nbytes for m in {id(i.mesh): i.mesh for i in self.scene.instances}.values())
        with enough_memory("scene", size, self.device, "split the scene or use fewer or smaller textures"):
            self._device_scene = DeviceScene(self.scene, self.device)
        self._revision = self.scene.revision
        self._scene_key += 1

    def _request(self, cameras: list[Camera]) -> tuple[Request, ShadowTable | None]:
        """What the frame asks of a plan, and its shadow maps where it has shadows."""
        scale = self.settings.scale
        if scale.rung != "off" and self.outputs != {"display"}:
            raise input_error(
                "Renderer.outputs",
                f"display alone while scale.rung is {scale.rung}",
                sorted(self.outputs),
                "set scale.rung=off: other outputs have a value for each rendered pixel, and there are fewer of them",
            )
        shown = (0, 0) if scale.rung == "off" else (self.width, self.height)
        size = ViewSize(scale.rendered(self.width), scale.rendered(self.height), False, *shown)
        request = Request(
            outputs=self.outputs,
            sizes=(size,) * len(cameras),
            settings=self.settings,
            features=self._features,
            **self._device_scene.capacities([c.world for c in cameras]),
            scene_key=self._scene_key,
            threads=self.threads,
            share_memory=self._share_memory,
            moving=self._moving,
            lens=Lens.of(functools.reduce(operator.or_, [c.lens_flags for c in cameras])),
        )
        request = with_passes(request, self._passes)
        if not (request.lit and called_for(request, "shadow")):
            return request, None
        worlds = [c.world for c in cameras]
        table = plan_slots(self.scene.lights, worlds, request.settings.shadow)
        sizes = [ViewSize(slot.size, slot.size, depth_only=True) for slot in table.slots]
        capacities = self._device_scene.capacities(worlds + [slot.world for slot in table.slots])
        sizes = (*request.sizes, *sizes)
        return dataclasses.replace(request, sizes=sizes, shadow_slots=len(table.slots), **capacities), table

    def _build(self, request: Request, progress: Callable[[str, int, int], None] | None) -> Plan:
        key = (request.features.light_capacity, request.cameras)

        def lights() -> LightStore:
            if key not in self._lights:
                self._lights[key] = LightStore(*key, self.device)
            return self._lights[key]

        if self.scene.transforms is not None:
            # Trees for rays are cut by where instances stand when they are made.
            self._device_scene.stage_transforms(self.scene.transforms)
        while len(self._plans) >= MAX_PLANS:
            self._plans.pop(next(iter(self._plans)))
        self._plans[request] = Plan(request, self._device_scene, lights, progress, [*self._plans.values()])
        return self._plans[request]

    def _update(self) -> None:
        scene, device_scene = self.scene, self._device_scene
        if scene.transforms is not None:
            device_scene.stage_transforms(scene.transforms)
            # The staging overwrites the host's transforms: they are uploaded again once the array is unbound.
            self._revision = -1
        elif self._revision != scene.revision:
            device_scene.update_transforms(scene)
            self._revision = scene.revision
        if device_scene.points is not None:
            device_scene.points.stage(scene.point_bindings)
        if len(scene.lights):
            self._plan.resources.lights.update(scene.lights)

    def _ranges(self, worlds: Sequence[int]) -> list[tuple[int, ...]]:
        result, offset = [], 0
        for world in worlds:
            r = self._device_scene.view_range(world)
            result.append((offset, *r))
            offset += r[0] + r[2]
        return result

    @in_turn
    def explain(self, *, measure: bool = True, views: int = 1) -> Explanation:
        """Tell for each pass whether it runs, why, at which rung, and what it costs.

        Args:
            measure: Time each pass by itself; renders a few frames of the scene's camera.
            views: Number of views a frame has, where none was rendered yet.
        """
        if self._plan is None or measure:
            if measure:
                self.render() if self.scene.camera is not None else self.render([Camera()] * views)
            else:
                self.prepare(views=views)
        plan = self._plan
        return Explanation.of(self.scene, plan, plan.reports(measure))

    def memory_report(self) -> MemoryReport:
        """List device memory by buffer, the scene's apart."""
        if self._plan is None:
            self.prepare()
        return MemoryReport.of(self._plan, self._device_scene)
