"""From a file or the name of a built-in scene to a `Scene`.

Files are read by kind: glTF by `gltf`, OBJ, PLY and STL by `mesh_files` (trimesh), TOML by `scene_file`.
A file without a camera is framed, one without a light is lit, and `Scene.notes` says so.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import os
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from .checks import input_error
from .framing import frame_camera, light_if_dark
from .load_report import LoadReport, LoadWarning, load_error
from .scene import Scene

__all__ = ["LoadWarning", "built_in_scenes", "load"]

_SCENES = "warp_deferred.scenes"


def load(source: str | os.PathLike[str]) -> Scene:
    """Read a file, or build a built-in scene.

    Args:
        source: Path of a .gltf, .glb, .obj, .ply, .stl or .toml file; or the name of a built-in scene, with
            parameters if wanted: "terrain?triangles=500000&seed=2" (numbers, true, false or text).

    Returns:
        The scene. Its notes tell of repairs, of what the file asks for and is not rendered, and of camera or light
        that were added; repairs also come as one `LoadWarning`.

    Raises:
        LoadError: If there is no such file or built-in scene, or the file cannot be read.
        InputError: If a built-in scene has no parameter of that name.
    """
    if not isinstance(source, (str, os.PathLike)):
        raise input_error("load.source", "a path or the name of a built-in scene", type(source).__name__)
    text = os.fspath(source)
    if not isinstance(text, str):
        text = os.fsdecode(text)
    path = Path(text)
    try:
        exists = os.path.lexists(path)
    except ValueError as error:
        raise load_error(repr(text), "a path", str(error)) from None
    if exists:
        return _load_file(path, text)
    name, _, query = text.partition("?")
    if isinstance(source, str) and re.fullmatch(r"[a-z_][a-z0-9_]*", name):
        names = _scene_names()
        if name in names and hasattr(module := _scene_module(name), "build"):
            return _build(name, module, query)
    raise _not_found(text, name)


def built_in_scenes() -> dict[str, str]:
    """List the built-in scenes: name and the first line of the docstring, in alphabetical order."""
    found = {}
    for name in _scene_names():
        module = _scene_module(name)
        if hasattr(module, "build"):
            found[name] = (inspect.getdoc(module) or inspect.getdoc(module.build) or "").split("\n")[0]
    return found


def _scene_names() -> list[str]:
    package = importlib.import_module(_SCENES)
    return sorted(info.name for info in pkgutil.iter_modules(package.__path__) if not info.name.startswith("_"))


def _scene_module(name: str) -> ModuleType:
    return importlib.import_module(f"{_SCENES}.{name}")


def _not_found(text: str, name: str) -> Exception:
    known = list(built_in_scenes())
    near = difflib.get_close_matches(name, known, 1)
    mend = f"did you mean {near[0]!r}?" if near else "check the path"
    expected = "a file, or one of the built-in scenes" + (f" {', '.join(known)}" if known else "")
    return load_error(
        repr(text), expected, f"neither (there is no file {text!r} below {os.path.basename(os.getcwd())!r})", mend
    )


def _build(name: str, module: ModuleType, query: str) -> Scene:
    """Call a scene module's `build` with the parameters of a query."""
    signature = inspect.signature(module.build).parameters
    open_ended = any(p.kind is p.VAR_KEYWORD for p in signature.values())
    known = [n for n, p in signature.items() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    parameters: dict[str, Any] = {}
    for part in filter(None, query.split("&")):
        key, equals, value = part.partition("=")
        if not equals:
            raise input_error(f"{name}?{part}", "name=value", part, f"such as {name}?{known[0]}=1" if known else "")
        if key not in known and not open_ended:
            near = difflib.get_close_matches(key, known, 1)
            mend = f"did you mean {near[0]!r}?" if near else ""
            listed = f"one of {', '.join(known)}" if known else "no parameters"
            raise input_error(f"{name}?{key}", listed, key, mend)
        parameters[key] = _value(value)
    scene = module.build(**parameters)
    scene.name = name
    scene.animate = getattr(module, "animate", None)
    return scene


def _value(text: str) -> int | float | bool | str:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _readers() -> dict[str, Callable[[Path, LoadReport], Scene]]:
    """Return the reader of each kind of model; imported here, so that importing the package stays quick."""
    from .gltf import load_gltf
    from .mesh_files import load_obj, load_ply, load_stl

    return {".gltf": load_gltf, ".glb": load_gltf, ".obj": load_obj, ".ply": load_ply, ".stl": load_stl}


def _load_model(path: Path, report: LoadReport) -> Scene:
    """Read one model file as it is, by its suffix."""
    readers = _readers()
    suffix = path.suffix.lower()
    if suffix not in readers:
        known = ", ".join([*readers, ".toml"])
        got = f"the suffix {suffix!r}" if suffix else "no suffix"
        raise report.error("", f"a file of a known kind ({known})", got, "convert it, to .glb for one")
    try:
        return readers[suffix](path, report)
    except OSError as error:
        raise report.error("", "a readable file", error.strerror or str(error), "check its permissions") from None
    except MemoryError:
        raise report.error("", "a file that fits in memory", "more than there is", "split the file") from None


def _load_file(path: Path, text: str) -> Scene:
    report = LoadReport(text)
    if path.is_dir():
        raise report.error("", "a file", "a folder", "name a file in it")
    if not path.is_file():
        raise report.error("", "a regular file", "a broken link or a device", "check the path")
    if path.suffix.lower() == ".toml":
        from .scene_file import load_scene_file

        scene = load_scene_file(path, report, _load_model)
    else:
        scene = _load_model(path, report)
    scene.notes += report.notes
    if not scene.triangle_count:
        scene.notes.append("no triangles in the file: the picture is background only")
    if not scene.cameras:
        scene.cameras.append(frame_camera(scene))
        scene.notes.append("no camera in the file: framed all of it")
    light_if_dark(scene)
    report.finish()
    return scene
