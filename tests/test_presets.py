"""Presets: chosen from a result by a rule, shipped as made, and set beside what a user sets."""

import re
import typing
from types import SimpleNamespace

import bench_package
import pytest

import warp_deferred as wd
from bench import fit, fit_tables, presets, record, tables
from bench.__main__ import main
from bench.ladders import LADDERS
from warp_deferred.errors import LoadError
from warp_deferred.fitting.model import Grid, LadderPrices, Market, Offer
from warp_deferred.loading import load
from warp_deferred.presets import PRESETS

ROOT = bench_package.ROOT
NAMES = ("draft", "balanced", "high", "reference")


def accuracy(rows):
    """A result of two ladders with these (ladder, scene, rung, frame ms, RMSE)."""
    keys = ("ladder", "scene", "rung", "frame.ms", "error.rmse")
    head = {"bench": "accuracy", "device": "CPU, 2 cores", "date": "2026-01-01 00:00 UTC", "format": 1}
    return head | {"rows": [dict(zip(keys, row, strict=True)) for row in rows]}


RESULT = accuracy([
    ("anti_aliasing", "hundred_lights", "off", 1.0, 0.07), ("anti_aliasing", "hundred_lights", "fxaa", 1.1, 0.05),
    ("anti_aliasing", "hundred_lights", "samples_4", 4.0, 0.03),
    ("anti_aliasing", "hundred_lights", "samples_16", 16.0, 0.01),
    ("anti_aliasing", "hundred_lights", "samples_64", 64.0, 0.0),
    ("bloom", "glow", "off", 2.0, 0.1), ("bloom", "glow", "exact", 12.0, 0.0),
    ("bloom", "shadows", "off", 10.0, 0.02), ("bloom", "shadows", "exact", 20.0, 0.0),
    ("light_culling", "glow", "tiles", 1.0, 0.0),
])  # fmt: skip


def test_the_rule_in_a_case_done_by_hand():
    chosen = presets.choose(RESULT)
    rungs = {name: {c.ladder: c.rung for c in of} for name, of in chosen.items()}
    # Rate 0.05: off 0.07, fxaa 0.055, samples_4 0.18; 0.005: 0.07, 0.0505, 0.045, 0.085; 0.001: 0.033, 0.025, ....
    assert [rungs[name]["anti_aliasing"] for name in NAMES] == ["fxaa", "samples_4", "samples_16", "samples_64"]
    bloom = chosen["reference"][1]
    # Frames 6 and 2 times as long: 5 and 1 more, 3 in the mean.
    assert (bloom.ladder, bloom.price) == ("bloom", pytest.approx(3.0))
    off = next(c for c in chosen["draft"] if c.ladder == "bloom")
    assert off.rung == "off" and off.error == pytest.approx(((0.1**2 + 0.02**2) / 2) ** 0.5)
    assert all("light_culling" not in of for of in rungs.values())


def test_rungs_that_all_give_the_same_bits_are_not_chosen_by_noise():
    rows = [("fast_math", "shadows", "fast", 1.0, 0.0), ("fast_math", "shadows", "fused", 0.9, 0.0),
            ("fast_math", "shadows", "precise", 1.1, 0.0)]  # fmt: skip
    assert all(of == [] for of in presets.choose(accuracy(rows)).values())
    rows[0] = (*rows[0][:4], 1e-6)
    chosen = presets.choose(accuracy(rows))
    assert [chosen[name][0].settings for name in ("draft", "reference")] == [
        ("shade.arithmetic=fused",), ("shade.arithmetic=precise",)
    ]  # fmt: skip


def test_dearer_presets_are_nearer():
    chosen = presets.choose(record.read(presets.source(ROOT)))
    errors = [{c.ladder: c.error for c in chosen[name]} for name in NAMES]
    for ladder in errors[0]:
        falling = [of[ladder] for of in errors]
        assert falling == sorted(falling, reverse=True), ladder
    assert all(c.rung == LADDERS[c.ladder].reference for c in chosen["reference"])


def test_the_shipped_module_is_what_the_command_makes_of_the_result_it_names(tmp_path, capsys):
    module = ROOT / presets.MODULE
    named = re.search(r"from (bench/results/\S+\.json)", module.read_text())[1]
    copy = tmp_path / "presets.py"
    assert main(["presets", "--from", str(ROOT / named), "-o", str(copy)]) == 0
    assert copy.read_text() == module.read_text()
    assert str(copy) in capsys.readouterr().out
    assert main(["presets", "--from", str(ROOT / named), "-o", str(copy), "--check"]) == 0
    copy.write_text("old")
    assert main(["presets", "--from", str(ROOT / named), "-o", str(copy), "--check"]) == 1
    assert copy.read_text() == "old"


def test_results_of_another_version_are_refused(tmp_path, capsys):
    with pytest.raises(LoadError, match="format: expected 1, got 2"):
        presets.choose(RESULT | {"format": 2})
    with pytest.raises(LoadError, match=r"expected ladders .* got 'hair'"):
        presets.choose(accuracy([("hair", "glow", "off", 1.0, 0.0)]))
    with pytest.raises(LoadError, match=r"expected accuracy\.json"):
        presets.source(tmp_path)
    assert main(["presets", "--from", str(tmp_path / "none.json")]) == 2 and "error: " in capsys.readouterr().err


def test_a_result_of_a_gpu_goes_before_one_of_a_cpu(tmp_path):
    folder = tmp_path / presets.RESULTS
    folder.mkdir(parents=True)
    (folder / "accuracy_cpu.json").write_text("{}")
    assert presets.source(tmp_path).name == "accuracy_cpu.json"
    (folder / "accuracy.json").write_text("{}")
    assert presets.source(tmp_path).name == "accuracy.json"


# ---- settings


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_sets_its_rungs(name):
    chosen = wd.Settings(preset=name)
    for stage, fields in PRESETS[name].items():
        for field, value in fields.items():
            assert str(getattr(getattr(chosen, stage), field)) == value
    # What a preset says nothing of is at its default.
    assert chosen.display == wd.Settings().display and chosen.raster == wd.Settings().raster
    assert hash(chosen) == hash(wd.Settings(preset=name)) and chosen == wd.Settings(preset=name)


def test_names_are_those_of_the_module():
    assert typing.get_args(wd.Settings.model_fields["preset"].annotation) == ("none", *PRESETS) == ("none", *NAMES)
    with pytest.raises(wd.InputError, match=r"Settings.preset: expected 'none', 'draft', .* got 'ultra'"):
        wd.Settings(preset="ultra")


def test_what_a_user_sets_goes_before_a_preset():
    high = wd.Settings(preset="high").with_values(["anti_aliasing.rung=off", "shadow.spot_size=512"])
    assert high.anti_aliasing.rung == "off" and high.shadow.spot_size == 512
    assert high.shadow.rung == PRESETS["high"]["shadow"]["rung"] and high.preset == "high"
    # In either order, and past another preset.
    first = wd.Settings().with_values(["anti_aliasing.rung=off"]).replace(preset="reference")
    assert first.anti_aliasing.rung == "off" and first.shadow.rung == "ray_traced"
    draft = first.replace(preset="draft")
    assert draft == wd.Settings(preset="draft").with_values(["anti_aliasing.rung=off"])
    none = first.replace(preset="none")
    assert none.with_values(["bloom.radius=0.1"]).shadow.rung == wd.Settings().shadow.rung
    with pytest.raises(wd.InputError, match=r"--set: expected stage\.field=value"):
        wd.Settings().with_values(["preset=draft"])
    with pytest.raises(wd.InputError, match="Settings: expected one of"):
        wd.Settings().with_values(["preset.rung=draft"])


def test_a_scene_file_may_name_a_preset(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('[settings]\npreset = "draft"\n[settings.anti_aliasing]\nrung = "samples_4"\n')
    chosen = load(path).settings
    assert chosen.preset == "draft" and chosen.anti_aliasing.rung == "samples_4"
    assert chosen.shadow == wd.Settings(preset="draft").shadow
    for text in ('preset = "ultra"', "preset = 3", "preset = {a = 1}"):
        path.write_text(f"[settings]\n{text}\n")
        with pytest.raises(LoadError, match="preset: expected"):
            load(path)


# ---- benches


def test_presets_are_measured(tmp_path):
    path = tmp_path / "presets.json"
    assert main(["presets", "--device", "cpu", "--quick", "--json", str(path)]) == 0
    result = record.read(path)
    rows = {row["preset"]: row for row in result["rows"]}
    assert tuple(rows) == NAMES and all(row["frame.ms"] > 0.0 for row in rows.values())
    errors = [rows[name]["error.rmse"] for name in NAMES]
    assert errors == sorted(errors, reverse=True) and errors[-1] == 0.0
    table = tables.full_table(result)
    assert table.count("\n") == 5 and f"{rows['draft']['error.rmse']:.3g}" in table and "| reference |" in table


def test_fits_are_told_in_a_table():
    row = {
        "scene": "hundred_lights", "budget_ms": 1.0, "frame.ms": 0.957, "frame.ms_p5": 0.95, "frame.ms_p95": 0.96,
        "frame.repeats": 60, "held.share": 0.9833, "error.rmse": 0.0301, "error.judged": 0.0302, "error.ratio": 1.04,
        "best.error": 0.029, "best.share": 0.99, "spent.share": 0.957, "unspent": "", "tried.count": 208,
        "tried.of": 2900, "tried.ratio": 1.31, "tried.s": 21.4,
        "first.s": 3.5, "first.load_s": 0.4, "first.compile_s": 61.0,
        "first.compiled": 43, "fresh.s": 3.2, "fresh.load_s": 0.3, "fresh.process_s": 4.4,
        "fit.s": 2.1, "fit.frames": 30, "cached.s": 0.9, "bought": "scale.rung=half",
        "best.bought": "", "next": "0.1 ms more would buy nothing",
    }  # fmt: skip
    table = fit_tables.fit_table({"device": "NVIDIA H200", "quick": False, "rows": [row]})
    assert "208 combinations of 2900, the others predicted to be 1.31 times the least error" in table
    assert "≤ 1.15 ✓" in table and "≤ 0.1 ✓" in table and "≤ 3 ✗" in table and "98% of 60" in table and "96%" in table
    assert "the defaults" in table and "`scale.rung=half`" in table
    lost = {k: v for k, v in row.items() if not k.startswith("best.") and k != "error.ratio"}
    del lost["fresh.s"], lost["fresh.load_s"], lost["fresh.process_s"]
    lost |= {"spent.share": 0.67, "unspent": "33% of the budget is left: nothing for sale between 0.67 and 1.04 ms"}
    table = fit_tables.fit_table({"device": "NVIDIA H200", "quick": False, "rows": [lost]})
    assert "| nothing for sale |" in table and "none fits" in table and "≤ 3" not in table


def test_every_combination_is_tried_but_for_estimates_and_what_is_far_past_the_budget():
    offers = (Offer("off", -0.1, 0.02), Offer("gtao", 0.0, 0.01), Offer("ray_traced", 90.0, 0.0, estimated=True))
    shade = LadderPrices("shade", "sample", (Offer("half", 0.0, 0.01), Offer("float32", 0.0, 0.0)))
    codecs = LadderPrices("gbuffer", "sample", (Offer("oct24", 0, 0.01), Offer("oct32", 0, 0.01), Offer("full", 0, 0)))
    ladders = (LadderPrices("ambient_visibility", "sample", offers), codecs, shade)
    grid = Grid({("off", 1): 1.0, ("off", 4): 4.0}, {("off", "off"): 0.1, ("off", "samples_4"): 0.05})
    known = SimpleNamespace(grid=grid, ladders=ladders)
    tried, ratios = fit.combinations(known, 5.0)
    # Those come first that nothing is predicted to beat in their time.
    assert ratios == sorted(ratios) and ratios[0] == 1.0 and ratios[-1] > 1.0
    assert tried[0] == min(tried, key=lambda c: Market(grid, ladders).predict(c)[0])
    # Formats at their ends, and both together.
    assert {(c["gbuffer"], c["shade"]) for c in tried} == {("oct24", "half"), ("full", "float32")}
    assert len(tried) == 8 and {c["ambient_visibility"] for c in tried} == {"off", "gtao"}
    cheap = sorted(c["anti_aliasing"] for c in fit.combinations(known, 3.7)[0])
    assert cheap == ["off"] * 4 + ["samples_4"] * 2


def test_the_best_is_the_nearest_picture_that_keeps_the_budget():
    plain, half = wd.Settings(), wd.Settings().with_values(["scale.rung=half"])
    tried = [(0.5, 0.04, half), (0.9, 0.02, plain), (1.1, 0.01, half)]
    row = fit._outcome(0.025, 1.0, tried)
    assert (row["best.error"], row["best.frame_ms"], row["best.bought"]) == (0.02, 0.9, "")
    assert row["error.ratio"] == 1.25 and row["best.share"] == 0.9
    assert fit._outcome(0.05, 0.6, tried)["best.bought"] == "scale.rung=half"
    assert "best.error" not in fit._outcome(0.05, 0.1, tried)
