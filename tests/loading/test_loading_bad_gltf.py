"""Damaged and hostile glTF files: one typed error that names file and place, or a repair with one warning."""

from __future__ import annotations

import json
import os
import socket
import struct
import time
import warnings

import numpy as np
import pytest

import warp_deferred as wd
from warp_deferred.loading import LoadWarning

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
BOTH = np.array([0, 1, 2, 0, 2, 3], np.uint16)


def refused(path, *words):
    """Load a file that must be refused, and look for words in the one-line message."""
    with pytest.raises(wd.LoadError) as caught:
        wd.load(path)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text and "expected" in text
    for word in words:
        assert word in text, text
    return text


def repaired(path, *words):
    """Load a file that must be repaired with exactly one warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = wd.load(path)
    found = [w for w in caught if issubclass(w.category, LoadWarning)]
    assert len(found) == 1
    for word in words:
        assert word in str(found[0].message), found[0].message
        assert any(word in note for note in scene.notes) or word == str(path)
    return scene


def with_mesh(gltf, *primitives, **fields):
    gltf.node(mesh=gltf.mesh(*primitives, **fields))
    return gltf.write()


def test_l1_empty_documents_and_meshes(gltf, tmp_path):
    (tmp_path / "empty.gltf").write_text('{"asset": {"version": "2.0"}}')
    assert wd.load(tmp_path / "empty.gltf").instances == ()
    none = np.zeros((0, 3), np.float32)
    attributes = {"POSITION": gltf.add("accessors", {"componentType": 5126, "count": 0, "type": "VEC3"})}
    scene = wd.load(with_mesh(gltf, {"attributes": attributes}, gltf.primitive(QUAD, np.zeros(0, np.uint16))))
    assert scene.triangle_count == 0 and scene.instances[0].mesh.positions.shape == none.shape


def test_l2_faces_with_indices_out_of_range_are_dropped(gltf):
    bad = np.array([0, 1, 2, 0, 1, 4, 9, 1, 2, 0, 2, 3], np.uint16)
    scene = repaired(with_mesh(gltf, gltf.primitive(QUAD, bad), name="wall"), "2 faces", "'wall'")
    mesh = scene.instances[0].mesh
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    np.testing.assert_array_equal(mesh.positions, QUAD)


def test_l2_all_indices_out_of_range(gltf):
    scene = repaired(with_mesh(gltf, gltf.primitive(QUAD, np.full(6, 70000, np.uint32))), "2 faces")
    assert scene.triangle_count == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_l4_faces_with_positions_that_are_not_finite_are_dropped(gltf, value):
    points = QUAD.copy()
    points[3, 1] = value
    scene = repaired(with_mesh(gltf, gltf.primitive(points, BOTH), name="wall"), "1 face", "'wall'", "not finite")
    mesh = scene.instances[0].mesh
    assert np.isfinite(mesh.positions).all()
    np.testing.assert_array_equal(mesh.positions[mesh.triangles], [QUAD[:3]])


def test_l5_attributes_that_are_not_finite_get_defaults(gltf):
    normals = np.array([[0, 0, 1], [np.nan, 0, 0], [0, 0, 1], [0, 1, 0]], np.float32)
    uvs = np.array([[0.5, 0.5], [0, 0.5], [np.inf, 0], [0.5, 1]], np.float32)
    colors = np.array([[0.5, 0.5, 0.5, 1], [0, 0, 0, 1], [0, 0, 0, 1], [0, np.nan, 0, 1]], np.float32)
    primitive = gltf.primitive(QUAD, BOTH, NORMAL=normals, TEXCOORD_0=uvs, COLOR_0=colors)
    scene = repaired(with_mesh(gltf, primitive), "1 normal", "1 uv", "1 colour")
    mesh = scene.instances[0].mesh
    assert mesh.normals[1].tolist() == [0, 0, 0] and mesh.normals[3].tolist() == [0, 1, 0]
    assert mesh.uvs[2].tolist() == [0, 0] and mesh.uvs[1].tolist() == [0, 0.5]
    assert mesh.colors[3].tolist() == [1, 1, 1, 1] and mesh.colors[0].tolist() == [0.5, 0.5, 0.5, 1]
    assert len(mesh.triangles) == 2


def test_l6_normals_are_made_unit_and_zero_stays_zero(gltf, load_quietly):
    normals = np.array([[0, 0, 0], [0, 0.1, 0], [0, 0, 1], [3, 0, 4]], np.float32)
    scene = load_quietly(with_mesh(gltf, gltf.primitive(QUAD, BOTH, NORMAL=normals)))
    expected = [[0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8]]
    np.testing.assert_allclose(scene.instances[0].mesh.normals, expected, atol=1e-7)


def test_l7_degenerate_faces_stay_and_need_no_repair(gltf, load_quietly):
    indices = np.array([0, 1, 2, 1, 1, 2, 0, 2, 3], np.uint16)
    assert load_quietly(with_mesh(gltf, gltf.primitive(QUAD, indices))).triangle_count == 3


def test_l8_textured_material_without_uvs_or_normals(gltf, load_quietly):
    texture = gltf.texture(gltf.image(np.zeros((2, 2, 3), np.uint8)))
    material = gltf.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": {"index": texture}}})
    mesh = load_quietly(with_mesh(gltf, gltf.primitive(material=material))).instances[0].mesh
    assert mesh.uvs is None and mesh.normals is None and mesh.colors is None


@pytest.mark.parametrize("children", [{0: [0]}, {0: [1], 1: [0]}, {0: [1], 1: [2], 2: [1]}])
@pytest.mark.parametrize("with_scene", [True, False])
def test_l14_node_cycles_are_errors(gltf, children, with_scene):
    for k in range(3):
        gltf.node(**({"children": children[k]} if k in children else {}))
    if with_scene:
        gltf.json["scenes"] = [{"nodes": [0]}]
    elif children == {0: [0]} or children == {0: [1], 1: [0]}:
        gltf.json["nodes"] = gltf.json["nodes"][: len(children)]
    refused(gltf.write(), "/nodes", "cycle")


def test_l14_shared_children_cannot_explode(gltf):
    mesh = gltf.mesh(gltf.primitive())
    for k in range(26):
        gltf.node(children=[k + 1, k + 1])
    gltf.node(mesh=mesh)
    start = time.perf_counter()
    refused(gltf.write(), "/nodes", "1000000")
    assert time.perf_counter() - start < 2.0


def test_l14_a_chain_of_five_thousand_nodes_is_walked(gltf, load_quietly):
    mesh = gltf.mesh(gltf.primitive())
    for k in range(5000):
        gltf.node(children=[k + 1], translation=[0.5, 0, 0])
    gltf.node(mesh=mesh)
    start = time.perf_counter()
    scene = load_quietly(gltf.write())
    assert time.perf_counter() - start < 2.0
    assert scene.instances[0].transform[0, 3] == 2500.0


def test_l14_a_mesh_of_many_primitives_cannot_explode(gltf):
    primitive = gltf.primitive()
    mesh = gltf.mesh(*[primitive] * 100)
    for k in range(13):
        gltf.node(children=[k + 1, k + 1])
    leaf = gltf.node(children=[14] * 2)
    gltf.node(mesh=mesh)
    gltf.json["scenes"] = [{"nodes": [0]}]
    assert leaf == 13
    refused(gltf.write(), "placed primitives")


def test_l14_deep_json_is_a_typed_error(tmp_path):
    path = tmp_path / "deep.gltf"
    path.write_text('{"extras": ' + "[" * 200000 + "]" * 200000 + "}")
    refused(path, "glTF JSON")


def test_l15_primitive_without_positions(gltf):
    primitive = gltf.primitive(NORMAL=np.zeros((3, 3), np.float32))
    del primitive["attributes"]["POSITION"]
    refused(with_mesh(gltf, primitive), "/meshes/0/primitives/0", "POSITION")


def test_l15_attributes_of_unequal_count(gltf):
    good = gltf.primitive()
    bad = gltf.primitive(TEXCOORD_0=np.zeros((2, 2), np.float32))
    refused(with_mesh(gltf, good, bad), "/meshes/0/primitives/1", "3 elements", "got 2")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"type": "VEC7"}, ("/accessors/0/type", "VEC3", "VEC7")),
        ({"type": "VEC2"}, ("/accessors/0/type", "VEC2")),
        ({"componentType": 5130}, ("/accessors/0/componentType", "5126", "5130")),
        ({"componentType": [5126]}, ("/accessors/0",)),
        ({"count": 4}, ("/accessors/0", "cut short or damaged")),
        ({"count": -1}, ("/accessors/0/count", "-1")),
        ({"count": 1 << 60}, ("/accessors/0/count",)),
        ({"count": 1.5}, ("/accessors/0/count",)),
        ({"byteOffset": 4}, ("/accessors/0",)),
        ({"byteOffset": -4}, ("/accessors/0",)),
        ({"bufferView": 99}, ("/accessors/0/bufferView", "99")),
        ({"bufferView": "x"}, ("/accessors/0/bufferView", "x")),
    ],
)
def test_l15_accessors_that_cannot_be_read(gltf, change, words):
    primitive = gltf.primitive()
    gltf.json["accessors"][0] |= change
    refused(with_mesh(gltf, primitive), *words)


@pytest.mark.parametrize("change", [{"byteLength": 9999}, {"byteOffset": -8}, {"byteStride": 4}, {"buffer": 3}])
def test_l15_buffer_views_outside_their_buffer(gltf, change):
    primitive = gltf.primitive()
    gltf.json["bufferViews"][0] |= change
    refused(with_mesh(gltf, primitive), "/0")


def test_l15_float_indices_and_sparse_indices_out_of_range(gltf):
    refused(with_mesh(gltf, gltf.primitive(QUAD, np.zeros(3, np.float32))), "whole numbers", "/primitives/0/indices")
    view = gltf.view(np.array([7], np.uint16).tobytes())
    sparse = {"count": 1, "indices": {"bufferView": view, "componentType": 5123}, "values": {"bufferView": 0}}
    gltf.json["accessors"][0]["sparse"] = sparse
    refused(gltf.write("sparse.glb"), "/accessors/0/sparse/indices")


@pytest.mark.parametrize("key", ["mesh", "camera"])
def test_references_to_what_is_not_there(gltf, key):
    gltf.node(**{key: 5})
    refused(gltf.write(), f"/nodes/0/{key}", "5")


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_l18_units_do_not_matter(gltf, load_quietly, scale):
    scene = load_quietly(with_mesh(gltf, gltf.primitive(QUAD * np.float32(scale), BOTH)))
    np.testing.assert_array_equal(scene.instances[0].mesh.positions, QUAD * np.float32(scale))
    far = np.linalg.norm(np.array(scene.camera.position)) / scale
    assert 1.0 < far < 4.0 and scene.camera.near < 0.01 * far * scale


def test_far_away_nodes_keep_their_float64_places(gltf, load_quietly):
    gltf.node(mesh=gltf.mesh(gltf.primitive()), translation=[6378137.125, 0.0, 0.0])
    scene = load_quietly(gltf.write())
    assert scene.instances[0].transform[0, 3] == 6378137.125
    assert scene.bounds()[1][0] == 6378138.125


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "MY_own"])
def test_required_extensions_that_are_not_known(gltf, name):
    gltf.json["extensionsRequired"] = [name]
    refused(with_mesh(gltf, gltf.primitive()), "/extensionsRequired", name)


@pytest.mark.parametrize(
    "node",
    [
        {"rotation": [0, 0, 0, 0]},
        {"translation": [1, 2]},
        {"scale": "big"},
        {"matrix": [0] * 15},
        {"matrix": [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        {"translation": [1e400, 0, 0]},
        {"children": "x"},
        {"children": [-1]},
    ],
)
def test_node_transforms_that_are_none(gltf, node):
    gltf.node(**node)
    gltf.json["scenes"] = [{"nodes": [0]}]
    path = gltf.write()
    refused(path)


def test_c8_light_parameters_that_are_none(gltf):
    for k, light in enumerate(
        (
            {"type": "point", "intensity": -1.0},
            {"type": "point", "range": 0.0},
            {"type": "spot", "spot": {"innerConeAngle": 0.9, "outerConeAngle": 0.5}},
            {"type": "area"},
            {"type": "point", "color": [1.0]},
        )
    ):
        gltf.json["extensions"] = {"KHR_lights_punctual": {"lights": [light]}}
        gltf.json["nodes"] = [{"extensions": {"KHR_lights_punctual": {"light": 0}}}]
        refused(gltf.write(f"light{k}.glb"), "/extensions/KHR_lights_punctual/lights/0")


def test_t7_cameras_that_are_none(gltf):
    for k, lens in enumerate(({"yfov": 0.0, "znear": 0.1}, {"yfov": 4.0, "znear": 0.1}, {"yfov": 1.0, "znear": 0.0})):
        gltf.json |= {"cameras": [{"type": "perspective", "perspective": lens}], "nodes": [{"camera": 0}]}
        refused(gltf.write(f"camera{k}.glb"), "/cameras/0", "Camera.")


def test_truncated_and_foreign_binary_files(gltf, tmp_path):
    data = with_mesh(gltf, gltf.primitive()).read_bytes()
    cut = tmp_path / "cut.glb"
    for size in (4, 12, 19, 40, len(data) - 1):
        cut.write_bytes(data[:size])
        refused(cut)
    for content in (b"", b"\x89PNG\r\n\x1a\n" + bytes(50), b"[1, 2]", b'{"asset": 5}', b"\xff\xfe\x00"):
        cut.write_bytes(content)
        refused(cut)
    cut.write_bytes(struct.pack("<4sII", b"glTF", 1, len(data)) + data[12:])
    refused(cut, "version 2")
    cut.write_text('{"asset": {"version": "1.0"}}')
    refused(cut, "/asset/version")
    cut.write_text('{"asset": {"version": "2.0"}, "nodes": [{"translation": [NaN, 0, 0]}]}')
    refused(cut, "NaN")


@pytest.mark.parametrize("section", ["nodes", "meshes", "accessors", "materials", "scenes", "bufferViews", "cameras"])
@pytest.mark.parametrize("value", [5, "x", [5], {"a": 1}, None])
def test_sections_of_the_wrong_kind_are_typed_errors(gltf, section, value):
    gltf.node(mesh=gltf.mesh(gltf.primitive(material=0)), camera=0)
    gltf.json |= {"materials": [{}], "scenes": [{"nodes": [0]}]}
    gltf.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    gltf.json[section] = value
    refused(gltf.write())


URIS = [
    "http://127.0.0.1:9/shape.bin",
    "https://example.org/shape.bin",
    "file:///etc/hostname",
    "/etc/hostname",
    "../shape.bin",
    "%2e%2e/shape.bin",
    "..%2Fshape.bin",
    "sub/../../shape.bin",
    "..\\shape.bin",
    "`touch hacked`",
    "$HOME/shape.bin",
    "~/shape.bin",
    "",
    "a\0b",
    "data:nothing",
    "data:application/octet-stream;base64,@@@@",
]


@pytest.mark.parametrize("uri", URIS)
def test_buffer_uris_are_not_followed_out_of_the_folder(gltf, tmp_path, monkeypatch, uri):
    def no_network(*_args, **_fields):
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", no_network)
    gltf.folder = tmp_path / "inside"
    gltf.folder.mkdir()
    primitive = gltf.primitive()
    (tmp_path / "shape.bin").write_bytes(gltf.data)
    gltf.node(mesh=gltf.mesh(primitive))
    gltf.json["buffers"] = [{"byteLength": len(gltf.data), "uri": uri}]
    refused(gltf.write("model.gltf"), "/buffers/0/uri")
    assert not os.path.exists("hacked") and not (gltf.folder / "hacked").exists()


def test_links_are_not_followed_out_of_the_folder(gltf, tmp_path):
    gltf.folder = tmp_path / "inside"
    gltf.folder.mkdir()
    primitive = gltf.primitive()
    (tmp_path / "shape.bin").write_bytes(gltf.data)
    (gltf.folder / "shape.bin").symlink_to(tmp_path / "shape.bin")
    gltf.node(mesh=gltf.mesh(primitive))
    gltf.json["buffers"] = [{"byteLength": len(gltf.data), "uri": "shape.bin"}]
    refused(gltf.write("model.gltf"), "/buffers/0/uri", "out of the file's own folder")


def test_buffer_shorter_than_announced(gltf, tmp_path):
    primitive = gltf.primitive()
    (tmp_path / "shape.bin").write_bytes(gltf.data[:-4])
    gltf.node(mesh=gltf.mesh(primitive))
    gltf.json["buffers"] = [{"byteLength": len(gltf.data), "uri": "shape.bin"}]
    refused(gltf.write("model.gltf"), "/buffers/0", "cut short")


def test_factors_outside_their_range_are_clamped(gltf):
    material = gltf.add("materials", {"pbrMetallicRoughness": {"baseColorFactor": [1.5, 0.5, -0.1, 1]}})
    scene = repaired(with_mesh(gltf, gltf.primitive(material=material)), "/materials/0", "clamped")
    assert scene.instances[0].material.base_color == (1.0, 0.5, 0.0, 1.0)


def test_random_damage_never_escapes_as_another_error(gltf, tmp_path):
    texture = gltf.texture(gltf.image(np.zeros((2, 2, 3), np.uint8)))
    material = gltf.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": {"index": texture}}})
    gltf.node(mesh=gltf.mesh(gltf.primitive(QUAD, BOTH, material=material)), children=[])
    gltf.json["scenes"] = [{"nodes": [0]}]
    path = gltf.write("model.gltf")
    gltf.json["buffers"] = [{"byteLength": len(gltf.data), "uri": "shape.bin"}]
    (tmp_path / "shape.bin").write_bytes(gltf.data)
    text = json.dumps(gltf.json)
    random = np.random.default_rng(5)
    refusals = 0
    for _ in range(300):
        damaged = bytearray(text.encode())
        for place in random.integers(0, len(damaged), 3):
            damaged[place] = random.choice(list(b'0123456789{}[],:"-e.x'))
        path.write_bytes(damaged)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LoadWarning)
                wd.load(path)
        except wd.LoadError:
            refusals += 1
    assert refusals > 50
