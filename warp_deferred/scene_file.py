"""TOML scene files: models, cameras, lights and settings put together without writing Python.

    [camera]                         # or several [[camera]]; every field of wd.Camera, and these
    eye = [3.0, 2.0, 4.0]
    target = [0.0, 0.5, 0.0]
    vertical_fov_deg = 40.0

    [[model]]                        # a file of any kind that wd.load reads
    file = "truck.glb"               # relative to this file; subfolders only
    translate = [0.0, 0.0, 0.0]      # metres
    rotate_deg = [0.0, 90.0, 0.0]    # about x, then y, then z
    scale = 1.0                      # or one factor for each axis; scale first, then rotate, then translate
    label = 3                        # class id for the output semantic_id
    world = -1
    lights = true                    # whether the lights in that file come along
    cameras = true

    [[light]]                        # every field of wd.PointLight, SpotLight or DirectionalLight, and these
    kind = "spot"
    position = [0.0, 3.0, 0.0]
    inner_angle_deg = 20.0
    outer_angle_deg = 35.0

    [environment]                    # wd.Environment
    ambient = [0.1, 0.1, 0.1]
    background = [0.02, 0.02, 0.03]

    [settings.display]               # wd.Settings, stage by stage
    tone_mapping = "aces"

A key that is not known is an error that names it and the nearest one that is. The file says all: nothing is framed
or lit on its own, but for a file that has no camera or no light at all.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .camera import Camera
from .checks import check_array
from .errors import InputError
from .gltf_file import local_file
from .lights import DirectionalLight, PointLight, SpotLight
from .load_report import LoadReport
from .scene import Environment, Scene
from .settings import Settings

__all__ = ["load_scene_file"]

_LIGHTS = {"point": PointLight, "spot": SpotLight, "directional": DirectionalLight}
_MODEL_KEYS = ("file", "translate", "rotate_deg", "scale", "label", "world", "lights", "cameras", "name")
_ANGLES = ("vertical_fov", "inner_angle", "outer_angle")


def load_scene_file(path: Path, report: LoadReport, load_model: Any) -> Scene:
    """Read a TOML scene file.

    Args:
        path: The file.
        report: Where errors and notes go.
        load_model: Function of (path, report) that reads one model file as it is, into a scene.

    Raises:
        LoadError: If the file, a key or a value in it is not right.
    """
    try:
        root = tomllib.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        raise report.error("", "a TOML file in UTF-8", str(error), "correct that line") from None
    _known(report, "", root, ("camera", "model", "light", "environment", "settings"))
    scene = Scene(path.name)
    for k, table in enumerate(_tables(report, root, "camera")):
        scene.cameras.append(_camera(report, table, f"[camera] {k}" if k else "[camera]"))
    for k, table in enumerate(_tables(report, root, "model")):
        _add_model(scene, report, path.parent, table, f"[[model]] {k}", load_model)
    for k, table in enumerate(_tables(report, root, "light")):
        scene.lights.add(_light(report, table, f"[[light]] {k}"))
    if "environment" in root:
        table = _table(report, root["environment"], "[environment]")
        _known(report, "[environment]", table, Environment.model_fields)
        with report.at("[environment]"):
            scene.environment = Environment(**table)
    if "settings" in root:
        scene.settings = _settings(report, _table(report, root["settings"], "[settings]"))
    return scene


def _table(report: LoadReport, value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise report.error(where, "a table", type(value).__name__)
    return value


def _tables(report: LoadReport, root: dict[str, Any], key: str) -> list[dict[str, Any]]:
    found = root.get(key, [])
    return [_table(report, t, f"[[{key}]]") for t in (found if isinstance(found, list) else [found])]


def _known(report: LoadReport, where: str, table: dict[str, Any], keys: Iterable[str]) -> None:
    """Refuse keys that are not known, naming the nearest that is."""
    options = list(keys)
    for key in table:
        if key not in options:
            near = difflib.get_close_matches(key, options, 1)
            mend = f"did you mean {near[0]!r}?" if near else "remove it"
            raise report.error(f"{where} {key!r}".strip(), f"one of {', '.join(options)}", repr(key), mend)


def _fields(report: LoadReport, table: dict[str, Any], where: str, fields: Iterable[str]) -> dict[str, Any]:
    """Return a record's fields from a table: angles in degrees made radians, lists made tuples."""
    names = list(fields)
    _known(report, where, table, [*names, *(f"{name}_deg" for name in _ANGLES if name in names)])
    values = {}
    for key, value in table.items():
        if key.endswith("_deg"):
            with report.at(f"{where} {key}", "a number of degrees"):
                key, value = key.removesuffix("_deg"), math.radians(value)
        values[key] = tuple(value) if isinstance(value, list) else value
    return values


def _camera(report: LoadReport, table: dict[str, Any], where: str) -> Camera:
    values = _fields(report, table, where, ["eye", "target", "up", *Camera.model_fields])
    with report.at(where):
        if "eye" in values or "target" in values:
            for key in ("position", "rotation"):
                if key in values:
                    raise report.error(f"{where} {key}", "either eye and target, or position and rotation", "both")
            if not ("eye" in values and "target" in values):
                raise report.error(where, "eye and target", "only one of them", "give both")
            return Camera.look_at(values.pop("eye"), values.pop("target"), **values)
        return Camera(**values)


def _light(report: LoadReport, table: dict[str, Any], where: str) -> Any:
    kind = table.get("kind")
    if kind not in _LIGHTS:
        raise report.error(
            f"{where} kind", 'one of "point", "spot", "directional"', repr(kind), "say which light it is"
        )
    rest = {key: value for key, value in table.items() if key != "kind"}
    values = _fields(report, rest, where, _LIGHTS[kind].model_fields)
    with report.at(where):
        return _LIGHTS[kind](**values)


def _settings(report: LoadReport, table: dict[str, Any]) -> Settings:
    result = Settings()
    _known(report, "[settings]", table, [*result.stages, "preset"])
    for stage, values in table.items():
        if stage == "preset":
            with report.at("[settings]"):
                result = result.replace(preset=values)
            continue
        current = getattr(result, stage)
        where = f"[settings.{stage}]"
        _known(report, where, _table(report, values, where), type(current).model_fields)
        with report.at(where):
            result = result.replace(**{stage: current.replace(**values)})
    return result


def _add_model(
    scene: Scene, report: LoadReport, folder: Path, table: dict[str, Any], where: str, load_model: Any
) -> None:
    """Place what another file holds: its instances, and unless told otherwise its lights and cameras."""
    _known(report, where, table, _MODEL_KEYS)
    name = table.get("file")
    try:
        if not isinstance(name, str):
            raise ValueError("no name")
        target = local_file(folder, name.replace("%", "%25"))
    except (OSError, ValueError) as error:
        mend = "put the model beside the scene file or below it"
        raise report.error(f"{where} file", "a file in the scene file's folder", f"{name!r}: {error}", mend) from None
    if target.suffix.lower() == ".toml":
        raise report.error(f"{where} file", "a model", f"the scene file {name!r}", "scene files do not nest")
    with report.at(where):
        matrix = _matrix(table)
    inner = LoadReport(str(Path(report.file).parent / name))
    model = load_model(target, inner)
    report.adopt(inner)
    with report.at(where):
        for instance in model.instances:
            scene.add(
                instance.mesh,
                transform=matrix @ instance.transform,
                material=instance.material,
                world=table.get("world", -1),
                label=table.get("label", 0),
                name=table.get("name", "") or instance.name,
            )
        if table.get("cameras", True):
            scene.cameras += [_moved_camera(camera, matrix) for camera in model.cameras]
        if table.get("lights", True):
            _add_lights(scene, model, matrix)


def _matrix(table: dict[str, Any]) -> np.ndarray:
    """Return translate x rotate x scale, (4, 4) float64, the rotation being z x y x x of angles in degrees."""
    matrix = np.eye(4)
    angles = np.radians(check_array("rotate_deg", table.get("rotate_deg", (0.0, 0.0, 0.0)), (3,), np.float64))
    for axis, angle in enumerate(angles):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(4)
        turn[i, i] = turn[j, j] = math.cos(angle)
        turn[j, i], turn[i, j] = math.sin(angle), -math.sin(angle)
        matrix = turn @ matrix
    scale = np.asarray(table.get("scale", 1.0), np.float64)
    if scale.shape not in ((), (3,)) or not np.isfinite(scale).all() or not (scale != 0.0).all():
        raise InputError(f"scale: expected one or three finite factors other than 0, got {table['scale']!r}")
    matrix[:3, :3] *= scale
    matrix[:3, 3] = check_array("translate", table.get("translate", (0.0, 0.0, 0.0)), (3,), np.float64)
    return matrix


def _moved_camera(camera: Camera, matrix: np.ndarray) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = np.array(camera.rotation).reshape(3, 3).T
    pose[:3, 3] = camera.position
    moved = Camera.from_matrix(matrix @ pose)
    return camera.replace(position=moved.position, rotation=moved.rotation)


def _add_lights(scene: Scene, model: Scene, matrix: np.ndarray) -> None:
    """Append a model's lights, moved; as with glTF nodes, scale changes neither intensity nor range."""
    for kind, group in model.lights.groups():
        if not len(group):
            continue
        values = {name: getattr(group, name) for name in group.FIELDS[kind]}
        if "position" in values:
            values["position"] = values["position"] @ matrix[:3, :3].T + matrix[:3, 3]
        if "direction" in values:
            values["direction"] = values["direction"] @ matrix[:3, :3].T
        scene.lights.extend(kind, len(group), **values)
