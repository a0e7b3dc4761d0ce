"""Presets: a rung for every ladder, by what accuracy costs.

Written by `python -m bench presets` from bench/results/accuracy_cpu.json (CPU, 2 cores, 2026-11-22); do not edit.
bench/presets.py has the rule. Each line tells what the rung costs and leaves, over the scenes of its ladder: how much
longer a frame takes than with the ladder's fastest rung, as a share of that frame, and the RMSE of `display` in [0, 1]
against the ladder's reference rung.

draft: a frame's worth of time must buy 0.05

- normals `oct32`: frame +7 %, off by 7e-05
- gbuffer `compact`: frame +7 %, off by 0.0016
- radiance `float32`: frame +4 %, off by 0
- shadow `off`: frame +0 %, off by 0.19
- ambient_visibility `gtao_half`: frame +40 %, off by 0.022
- bloom `mip_chain`: frame +7 %, off by 0.0039
- anti_aliasing `fxaa`: frame +5 %, off by 0.039
- scale `off`: frame +59 %, off by 0
- depth_of_field `off`: frame +0 %, off by 0.065
- motion_blur `off`: frame +0 %, off by 0.031

balanced: a frame's worth of time must buy 0.005

- normals `oct32`: frame +7 %, off by 7e-05
- gbuffer `full`: frame +14 %, off by 0
- radiance `float32`: frame +4 %, off by 0
- shadow `pcss`: frame +2328 %, off by 0.031
- ambient_visibility `gtao`: frame +70 %, off by 0.02
- bloom `mip_chain`: frame +7 %, off by 0.0039
- anti_aliasing `samples_4`: frame +305 %, off by 0.02
- scale `off`: frame +59 %, off by 0
- depth_of_field `gather`: frame +55 %, off by 0.044
- motion_blur `velocity_gather`: frame +16 %, off by 0.026

high: a frame's worth of time must buy 0.001

- normals `oct32`: frame +7 %, off by 7e-05
- gbuffer `full`: frame +14 %, off by 0
- radiance `float32`: frame +4 %, off by 0
- shadow `pcss`: frame +2328 %, off by 0.031
- ambient_visibility `gtao`: frame +70 %, off by 0.02
- bloom `exact`: frame +152 %, off by 0
- anti_aliasing `samples_16`: frame +1389 %, off by 0.0083
- scale `off`: frame +59 %, off by 0
- depth_of_field `gather`: frame +55 %, off by 0.044
- motion_blur `velocity_gather`: frame +16 %, off by 0.026

reference: every ladder's reference

- normals `float32`: frame +33 %, off by 0
- gbuffer `full`: frame +14 %, off by 0
- radiance `float32`: frame +4 %, off by 0
- shadow `ray_traced`: frame +76681 %, off by 0
- ambient_visibility `ray_traced`: frame +12998 %, off by 0
- bloom `exact`: frame +152 %, off by 0
- anti_aliasing `samples_64`: frame +5682 %, off by 0
- scale `off`: frame +59 %, off by 0
- depth_of_field `lens_samples`: frame +6248 %, off by 0
- motion_blur `shutter_samples`: frame +5097 %, off by 0
"""

from __future__ import annotations

__all__ = ["PRESETS"]

#: Preset -> stage -> field -> value.
PRESETS: dict[str, dict[str, dict[str, str]]] = {
    "draft": {
        "gbuffer": {"normal": "oct32", "rung": "compact"},
        "shade": {"radiance": "float32"},
        "shadow": {"rung": "off"},
        "ambient_visibility": {"rung": "gtao_half"},
        "bloom": {"rung": "mip_chain"},
        "anti_aliasing": {"rung": "fxaa"},
        "scale": {"rung": "off"},
        "depth_of_field": {"rung": "off"},
        "motion_blur": {"rung": "off"},
    },
    "balanced": {
        "gbuffer": {"normal": "oct32", "rung": "full"},
        "shade": {"radiance": "float32"},
        "shadow": {"rung": "pcss"},
        "ambient_visibility": {"rung": "gtao"},
        "bloom": {"rung": "mip_chain"},
        "anti_aliasing": {"rung": "samples_4"},
        "scale": {"rung": "off"},
        "depth_of_field": {"rung": "gather"},
        "motion_blur": {"rung": "velocity_gather"},
    },
    "high": {
        "gbuffer": {"normal": "oct32", "rung": "full"},
        "shade": {"radiance": "float32"},
        "shadow": {"rung": "pcss"},
        "ambient_visibility": {"rung": "gtao"},
        "bloom": {"rung": "exact"},
        "anti_aliasing": {"rung": "samples_16"},
        "scale": {"rung": "off"},
        "depth_of_field": {"rung": "gather"},
        "motion_blur": {"rung": "velocity_gather"},
    },
    "reference": {
        "gbuffer": {"normal": "float32", "rung": "full"},
        "shade": {"radiance": "float32"},
        "shadow": {"rung": "ray_traced"},
        "ambient_visibility": {"rung": "ray_traced"},
        "bloom": {"rung": "exact"},
        "anti_aliasing": {"rung": "samples_64"},
        "scale": {"rung": "off"},
        "depth_of_field": {"rung": "lens_samples"},
        "motion_blur": {"rung": "shutter_samples"},
    },
}
