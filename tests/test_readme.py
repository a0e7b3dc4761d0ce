"""What README.md and docs/ promise: the example runs as printed, commands and flags exist, links lead somewhere."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import warp_deferred as wd
from warp_deferred import cli
from warp_deferred.channels import OUTPUTS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text("utf-8")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Written by `python -m bench report`, so they are there only where such results are.
GENERATED = {"docs/benchmarks.md": "*.json", "docs/effects.md": "effects*.json"}


def blocks(text: str, language: str = "") -> list[str]:
    """Return the fenced code blocks of a language."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [body for word, body in found if word == language]


def shell_lines(text: str) -> list[list[str]]:
    """Return the words of every command line in the fenced blocks, comments taken off."""
    lines = [line for body in blocks(text) for line in body.splitlines()]
    return [shlex.split(line, comments=True) for line in lines if re.match(r"(make|warp-deferred|python -m) ", line)]


def test_the_example_runs_as_printed(tmp_path, monkeypatch):
    (example,) = blocks(README, "python")
    assert "width=1280, height=720" in example
    small = example.replace("width=1280, height=720", "width=64, height=36")
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    exec(compile(small, "README.md", "exec"), namespace)
    assert namespace["radiance"].shape == (1, 36, 64)
    assert namespace["depth"].shape == (1, 36, 64) and (namespace["depth"] > 0).all()
    assert (tmp_path / "hall.png").stat().st_size > 1000 and (tmp_path / "hall.exr").stat().st_size > 1000


def test_the_scene_file_example_loads_as_printed(tmp_path):
    (example,) = blocks((ROOT / "docs/scene-files.md").read_text("utf-8"), "toml")
    assert 'file = "truck.glb"' in example
    triangle = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    triangle += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "truck.ply").write_text(triangle)
    (tmp_path / "stage.toml").write_text(example.replace("truck.glb", "truck.ply"))
    scene = wd.load(tmp_path / "stage.toml")
    assert scene.triangle_count == 1 and len(scene.lights) == 1 and len(scene.cameras) == 1 and not scene.notes
    assert scene.instances[0].label == 3 and scene.settings.display.tone_mapping == "aces"


def test_the_cloth_example_runs_as_printed(tmp_path):
    (example,) = blocks((ROOT / "docs/device-arrays.md").read_text("utf-8"), "python")
    # Warp reads a kernel's source from its file, so the example is run as one.
    for printed, small in (
        ("SIDE, SPACING, STEP = 96,", "SIDE, SPACING, STEP = 12,"),
        ("960, height=540", "64, height=36"),
        ("range(60)", "range(2)"),
    ):
        assert printed in example
        example = example.replace(printed, small)
    (tmp_path / "cloth.py").write_text(example)
    subprocess.run([sys.executable, "cloth.py"], cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "cloth.png").stat().st_size > 1000


def test_the_example_is_short():
    (example,) = blocks(README, "python")
    assert len([line for line in example.splitlines() if line.strip()]) <= 11


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_flags_exist(page):
    commands = typer.main.get_command(cli.app).commands
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    for words in shell_lines(page.read_text("utf-8")):
        if words[0] == "make":
            assert words[1] in targets, words
        elif words[0] == "warp-deferred" and words[1] != "COMMAND":
            command = commands[words[1]]
            flags = {name for parameter in command.params for name in parameter.opts + parameter.secondary_opts}
            for word in words[2:]:
                assert not word.startswith("-") or word.partition("=")[0] in flags, words


def test_the_readme_names_the_commands_there_are():
    named = {words[1] for words in shell_lines(README) if words[0] == "warp-deferred"}
    assert named == set(typer.main.get_command(cli.app).commands)


def test_the_readme_lists_every_output():
    rows = [line for line in README.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])} == set(OUTPUTS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    skip = {name for name, results in GENERATED.items() if not any((ROOT / "bench/results").glob(results))}
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text("utf-8")):
        if "://" not in target:
            path = (page.parent / target).resolve()
            assert path.exists() or path.relative_to(ROOT).as_posix() in skip, f"{page.name}: {target}"


def test_pages_name_no_place_on_one_machine():
    for page in PAGES:
        assert not re.search(r"(?<![\w.])/(work|home|root|tmp)/", page.read_text("utf-8")), page.name
