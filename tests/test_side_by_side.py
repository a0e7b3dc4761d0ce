"""Passes that run at the same time: only those that share nothing, in memory of their own, with the same bits."""

from __future__ import annotations

import itertools
import types

import pytest
import warp as wp
from builders import assert_same, images

import warp_deferred as wd
from warp_deferred.arena import lay_out, run_together
from warp_deferred.passes.ambient_visibility import AmbientVisibilityPass
from warp_deferred.passes.base import Buffer, Pass

NAMES = ("color", "light_count", "depth")


class Made(Pass):
    """A pass that only says what it reads and writes."""

    def __init__(self, name, reads=(), writes=(), beside=()):
        self.name, self.beside = name, beside
        self._reads, self._writes = reads, {n: Buffer(wp.int32, 100) for n in writes}

    def reads(self):
        return self._reads

    def writes(self):
        return self._writes

    def run(self, resources):
        raise NotImplementedError


def test_only_what_shares_nothing_runs_together():
    names = ("b", "c", "d")
    first = Made("a", reads=("in",), writes=("x",), beside=names)
    assert run_together([first, Made("b", ("in",), ("y",)), Made("c", ("y",), ("z",))], range(0)) == [2, 0, 0]
    # It reads what the first writes, writes what that reads, writes the same, is not named, or runs in another part.
    assert run_together([first, Made("b", ("x",), ("y",))], range(0)) == [0, 0]
    assert run_together([first, Made("b", (), ("in",))], range(0)) == [0, 0]
    assert run_together([first, Made("b", (), ("x",))], range(0)) == [0, 0]
    assert run_together([first, Made("e", (), ("y",)), Made("b", (), ("z",))], range(0)) == [0, 0, 0]
    assert run_together([first, Made("b", (), ("y",)), Made("c", (), ("z",))], range(0, 2)) == [1, 0, 0]


def test_what_runs_together_lives_together():
    first, second = Made("a", ("in",), ("x",), ("b",)), Made("b", ("in",), ("y",))
    request = types.SimpleNamespace(outputs=frozenset(), share_memory=True)
    assert len(set(lay_out([first, second], request, range(0)).places.values())) == 1
    assert len(set(lay_out([first, second], request, range(0), [1, 0]).places.values())) == 2


def plan_of(scene, device, *values):
    settings = wd.Settings().with_values(["ambient_visibility.rung=gtao", *values])
    renderer = wd.Renderer(scene, width=80, height=48, device=device, outputs=NAMES, settings=settings)
    return images(renderer.render()), renderer.plan


def test_they_share_no_memory(device):
    plan = plan_of(wd.load("terrain?triangles=2000&lights=30"), device)[1]
    sections = {s.name: s.beside for s in plan.resources.program.sections}
    assert sections["ambient_visibility"] == 2 and sum(sections.values()) == 2
    together = [sections[stage.name] for stage in plan.passes]
    apart = lay_out(plan.passes, plan.request, range(0), together)
    stages = {stage.name: stage for stage in plan.passes}
    sides = [
        [n for n in stages[name].writes() if n in apart.places] for name in ("ambient_visibility", "light_culling")
    ]
    assert all(sides)
    for one, two in itertools.product(*sides):
        (a, b), (c, d) = ((apart.places[n], apart.places[n] + apart.sizes[n]) for n in (one, two))
        assert b <= c or d <= a


@pytest.mark.parametrize("samples", ["off", "samples_4"])
def test_the_bits_are_those_of_one_after_the_other(samples, device, monkeypatch):
    scene = wd.load("terrain?triangles=2000&lights=30")
    rung = f"anti_aliasing.rung={samples}"
    beside, plan = plan_of(scene, device, rung)
    assert any(s.beside for s in plan.resources.program.sections)
    monkeypatch.setattr(AmbientVisibilityPass, "beside", ())
    after, plan = plan_of(scene, device, rung)
    assert not any(s.beside for s in plan.resources.program.sections)
    assert_same(beside, after)
