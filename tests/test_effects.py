"""The table of effects, what a lens calls for, and passes that a value on the device switches."""

import re
import types

import numpy as np
import pytest
import warp as wp
from builders import assert_same, gallery, images, spied
from test_custom_pass import Scale

import warp_deferred as wd
from warp_deferred import effects
from warp_deferred.arena import lay_out
from warp_deferred.effects import Effect, Verdict
from warp_deferred.passes.base import Lens
from warp_deferred.program import END, SAMPLE, START, Program


def renderer_of(device="cpu", outputs=("color", "display"), scene=None, rung="off", **fields):
    settings = wd.Settings().with_values([f"anti_aliasing.rung={rung}", "ambient_visibility.rung=off"])
    scene = scene or gallery()
    return wd.Renderer(scene, width=64, height=48, device=device, outputs=outputs, settings=settings, **fields)


# ---- the table


class GlowPass(Scale):
    name = "glow"

    def __init__(self):
        self.amount = 2.0
        self.image = "turn"


def glow_rule(request):
    return Verdict(request.lens.bloom, "lens has bloom" if request.lens.bloom else "lens has no bloom")


@pytest.fixture
def glow(monkeypatch):
    """Put an effect into the table whose module exists only once it is asked for."""
    module = types.ModuleType("warp_deferred.passes.glow")
    module.GlowPass = GlowPass
    loads = []

    def importer(name, package):
        loads.append(name)
        return module

    # Bloom asks for the same lens.
    others = [effect for effect in effects.EFFECTS if effect.name != "bloom"]
    monkeypatch.setattr(effects, "EFFECTS", (*others, Effect("glow", "shade", glow_rule)))
    monkeypatch.setattr(effects.importlib, "import_module", importer)
    return loads


def test_an_effect_is_imported_once_it_is_called_for(glow, device):
    scene = gallery()
    plain = renderer_of(device, scene=scene)
    before = images(plain.render())
    row = {r.name: r for r in plain.explain(measure=False).rows}["glow"]
    assert not glow and not row.runs and row.reason == "lens has no bloom"
    bright = images(plain.render(scene.camera.replace(bloom=0.5)))
    row = {r.name: r for r in plain.explain(measure=False).rows}["glow"]
    assert glow == [".passes.glow"] and row.runs and row.reason == "lens has bloom"
    assert np.array_equal(bright["color"], 2.0 * before["color"])
    # One camera of a batch is enough, and both plans are kept.
    assert_same(images(spied(plain)), before)
    assert_same(images(spied(plain, scene.camera.replace(bloom=0.5))), bright)
    batch = images(plain.render([scene.camera, scene.camera.replace(bloom=0.1)]))
    assert np.array_equal(batch["color"], bright["color"])


def test_settings_turn_an_effect_off_or_force_it_on():
    def verdict(rung, when, bloom):
        settings = types.SimpleNamespace(glow=types.SimpleNamespace(rung=rung, when=when))
        request = types.SimpleNamespace(settings=settings, lens=Lens(bloom=bloom))
        return Effect("glow", "shade", glow_rule).verdict(request)

    assert verdict("full", "called_for", True) == (True, "lens has bloom")
    assert verdict("full", "called_for", False) == (False, "lens has no bloom")
    assert verdict("off", "always", True) == (False, "glow.rung is off")
    assert verdict("full", "always", False) == (True, "glow.when is always (lens has no bloom)")


def test_every_effect_stands_behind_a_pass_that_exists_and_can_be_loaded():
    from warp_deferred.plan import PASSES

    names = {"", *(kind.name for kind in PASSES)}
    for effect in effects.EFFECTS:
        assert effect.after in names and effect.load().name == effect.name
        names.add(effect.name)


def test_a_lens_is_read_once_a_camera():
    camera = wd.Camera(aperture=0.01, bloom=0.2, world=3)
    assert Lens.of(camera.lens_flags) == Lens(aperture=True, bloom=True)
    assert Lens.of(wd.Camera(shutter=0.5).lens_flags) == Lens(shutter=True)
    assert camera.selector == 8 * 3 + 5 and "selector" in vars(camera)
    # What is cached neither shows in comparisons nor goes into copies.
    assert camera == wd.Camera(aperture=0.01, bloom=0.2, world=3) and camera.replace(bloom=0.0).lens_flags == 1
    assert len({wd.Camera(world=w, **lens).selector for w in (-1, 0, 1) for lens in ({}, {"bloom": 0.1})}) == 6


# ---- conditions on the device


class Switched(Scale):
    active_if = "somebody flipped the switch"

    def __init__(self, switch, amount=3.0, name="switched", **fields):
        super().__init__(amount, name, **fields)
        self.switch = switch

    def active(self, resources):
        return self.switch


@pytest.mark.parametrize("rung", ["off", "samples_4"])
@pytest.mark.parametrize("image", ["turn", "rewrite"])
def test_a_pass_is_skipped_while_its_condition_is_zero(device, image, rung):
    switch = wp.zeros(1, dtype=wp.int32, device=device)
    plain = images(renderer_of(device, rung=rung).render())
    scaled = images(renderer_of(device, rung=rung, passes=[Scale(3.0)]).render())
    renderer = renderer_of(device, rung=rung, passes=[Switched(switch, image=image)])
    assert_same(images(renderer.render()), plain)
    switch.fill_(1)
    assert_same(images(spied(renderer)), scaled)
    switch.fill_(0)
    assert_same(images(spied(renderer)), plain)
    renderer.plan.resources.program.run()
    assert_same(plain, {name: array.numpy()[0] for name, array in renderer.plan.shown.items()})


def test_what_a_skipped_pass_writes_is_left_alone(device):
    class Marks(Switched):
        image = ""

        def __init__(self, switch):
            self.name, self.switch = "marks", switch

        def writes(self):
            return {"marks": wd.Buffer(wp.vec3, self.layout.pixels, lasting=True)}

        def reads(self):
            return ("normal",)

        def run(self, resources):
            c = resources.channels
            inputs = [c["normal"], 2.0]
            resources.program.launch(self.kernel, self.layout.pixels, inputs, [c["marks"]], block_dim=64)

    switch = wp.ones(1, dtype=wp.int32, device=device)
    renderer = renderer_of(device, ("display",), passes=[Marks(switch)], share_memory=False)
    first = images(renderer.render())
    marks = renderer.plan.resources.channels["marks"]
    written = marks.numpy().copy()
    assert np.abs(written).max() > 1.0
    marks.fill_(7.0)
    switch.fill_(0)
    assert_same(images(renderer.render()), first)
    assert np.all(marks.numpy() == 7.0)


def test_explain_tells_both_reasons_and_what_was_active(device):
    switch = wp.zeros(1, dtype=wp.int32, device=device)
    renderer = renderer_of(device, passes=[Switched(switch)])
    renderer.render()
    for value, word in ((0, "skipped"), (1, "runs")):
        switch.fill_(value)
        told = renderer.explain()
        row = {r.name: r for r in told.rows}["switched"]
        assert row.reason == "handed in with passes=; active if somebody flipped the switch"
        assert row.active is bool(value) and row.runs
        assert re.search(rf"switched +{word}", str(told))
    assert {r.name: r for r in told.rows}["shade"].active is None
    assert {r.name: r for r in renderer.explain(measure=False).rows}["switched"].active is None


def test_clears_do_not_slip_into_a_pass_that_may_be_skipped(device):
    switch = wp.zeros(1, dtype=wp.int32, device=device)
    # Raster clears its keys beside the pass before; here that pass is skipped.
    renderer = renderer_of(device, passes=[Switched(switch, name="early", after="clusters", image="")])
    renderer._passes[0].run = lambda resources: resources.program.call(lambda: None)
    scene = gallery()
    for camera in (scene.camera, scene.camera.replace(position=(0.0, 2.0, 6.0))):
        assert_same(images(renderer.render(camera)), images(renderer_of(device, scene=scene).render(camera)))


def test_more_than_two_conditions_are_refused(device):
    switch = wp.zeros(1, dtype=wp.int32, device=device)
    names = ("one", "two", "three")
    renderer = renderer_of(device, passes=[Switched(switch, name=n) for n in names])
    with pytest.raises(wd.Error, match=r"three\.active: expected at most 2 passes .*got one, two, three; decide"):
        renderer.render()


class Leaver(Switched):
    """One whose kernels would look at the switch themselves."""

    leaves_early = True


@pytest.mark.parametrize("image, fits", [("rewrite", True), ("turn", False)])
def test_conditions_that_kernels_look_at_themselves_do_not_count(device, image, fits):
    switch = wp.zeros(1, dtype=wp.int32, device=device)
    leavers = [Leaver(switch, name=n, image=image) for n in ("one", "two", "three")]
    renderer = renderer_of(device, passes=leavers)
    if not fits:
        # A pass that turns the image needs a copy in its place.
        with pytest.raises(wd.Error, match=r"three\.active: expected at most 2 passes"):
            renderer.render()
        return
    renderer.render()
    sections = {section.name: section for section in renderer.plan.resources.program.sections}
    assert all(sections[stage.name].leaves_early for stage in leavers)


def test_a_copy_stands_in_for_a_pass_that_leaves_early_and_turns_the_image(device):
    switch = wp.zeros(1, dtype=wp.int32, device=device)
    plain, scaled = (images(renderer_of(device, passes=p).render()) for p in ([], [Scale(3.0)]))
    renderer = renderer_of(device, passes=[Leaver(switch, image="turn")])
    assert_same(images(renderer.render()), plain)
    switch.fill_(1)
    assert_same(images(renderer.render()), scaled)


# ---- parts of a frame


class DeepPass(Scale):
    """An effect after the samples that looks at the depth of the pixel's centre."""

    name = "deep"
    scope = "frame_end"

    def __init__(self):
        self.amount, self.image = 2.0, "turn"

    def reads(self):
        return ("depth",)


def test_an_effect_after_the_samples_reads_the_depth_of_the_centre(device, monkeypatch):
    outputs = ("color",)
    plain = renderer_of(device, outputs, rung="samples_4")
    expected = images(plain.render())["color"] * np.float32(2.0)
    effect = Effect("deep", "average", lambda request: Verdict(True, "always"))
    monkeypatch.setattr(Effect, "load", lambda self, load=Effect.load: DeepPass if self is effect else load(self))
    monkeypatch.setattr(effects, "EFFECTS", (*effects.EFFECTS, effect))
    renderer = renderer_of(device, outputs, rung="samples_4", share_memory=False)
    assert np.array_equal(images(renderer.render())["color"], expected)
    assert plain.plan.replays == 4 and renderer.plan.replays == 5
    depth = renderer.plan.resources.channels["depth"].numpy().reshape(48, 64)
    assert np.array_equal(depth, images(renderer_of(device, ("depth",)).render())["depth"])


def test_calls_stay_in_their_part():
    seen = []
    program = Program(wp.get_device("cpu"), 1, samples=3)
    for part, name in ((START, "start"), (SAMPLE, "one"), (SAMPLE, "two"), (END, "end")):
        program.begin(name, part)
        program.call(lambda name=name: seen.append(name), beside=True)
    program.replay()
    assert sorted(seen[1:-1]) == ["one"] * 3 + ["two"] * 3 and (seen[0], seen[-1]) == ("start", "end")
    assert [len(section.steps) for section in program.sections] == [1, 1, 0, 1]
    seen.clear()
    program.run(2)
    # Stopped within the samples: one of them.
    assert sorted(seen) == ["one", "start", "two"]


class Stage(wd.Pass):
    """A pass that is nothing but its channels."""

    def __init__(self, reads, writes, **buffer):
        self._reads, self._writes = reads, {name: wd.Buffer(wp.float32, 64, **buffer) for name in writes}

    def reads(self):
        return self._reads

    def writes(self):
        return self._writes

    def run(self, resources):
        pass


@pytest.mark.parametrize("share", [True, False])
def test_buffers_live_as_long_as_the_samples_need_them(share):
    stages = [
        Stage((), ("a",)),
        Stage(("a",), ("b",)),  # reads what was written before the samples, in each of them
        Stage(("b",), ("c",)),
        Stage(("c",), ("d", "late")),
        Stage(("d",), ("sum",), carried=True),
        Stage(("sum", "late"), ("e",)),
    ]
    request = types.SimpleNamespace(outputs=frozenset({"e"}), share_memory=share)
    together = lay_out(stages, request, range(0))
    assert together.places.keys() == {"a", "b", "c", "d", "sum", "late"}
    places = lay_out(stages, request, range(1, 5)).places
    # Neither what comes in nor what is carried may be written over by any pass of the samples.
    for kept in ("a", "sum"):
        assert all(places[kept] != places[name] for name in ("b", "c", "d", "late") if name != kept)
    assert len({places[n] for n in ("a", "b", "c", "d", "late", "sum")}) == (5 if share else 6)
    assert (len(set(together.places.values())) < 5) is share
