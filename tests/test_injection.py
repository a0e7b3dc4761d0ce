"""Whatever stands in a channel that a pass reads, what the pass writes is finite: NaN, infinities and huge numbers are
put into every channel of every pass, one at a time and all together."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from builders import gallery, tilt

import warp_deferred as wd
from warp_deferred.passes.image import all_reads

#: Ends of ranges, subnormal numbers, infinities, NaN of several kinds, each with both signs.
BITS = np.array([0, 0x3F800000, 0x00800000, 1, 0x7F7FFFFF, 0x7F800000, 0x34000000, 0x7FC00000, 0x7FAAAAAA], np.uint32)
BAD = np.concatenate([(BITS | sign).view(np.float32) for sign in (np.uint32(0), np.uint32(0x80000000))])
BAD = np.concatenate([BAD, np.float32([65504.0, 65520.0, 3e38, -3e38])])
SIZE = (48, 36)

#: Settings of plans that together have every pass, and most of their rungs.
PLANS = {
    "default": ["shadow.rung=pcf"],
    "float32": ["gbuffer.rung=full", "shadow.rung=pcss", "ambient_visibility.rung=ssao", "bloom.rung=neighbourhood"],
    "codecs": ["gbuffer.normal=xy16", "shadow.rung=hard", "depth_of_field.rung=plane_lerp", "bloom.rung=exact"],
    "halves": ["ambient_visibility.rung=gtao_half", "light_culling.rung=tiles", "blur.rung=gaussian", "blur.sigma_px=2",
               "shadow.rung=hard"],
    "samples": ["anti_aliasing.rung=samples_4", "gbuffer.rung=full", "shadow.rung=pcf"],
    "rays": ["shadow.rung=ray_traced", "shadow.samples=4", "ambient_visibility.rung=ray_traced"],
    "scaled": ["scale.rung=half", "anti_aliasing.rung=fxaa", "shadow.rung=hard"],
}  # fmt: skip
OUTPUTS = (
    "color",
    "display",
    "diffuse",
    "specular",
    "normal",
    "position",
    "albedo",
    "alpha",
    "motion",
    "depth",
    "light_count",
)


def scene_of_everything():
    """A scene and a camera that call for every effect."""
    scene = gallery()
    scene.lights.point.casts_shadow = np.ones(len(scene.lights.point), bool)
    scene.lights.directional.casts_shadow = np.ones(1, bool)
    scene.lights.spot.casts_shadow = np.ones(len(scene.lights.spot), bool)
    lens = {"aperture": 0.1, "focus_distance": 4.0, "bloom": 0.3, "shutter": 0.5}
    scene.camera = scene.camera.replace(**lens)
    return scene


def renderer_of(name, device):
    scene = scene_of_everything()
    values = [*PLANS[name], "shadow.point_size=128", "shadow.spot_size=128", "shadow.directional_size=128"]
    outputs = ("display",) if name in ("scaled", "halves") else OUTPUTS
    settings = wd.Settings(check_finite=True).with_values(values)
    renderer = wd.Renderer(
        scene, width=SIZE[0], height=SIZE[1], device=device, outputs=outputs, settings=settings, share_memory=False
    )
    for k in range(2):
        scene.instances[1].transform = tilt(20.0, 30.0, 1.0, (-1.2 + 0.05 * k, 0.6, 0.2))
        renderer.render()
    return renderer


def floats_of(array, name):
    """Numbers of a channel as a writable copy (any shape) and how to put them back; None if it has none."""
    host = array.numpy()
    if host.dtype == np.float32:
        return host.copy(), lambda values: array.assign(values)
    if array.dtype is wp.uint64 and name not in ("keys", "slice_keys"):
        halves = host.view(np.float16).copy()
        return halves, lambda values: array.assign(values.view(np.uint64))
    if host.dtype.names and name == "pairs":
        rows = host.copy()
        words = rows["matrix"].reshape(len(rows), -1)

        def put(values):
            rows["matrix"] = values.reshape(rows["matrix"].shape)
            array.assign(rows)

        return words.copy(), put
    return None


@pytest.mark.parametrize("name", PLANS)
def test_p11_every_pass_writes_finite_numbers_whatever_it_reads(name, device, rng):
    renderer = renderer_of(name, device)
    plan = renderer.plan
    program, check, channels = plan.resources.program, plan.finite_check, plan.resources.channels
    sections = {section.name: section for section in program.sections}
    injected, failures = set(), []
    for stage in plan.passes:
        section = sections[stage.name]
        # A pass whose condition is not met writes nothing.
        reads = [n for n in all_reads(stage) if n in channels]
        kept = {n: floats_of(channels[n], n) for n in reads}
        kept = {n: value for n, value in kept.items() if value is not None}
        for chosen in [*([n] for n in kept), list(kept)]:
            for channel in chosen:
                values, put = kept[channel]
                bad = rng.choice(BAD, values.shape)
                with np.errstate(over="ignore", invalid="ignore"):
                    put(np.where(rng.random(values.shape) < 0.3, bad, values).astype(values.dtype))
                injected.add((stage.name, channel))
            check.begin()
            program._run_steps(section)
            try:
                check.end()
            except wd.Error as error:
                failures.append(f"{stage.name} with {', '.join(chosen)}: {error}")
            for channel in chosen:
                kept[channel][1](kept[channel][0])
        # What it wrote of good numbers is what the next pass reads.
        program.run_section(section)
    assert not failures, "\n".join(failures)
    assert {stage for stage, _ in injected} >= {"shade", "display"} & set(sections)


def test_every_pass_of_every_effect_is_in_some_plan():
    """A new effect must be put into one of the plans above."""
    from warp_deferred.effects import EFFECTS

    left = {"debug_view", "points"}  # One writes bytes, the other reads arrays that are no channels.
    names = set()
    for name in PLANS:
        names |= {stage.name for stage in renderer_of(name, "cpu").plan.passes}
    assert {effect.name for effect in EFFECTS} - names - left <= {"lens_samples", "shutter_samples", "ray_instances"}
