"""`bench compare`: noise flags nothing, a shift flags itself, and results that cannot be compared are refused."""

import copy
import json
import math
from pathlib import Path

import bench_package
import numpy as np
import pytest

from bench import compare, noise, record
from bench.__main__ import main
from bench.timing import Timing
from warp_deferred.errors import InputError, LoadError

RESULTS = sorted((bench_package.ROOT / "bench" / "results").glob("*.json"))
PASSES = {"clusters": 0.4, "raster": 1.0, "resolve": 2.0, "shade": 5.0, "display": 1.5}
#: Standard deviation of a measurement, as a share of its time.
SIGMA = 0.04


def made(rng, repeats=50, sigma=SIGMA, shift=None, cases=6, draw="normal"):
    """A result of whole frames whose times are drawn at random; `shift` adds standard deviations to (case, pass)."""
    rows = []
    for case in range(cases):
        row = {"case": f"case_{case}", "width": 64, "height": 36, "memory.bytes": 1000, "error.rmse": 0.1234}
        for name, time in PASSES.items():
            values = {
                "normal": rng.normal,
                "uniform": lambda size: rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), size),
                "exponential": rng.exponential,
            }[draw](size=repeats)
            late = (shift or {}).get((row["case"], name), 0.0)
            row |= Timing.of(time * (1.0 + sigma * (values + late))).metrics(f"pass.{name}")
        rows.append(row)
    return {
        "bench": "frame", "machine": "m", "device": "NVIDIA X", "warp": "1", "driver": "", "commit": "c",
        "date": "", "quick": False, "settings": [], "rows": rows,
    }  # fmt: skip


def flagged(comparison):
    return {(c.row, c.metric, c.verdict) for c in comparison.changes if c.verdict != "same"}


@pytest.fixture
def no_drift(monkeypatch):
    """Noise within the runs alone, so that nothing else hides a false alarm."""
    for name in ("DRIFT", "FLOOR_MS"):
        monkeypatch.setattr(compare, name, {"cuda": 0.0, "cpu": 0.0})


# ---- the rule


@pytest.mark.parametrize(
    "chance, freedom, value",
    [(0.05, 1, 12.7062), (0.05, 4, 2.7764), (0.001, 10, 4.5869), (1e-4, 8, 7.1200), (0.05, 2000, 1.9612)],
)
def test_student_agrees_with_its_table(chance, freedom, value):
    assert noise.student(chance, freedom) == pytest.approx(value, rel=2e-4)


def test_limit_in_a_case_done_by_hand():
    # Errors 1.8 / (1.8 √9) = 1/3 each, Welch's freedom 16; Student's two-sided 5 % there is 2.1199.
    old, new = noise.Sample(10.0, 1.8, 9), noise.Sample(11.0, 1.8, 9)
    assert noise.limit(old, new, 1, 0.0) == pytest.approx(2.1199 * math.sqrt(2.0) / 3.0, rel=1e-4)
    assert noise.limit(old, new, 1, 0.8) == pytest.approx(2.1199 * math.sqrt(2.0) / 3.0 + 0.8, rel=1e-4)
    # More times share the same chance of a false alarm.
    assert noise.limit(old, new, 100, 0.0) > 1.8 * noise.limit(old, new, 1, 0.0)
    still = noise.Sample(10.0, 0.0, 50)
    assert noise.limit(still, still, 10, 0.3) == 0.3


@pytest.mark.parametrize("draw", ["normal", "exponential"])
@pytest.mark.parametrize("repeats", [5, 20, 50, 300])
def test_pure_noise_flags_nothing_in_95_percent_of_seeds(no_drift, repeats, draw):
    seeds = 100
    clean = 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        clean += not flagged(compare.compare(*(made(rng, repeats, draw=draw) for _ in range(2))))
    assert clean >= 0.95 * seeds


def test_drift_covers_what_the_bound_leaves_open():
    # Times of equal likelihood attain the bound, and few repeats blur the percentiles.
    seeds = [np.random.default_rng(k) for k in range(100)]
    clean = [not flagged(compare.compare(*(made(rng, 20, 0.02, draw="uniform") for _ in range(2)))) for rng in seeds]
    assert sum(clean) >= 0.95 * len(clean)


@pytest.mark.parametrize("name", PASSES)
def test_a_shift_of_three_sigma_flags_that_pass_alone(name):
    found, others = 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        verdicts = flagged(compare.compare(made(rng), made(rng, shift={("case_3", name): 3.0})))
        found += ("case_3", f"pass.{name}.ms", "slower") in verdicts
        others += len(verdicts - {("case_3", f"pass.{name}.ms", "slower")}) > 0
    assert found == 40 and others <= 2


def test_what_got_faster_is_told_apart():
    rng = np.random.default_rng(0)
    result = compare.compare(made(rng), made(rng, shift={("case_1", "shade"): -3.0}))
    assert flagged(result) == {("case_1", "pass.shade.ms", "faster")} and result.count("slower") == 0


def test_a_factor_widens_the_noise():
    rng = np.random.default_rng(0)
    old, new = made(rng), made(rng, shift={("case_1", "shade"): 3.0})
    assert compare.compare(old, new).count("slower") == 1
    assert compare.compare(old, new, factor=3.0).count("slower") == 0
    # Without any noise every median that moved at all is named, but the shares of counts stay.
    all_named = compare.compare(old, new, factor=0.0)
    assert all_named.count("slower") + all_named.count("faster") >= 28 and all_named.count("more") == 0
    for bad in (-1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="--factor"):
            compare.compare(old, new, factor=bad)


def test_the_clock_hides_what_it_cannot_tell():
    old = made(np.random.default_rng(0), sigma=0.0, cases=1)
    new = copy.deepcopy(old)
    for change, verdict in ((0.0129, "same"), (0.0131, "slower")):
        # 3 % of 0.4 ms and 1 µs.
        new["rows"][0]["pass.clusters.ms"] = round(0.4 + change, 5)
        (found,) = [c for c in compare.compare(old, new).changes if c.metric == "pass.clusters.ms"]
        assert found.verdict == verdict and found.noise == pytest.approx(0.013)


def test_a_time_without_spread_takes_the_widest_of_its_row():
    rng = np.random.default_rng(0)
    old, new = made(rng), made(rng)
    for result in (old, new):
        result["rows"][0]["raster.ms"] = 1.0
    noises = {c.metric: c.noise for c in compare.compare(old, new).changes if c.row == "case_0"}
    alone = {k: v for k, v in noises.items() if k.startswith("pass.")}
    assert noises["raster.ms"] == pytest.approx(max(v - 0.03 * PASSES[k[5:-3]] for k, v in alone.items()) + 0.03, 0.1)
    for result in (old, new):
        result["rows"][0] = {"case": "case_0", "raster.ms": 1.0}
    with pytest.raises(LoadError, match=r"raster\.ms: expected a time with a spread"):
        compare.compare(old, new)


def test_runs_differ_by_a_share_of_the_whole_that_a_time_is_a_difference_of():
    row = {"ladder": "l", "scene": "s", "rung": "r"} | Timing(100.0, 100.0, 100.0, 9).metrics("frame")
    old = made(np.random.default_rng(0)) | {"bench": "accuracy", "rows": [row | Timing(2.0, 2, 2, 9).metrics("stage")]}
    for stage, verdict in ((4.9, "same"), (5.1, "slower")):
        new = old | {"rows": [row | Timing(stage, stage, stage, 9).metrics("stage")]}
        assert {c.metric: c.verdict for c in compare.compare(old, new).changes} == {
            "frame.ms": "same",
            "stage.ms": verdict,
        }


def test_few_repeats_widen_the_noise():
    rows = [made(np.random.default_rng(0), repeats) for repeats in (5, 5, 50, 50)]
    for row in rows[2]["rows"] + rows[3]["rows"]:
        row |= {k: v for k, v in rows[0]["rows"][0].items() if ".ms" in k}
    few, many = (compare.compare(*pair).changes[2].noise for pair in (rows[:2], rows[2:]))
    assert few > 2.0 * many
    # Where a result does not tell, those of its bench count; on the CPU the fewest.
    for result in rows[2:]:
        for row in result["rows"]:
            for key in [k for k in row if k.endswith(".repeats")]:
                del row[key]
    assert compare.compare(*rows[2:]).changes[2].noise < few
    for result in rows[2:]:
        result["device"] = "CPU, 2 cores"
    assert compare.compare(*rows[2:]).changes[2].noise > few


@pytest.mark.parametrize(
    "bench, told, time",
    [("host", "calls", "host.us"), ("effects", "frame.repeats", "pass.shade.ms"), ("frame", "a.repeats", "a.ms")],
)
def test_repeats_are_found_under_their_names(no_drift, bench, told, time):
    def noise_of(repeats):
        row = {"case": "c", time: 5.0, f"{time}_p5": 4.0, f"{time}_p95": 6.0, told: repeats}
        result = made(np.random.default_rng(0)) | {"bench": bench, "rows": [row]}
        return next(c.noise for c in compare.compare(result, result).changes if c.metric == time)

    assert noise_of(10) > 1.5 * noise_of(100) > 0.0


# ---- rows and figures


def test_counts_sizes_and_errors_are_compared():
    old = made(np.random.default_rng(0))
    new = copy.deepcopy(old)
    new["rows"][0]["memory.bytes"] = 1001
    new["rows"][1]["error.rmse"] = 0.12345  # within the rounding of errors
    new["rows"][2]["error.rmse"] = 0.12
    assert flagged(compare.compare(old, new)) == {
        ("case_0", "memory.bytes", "more"),
        ("case_2", "error.rmse", "less"),
    }


def test_rows_and_figures_that_come_and_go_are_named(tmp_path, capsys):
    old = made(np.random.default_rng(0))
    new = copy.deepcopy(old)
    del new["rows"][1], new["rows"][0]["pass.shade.ms"]
    new["rows"].append(new["rows"][0] | {"case": "later"})
    new["rows"][1]["width"] = 128
    paths = [record.write(tmp_path / name, result) for name, result in (("old.json", old), ("new.json", new))]
    assert main(["compare", *map(str, paths)]) == 0
    text = capsys.readouterr().out
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:] if "|" in line]
    assert [(line[0], line[1], line[6]) for line in lines] == [
        ("case_2", "(the row)", "another case"),
        ("case_0", "pass.shade.ms", "missing"),
        ("case_1", "(the row)", "missing"),
        ("later", "(the row)", "new"),
    ]
    assert lines[0][4] == "width 64 → 128" and text.splitlines()[-1].startswith("27 same, 2 missing, 1 new, 1 another")


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_every_result_there_is_equals_itself_and_not_a_slower_one(path):
    old = record.read(path)
    same = compare.compare(old, old)
    assert not flagged(same) and len({c.row for c in same.changes}) == len(old["rows"])
    new = copy.deepcopy(old)
    row = new["rows"][-1]
    metric = next(k for k in row if k.endswith((".ms", ".us")) and f"{k}_p5" in row)
    # More than any noise, be it that of a host whose queue was full.
    for key in (metric, f"{metric}_p5", f"{metric}_p95"):
        row[key] += 10.0 * old["rows"][-1][f"{metric}_p95"]
    (change,) = [c for c in compare.compare(old, new).changes if c.verdict != "same"]
    assert (change.metric, change.verdict) == (metric, "slower")


# ---- the command line


def test_exit_codes_and_table(tmp_path, capsys):
    rng = np.random.default_rng(1)
    old, new = made(rng), made(rng, shift={("case_3", "raster"): 3.0})
    paths = [str(record.write(tmp_path / name, result)) for name, result in (("a.json", old), ("b.json", new))]
    assert main(["compare", paths[0], paths[0]]) == 0
    assert capsys.readouterr().out == "42 same; times are +0.0 % at the median\n"
    assert main(["compare", paths[1], paths[0]]) == 0  # faster
    capsys.readouterr()
    assert main(["compare", *paths]) == 1
    text = capsys.readouterr().out
    assert text.count("| case_") == 1 and "| case_3 | pass.raster.ms | " in text and "| **slower** |" in text
    assert main(["compare", *paths, "--factor", "10"]) == 0
    capsys.readouterr()
    assert main(["compare", *paths, "--all"]) == 1
    text = capsys.readouterr().out
    assert text.count("| case_") == 42 and text.index("slower") < text.index("| same |")


@pytest.mark.parametrize(
    "change, words",
    [
        ({"bench": "lights"}, "bench: expected the same in both results, got 'frame' and 'lights'"),
        ({"warp": "2"}, "warp: expected the same"),
        ({"device": "NVIDIA Y"}, "device: expected the same"),
        ({"quick": True}, "quick: expected the same"),
        ({"rows": []}, "rows: expected some that both results have"),
        ({"rows": [{"case": "other", "frame.ms": 1.0}]}, "got none, such as 'case_0' and 'other'"),
        ({"rows": [{"case": "case_0"}, {"case": "case_0"}]}, "expected one named 'case_0', got two"),
        ({"rows": [{"case": "case_0", "memory.bytes": "many"}]}, "memory.bytes: expected a number, got 'many'"),
        ({"rows": [3]}, "rows[0]: expected figures by name, got 3"),
    ],
)
def test_results_that_cannot_be_compared_are_refused(tmp_path, capsys, change, words):
    old = made(np.random.default_rng(0))
    new = old | change
    if new["rows"] and isinstance(new["rows"][-1], dict) and "memory.bytes" in change.get("rows", [{}])[-1]:
        new["rows"][-1] |= {"width": 64, "height": 36}
    (tmp_path / "a.json").write_text(json.dumps(old))
    (tmp_path / "b.json").write_text(json.dumps(new))
    assert main(["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]) == 2
    said = capsys.readouterr()
    assert words in said.err and said.err.count("error:") == 1 and said.out == ""


def test_other_machines_are_refused_where_their_cores_are_timed():
    old = made(np.random.default_rng(0))
    new = old | {"machine": "another", "driver": "9", "settings": ["a.b=1"], "commit": "c-dirty"}
    text = compare.table(compare.compare(old, new))
    for words in ("driver differs", "machine differs", "settings differs", "the new result is of files"):
        assert words in text
    for both in ({"device": "CPU, 2 cores"}, {"bench": "host"}):
        with pytest.raises(InputError, match="machine: expected the same"):
            compare.compare(old | both, new | both)


def test_a_device_that_copies_slower_is_noted():
    old = made(np.random.default_rng(0)) | {"copy_bytes_per_s": 4e12}
    assert not compare.compare(old, old | {"copy_bytes_per_s": 3.9e12}).notes
    assert "3,500 GB/s and copied 4,000" in compare.compare(old, old | {"copy_bytes_per_s": 3.5e12}).notes[0]


def test_files_that_are_no_results_are_named(tmp_path, capsys):
    assert main(["compare", str(Path(RESULTS[0])), str(tmp_path / "none.json")]) == 2
    assert "none.json: expected a result of a bench" in capsys.readouterr().err
