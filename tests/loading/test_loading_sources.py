"""What `load` takes: paths of every kind, built-in names with parameters, and everything else by its error."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import warp_deferred as wd
from warp_deferred.loading import built_in_scenes, load

MODULE = '''"""A test scene of so many points.

More about it.
"""

import warp_deferred as wd


def build(*, count=3, bright=False, size=1.0, title=""):
    scene = wd.Scene()
    scene.notes.append(repr((count, bright, size, title)))
    return scene


def animate(scene, time):
    scene.notes.append(str(time))
'''


@pytest.fixture
def built_in(tmp_path, monkeypatch):
    """Put two modules among the built-in scenes: one that is a scene, one that only helps."""
    import warp_deferred.scenes as package

    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "loading_test_points.py").write_text(MODULE)
    (folder / "loading_test_helper.py").write_text('"""Helps."""\n')
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(folder)])
    yield
    for name in ("loading_test_points", "loading_test_helper"):
        sys.modules.pop(f"warp_deferred.scenes.{name}", None)


def test_built_in_scenes_are_listed_by_their_first_line(built_in):
    found = built_in_scenes()
    assert found["loading_test_points"] == "A test scene of so many points."
    assert "loading_test_helper" not in found and list(found) == sorted(found)


def test_built_in_scene_with_parameters(built_in):
    scene = load("loading_test_points?count=500&bright=true&size=2.5&title=a b")
    assert scene.notes == ["(500, True, 2.5, 'a b')"]
    assert scene.name == "loading_test_points"
    # Built-in scenes say all themselves: no camera and no light is added.
    assert scene.camera is None and len(scene.lights) == 0
    scene.animate(scene, 0.5)
    assert scene.notes[-1] == "0.5"
    assert load("loading_test_points").notes == ["(3, False, 1.0, '')"]


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("loading_test_points?cuont=5", ["count, bright, size, title", "did you mean 'count'"]),
        ("loading_test_points?count", ["name=value"]),
    ],
)
def test_built_in_scene_with_parameters_it_does_not_have(built_in, source, words):
    with pytest.raises(wd.InputError) as caught:
        load(source)
    for word in words:
        assert word in str(caught.value)


def test_names_that_are_nothing(built_in):
    with pytest.raises(wd.LoadError, match="did you mean 'loading_test_points'"):
        load("loading_test_point")
    with pytest.raises(wd.LoadError, match=r"'models/absent\.glb': expected a file, or one of the built-in scenes"):
        load("models/absent.glb")
    with pytest.raises(wd.LoadError, match="loading_test_helper"):
        load("loading_test_helper")
    with pytest.raises(wd.LoadError):
        load("")
    with pytest.raises(wd.LoadError):
        load("a\0b.glb")


@pytest.mark.parametrize("source", [None, 5, ["a.glb"]])
def test_sources_of_the_wrong_kind(source):
    with pytest.raises(wd.InputError, match=r"load\.source: expected a path"):
        load(source)


def test_folders_unknown_kinds_and_unreadable_files(tmp_path):
    with pytest.raises(wd.LoadError, match="expected a file, got a folder"):
        load(tmp_path)
    (tmp_path / "picture.png").write_bytes(b"\x89PNG")
    with pytest.raises(wd.LoadError, match=r"picture\.png.*known kind.*\.glb.*'\.png'"):
        load(tmp_path / "picture.png")
    (tmp_path / "model").write_bytes(b"x")
    with pytest.raises(wd.LoadError, match="no suffix"):
        load(tmp_path / "model")
    (tmp_path / "link.glb").symlink_to(tmp_path / "absent.glb")
    with pytest.raises(wd.LoadError, match="broken link"):
        load(tmp_path / "link.glb")


def test_paths_may_be_text_or_path_and_suffixes_of_any_case(gltf, tmp_path):
    gltf.node(mesh=gltf.mesh(gltf.primitive()))
    path = gltf.write("MODEL.GLB")
    assert load(path).triangle_count == load(str(path)).triangle_count == wd.load(path).triangle_count == 1


def test_file_without_camera_and_light_gets_both_and_says_so(gltf):
    # A material that says nothing is metal in glTF.
    material = gltf.add("materials", {"pbrMetallicRoughness": {"metallicFactor": 0.0}})
    gltf.node(mesh=gltf.mesh(gltf.primitive(material=material)))
    scene = load(gltf.write())
    assert scene.name == "model.glb"
    assert scene.notes == [
        "no camera in the file: framed all of it",
        "no light in the file: added key, fill, rim and ambient light",
    ]
    assert len(scene.cameras) == 1 and len(scene.lights.directional) == 3
    assert min(scene.environment.ambient) > 0.0


def test_importing_the_loader_imports_no_reader():
    code = (
        "import sys, warp_deferred.loading; "
        "print([m for m in ('warp', 'trimesh', 'OpenImageIO', 'PIL') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]" and done.stderr == ""


def test_loading_twice_gives_the_same_arrays(gltf):
    gltf.node(mesh=gltf.mesh(gltf.primitive()))
    path = gltf.write()
    first, second = load(path).instances[0].mesh, load(path).instances[0].mesh
    assert first is not second
    np.testing.assert_array_equal(first.positions, second.positions)
