"""What a scene does not call for is not there, effect by effect, while the others run: each in fresh processes."""

import json
import pathlib
import subprocess
import sys

import absence
import numpy as np
import pytest

from warp_deferred.effects import EFFECTS

LIMIT_S = 600


@pytest.fixture(scope="module")
def everything():
    """Plans that call for each effect, by the name of its modules: buffers its passes write, kernels it launches."""
    found = {}
    for without in ("debug_view", "anti_aliasing"):
        _, plan = absence.render(without)
        written = {}
        for stage in plan.passes:
            # The picture, and the one that is scaled up, are made by one pass or another.
            names = {name for name in stage.writes() if not name.startswith("display")}
            written.setdefault(type(stage).__module__.split(".")[-1], set()).update(names)
        found |= {name: names for name, names in written.items() if name in absence.GROUPS and name not in found}
    return found


def test_every_effect_is_in_a_group_with_modules_that_exist():
    assert sorted(name for names in absence.GROUPS.values() for name in names) == sorted(e.name for e in EFFECTS)
    root = pathlib.Path(__file__).resolve().parents[1]
    for effect in EFFECTS:
        assert effect.name in absence.GROUPS[effect.module or effect.name]
    owned = [name for group in absence.GROUPS for name in absence.modules_of(group)]
    assert len(owned) == len(set(owned))
    for name in owned:
        *_, folder, stem = name.split(".")
        place = root / "kernels" if folder == "kernels" else root / "warp_deferred" / folder
        assert (place / f"{stem}.py").is_file(), name


def test_the_others_run_while_one_is_absent(everything):
    # All but the debug views, which show no picture: their own tests call for them.
    assert set(everything) == set(absence.GROUPS) - {"debug_view"}
    # Those that have no buffer of their own but the picture.
    assert {name for name, buffers in everything.items() if not buffers} <= {"anti_aliasing", "scale"}


@pytest.mark.parametrize("effect", absence.GROUPS)
def test_an_absent_effect_loads_launches_and_allocates_nothing_and_its_modules_may_be_missing(
    effect, everything, tmp_path
):
    folders = {"": tmp_path / "free", "blocked": tmp_path / "blocked"}
    running = []
    for word, folder in folders.items():
        folder.mkdir()
        command = [sys.executable, absence.__file__, effect, str(folder), word]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
    for process in running:
        told, _ = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0, told
    seen = [json.loads((folder / "seen.json").read_text()) for folder in folders.values()]
    for one in seen:
        assert not set(one["modules"]) & set(absence.modules_of(effect))
        assert not set(one["kernels"]) & set(absence.modules_of(effect))
        assert not set(one["passes"]) & set(absence.GROUPS[effect])
        shared = set().union(*(names for other, names in everything.items() if other != effect))
        assert not (everything.get(effect, set()) - shared) & set(one["buffers"])
        others = set(absence.GROUPS) - {
            effect,
            "debug_view",
            "sampling",
            "ray_scene",
            *absence.GOES_WITH.get(effect, ()),
        }
        assert others <= set(one["passes"]), "the others do run"
    assert seen[0]["passes"] == seen[1]["passes"]
    shown = [np.load(folder / "display.npy") for folder in folders.values()]
    assert np.array_equal(*shown) and shown[0][..., :3].std() > 10.0
