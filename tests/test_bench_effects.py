"""The bench of the effects: cases that call for what they name, rows that add up, strips and a page that show them."""

import dataclasses
import json
import re

import pytest
import warp as wp

from bench import (
    effect_cases,
    effect_compile,
    effect_images,
    effect_tables,
    effect_texts,
    effects,
    fog,
    record,
    report,
    timing,
)  # fmt: skip
from bench.__main__ import main
from warp_deferred import Settings
from warp_deferred.errors import Error, LoadError
from warp_deferred.images import read_png
from warp_deferred.loading import built_in_scenes

KNOWN = effect_cases.ladders()
CASES = list(effect_cases.EFFECT_CASES.values())
WITH_CAUSE = [case for case in CASES if case.has_cause]
DRAWN = [case for case in CASES if case.draws]


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


def test_every_effect_has_a_case_and_every_case_its_scene_its_rungs_and_its_words():
    assert effect_cases.without_case() == []
    for case in CASES:
        rungs = case.rungs()
        assert case.source.split("?")[0] in built_in_scenes() and len(rungs) > 1 and rungs[0] == "off", case.name
        assert case.reference in ("", *rungs)
        assert set(case.leaves_out) <= set(KNOWN.get(case.stage, ()))
        assert 100 < len(effect_texts.TEXTS[case.name]) < 900
        # What a text calls a rung is one.
        for word in re.findall(r"(?<=Choose )`(\w+)`", effect_texts.TEXTS[case.name]):
            assert word in rungs, (case.name, word)
    assert set(effect_texts.TEXTS) == set(effect_cases.EFFECT_CASES) >= set(effect_texts.TITLES)
    # A ladder's errors are taken against its dearest rung, unless it saves time; filters and choices have none.
    assert {case.name: case.reference for case in CASES if case.reference != case.rungs()[-1]} == {
        "scale": "off", "scale_samples_16": "off", "blur": "", "tone_mapping": "", "custom_pass": "",
        "shadow_cascades": "", "ambient_visibility_terrain": "",
    }  # fmt: skip


def test_rungs_are_set_one_effect_at_a_time():
    cases = effect_cases.EFFECT_CASES
    changed = cases["anti_aliasing"].at(Settings(), "samples_4")
    assert changed == Settings().with_values(["anti_aliasing.rung=samples_4"]) != Settings()
    agx = cases["tone_mapping"].at(Settings(), "agx")
    assert agx == Settings().with_values(["display.tone_mapping=agx"])
    assert cases["custom_pass"].at(Settings(), "fog") == Settings()
    assert cases["tone_mapping"].default(Settings()) == "pbr_neutral"
    assert cases["scale"].default(Settings()) == "half" and cases["custom_pass"].default(Settings()) == "fog"


def test_the_pass_that_is_timed_is_the_one_of_the_page():
    kernel = fog._definitions()["fog_kernel"]
    assert kernel.adj.source.startswith("@wp.kernel\ndef fog_kernel(") and kernel.adj.source in fog.PAGE.read_text(
        "utf-8"
    )
    made = fog.make_fog()
    assert (made.name, made.density, type(made).__doc__) == ("fog", 0.05, "Fog of constant density [1/m].")


@pytest.mark.parametrize("case", WITH_CAUSE, ids=lambda case: case.name)
def test_what_a_case_takes_back_is_what_calls_for_its_effect(case):
    device, case = wp.get_device("cpu"), case.quick()
    settings = case.at(Settings().with_values(list(case.settings)), case.default(Settings()))
    plans = {}
    for name, change, more in (("called", None, ()), ("free", case.free, case.free_settings)):
        renderer = effects.open_case(case, (16, 9), device, change)
        renderer.scene.settings = settings.with_values(list(more))
        renderer.prepare()
        plans[name] = {line.name: line for line in renderer.plan.reports(measure=False)}[case.stage]
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
    assert effect_tables.case_names(result) == [case.name for case in CASES]
    for case in CASES:
        off, *rows = effect_tables.rungs_of(result, case.name)
        assert [off["rung"], *(r["rung"] for r in rows)] == list(case.rungs())
        for row in rows:
            assert row["cost.difference_ms"] == pytest.approx(row["frame.ms"] - off["frame.ms"], abs=2e-5)
            assert row["memory.added_bytes"] == row["memory.bytes"] - off["memory.bytes"]
            names = row.get("own.passes", "").split(" + ")
            assert not any(f"pass.{name}.ms" in off for name in names)
            if names != [""]:
                assert row["own.ms"] == pytest.approx(sum(row[f"pass.{n}.ms"] for n in names), abs=1e-4)
            if "shared.passes" in row:
                total = sum(row["shared.passes"].values())
                assert row["shared.difference_ms"] == pytest.approx(total, abs=1e-4)
            assert row["explain"], (case.name, row["rung"])
        if case.reference:
            for row in (off, *rows):
                assert (row["error.rmse"] == row["error.max"] == 0.0) == (row["rung"] == case.reference)
                assert row["reference"] == case.reference
        else:
            assert not any(key.startswith("error.") for row in (off, *rows) for key in row)


def test_explain_is_quoted_for_each_rung_and_for_no_cause(result):
    lines = effect_tables.explain_lines(result, "ambient_visibility").splitlines()
    # The reference brings trees of its own to trace.
    trees = [k for k, line in enumerate(lines) if line.split()[:2] == ["ray_scene", "runs"]]
    assert trees == [len(KNOWN["ambient_visibility"]) - 2]
    assert [line.split()[:3] for line in lines if not line.startswith("ray_scene")] == [
        *(["ambient_visibility", "runs", rung] for rung in KNOWN["ambient_visibility"][1:]),
        ["ambient_visibility", "-", "off"],
    ]
    assert lines[0].endswith("ambient light is not zero") and lines[-1].endswith("ambient light is zero")
    lines = {line.split()[0]: line for line in effect_tables.explain_lines(result, "custom_pass").splitlines()}
    assert lines["fog"].split()[1] == "runs" and lines["fog"].endswith("handed in with passes=")


def test_samples_come_nearer_to_the_reference(result):
    rows = {row["rung"]: row for row in effect_tables.rungs_of(result, "anti_aliasing")}
    assert rows["off"]["error.rmse"] > rows["samples_4"]["error.rmse"] > rows["samples_16"]["error.rmse"] > 0.0
    assert rows["samples_16"]["samples"] == 16


def test_what_is_not_called_for_adds_nothing_to_the_plan(result):
    rows = [row for row in result["rows"] if row["kind"] == "free" and "free.passes" in row]
    assert [row["case"] for row in rows] == [case.name for case in WITH_CAUSE]
    for row in rows:
        assert row["free.reason"]
        assert [row[f"free.{key}"] for key in ("passes", "launches", "kernels", "bytes")] == [0, 0, 0, 0]


def test_an_effect_with_nothing_to_do_is_skipped_on_the_device(result):
    rows = [row for row in result["rows"] if "idle.active" in row]
    assert [row["case"] for row in rows] == [case.name for case in CASES if case.idle is not None]
    for row in rows:
        assert row["idle.active"] == ""
        assert row["idle.difference_ms"] == pytest.approx(row["frame.ms"] - row["off.ms"], abs=2e-5)


def test_nothing_is_left_out_in_silence(result):
    told = " ".join(result["skipped"])
    shown = set(effect_tables.case_names(result))
    for name in effect_cases.EFFECT_CASES:
        assert (name in shown) != bool(re.search(rf"\b{name}: ", told)), name
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
        monkeypatch.setattr(effects, "without_case", lambda cases=cases: ["anti_aliasing"] * (not cases))
        outcome = effects.run(device, quick=True, settings=Settings(), note=notes.append)
        assert not outcome["rows"] and any(text.startswith(words) for text in outcome["skipped"])
        assert any(words in text for text in notes)


def test_what_fails_is_named_and_the_others_go_on(monkeypatch):
    def broken():
        raise RuntimeError("out of luck\nmore of it")

    cases = effect_cases.EFFECT_CASES
    small = dataclasses.replace(cases["blur"], source=cases["scale"].small)
    given = {
        "custom_pass": dataclasses.replace(cases["custom_pass"], change=lambda scene: broken()),
        "blur": dataclasses.replace(small, free=lambda scene: broken()),
    }
    monkeypatch.setattr(effects, "EFFECT_CASES", given)
    monkeypatch.setattr(effects, "composite_cases", lambda *_, **__: ())
    monkeypatch.setattr(effects, "picture", lambda *_: broken() if _[1].plan.request.settings.blur.rung != "off" else 0)
    kept = []
    outcome = effects.run(
        wp.get_device("cpu"),
        quick=True,
        settings=Settings(),
        note=str,
        keep=lambda part: kept.append(len(part["rows"])),
    )
    told = outcome["skipped"]
    assert "custom_pass: RuntimeError: out of luck" in told and "blur.rung=gaussian: RuntimeError: out of luck" in told
    assert "blur, not called for: RuntimeError: out of luck" in told
    assert [(row["case"], row["rung"]) for row in outcome["rows"]] == [("blur", "off")] and kept == [0, 1]


def test_one_case_can_be_run_alone(tmp_path):
    path = tmp_path / "one.json"
    assert main(["effects", "--device", "cpu", "--quick", "--only", "blur", "--json", str(path)]) == 0
    outcome = record.read(path)
    assert effect_tables.case_names(outcome) == ["blur"] and {row["kind"] for row in outcome["rows"]} == {
        "rung",
        "free",
    }
    assert main(["effects", "--device", "cpu", "--quick", "--only", "blurr"]) == 2


def test_frames_that_differ_are_timed_one_by_one(device):
    seen = []
    result = timing.time_moving(wp.get_device(device), seen.append, 6)
    assert result.repeats == 6 and seen == list(range(6 + timing.WARM_CALLS)) and result.median >= 0.0


# ---- compile times


def test_compile_times_are_of_the_effect_s_kernels_alone():
    times = effect_compile.compile_times("anti_aliasing", "cpu", ["samples_4"], Settings())["samples_4"]
    assert 1 <= times["compile.kernels"] <= 8
    assert 0.0 < times["compile.s"] < 600.0 and times["compile.replaced_s"] >= 0.0


def test_compiles_of_several_cases_are_told_apart():
    blur, gone = effect_cases.EFFECT_CASES["blur"], dataclasses.replace(effect_cases.EFFECT_CASES["blur"], name="gone")
    notes, skipped = [], []
    times = effect_compile.compile_all([blur, gone], "cpu", Settings(), notes.append, skipped.append)
    assert list(times) == [("blur", "gaussian")] and times["blur", "gaussian"]["compile.s"] > 0.0
    assert notes == ["blur, kernels compiled anew"] and len(skipped) == 1 and "gone, compile times: " in skipped[0]


def test_a_compile_that_fails_says_why():
    with pytest.raises(Error, match=r"compiling the kernels of anti_aliasing: expected times, got .*samples_9"):
        effect_compile.compile_times("anti_aliasing", "cpu", ["samples_9"], Settings())


# ---- strips and page


def test_strips_show_every_rung_and_stay_small(results):
    images = results / "docs" / "images"
    for case in DRAWN:
        path = effect_images.strip_path(images, case.name)
        assert effect_images.strip_rungs(path) == list(case.rungs())
        assert path.stat().st_size <= effect_images.MOST_BYTES
        assert read_png(path)[..., :3].max(axis=-1).mean() > 20.0
    sheet = read_png(effect_images.strip_path(images, ""))
    (width, height), gap = effect_images.CELL, effect_images.GAP
    assert sheet.shape[:2] == (2 * (height + effect_images.BAR + gap) - gap, 3 * (width + gap) - gap)
    with pytest.raises(LoadError, match="draw it again"):
        effect_images.strip_rungs(images / "none.png")


def test_the_page_shows_what_the_result_holds(results, result):
    pytest.importorskip("matplotlib")
    assert main(["report", "--root", str(results)]) == 0
    text = (results / "docs" / "effects.md").read_text()
    for case in CASES:
        title = effect_texts.TITLES.get(case.name, case.name)
        assert f"## {title}\n" in text and effect_texts.TEXTS[case.name] in text
        assert (f"(images/effects_{case.name}.png)" in text) is case.draws
        for row in effect_tables.rungs_of(result, case.name):
            assert f"| `{row['rung']}` |" in text
    # Bounds are quoted, not retold.
    assert "> at most: ssao 0.17, gtao_half 0.12, gtao 0.11;" in text
    anchors = {re.sub(r"[^\w-]", "", t.lower().replace(" ", "-")) for t in re.findall(r"^## (.*)$", text, re.MULTILINE)}
    assert set(re.findall(r"\]\(#([\w-]+)\)", text)) <= anchors
    assert "reference" in text and result["commit"] in text and "a quick run" in text
    for line in result["skipped"]:
        assert f"- {line}" in text
    for image in re.findall(r"\]\((images/\S+)\)", text + (results / "docs" / "benchmarks.md").read_text()):
        assert (results / "docs" / image).is_file()
    assert main(["report", "--check", "--root", str(results)]) == 0
    page = report.effects_page({"effects": json.loads(json.dumps(result))}, results / "docs" / "images")
    assert page == text


def test_costs_are_judged_by_their_limits(result):
    row = {"kind": "rung", "case": "bloom", "effect": "bloom", "source": "glow", "width": 1920, "height": 1080,
           "rung": "mip_chain", "frame.ms": 0.4, "frame.ms_p5": 0.4, "frame.ms_p95": 0.4,
           "cost.difference_ms": 0.041}  # fmt: skip
    on_card = {"device": "NVIDIA H200", "quick": False, "skipped": [], "rows": [row]}
    assert "≤ 0.05 ✓" in effect_tables.ladder_table(on_card, "bloom")
    elsewhere = effect_tables.ladder_table(on_card | {"device": "CPU, 2 cores"}, "bloom")
    assert "≤ 0.05 |" in elsewhere
    assert "≤ 0.05 ✗" in effect_tables.ladder_table(on_card | {"rows": [row | {"cost.difference_ms": 0.06}]}, "bloom")
    idle = {
        "kind": "free",
        "case": "bloom",
        "effect": "bloom",
        "frame.ms": 0.4,
        "off.ms": 0.395,
        "idle.difference_ms": 0.005,
    }
    assert "≤ 0.01 ✓" in effect_tables.free_table(on_card | {"rows": [idle]})


def test_the_price_of_not_calling_has_launches_bytes_and_seconds():
    row = {"kind": "free", "case": "blur", "effect": "blur", "rung": "gaussian", "frame.ms": 1.0, "off.ms": 1.0,
           "free.passes": 0, "free.launches": 0, "free.kernels": 0, "free.bytes": 0, "free.reason": "why",
           "compile.s": 3.21}  # fmt: skip
    table = effect_tables.free_table({"device": "CPU", "quick": False, "rows": [row]})
    assert "| `blur` | not called for: why | 1.00 | 1.00 | 0 | 0 | 0 | 0.0 kB | 3.2 | by the plan, none |" in table
    more = effect_tables.free_table({"device": "CPU", "quick": False, "rows": [row | {"free.launches": 1}]})
    assert "by the plan, none" not in more
