"""Presets: a rung for every ladder, by what accuracy costs.

Written by `python -m bench presets` from bench/results/accuracy.json (NVIDIA H200, 2026-11-28); do not edit.
bench/presets.py has the rule. Each line tells what the rung costs and leaves, over the scenes of its ladder: how much
longer a frame takes than with the ladder's fastest rung, as a share of that frame, and the RMSE of `display` in [0, 1]
against the ladder's reference rung.

draft: a frame's worth of time must buy 0.05

- depth_format `float32`: frame +0 %, off by 0
- fast_math `fast`: frame +0 %, off by 1.9e-05
- accumulation `float32`: frame +0 %, off by 0
- normals `float32`: frame +0 %, off by 0
- gbuffer `full`: frame +1 %, off by 0
- radiance `half`: frame +0 %, off by 0.00038
- shadow `hard`: frame +109 %, off by 0.027
- ambient_visibility `gtao_half`: frame +16 %, off by 0.018
- bloom `mip_chain`: frame +16 %, off by 0.0011
- anti_aliasing `fxaa`: frame +8 %, off by 0.013
- scale `half`: frame +0 %, off by 0.021
- depth_of_field `gather`: frame +42 %, off by 0.021
- motion_blur `off`: frame +0 %, off by 0.031

balanced: a frame's worth of time must buy 0.005

- depth_format `float32`: frame +0 %, off by 0
- fast_math `fast`: frame +0 %, off by 1.9e-05
- accumulation `float32`: frame +0 %, off by 0
- normals `float32`: frame +0 %, off by 0
- gbuffer `full`: frame +1 %, off by 0
- radiance `float32`: frame +1 %, off by 0
- shadow `hard`: frame +109 %, off by 0.027
- ambient_visibility `gtao_half`: frame +16 %, off by 0.018
- bloom `mip_chain`: frame +16 %, off by 0.0011
- anti_aliasing `fxaa`: frame +8 %, off by 0.013
- scale `off`: frame +78 %, off by 0
- depth_of_field `gather`: frame +42 %, off by 0.021
- motion_blur `velocity_gather`: frame +38 %, off by 0.013

high: a frame's worth of time must buy 0.001

- depth_format `float32`: frame +0 %, off by 0
- fast_math `fast`: frame +0 %, off by 1.9e-05
- accumulation `float32`: frame +0 %, off by 0
- normals `float32`: frame +0 %, off by 0
- gbuffer `full`: frame +1 %, off by 0
- radiance `float32`: frame +1 %, off by 0
- shadow `pcss`: frame +337 %, off by 0.021
- ambient_visibility `gtao`: frame +41 %, off by 0.018
- bloom `mip_chain`: frame +16 %, off by 0.0011
- anti_aliasing `samples_4`: frame +317 %, off by 0.0062
- scale `off`: frame +78 %, off by 0
- depth_of_field `gather`: frame +42 %, off by 0.021
- motion_blur `velocity_gather`: frame +38 %, off by 0.013

reference: every ladder's reference

- depth_format `float32`: frame +0 %, off by 0
- fast_math `precise`: frame +7 %, off by 0
- accumulation `float32`: frame +0 %, off by 0
- normals `float32`: frame +0 %, off by 0
- gbuffer `full`: frame +1 %, off by 0
- radiance `float32`: frame +1 %, off by 0
- shadow `ray_traced`: frame +547203 %, off by 0
- ambient_visibility `ray_traced`: frame +75694 %, off by 0
- bloom `exact`: frame +2928 %, off by 0
- anti_aliasing `samples_64`: frame +6337 %, off by 0
- scale `off`: frame +78 %, off by 0
- depth_of_field `lens_samples`: frame +6548 %, off by 0
- motion_blur `shutter_samples`: frame +6650 %, off by 0
"""

from __future__ import annotations

__all__ = ["PRESETS"]

#: Preset -> stage -> field -> value.
PRESETS: dict[str, dict[str, dict[str, str]]] = {
    "draft": {
        "gbuffer": {"depth": "float32", "normal": "float32", "rung": "full"},
        "shade": {"arithmetic": "fast", "accumulation": "float32", "radiance": "half"},
        "shadow": {"rung": "hard"},
        "ambient_visibility": {"rung": "gtao_half"},
        "bloom": {"rung": "mip_chain"},
        "anti_aliasing": {"rung": "fxaa"},
        "scale": {"rung": "half"},
        "depth_of_field": {"rung": "gather"},
        "motion_blur": {"rung": "off"},
    },
    "balanced": {
        "gbuffer": {"depth": "float32", "normal": "float32", "rung": "full"},
        "shade": {"arithmetic": "fast", "accumulation": "float32", "radiance": "float32"},
        "shadow": {"rung": "hard"},
        "ambient_visibility": {"rung": "gtao_half"},
        "bloom": {"rung": "mip_chain"},
        "anti_aliasing": {"rung": "fxaa"},
        "scale": {"rung": "off"},
        "depth_of_field": {"rung": "gather"},
        "motion_blur": {"rung": "velocity_gather"},
    },
    "high": {
        "gbuffer": {"depth": "float32", "normal": "float32", "rung": "full"},
        "shade": {"arithmetic": "fast", "accumulation": "float32", "radiance": "float32"},
        "shadow": {"rung": "pcss"},
        "ambient_visibility": {"rung": "gtao"},
        "bloom": {"rung": "mip_chain"},
        "anti_aliasing": {"rung": "samples_4"},
        "scale": {"rung": "off"},
        "depth_of_field": {"rung": "gather"},
        "motion_blur": {"rung": "velocity_gather"},
    },
    "reference": {
        "gbuffer": {"depth": "float32", "normal": "float32", "rung": "full"},
        "shade": {"arithmetic": "precise", "accumulation": "float32", "radiance": "float32"},
        "shadow": {"rung": "ray_traced"},
        "ambient_visibility": {"rung": "ray_traced"},
        "bloom": {"rung": "exact"},
        "anti_aliasing": {"rung": "samples_64"},
        "scale": {"rung": "off"},
        "depth_of_field": {"rung": "lens_samples"},
        "motion_blur": {"rung": "shutter_samples"},
    },
}
