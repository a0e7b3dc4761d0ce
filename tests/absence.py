"""A frame with every effect that can be together but one, made in a process of its own; see test_effects_absent.py.

`python absence.py EFFECT FOLDER [blocked]` renders the frame without EFFECT and writes `FOLDER/NAME.npy` for each
output and `FOLDER/seen.json`: modules that were imported, kernels that are launched and buffers that are there. With
`blocked`, importing the effect's modules is an error.
"""

from __future__ import annotations

import json
import pathlib
import sys

import numpy as np
import warp as wp

__all__ = ["GOES_WITH", "GROUPS", "main", "modules_of", "scene_without"]

#: Name of an effect's modules -> passes they hold.
GROUPS = {
    "points": ("points",),
    "ambient_visibility": ("ambient_visibility",),
    "sampling": ("start_samples", "begin_sample", "accumulate", "average"),
    "shadow": ("shadow",),
    "motion": ("motion",),
    "depth_of_field": ("depth_of_field", "lens_samples"),
    "motion_blur": ("motion_blur", "shutter_samples"),
    "bloom": ("bloom",),
    "anti_aliasing": ("anti_aliasing",),
    "blur": ("blur",),
    "debug_view": ("debug_view",),
    "scale": ("scale",),
    "ray_scene": ("ray_scene", "ray_instances"),
}
#: Files of kernels that belong to an effect without bearing its name.
MORE_KERNELS = {
    "depth_of_field": ("lens", "lens_layers"),
    "ambient_visibility": ("hemisphere", "visibility_upsampling"),
}


#: What has to be absent, too: what reads the motion, and what has rungs of many samples in its file.
GOES_WITH = {
    "motion": ("motion_blur",),
    "motion_blur": ("motion",),
    "sampling": ("depth_of_field", "motion_blur", "motion"),
}


def modules_of(effect: str) -> list[str]:
    """Names of the modules that only this effect needs: its pass, and the kernel files of its stem."""
    folder = pathlib.Path(__file__).resolve().parents[1] / "kernels"
    longer = [other for other in GROUPS if other != effect and other.startswith(effect)]
    stems = [path.stem for path in folder.glob("*.py")]
    own = [s for s in stems if (s == effect or s.startswith(f"{effect}_")) and not s.startswith(tuple(longer))]
    own += MORE_KERNELS.get(effect, ())
    return [f"warp_deferred.passes.{effect}", *(f"warp_deferred.kernels.{stem}" for stem in sorted(own))]


def scene_without(effect: str):
    """A scene, outputs and settings that call for every effect that goes with the others, but one.

    `debug_view` goes with none of them, fxaa not with `sampling`, and shadow maps not with `ray_scene`: the picture
    without `anti_aliasing` takes samples and traces its shadows.
    """
    import warp_deferred as wd

    absent = (effect, *GOES_WITH.get(effect, ()))

    def has(name):
        return name not in absent

    scene = wd.Scene("absence")
    matt = wd.Material(model="lambert", base_color=(0.8, 0.7, 0.6, 1.0), two_sided=True)
    bright = wd.Material(model="lambert", base_color=(0.2, 0.2, 0.2, 1.0), emissive=(4.0, 3.0, 2.0))
    floor = wd.Mesh([[-4, 0, -4], [-4, 0, 4], [4, 0, 4], [4, 0, -4]], [[0, 1, 2], [0, 2, 3]])
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)], np.float32)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
             [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    cube = wd.Mesh(corners, faces)
    scene.add(floor, material=matt)
    for k, material in enumerate((matt, bright)):
        place = np.eye(4)
        place[:3, 3] = (k - 0.4, 0.5 + 0.2 * k, -0.8 * k)
        scene.add(cube, transform=place, material=material)
    if has("points"):
        scene.bind_points(cube, wp.array(corners * 0.9, dtype=wp.vec3, device="cpu"))
    scene.lights.add(wd.PointLight(position=(1.5, 2.5, 2.0), intensity=30.0, range=20.0, casts_shadow=has("shadow")))
    scene.environment = wd.Environment(ambient=(0.1,) * 3 if has("ambient_visibility") else (0.0,) * 3)
    scene.camera = wd.Camera.look_at((0.5, 1.5, 4.0), (0.0, 0.5, 0.0)).replace(
        aperture=0.05 if has("depth_of_field") else 0.0,
        focus_distance=4.0,
        shutter=0.5 if has("motion_blur") else 0.0,
        bloom=0.2 if has("bloom") else 0.0,
    )
    values = ["shadow.point_size=128", f"blur.sigma_px={int(has('blur'))}", "blur.rung=gaussian"]
    values += ["scale.rung=half"] * has("scale")
    values += ["anti_aliasing.rung=fxaa"]
    if not has("anti_aliasing"):
        values += ["anti_aliasing.rung=samples_4", "shadow.rung=ray_traced", "shadow.samples=4"]
    return scene, ("display",), wd.Settings().with_values(values)


def render(effect: str):
    """Render two frames between which the camera moves; the second one's outputs and its plan."""
    import warp_deferred as wd

    scene, outputs, settings = scene_without(effect)
    renderer = wd.Renderer(
        scene, width=48, height=36, device="cpu", outputs=outputs, settings=settings, share_memory=False
    )
    renderer.render()
    x, y, z = scene.camera.position
    frame = renderer.render(scene.camera.replace(position=(x + 0.05, y, z)))
    return {name: frame.numpy(name) for name in outputs}, renderer.plan


def main(effect: str, folder: str, blocked: str = "") -> None:
    """Render the frame and write what was seen."""
    wp.config.log_level = wp.LOG_WARNING
    if blocked:
        sys.modules.update(dict.fromkeys(modules_of(effect)))
    outputs, plan = render(effect)
    seen = {
        "modules": sorted(name for name, module in sys.modules.items() if module is not None),
        "kernels": sorted({kernel.func.__module__ for kernel, _ in plan.resources.program.kernels}),
        "buffers": sorted(plan.memory),
        "passes": [stage.name for stage in plan.passes],
    }
    target = pathlib.Path(folder)
    for name, array in outputs.items():
        np.save(target / f"{name}.npy", array)
    (target / "seen.json").write_text(json.dumps(seen))


if __name__ == "__main__":
    main(*sys.argv[1:])
