"""A tiled deferred renderer in NVIDIA Warp kernels. Importing this package compiles and allocates nothing."""

from __future__ import annotations

from .camera import Camera
from .errors import CapacityError, DeviceError, Error, InputError, LoadError
from .lights import DirectionalLight, PointLight, SpotLight
from .materials import Material, Texture
from .scene import Environment, Instance, Mesh, Scene
from .settings import Settings

__version__ = "0.1.0"
__all__ = [
    "Buffer",
    "Camera",
    "CapacityError",
    "DeviceError",
    "DirectionalLight",
    "Environment",
    "Error",
    "Fit",
    "Frame",
    "InputError",
    "Instance",
    "LoadError",
    "LoadWarning",
    "Material",
    "Mesh",
    "Pass",
    "PointLight",
    "Renderer",
    "Scene",
    "Settings",
    "SpotLight",
    "Texture",
    "fit",
    "load",
]


def __getattr__(name: str) -> object:
    # Warp and the loaders are imported on first use, so that `import warp_deferred` stays quick and silent.
    if name in ("Renderer", "Frame"):
        from . import frame, renderer

        return {"Renderer": renderer.Renderer, "Frame": frame.Frame}[name]
    if name in ("Pass", "Buffer"):
        from .passes import base

        return getattr(base, name)
    if name in ("fit", "Fit"):
        from . import fitting

        return getattr(fitting, name)
    if name in ("load", "LoadWarning"):
        from . import loading

        return getattr(loading, name)
    raise AttributeError(f"module 'warp_deferred' has no attribute {name!r}")
