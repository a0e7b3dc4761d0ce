"""Settings of precision: depth formats, sums of halves, fused and fast arithmetic; defaults keep every bit."""

import builders
import numpy as np
import pytest

import warp_deferred as wd

SIZE = (52, 37)
CODED = ("unorm16", "ufloat16", "unorm24")
LIT = ("color", "diffuse", "specular", "light_count")


def renderer(scene, device, *assignments, outputs=LIT, **fields):
    width, height = SIZE
    settings = wd.Settings().with_values(["shadow.rung=off", "ambient_visibility.rung=off", *assignments])
    return wd.Renderer(scene, width=width, height=height, device=device, outputs=outputs, settings=settings, **fields)


def render(scene, device, *assignments, **fields):
    return builders.images(renderer(scene, device, *assignments, **fields).render())


@pytest.fixture(scope="module")
def gallery():
    return builders.gallery()


def dim(scene):
    """Mean radiance of what is lit."""
    return float(scene["color"].mean())


# ---- depth formats


@pytest.mark.parametrize("name", CODED)
def test_coded_depth_lights_nearly_alike_and_leaves_the_rest(name, device, gallery):
    outputs = (*LIT, "depth", "position", "normal", "instance_id", "triangle_id")
    plain = render(gallery, device, outputs=outputs)
    coded = render(gallery, device, f"gbuffer.depth={name}", outputs=outputs)
    # What is no lighting is the same to the bit.
    builders.assert_same(plain, coded, outputs[len(LIT) :])
    # 5 m away at a near plane of 0.05 m, unorm16 is off by up to 4 mm, ufloat16 by 1 mm.
    bound = {"unorm16": 2e-2, "ufloat16": 5e-3, "unorm24": 1e-4}[name]
    assert 0.0 < np.abs(coded["color"] - plain["color"]).mean() < bound * dim(plain)
    background = np.isinf(plain["depth"])
    assert background.any() and np.array_equal(coded["color"][background], plain["color"][background])


@pytest.mark.parametrize("name", CODED)
def test_coded_depth_misses_no_light(name, device, gallery):
    """Culling sees the depth that shading sees: masks give the bits of brute force."""
    masked, brute = (
        render(gallery, device, f"gbuffer.depth={name}", f"light_culling.rung={rung}")
        for rung in ("tiles_depth", "brute_force")
    )
    builders.assert_same(masked, brute)


@pytest.mark.parametrize("name", CODED)
def test_coded_depth_is_the_same_whatever_else_is_asked_for(name, device, gallery):
    alone = render(gallery, device, f"gbuffer.depth={name}", outputs=("color",))
    beside = render(gallery, device, f"gbuffer.depth={name}", outputs=("color", "depth", "motion"))
    builders.assert_same(alone, beside, ["color"])


def test_codes_take_the_place_of_linear_depth_where_nobody_reads_that(device, gallery):
    def channels(*assignments, **fields):
        made = renderer(gallery, device, *assignments, **fields)
        made.render()
        return set(made.plan.resources.channels) & {"depth", "gbuffer_depth16", "gbuffer_depth32"}

    assert channels() == {"depth"}
    assert channels("gbuffer.depth=unorm16") == channels("gbuffer.depth=ufloat16") == {"gbuffer_depth16"}
    assert channels("gbuffer.depth=unorm24") == {"gbuffer_depth32"}
    assert channels("gbuffer.depth=unorm24", "gbuffer.rung=full") == {"depth"}
    # Ambient visibility looks at depth itself; without lighting nobody reads codes.
    assert channels("gbuffer.depth=unorm16", "ambient_visibility.rung=gtao") == {"depth", "gbuffer_depth16"}
    assert channels("gbuffer.depth=unorm16", "ambient_visibility.rung=gtao", outputs=("ambient_visibility",)) == {
        "depth"
    }
    assert channels("gbuffer.depth=unorm16", outputs=("depth",)) == {"depth"}


@pytest.mark.parametrize("effect", ["ambient_visibility.rung=gtao", "depth_of_field.rung=gather", "shadow.rung=pcf"])
def test_effects_run_beside_coded_depth(effect, device, gallery):
    camera = gallery.camera.replace(aperture=0.05, focus_distance=4.0)
    made = renderer(gallery, device, "gbuffer.depth=ufloat16", effect, outputs=("display",))
    shown = made.render(camera).numpy("display")
    assert shown[..., :3].std() > 5.0


def test_batches_and_orthographic_views_have_coded_depth_too(device, gallery):
    views = [gallery.camera, gallery.camera.replace(projection="orthographic", far=50.0)]
    plain, coded = (
        renderer(gallery, device, *assignments).render(views).numpy("color").copy()
        for assignments in ((), ("gbuffer.depth=unorm24",))
    )
    assert all(plain[view].std() > 0.01 for view in (0, 1))
    assert 0.0 < np.abs(coded - plain).mean() < 1e-4 * plain.mean()


# ---- sums of halves


def test_half_sums_are_off_by_what_rounding_each_light_may_move(device, gallery):
    plain = render(gallery, device)
    half = render(gallery, device, "shade.accumulation=half")
    assert np.array_equal(half["light_count"], plain["light_count"])
    count = np.maximum(plain["light_count"], 0)[..., None].astype(np.float64)
    for name in ("diffuse", "specular"):
        exact = plain[name].astype(np.float64)
        # Every partial sum is at most the whole; halves below 2^-14 have a step of 2^-24.
        bound = count * (2.0**-11 * exact * (1.0 + 1e-3) + 2.0**-25)
        assert (np.abs(half[name] - exact) <= bound).all(), name
        assert np.array_equal(half[name], half[name].astype(np.float16).astype(np.float32)), name
    assert np.abs(half["color"] - plain["color"]).max() > 0.0


def test_half_sums_stay_within_halfs_range(device):
    scene = builders.gallery(lights=False)
    scene.lights.add(wd.DirectionalLight(direction=(0.0, -1.0, 0.0), intensity=1e6), wd.DirectionalLight(intensity=1e6))
    half = render(scene, device, "shade.accumulation=half")
    assert np.isfinite(half["diffuse"]).all() and half["diffuse"].max() == 65504.0
    assert render(scene, device)["diffuse"].max() > 65504.0


# ---- fused and fast arithmetic


@pytest.mark.parametrize("arithmetic", ["fused", "fast"])
def test_arithmetic_moves_lighting_by_roundings_and_nothing_else(arithmetic, device, gallery):
    outputs = (*LIT, "depth", "normal", "position", "instance_id", "triangle_id")
    plain = render(gallery, device, outputs=outputs)
    other = render(gallery, device, f"shade.arithmetic={arithmetic}", outputs=outputs)
    builders.assert_same(plain, other, outputs[len(LIT) :])
    assert np.isfinite(other["color"]).all()
    # A power of 60 makes of the fast logarithm's 2^-22 some 1e-5 of a highlight.
    assert np.abs(other["color"] - plain["color"]).mean() < 1e-4 * dim(plain)
    if device == "cpu":
        # Warp hands fast_math to CUDA alone, and its CPU has no instruction that fuses.
        builders.assert_same(plain, other)


@pytest.mark.parametrize("arithmetic", ["fused", "fast"])
def test_masks_miss_no_light_under_other_arithmetic(arithmetic, device, gallery):
    masked, brute = (
        render(gallery, device, f"shade.arithmetic={arithmetic}", f"light_culling.rung={rung}")
        for rung in ("tiles_depth", "brute_force")
    )
    builders.assert_same(masked, brute)


def test_plans_say_what_is_not_at_its_most_exact(gallery):
    chosen = ("gbuffer.depth=unorm24", "shade.accumulation=half", "shade.arithmetic=fast")
    text = str(renderer(gallery, "cpu", *chosen, outputs=("display",)).explain(measure=False))
    assert "compact, oct24, unorm24" in text and "half, half sums, fast" in text
