"""The bench of the effects: cases that call for what they name, rows that add up, strips and a page that show them."""

import dataclasses
import json
import re

import bench_package  # noqa: F401
import numpy as np
import pytest
import warp as wp

from bench import effect_cases, effect_compile, effect_images, effect_tables, effects, record, report, timing
from bench.__main__ import main
from warp_deferred import Settings
from warp_deferred.errors import Error, LoadError
from warp_deferred.images import read_png
from warp_deferred.loading import built_in_scenes

KNOWN = effect_cases.ladders()
#: Cases whose effect and scene are there.
READY = [case for case in effect_cases.EFFECT_CASES.values()
         if case.effect in KNOWN and case.source.split("?")[0] in built_in_scenes()]  # fmt: skip
WITH_CAUSE = [case for case in READY if case.free is not None]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Folder with a quick result and strips of the effects, made through the command line."""
    root = tmp_path_factory.mktemp("effects")
    path = root / "bench" / "results" / "effects.json"
    assert main(["effects", "--device", "cpu", "--quick", "--json", str(path)]) == 0
    assert main(["effects-images", "--device", "cpu", "--quick", "--out", str(root / "docs" / "images")]) == 0
    return root


@pytest.fixture
def result(results):
    return record.read(results / "bench" / "results" / "effects.json")


# ---- cases


def test_every_ladder_goes_from_off_to_its_reference():
    assert KNOWN["anti_aliasing"][0] == "off" and KNOWN["anti_aliasing"][-1] == "samples_64"
    for effect, rungs in KNOWN.items():
        # A filter, such as blur, is off or on; a ladder has something between.
        assert len(rungs) >= 2 and effect not in ("gbuffer", "light_culling", "raster"), effect


def test_rungs_are_set_one_effect_at_a_time():
    changed = effects.at_rung(Settings(), "anti_aliasing", "samples_4")
    assert changed == Settings().with_values(["anti_aliasing.rung=samples_4"]) != Settings()


@pytest.mark.parametrize("case", WITH_CAUSE, ids=lambda case: case.effect)
def test_what_a_case_takes_back_is_what_calls_for_its_effect(case):
    device = wp.get_device("cpu")
    rung = getattr(Settings(), case.effect).rung
    plans = {}
    for name, change in (("called", None), ("free", case.free)):
        renderer = effects.open_case(case, (16, 9), device, change)
        renderer.scene.settings = effects.at_rung(Settings().with_values(list(case.small_settings)), case.effect, rung)
        renderer.prepare()
        plans[name] = {line.name: line for line in renderer.plan.reports(measure=False)}[case.effect]
    assert plans["called"].runs and not plans["free"].runs, plans["free"].reason


@pytest.mark.parametrize("cuda", [True, False])
def test_composite_frames_are_of_the_stated_size_and_turn_other_effects_off(cuda):
    cases = effect_cases.composite_cases(cuda, quick=False)
    names = [case.name for case in cases]
    assert names[0].startswith("composite_") and any(name.startswith("shadowed_points_") for name in names)
    if cuda:
        assert cases[0].source == "terrain?triangles=500000&lights=1000"
        assert [(c.width, c.height) for c in cases[:2]] == [(1920, 1080), (3840, 2160)]
        assert "lights=16&" in cases[2].source and "shadow.point_size=512" in cases[2].settings
    for case in cases:
        off = {text.split(".")[0] for text in case.assignments() if text.endswith(".rung=off")}
        assert off == set(KNOWN) - set(case.needs)


def test_composite_frames_call_for_what_they_need():
    composite, *points = effect_cases.composite_cases(False, quick=True)
    scene = composite.build()
    assert scene.lights.directional.casts_shadow.tolist() == [True] and scene.camera.bloom > 0.0
    assert max(scene.environment.ambient) > 0.0 and not scene.lights.point.casts_shadow.any()
    for case in points:
        scene = case.build()
        assert scene.lights.point.casts_shadow.all() and len(scene.lights.point) == 2


# ---- rows


def test_each_rung_stands_beside_its_frame_without_the_effect(result):
    assert effect_tables.effect_names(result) == [case.effect for case in READY]
    for effect in effect_tables.effect_names(result):
        off, *rows = effect_tables.rungs_of(result, effect)
        assert [off["rung"], *(r["rung"] for r in rows)] == list(KNOWN[effect])
        for row in rows:
            assert row["cost.difference_ms"] == pytest.approx(row["frame.ms"] - off["frame.ms"], abs=2e-5)
            assert row["memory.added_bytes"] == row["memory.bytes"] - off["memory.bytes"]
            names = row.get("own.passes", "").split(" + ")
            assert not any(f"pass.{name}.ms" in off for name in names)
            if names != [""]:
                assert row["own.ms"] == pytest.approx(sum(row[f"pass.{n}.ms"] for n in names), abs=1e-4)
        assert rows[-1]["error.rmse"] == rows[-1]["error.max"] == 0.0
        assert off["error.rmse"] > 0.0, "the effect changes the picture of its own scene"


def test_samples_come_nearer_to_the_reference(result):
    rows = {row["rung"]: row for row in effect_tables.rungs_of(result, "anti_aliasing")}
    assert rows["off"]["error.rmse"] > rows["samples_4"]["error.rmse"] > rows["samples_16"]["error.rmse"] > 0.0
    assert rows["samples_16"]["samples"] == 16


def test_what_is_not_called_for_adds_nothing_to_the_plan(result):
    rows = [row for row in result["rows"] if row["kind"] == "free" and "free.passes" in row]
    assert [row["effect"] for row in rows] == [case.effect for case in WITH_CAUSE]
    for row in rows:
        assert [row[f"free.{key}"] for key in ("passes", "launches", "kernels", "bytes")] == [0, 0, 0, 0]


def test_an_effect_with_nothing_to_do_is_skipped_on_the_device(result):
    rows = [row for row in result["rows"] if "idle.active" in row]
    assert [row["effect"] for row in rows] == [case.effect for case in READY if case.idle is not None]
    for row in rows:
        assert row["idle.active"] == ""
        assert row["idle.difference_ms"] == pytest.approx(row["frame.ms"] - row["off.ms"], abs=2e-5)


def test_nothing_is_left_out_in_silence(result):
    told = " ".join(result["skipped"])
    shown = set(effect_tables.effect_names(result))
    for effect in set(effect_cases.EFFECT_CASES) | set(KNOWN):
        assert (effect in shown) != bool(re.search(rf"\b{effect}: ", told)), effect
    frames = {row["case"] for row in result["rows"] if row["kind"] == "frame"}
    for case in effect_cases.composite_cases(False, quick=True):
        assert (case.name in frames) != (f"{case.name}: no " in told)


def test_a_case_without_its_scene_and_an_effect_without_a_case_are_named(monkeypatch):
    case = effect_cases.EFFECT_CASES["anti_aliasing"]
    device, notes = wp.get_device("cpu"), []
    gone = {"anti_aliasing": dataclasses.replace(case, source="no_such_scene", small="")}
    for cases, words in ((gone, "anti_aliasing: 'no_such_scene'"), ({}, "anti_aliasing: no case")):
        monkeypatch.setattr(effects, "EFFECT_CASES", cases)
        monkeypatch.setattr(effects, "composite_cases", lambda *_, **__: ())
        monkeypatch.setattr(effects, "ladders", lambda: {"anti_aliasing": KNOWN["anti_aliasing"]})
        outcome = effects.run(device, quick=True, settings=Settings(), note=notes.append)
        assert not outcome["rows"] and any(text.startswith(words) for text in outcome["skipped"])
        assert any(words in text for text in notes)


def test_frames_that_differ_are_timed_one_by_one(device):
    seen = []
    result = timing.time_moving(wp.get_device(device), seen.append, 6)
    assert result.repeats == 6 and seen == list(range(6 + timing.WARM_CALLS)) and result.median >= 0.0


# ---- compile times


def test_compile_times_are_of_the_effect_s_kernels_alone():
    times = effect_compile.compile_times("anti_aliasing", "cpu", ["samples_4"], Settings())["samples_4"]
    assert 1 <= times["compile.kernels"] <= 8
    assert 0.0 < times["compile.s"] < 600.0 and times["compile.replaced_s"] >= 0.0


def test_a_compile_that_fails_says_why():
    with pytest.raises(Error, match=r"compiling the kernels of anti_aliasing: expected times, got .*samples_5"):
        effect_compile.compile_times("anti_aliasing", "cpu", ["samples_5"], Settings())


# ---- strips and page


def test_strips_show_every_rung_and_stay_small(results):
    images = results / "docs" / "images"
    for case in READY:
        path = effect_images.strip_path(images, case.effect)
        assert effect_images.strip_rungs(path) == list(KNOWN[case.effect])
        assert path.stat().st_size <= effect_images.MOST_BYTES
        assert read_png(path)[..., :3].max(axis=-1).mean() > 20.0
    with pytest.raises(LoadError, match="draw it again"):
        effect_images.strip_rungs(images / "none.png")


def test_a_cut_is_where_the_case_says_and_enlarged():
    image = np.zeros((40, 60, 4), np.uint8)
    image[20, 15] = 255
    case = dataclasses.replace(effect_cases.EFFECT_CASES["anti_aliasing"], centre=(0.25, 0.5), zoom=2)
    piece = effect_images.cut(image, case, (12, 8))
    assert piece.shape == (8, 12, 4) and piece[..., 0].sum() == 4 * 255
    y, x = np.argwhere(piece[..., 0])[0]
    assert (y, x) == (4, 6)
    # At a border the cut moves inwards; it never grows past the picture.
    corner = effect_images.cut(image, dataclasses.replace(case, centre=(1.0, 1.0), zoom=1), (500, 8))
    assert corner.shape == (8, 60, 4)


def test_pictures_lie_from_left_to_right_then_down():
    cuts = [np.full((2, 3, 4), k, np.uint8) for k in range(5)]
    sheet = effect_images.lay_side_by_side(cuts)
    gap = effect_images.GAP
    assert sheet.shape == (4 + gap, 9 + 2 * gap, 4)
    assert [sheet[0, k * (3 + gap), 0] for k in range(3)] == [0, 1, 2]
    assert [sheet[2 + gap, k * (3 + gap), 0] for k in range(3)] == [3, 4, 255]


def test_a_strip_shrinks_until_it_fits(tmp_path, monkeypatch):
    noise = np.random.default_rng(0).integers(0, 255, (270, 480, 4)).astype(np.uint8)
    monkeypatch.setattr(effect_images, "MOST_BYTES", 60_000)
    case = effect_cases.EFFECT_CASES["bloom"]
    path = effect_images._write(tmp_path / "a.png", case, {"off": noise, "exact": noise})
    assert 20_000 < path.stat().st_size <= 60_000 and effect_images.strip_rungs(path) == ["off", "exact"]


def test_the_page_shows_what_the_result_holds(results, result):
    pytest.importorskip("matplotlib")
    assert main(["report", "--root", str(results)]) == 0
    text = (results / "docs" / "effects.md").read_text()
    for effect in effect_tables.effect_names(result):
        assert f"## {effect}\n" in text and f"(images/effects_{effect}.png)" in text
        for row in effect_tables.rungs_of(result, effect):
            assert f"| `{row['rung']}` |" in text
    assert "reference" in text and result["commit"] in text and "a quick run" in text
    for line in result["skipped"]:
        assert f"- {line}" in text
    for image in re.findall(r"\]\((images/\S+)\)", text + (results / "docs" / "benchmarks.md").read_text()):
        assert (results / "docs" / image).is_file()
    assert main(["report", "--check", "--root", str(results)]) == 0
    page = report.effects_page({"effects": json.loads(json.dumps(result))}, results / "docs" / "images")
    assert page == text


def test_costs_are_judged_by_their_limits(result):
    row = {"kind": "rung", "effect": "bloom", "source": "glow", "width": 1920, "height": 1080, "rung": "mip_chain",
           "frame.ms": 0.4, "frame.ms_p5": 0.4, "frame.ms_p95": 0.4, "cost.difference_ms": 0.041}  # fmt: skip
    on_card = {"device": "NVIDIA H200", "quick": False, "skipped": [], "rows": [row]}
    assert "≤ 0.05 ✓" in effect_tables.ladder_table(on_card, "bloom")
    assert "≤ 0.05 ✗" in effect_tables.ladder_table(on_card | {"rows": [row | {"cost.difference_ms": 0.06}]}, "bloom")
    idle = {"kind": "free", "effect": "bloom", "frame.ms": 0.4, "off.ms": 0.395, "idle.difference_ms": 0.005}
    assert "≤ 0.01 ✓" in effect_tables.free_table(on_card | {"rows": [idle]})
