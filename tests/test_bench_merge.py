"""`bench merge`: rows of later results go first, and results of different runs are refused by what differs."""

import json

import bench_package
import pytest

from bench import accuracy_tables, compare, merge, record
from bench.__main__ import main
from warp_deferred.errors import InputError


def made(*rows, bench="accuracy", **head):
    """A result with rows of (ladder, scene, rung, ms)."""
    keys = ("ladder", "scene", "rung", "stage.ms")
    return {
        "bench": bench, "machine": "m", "device": "NVIDIA X", "warp": "1", "driver": "d", "commit": "c", "date": "1",
        "quick": False, "settings": [], "format": accuracy_tables.FORMAT, "skipped": [],
        "rows": [dict(zip(keys, row, strict=True)) for row in rows],
    } | head  # fmt: skip


def names_of(result):
    return [(row["ladder"], row["scene"], row["rung"], row["stage.ms"]) for row in result["rows"]]


def joined(*records):
    return merge.merge(records, [f"{k}.json" for k in range(len(records))])


OLD = made(
    ("normals", "spheres_50k", "oct16", 1.0), ("normals", "spheres_50k", "float32", 2.0), ("bloom", "glow", "off", 3.0)
)


def test_later_rows_take_the_place_of_earlier_ones_and_stand_in_the_order_of_a_whole_run():
    new = made(("bloom", "glow", "exact", 9.0), ("normals", "spheres_50k", "rgb8", 7.0),
               ("normals", "spheres_50k", "oct16", 8.0), commit="d", date="2")  # fmt: skip
    result = joined(OLD, new)
    assert names_of(result) == [
        ("normals", "spheres_50k", "rgb8", 7.0), ("normals", "spheres_50k", "oct16", 8.0),
        ("normals", "spheres_50k", "float32", 2.0), ("bloom", "glow", "off", 3.0), ("bloom", "glow", "exact", 9.0),
    ]  # fmt: skip
    assert result["commit"] == "c, d" and result["date"] == "2"
    assert joined(result, new)["commit"] == "c, d" and joined(OLD)["rows"] == OLD["rows"]
    # The other way round the older figure stays.
    assert ("normals", "spheres_50k", "oct16", 1.0) in names_of(joined(new, OLD))


def test_the_shipped_result_joined_with_itself_or_with_a_part_is_itself():
    whole = record.read(bench_package.ROOT / "bench" / "results" / "accuracy.json")
    part = whole | {"rows": [row for row in whole["rows"] if row["ladder"] == "shadow"]}
    known = joined(whole)
    assert joined(whole, part) == known and joined(whole, whole) == known
    comparison = compare.compare(known, joined(part, whole))
    assert {change.verdict for change in comparison.changes} == {"same"}


def test_rungs_that_no_ladder_has_are_left_out():
    odd = made(("depth", "corner", "float32_keys", 1.0), ("depth", "corner", "float32", 2.0))
    assert names_of(joined(odd)) == [("depth", "corner", "float32", 2.0)]


def test_what_was_skipped_stays_until_it_is_measured():
    texts = ["bloom.exact on glow: no", "bloom on shadows: why", "normals.oct16 on spheres_50k: odd"]
    result = joined(OLD | {"skipped": texts}, made(("bloom", "glow", "exact", 9.0), ("bloom", "shadows", "off", 1.0)))
    assert result["skipped"] == []
    assert joined(made(), made() | {"skipped": texts})["skipped"] == texts


def test_results_of_other_benches_join_too():
    rows = [{"case": name, "frame.ms": time} for name, time in (("a", 1.0), ("b", 2.0))]
    one = made(bench="frame") | {"rows": rows}
    two = made(bench="frame") | {"rows": [{"case": "b", "frame.ms": 3.0}, {"case": "c", "frame.ms": 4.0}]}
    assert [(row["case"], row["frame.ms"]) for row in joined(one, two)["rows"]] == [("a", 1.0), ("b", 3.0), ("c", 4.0)]


@pytest.mark.parametrize(
    "change, words",
    [
        ({"bench": "effects"}, "bench: expected 'accuracy', as in 0.json, got 'effects'; join results of one bench"),
        ({"device": "NVIDIA Y"}, "device: expected 'NVIDIA X', as in 0.json, got 'NVIDIA Y'; measure both on one"),
        ({"warp": "2"}, "warp: expected '1', as in 0.json, got '2'"),
        ({"driver": "e"}, "driver: expected 'd'"),
        ({"quick": True}, "quick: expected False, as in 0.json, got True"),
        ({"settings": ["a.b=c"]}, "settings: expected"),
        ({"format": 0}, "format: expected"),
    ],
)
def test_results_of_different_runs_are_refused(change, words):
    with pytest.raises(InputError) as caught:
        joined(OLD, OLD, OLD | change)
    assert words in str(caught.value) and str(caught.value).startswith("2.json")


def test_the_machine_counts_where_the_host_is_measured():
    assert joined(OLD, OLD | {"machine": "n"})["machine"] == "n"
    cpu = OLD | {"device": "CPU, 2 cores"}
    with pytest.raises(InputError, match="machine: expected 'm'"):
        joined(cpu, cpu | {"machine": "n"})


def test_two_rows_of_one_name_are_refused():
    with pytest.raises(InputError, match=r"0\.json: expected one row named 'bloom, glow, off', got 2"):
        joined(made(("bloom", "glow", "off", 1.0), ("bloom", "glow", "off", 2.0)))
    with pytest.raises(InputError, match="at least one"):
        joined()


def test_the_command_joins_files_in_place_and_names_what_is_wrong(tmp_path, capsys):
    paths = [str(record.write(tmp_path / name, result)) for name, result in (("a.json", OLD), ("b.json", made(
        ("bloom", "glow", "exact", 9.0))), ("c.json", OLD | {"device": "NVIDIA Y"}))]  # fmt: skip
    assert main(["merge", paths[0], paths[1], "--json", paths[0]]) == 0
    assert "wrote " in capsys.readouterr().out
    assert len(record.read(paths[0])["rows"]) == 4
    before = json.loads((tmp_path / "a.json").read_text())
    assert main(["merge", paths[0], paths[2], "--json", paths[0]]) == 2
    error = capsys.readouterr().err
    assert "c.json: device: expected 'NVIDIA X'" in error and error.count("error:") == 1
    assert json.loads((tmp_path / "a.json").read_text()) == before
    assert main(["merge", paths[0], "--json", str(tmp_path / "x.json"), str(tmp_path / "none.json")]) == 2
