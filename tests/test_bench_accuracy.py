"""The bench `accuracy`: ladders that can be climbed, errors in their units, fronts, a page that says what rows say."""

import dataclasses
import itertools
import json
import re

import bench_package
import numpy as np
import pytest
import reference
import warp as wp

from bench import accuracy, accuracy_images, accuracy_page, accuracy_tables, accuracy_texts, measures, record, tables
from bench.__main__ import main
from bench.ladders import LADDERS, SCENES, TWIN, Ladder, Rung, narrowed
from warp_deferred import Settings
from warp_deferred.errors import Error, InputError, LoadError
from warp_deferred.images import read_png
from warp_deferred.loading import built_in_scenes

from .kernels.test_encoding import LARGEST_ERROR

SAMPLED = [name for name, ladder in LADDERS.items() if ladder.quarter]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Folder with a quick result of every ladder and its strips, made through the command line."""
    root = tmp_path_factory.mktemp("accuracy")
    path, images = root / "bench" / "results" / "accuracy.json", root / "docs" / "images"
    assert main(["accuracy", "--device", "cpu", "--quick", "--json", str(path), "--images", str(images)]) == 0
    return root


@pytest.fixture
def result(results):
    return record.read(results / "bench" / "results" / "accuracy.json")


def row_of(result, ladder, rung):
    return next(row for row in result["rows"] if (row["ladder"], row["rung"]) == (ladder, rung))


# ---- ladders


def test_ladders_of_the_settings_are_climbed_whole_and_have_words():
    ladder = LADDERS["shadow"]
    assert [rung.name for rung in ladder.rungs] == ["off", "hard", "pcf", "pcss", "ray_traced"]
    assert [rung.name for rung in LADDERS["scale"].rungs] == ["half", "two_thirds", "five_sixths", "off"]
    assert [rung.name for rung in LADDERS["tile_size"].rungs] == ["64", "32", "16", "8"]
    assert len({scene for ladder in LADDERS.values() for scene in ladder.scenes}) == len(SCENES)
    assert set(accuracy_texts.WORDS) == set(LADDERS)
    for stand in SCENES.values():
        for source in (stand.source, stand.chosen(False, False), stand.chosen(False, True)):
            assert source.split("?")[0] in built_in_scenes()
    for name, ladder in LADDERS.items():
        # The reference stands last, but for the twin, which no setting selects.
        assert ladder.reference == (TWIN if ladder.twin else ladder.rungs[-1].name), name
        assert ladder.measure in measures.MEASURES and len(ladder.scenes) >= 4, name


def test_a_rung_leaves_other_effects_off_and_holds_what_is_fixed():
    settings = LADDERS["shadow"].at("pcss")
    assert settings.shadow.rung == "pcss" and not settings.shadow.keep_maps
    assert settings.ambient_visibility.rung == settings.bloom.rung == settings.motion_blur.rung == "off"
    assert LADDERS["normals"].at("oct16").shadow.rung == "off"
    assert accuracy_tables.default_rung(LADDERS["normals"]) == "oct24"
    assert accuracy_tables.default_rung(LADDERS["tile_size"]) == "16"


def test_wrong_names_are_clear_errors_before_anything_is_measured(capsys):
    for only, words in (("shadow.pcff", "did you mean 'pcf'"), ("shadows", "did you mean 'shadow'")):
        assert main(["accuracy", "--device", "cpu", "--quick", "--only", only]) == 2
        error = capsys.readouterr().err
        assert words in error and "accuracy on" not in error and error.count("error:") == 1
    plain = LADDERS["gbuffer"]
    for change in (
        {"reference": "fulll"},
        {"rungs": (Rung("compact", ("gbuffer.rung=compactt",)), Rung("full", ()))},
        {"rungs": (*plain.rungs, plain.rungs[0])},
        {"scenes": ("nowhere",)},
        {"scenes": ()},
    ):
        with pytest.raises(InputError):
            dataclasses.replace(plain, **change)


def test_one_rung_is_measured_beside_off_and_the_reference():
    assert [rung.name for rung in narrowed("shadow.pcf")["shadow"].rungs] == ["off", "pcf", "ray_traced"]
    assert [rung.name for rung in narrowed("normals.oct16")["normals"].rungs] == ["oct16", "float32"]
    assert list(narrowed("")) == list(LADDERS) and list(narrowed("bloom")) == ["bloom"]


# ---- measures


def test_angles_are_those_normals_were_turned_by(rng):
    normals = reference.unit(rng.normal(size=(500, 3)))
    axis = reference.unit(np.cross(normals, rng.normal(size=(500, 3))))
    angle = np.radians(rng.uniform(1e-4, 2.0, 500))[:, None]
    turned = normals * np.cos(angle) + np.cross(axis, normals) * np.sin(angle)
    background = np.zeros((7, 3))
    found = measures.MEASURES["degrees"].errors(np.vstack([turned, background]), np.vstack([normals, background]), None)
    assert np.allclose(found, np.degrees(angle[:, 0]), rtol=1e-6)


def test_visibility_of_direct_light_is_a_share_of_what_arrives_unshadowed():
    off = np.full((4, 4, 3), 2.0, np.float32)
    off[0] = 0.0
    half = 0.25 * off
    found = measures.stage_errors(measures.MEASURES["direct_visibility"], half, off, off)
    assert found == {"rmse": 0.75, "max": 0.75, "off_share": 1.0}


def test_scattered_light_is_enlarged_as_display_does(rng):
    level = rng.uniform(0.0, 2.0, (4, 5, 3)).astype(np.float32)
    for height, width in ((8, 10), (7, 9)):
        assert np.allclose(
            measures._enlarged(level, height, width), reference.bloom_bilinear(level, height, width), atol=1e-6
        )


def test_errors_of_pictures_are_shares_of_the_codes():
    one = np.zeros((20, 30, 4), np.uint8)
    other = one.copy()
    other[:, :, 1] = 51
    found = measures.picture_errors(other, one)
    assert found["rmse"] == pytest.approx(0.2 / np.sqrt(3.0), rel=1e-3) and found["max"] == 0.2
    assert measures.picture_errors(one, one) == {"rmse": 0.0, "max": 0.0, "flip": 0.0}
    with pytest.raises(Error, match="got 1 that are not"):
        bad = np.zeros((2, 3))
        bad[0, 0] = np.nan
        measures.stage_errors(measures.MEASURES["visibility"], bad, np.zeros((2, 3)), None)


def test_the_worst_place_is_where_most_is_off():
    apart = np.zeros((90, 160), np.int32)
    apart[60:70, 20:30] = 9
    apart[5, 150] = 200
    x, y = accuracy_images.worst_place(apart)
    assert abs(x * 160 - 25) <= 16 and abs(y * 90 - 65) <= 16


@pytest.mark.parametrize("seed", range(20))
def test_the_front_is_that_of_all_pairs(seed):
    rng = np.random.default_rng(seed)
    # Small integers: many ties in one, the other, and both.
    points = [tuple(map(float, p)) for p in rng.integers(0, 6, (rng.integers(1, 25), 2))]
    beaten = {
        j
        for i, j in itertools.permutations(range(len(points)), 2)
        if points[i] != points[j] and points[i][0] <= points[j][0] and points[i][1] <= points[j][1]
    }
    front = accuracy_tables.pareto_front(points)
    assert set(front) == set(range(len(points))) - beaten and len(front) == len(set(front))
    assert [points[k][0] for k in front] == sorted(points[k][0] for k in front)


# ---- a run


def test_every_ladder_has_every_rung(result):
    assert result["skipped"] == [] and result["format"] == accuracy_tables.FORMAT
    assert accuracy_tables.ladder_names(result) == list(LADDERS)
    for name, ladder in LADDERS.items():
        (scene,) = accuracy_tables.scenes_of(result, name)
        assert scene == ladder.scenes[0]
        rows = accuracy_tables.rows_of(result, name, scene)
        assert [row["rung"] for row in rows] == [rung.name for rung in ladder.rungs]
        for row in rows:
            errors = [
                value for key, value in row.items() if re.match(r"(stage|error)\.(rmse|max|off_share|flip)$", key)
            ]
            assert len(errors) >= 3 and all(value >= 0.0 for value in errors)
            assert row["stage.ms_p5"] <= row["stage.ms"] <= row["stage.ms_p95"] and row["frame.ms"] > 0.0
            if row["rung"] == row["reference"] or ladder.exact:
                assert not any(errors), (name, row["rung"])
            # A CPU has neither fast nor, as it is compiled for, fused arithmetic.
            elif row["rung"] != "off" and name not in ("motion_blur", "fast_math"):
                assert row["stage.rmse"] > 0.0, (name, row["rung"])


def test_normals_stay_within_the_angles_of_their_codecs(result):
    for codec, bound in LARGEST_ERROR.items():
        assert 0.0 < row_of(result, "normals", codec)["stage.max"] <= bound
    assert row_of(result, "normals", "oct16")["stage.rmse"] > 10.0 * row_of(result, "normals", "oct24")["stage.rmse"]


@pytest.mark.parametrize("only", ["normals.oct16", "light_culling.tiles", "bloom.mip_chain", "depth"])
def test_ladders_can_be_climbed_on_each_device(only, device):
    outcome = accuracy.run(wp.get_device(device), quick=True, settings=Settings(), note=str, only=only)
    assert outcome["skipped"] == []
    rows = {row["rung"]: row for row in outcome["rows"]}
    row = rows[only.partition(".")[2] or "float32"]
    assert (row["stage.rmse"] > 0.0) != LADDERS[row["ladder"]].exact and row["stage.ms"] != 0.0
    if row["ladder"] == "normals":
        assert row["stage.max"] <= LARGEST_ERROR["oct16"]


def test_references_that_sample_say_their_noise(result):
    for name in LADDERS:
        row = row_of(result, name, LADDERS[name].reference) if not LADDERS[name].twin else {}
        assert ("noise.stage_rmse" in row) == (name in SAMPLED)
        if name in SAMPLED:
            # Nearer to the truth than the cheapest rung by far.
            off = row_of(result, name, "off")
            assert 0.0 <= row["noise.stage_rmse"] < 0.5 * off["stage.rmse"]


def test_the_twin_agrees(result):
    depth, compact, full = (row_of(result, *name) for name in
                            (("depth", "float32"), ("arithmetic", "compact"), ("arithmetic", "full")))  # fmt: skip
    assert 0.0 < depth["stage.rmse"] < 1e-5 and depth["pixels.other"] < 0.01
    assert 0.0 < full["stage.rmse"] < 0.01 * compact["stage.rmse"]


def test_depth_stays_within_its_formats_bounds(result):
    near = 0.05
    # Both quick scenes lie within 20 m of an eye whose near plane is at 0.05 m.
    bounds = {"unorm16": 20.0 / (2 * 65535 * near), "ufloat16": 2.45e-4, "unorm24": 20.0 / (2 * (2**24 - 1) * near)}
    for ladder in ("depth", "depth_format"):
        errors = [row_of(result, ladder, name)["stage.max"] for name in bounds]
        assert all(0.0 < error <= bound + 1e-6 for error, bound in zip(errors, bounds.values(), strict=True)), errors
    ladder = LADDERS["depth"]
    assert [rung.name for rung in ladder.rungs] == ["unorm16", "ufloat16", "unorm24", "float32"]


def test_the_twin_ranks_roundings(result):
    names = ("compact", "half_sums", "fast", "fused", "full")
    errors = {name: row_of(result, "arithmetic", name)["stage.rmse"] for name in names}
    # On the CPU the last three are one.
    assert errors["compact"] > errors["half_sums"] > 2.0 * errors["full"] > 0.0
    assert errors["fast"] == errors["fused"] == errors["full"]


def test_lights_that_cast_for_a_ladder_alone_do_not_cast_afterwards(monkeypatch):
    seen = []
    monkeypatch.setattr(accuracy._Bench, "_rows", lambda self, ladder, skip: seen.append(casts(self.scene)) or [])

    def casts(scene):
        return [bool(np.any(group.casts_shadow)) for _, group in scene.lights.groups() if len(group)]

    shared = accuracy._Run(wp.get_device("cpu"), True, Settings(), str, None)
    bench = accuracy._Bench(shared, "corner", "corner")
    bench.climb(LADDERS["shadow"], str)
    assert seen == [[True]] and casts(bench.scene) == [False]


def test_what_fails_is_named_and_the_others_go_on(monkeypatch):
    climb = accuracy._Bench.climb

    def broken(self, ladder, skip):
        if ladder.name == "tile_size":
            raise RuntimeError("out of luck\nmore of it")
        return climb(self, ladder, skip)

    monkeypatch.setattr(accuracy._Bench, "climb", broken)
    monkeypatch.setattr(accuracy, "narrowed", lambda _: {n: LADDERS[n] for n in ("tile_size", "light_culling")})
    kept = []
    outcome = accuracy.run(
        wp.get_device("cpu"),
        quick=True,
        settings=Settings(),
        note=str,
        keep=lambda part: kept.append(len(part["rows"])),
    )
    assert outcome["skipped"] == ["tile_size on many_lights: RuntimeError: out of luck"]
    assert {row["ladder"] for row in outcome["rows"]} == {"light_culling"} and kept == [0, 3]


def test_a_rung_that_fails_leaves_the_rest_of_its_ladder(monkeypatch):
    times = accuracy._times

    def broken(plan, *more):
        if plan.request.settings.gbuffer.normal == "xy16":
            raise RuntimeError("no such bits")
        return times(plan, *more)

    monkeypatch.setattr(accuracy, "_times", broken)
    outcome = accuracy.run(wp.get_device("cpu"), quick=True, settings=Settings(), note=str, only="normals")
    assert outcome["skipped"] == ["normals.xy16 on spheres_50k: RuntimeError: no such bits"]
    assert [row["rung"] for row in outcome["rows"]] == ["rgb8", "oct16", "oct24", "oct32", "float32"]


def test_an_interrupted_run_leaves_its_finished_rows(monkeypatch, tmp_path):
    climb = accuracy._Bench.climb

    def interrupted(self, ladder, skip):
        if ladder.name == "light_culling":
            raise KeyboardInterrupt
        return climb(self, ladder, skip)

    monkeypatch.setattr(accuracy._Bench, "climb", interrupted)
    path = tmp_path / "accuracy.json"
    assert main(["accuracy", "--device", "cpu", "--quick", "--json", str(path)]) not in (0, 1)
    outcome = record.read(path)
    assert {row["ladder"] for row in outcome["rows"]} == {"fast_math", "accumulation", "tile_size"}
    assert "tile" in tables.full_table(outcome)


# ---- page


def test_the_page_says_what_the_rows_say(results, result):
    pytest.importorskip("matplotlib")
    assert main(["report", "--root", str(results)]) == 0
    docs = results / "docs"
    text = (docs / "accuracy.md").read_text()
    assert "These are figures of a CPU" in text and result["commit"] in text and "a quick run" in text
    for name, ladder in LADDERS.items():
        part = text.split(f"\n## {ladder.title}\n")[1].split("\n## ")[0]
        assert f"images/accuracy_{name}.png" in part
        lines = [line for line in part.splitlines() if line.startswith("|")][2:]
        rows = [row for row in result["rows"] if row["ladder"] == name]
        assert len(lines) == len(rows)
        for line, row in zip(lines, rows, strict=True):
            cells = [cell.strip(" *`") for cell in line.strip("|").split("|")]
            assert cells[1].split("`")[0] == row["rung"]
            assert cells[2] == tables.milliseconds(row["stage.ms"]) and cells[5] == tables.milliseconds(row["frame.ms"])
            if row["rung"] == row["reference"]:
                assert cells[6].startswith("reference")
            else:
                assert [float(cells[k]) for k in (6, 7)] == [
                    float(f"{row[key]:.3g}") for key in ("stage.rmse", "stage.max")
                ]
    assert "> at most: ssao 0.17, gtao_half 0.12, gtao 0.11;" in text
    for image in re.findall(r"\]\((images/\S+)\)", text):
        shown = read_png(docs / image)
        assert shown[..., :3].std() > 5.0, image
    assert "accuracy.md#shadows" in (docs / "benchmarks.md").read_text()
    assert main(["report", "--check", "--root", str(results)]) == 0
    (docs / "accuracy.md").write_text(text.replace("reference", "Reference", 1))
    assert main(["report", "--check", "--root", str(results)]) == 1


def test_a_result_of_another_version_is_refused(results, result, tmp_path, capsys):
    path = tmp_path / "bench" / "results" / "accuracy.json"
    for other in (result | {"format": accuracy_tables.FORMAT + 1}, {k: v for k, v in result.items() if k != "format"}):
        record.write(path, other)
        assert main(["report", "--root", str(tmp_path)]) == 2
        assert "bench/results/accuracy.json: format: expected 1, got" in capsys.readouterr().err
        assert not (tmp_path / "docs").exists()
        with pytest.raises(LoadError, match="another version"):
            accuracy_tables.check_format(other, "x")


def test_the_page_is_made_of_the_card_s_result_where_there_is_one(result):
    records = {"accuracy_cpu": result}
    assert accuracy_page.chosen(records) == "accuracy_cpu"
    records = {"accuracy": json.loads(json.dumps(result)) | {"device": "NVIDIA H200"}, "accuracy_cpu": result}
    page = accuracy_page.accuracy_page(records, bench_package.ROOT / "no" / "images")
    assert accuracy_page.chosen(records) == "accuracy" and "These are figures of a CPU" not in page
    assert "## cpu\n" in page and "Measured on NVIDIA H200" in page


def test_a_ladder_needs_no_settings_of_its_own():
    ladder = Ladder("x", "X", (Rung("a", ()),), TWIN, ("corner",), "relative_depth", ("raster",), twin=True)
    assert ladder.at("a") == LADDERS["normals"].at("oct24") and not ladder.has_off
