"""What `explain` says of every built-in scene: exactly the effects the scene is there to show, and why."""

import pytest
from test_scenes import SMALL

import warp_deferred as wd
from warp_deferred.effects import EFFECTS

#: Scene -> effects that its lights, camera and environment call for.
CALLED_FOR = {
    "corner": {"ambient_visibility"},
    "focus": {"ambient_visibility", "depth_of_field"},
    "fullscreen_spots": {"ambient_visibility"},
    "furnace": {"ambient_visibility"},
    "glow": {"ambient_visibility", "bloom"},
    "hundred_lights": {"ambient_visibility"},
    "lambert_plane": set(),
    "many_lights": {"ambient_visibility"},
    "motion": {"ambient_visibility", "motion", "motion_blur"},
    "shadows": {"ambient_visibility", "shadow"},
    "spheres_50k": {"ambient_visibility", "shadow"},
    "terrain": {"ambient_visibility"},
    "terrain_400k": {"ambient_visibility", "shadow"},
}
#: Effect -> words of the reason that lie in the scene.
REASONS = {
    "ambient_visibility": "ambient light is not zero",
    "bloom": "a camera's lens has bloom",
    "depth_of_field": "a camera has an aperture",
    "motion": "motion_blur reads it",
    "motion_blur": "a camera has an open shutter, and the scene can be animated",
    "shadow": "cast shadows",
}


@pytest.mark.parametrize("name", SMALL)
def test_explain_names_exactly_the_effects_a_scene_calls_for(name):
    renderer = wd.Renderer(wd.load(SMALL[name]), width=32, height=18, device="cpu", outputs=("display",))
    renderer.prepare()
    known = {effect.name for effect in EFFECTS}
    lines = {line.name: line for line in renderer.explain(measure=False).rows if line.name in known}
    assert {effect for effect, line in lines.items() if line.runs} == CALLED_FOR[name]
    for effect in CALLED_FOR[name]:
        assert REASONS[effect] in lines[effect].reason
    # The others are named, too, unless they are part of another, and told why they are not there.
    assert {effect.name for effect in EFFECTS if not effect.quiet} <= set(lines)
    assert all(line.reason for line in lines.values())


def test_every_effect_of_matter_or_lens_has_a_scene_that_calls_for_it():
    assert set().union(*CALLED_FOR.values()) == set(REASONS) and set(CALLED_FOR) == set(SMALL)
