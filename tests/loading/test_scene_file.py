"""TOML scene files."""

from __future__ import annotations

import math

import numpy as np
import pytest

import warp_deferred as wd

SCENE = """
[camera]
eye = [3, 2, 4]
target = [0, 0.5, 0]
vertical_fov_deg = 40
exposure = 1.5

[[model]]
file = "parts/model.glb"
translate = [1, 2, 3]
rotate_deg = [0, 90, 0]
scale = 2
label = 7

[[model]]
file = "parts/model.glb"
scale = [1, 2, 3]
lights = false
cameras = false

[[light]]
kind = "spot"
position = [0, 3, 0]
direction = [0, -1, 0]
intensity = 12.5
inner_angle_deg = 20
outer_angle_deg = 35

[[light]]
kind = "directional"
direction = [1, -1, 0]

[environment]
ambient = [0.1, 0.2, 0.3]

[settings.display]
tone_mapping = "aces"
[settings.light_culling]
tile_size = 32
"""


@pytest.fixture
def parts(gltf, tmp_path):
    gltf.folder = tmp_path / "parts"
    gltf.folder.mkdir()
    gltf.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "spot", "intensity": 5.0}]}}
    gltf.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.1}}]
    gltf.node(mesh=gltf.mesh(gltf.primitive()), name="part", translation=[0, 0, 1])
    gltf.node(camera=0, extensions={"KHR_lights_punctual": {"light": 0}}, translation=[1, 0, 0])
    gltf.write()
    return tmp_path


def test_everything_a_scene_file_says(parts):
    path = parts / "stage.toml"
    path.write_text(SCENE)
    scene = wd.load(path)
    first, second = scene.instances
    # Scale 2, then a quarter turn about y: x to -z, z to x; then moved.
    np.testing.assert_allclose(first.transform, [[0, 0, 2, 3], [0, 2, 0, 2], [-2, 0, 0, 3], [0, 0, 0, 1]], atol=1e-12)
    assert np.diag(second.transform).tolist() == [1, 2, 3, 1] and second.transform[2, 3] == 3.0
    assert (first.label, second.label, first.name) == (7, 0, "part")
    camera, other = scene.cameras
    assert scene.camera is camera and camera.position == (3.0, 2.0, 4.0) and camera.exposure == 1.5
    assert math.isclose(camera.vertical_fov, math.radians(40))
    np.testing.assert_allclose(other.position, (1, 2, 1), atol=1e-12)
    spot = scene.lights.spot
    assert spot.intensity.tolist() == [5.0, 12.5] and len(scene.lights) == 3
    np.testing.assert_allclose(spot.position, [(1, 2, 1), (0, 3, 0)], atol=1e-12)
    np.testing.assert_allclose(spot.direction[0] / np.linalg.norm(spot.direction[0]), (-1, 0, 0), atol=1e-6)
    np.testing.assert_allclose(spot.outer_angle, [math.pi / 4, math.radians(35)], rtol=1e-6)
    assert scene.environment.ambient == (0.1, 0.2, 0.3)
    assert scene.settings.display.tone_mapping == "aces" and scene.settings.light_culling.tile_size == 32


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[camra]\n", ["'camra'", "did you mean 'camera'"]),
        ("[camera]\neye=[0,0,1]\ntarget=[0,0,0]\nvertical_fov_dge=3\n", ["did you mean 'vertical_fov_deg'"]),
        ("[camera]\neye=[0,0,1]\n", ["eye and target"]),
        ("[camera]\neye=[0,0,1]\ntarget=[0,0,1]\n", ["other than the eye"]),
        ("[camera]\neye=[0,0,1]\ntarget=[0,0,0]\nvertical_fov_deg='x'\n", ["vertical_fov_deg", "number of degrees"]),
        ("[[model]]\nfiel='a.glb'\n", ["did you mean 'file'"]),
        ("[[model]]\n", ["[[model]] 0 file"]),
        ("[[model]]\nfile='absent.glb'\n", ["absent.glb", "no such file"]),
        ("[[model]]\nfile='../stage.toml'\n", ["out of the file's own folder"]),
        ("[[model]]\nfile='stage.toml'\n", ["do not nest"]),
        ("[[model]]\nfile='parts/model.glb'\nscale=0\n", ["scale"]),
        ("[[model]]\nfile='parts/model.glb'\nrotate_deg=[1]\n", ["rotate_deg"]),
        ("[[model]]\nfile='parts/broken.glb'\n", ["broken.glb", "(GLB)"]),
        ("[[light]]\nkind='pnt'\n", ["[[light]] 0 kind", "point"]),
        ("[[light]]\nkind='point'\nintensty=3\n", ["did you mean 'intensity'"]),
        ("[[light]]\nkind='point'\nintensity=-3\n", ["PointLight.intensity"]),
        ("[environment]\nambient=[-1,0,0]\n", ["Environment.ambient"]),
        ("[settings.displya]\n", ["did you mean 'display'"]),
        ("[settings.display]\ntone_maping='aces'\n", ["did you mean 'tone_mapping'"]),
        ("[settings.display]\ntone_mapping='acse'\n", ["DisplaySettings.tone_mapping"]),
        ("camera = 5\n", ["[[camera]]", "a table"]),
        ("settings = 5\n", ["a table"]),
        ("[camera\n", ["TOML"]),
    ],
)
def test_scene_files_with_mistakes(parts, text, words):
    (parts / "parts" / "broken.glb").write_bytes(b"glTF")
    path = parts / "stage.toml"
    path.write_text(text)
    with pytest.raises(wd.LoadError) as caught:
        wd.load(path)
    for word in ["stage.toml" if "broken" not in text else "broken.glb", *words]:
        assert word in str(caught.value), str(caught.value)
    assert "\n" not in str(caught.value)


def test_repairs_inside_models_are_passed_on(parts, gltf):
    gltf.node(mesh=gltf.mesh(gltf.primitive(indices=np.array([0, 1, 9], np.uint8)), name="wall"))
    gltf.write("bad.glb")
    (parts / "stage.toml").write_text("[[model]]\nfile='parts/bad.glb'\n")
    with pytest.warns(wd.loading.LoadWarning, match=r"bad\.glb.*'wall'.*1 face") as caught:
        scene = wd.load(parts / "stage.toml")
    assert len(caught) == 1
    assert any("'wall'" in note for note in scene.notes)
