"""What a sound glTF file means: hierarchy, instances, materials, cameras, lights, attributes."""

from __future__ import annotations

import math

import numpy as np
import pytest

QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
RED = np.full((2, 2, 3), (200, 10, 30), np.uint8)


def one_mesh(gltf, *primitives, **fields):
    mesh = gltf.mesh(*primitives, **fields)
    gltf.node(mesh=mesh)
    return gltf.write()


def test_shared_mesh_is_one_object_with_instances_in_node_order(gltf, load_quietly):
    mesh = gltf.mesh(gltf.primitive(), gltf.primitive(QUAD, np.array([0, 1, 2, 0, 2, 3], np.uint8)), name="part")
    gltf.node(mesh=mesh, name="left", translation=[-1, 0, 0])
    gltf.node(mesh=mesh, name="right", translation=[1, 0, 0])
    scene = load_quietly(gltf.write())
    assert [i.name for i in scene.instances] == ["left", "left", "right", "right"]
    a, b, c, d = (i.mesh for i in scene.instances)
    assert a is c and b is d and a is not b
    assert (a.name, b.name) == ("part/0", "part/1")
    assert len(b.triangles) == 2
    assert scene.instances[2].transform[:3, 3].tolist() == [1.0, 0.0, 0.0]


def test_transforms_multiply_in_float64(gltf, load_quietly):
    half = math.sqrt(0.5)
    mesh = gltf.mesh(gltf.primitive())
    leaf = gltf.node(mesh=mesh, matrix=[2, 0, 0, 0, 0, 3, 0, 0, 0, 0, 4, 0, 1, 2, 3, 1])
    middle = gltf.node(children=[leaf], rotation=[0, half, 0, half], scale=[1, 1, -1])
    root = gltf.node(children=[middle], translation=[1e9 + 0.25, 0, 0])
    gltf.json["scenes"] = [{"nodes": [root]}]
    instance = load_quietly(gltf.write()).instances[0]
    # By hand: 90 degrees about y takes (x, y, z) to (z, y, -x); z is mirrored first.
    expected = [[0, 0, -4, 1e9 + 0.25 - 3], [0, 3, 0, 2], [-2, 0, 0, -1], [0, 0, 0, 1]]
    np.testing.assert_allclose(instance.transform, expected, rtol=0, atol=1e-7)
    assert np.linalg.det(instance.transform[:3, :3]) < 0.0


def test_only_the_default_scene_is_shown(gltf, load_quietly):
    mesh = gltf.mesh(gltf.primitive())
    nodes = [gltf.node(mesh=mesh, name=name) for name in ("first", "second")]
    gltf.json |= {"scenes": [{"nodes": [nodes[0]]}, {"nodes": [nodes[1]]}], "scene": 1}
    assert [i.name for i in load_quietly(gltf.write()).instances] == ["second"]


def test_cameras_nested_and_orthographic_in_node_order(gltf, load_quietly):
    gltf.json["cameras"] = [
        {"type": "orthographic", "orthographic": {"xmag": 3.0, "ymag": 2.0, "znear": 0.5, "zfar": 9.0}},
        {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.25, "zfar": 50.0}, "name": "eye"},
    ]
    inner = gltf.node(camera=1, translation=[0, 0, 5])
    gltf.node(children=[inner], translation=[1, 2, 0], scale=[2, 2, 2])
    gltf.node(camera=0, name="plan", rotation=[-math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    scene = load_quietly(gltf.write())
    first, second = scene.cameras
    assert (first.projection, first.vertical_fov, first.near, first.name) == ("perspective", 0.7, 0.25, "eye")
    assert first.position == (1.0, 2.0, 10.0)
    assert (second.projection, second.vertical_extent, second.near, second.far) == ("orthographic", 4.0, 0.5, 9.0)
    # Turned by -90 degrees about x it looks straight down: backward is +y.
    np.testing.assert_allclose(second.rotation[6:], (0, 1, 0), atol=1e-12)
    assert scene.camera is first
    assert any("far plane" in note for note in scene.notes)


def test_lights_take_position_and_direction_from_their_node(gltf, load_quietly):
    gltf.json["extensions"] = {
        "KHR_lights_punctual": {
            "lights": [
                {"type": "point", "color": [1, 0.5, 0.25], "intensity": 40.0, "range": 6.0},
                {"type": "spot", "intensity": 7.0, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.6}},
                {"type": "spot"},
                {"type": "directional", "intensity": 3.0},
            ]
        }
    }
    for k in range(4):
        gltf.node(
            extensions={"KHR_lights_punctual": {"light": k}},
            translation=[k, 1, 2],
            rotation=[0, math.sqrt(0.5), 0, math.sqrt(0.5)],
            scale=[3, 3, 3],
        )
    scene = load_quietly(gltf.write())
    point, spot, sun = scene.lights.point, scene.lights.spot, scene.lights.directional
    assert (len(point), len(spot), len(sun)) == (1, 2, 1)
    assert point.intensity.tolist() == [40.0] and point.range.tolist() == [6.0]
    assert point.color.tolist() == [[1.0, 0.5, 0.25]]
    assert spot.position.tolist() == [[1.0, 1.0, 2.0], [2.0, 1.0, 2.0]]
    np.testing.assert_allclose(spot.direction, [[-1, 0, 0]] * 2, atol=1e-7)
    np.testing.assert_allclose(spot.inner_angle, [0.2, 0.0], rtol=1e-6)
    np.testing.assert_allclose(spot.outer_angle, [0.6, math.pi / 4], rtol=1e-6)
    assert np.isinf(spot.range).all() and spot.intensity.tolist() == [7.0, 1.0]
    np.testing.assert_allclose(sun.direction, [[-1, 0, 0]], atol=1e-7)
    # A file with lights gets none added, and no ambient light.
    assert scene.environment.ambient == (0.0, 0.0, 0.0)


def test_default_material_is_white_metallic_and_rough(gltf, load_quietly):
    material = load_quietly(one_mesh(gltf, gltf.primitive())).instances[0].material
    assert (material.model, material.metallic, material.roughness) == ("ggx", 1.0, 1.0)
    assert material.base_color == (1.0, 1.0, 1.0, 1.0)
    assert not material.two_sided and material.alpha_mode == "opaque"


def test_material_fields_wraps_and_emissive_strength(gltf, load_quietly):
    image = gltf.image(RED)
    texture = gltf.texture(image, wrapS=33071, wrapT=33648, magFilter=9728)
    plain = gltf.texture(image)
    material = gltf.add(
        "materials",
        {
            "name": "paint",
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.5, 0.25, 0.125, 0.75],
                "baseColorTexture": {"index": texture},
                "metallicFactor": 0.3,
                "roughnessFactor": 0.6,
                "metallicRoughnessTexture": {"index": plain},
            },
            "emissiveFactor": [1.0, 0.5, 0.0],
            "emissiveTexture": {"index": texture},
            "occlusionTexture": {"index": plain, "strength": 0.4},
            "normalTexture": {"index": plain},
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}},
            "alphaMode": "MASK",
            "alphaCutoff": 0.25,
            "doubleSided": True,
        },
    )
    scene = load_quietly(one_mesh(gltf, gltf.primitive(material=material)))
    found = scene.instances[0].material
    assert found.name == "paint" and found.base_color == (0.5, 0.25, 0.125, 0.75)
    assert (found.metallic, found.roughness, found.occlusion_strength) == (0.3, 0.6, 0.4)
    assert found.emissive == (4.0, 2.0, 0.0)
    assert (found.alpha_mode, found.alpha_cutoff, found.two_sided) == ("mask", 0.25, True)
    base, rough, emissive, occlusion = found.textures
    assert base.wrap == ("clamp", "mirror") and not base.linear_filter and base.srgb
    assert rough.wrap == ("repeat", "repeat") and rough.linear_filter and not rough.srgb
    # One object for each (image, sampler, colour space); one decoding for all.
    assert base is emissive and rough is occlusion and base is not rough
    assert base.pixels is rough.pixels or np.shares_memory(base.pixels, rough.pixels)
    assert base.pixels.tolist() == RED.tolist()
    assert any("normal maps" in note for note in scene.notes)


def test_texture_requests_that_are_not_rendered_are_noted(gltf, load_quietly):
    texture = gltf.texture(gltf.image(RED))
    info = {"index": texture, "texCoord": 1, "extensions": {"KHR_texture_transform": {"scale": [2, 2]}}}
    material = gltf.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": info}})
    scene = load_quietly(one_mesh(gltf, gltf.primitive(material=material)))
    assert scene.instances[0].material.base_color_texture is not None
    assert any("TEXCOORD_1" in note for note in scene.notes)
    assert any("KHR_texture_transform" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("values", "normalized"),
    [
        (np.array([[255, 0, 51]] * 3, np.uint8), True),
        (np.array([[65535, 0, 13107, 65535]] * 3, np.uint16), True),
        (np.array([[255, 0, 51]] * 3, np.uint8), False),
        (np.array([[1.0, 0.0, 0.2]] * 3, np.float32), False),
    ],
)
def test_vertex_colours_are_linear_shares(gltf, load_quietly, values, normalized):
    colors = gltf.array(values, normalized=normalized)
    mesh = load_quietly(one_mesh(gltf, gltf.primitive(COLOR_0=colors))).instances[0].mesh
    np.testing.assert_allclose(mesh.colors, [[1.0, 0.0, 0.2, 1.0]] * 3, atol=1e-6)


def test_uvs_normals_and_missing_normals(gltf, load_quietly):
    uvs = np.array([[0, 0], [0.25, 0], [0, 0.75]], np.float32)
    normals = np.array([[0, 0, 2], [0, 0, 0.1], [0, 0, 1]], np.float32)
    full = gltf.primitive(TEXCOORD_0=uvs, NORMAL=normals)
    scene = load_quietly(one_mesh(gltf, full, gltf.primitive()))
    first, second = (i.mesh for i in scene.instances)
    assert first.uvs.tolist() == uvs.tolist()
    np.testing.assert_array_equal(first.normals, [[0, 0, 1]] * 3)
    # glTF asks for flat normals where there are none.
    assert second.normals is None and not second.smooth


def test_strips_and_fans_become_triangles(gltf, load_quietly):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], np.float32)
    scene = load_quietly(one_mesh(gltf, gltf.primitive(points, mode=5), gltf.primitive(QUAD, mode=6)))
    strip, fan = (i.mesh for i in scene.instances)
    for mesh, count in ((strip, 3), (fan, 2)):
        corners = mesh.positions[mesh.triangles]
        turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert len(corners) == count and (turned[:, 2] > 0.0).all()
    assert strip.positions[strip.triangles].reshape(-1, 3).max(axis=0).tolist() == [1.0, 2.0, 0.0]


def test_points_lines_skins_and_animations_are_noted(gltf, load_quietly):
    gltf.json |= {"animations": [{"channels": [], "samplers": []}], "skins": [{"joints": [0]}]}
    scene = load_quietly(one_mesh(gltf, gltf.primitive(mode=0), gltf.primitive(mode=3), gltf.primitive()))
    assert len(scene.instances) == 1
    for word in ("points", "lines", "skins", "animations"):
        assert any(word in note for note in scene.notes)


def test_interleaved_and_sparse_accessors(gltf, load_quietly):
    rows = np.zeros(3, [("p", "<f4", 3), ("t", "<u2", 2)])
    rows["p"] = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    rows["t"] = [[0, 0], [65535, 0], [0, 65535]]
    view = gltf.view(rows.tobytes(), byteStride=16)
    where = gltf.view(np.array([2], np.uint16).tobytes())
    new = gltf.view(np.array([[0, 5, 0]], np.float32).tobytes())
    position = {"bufferView": view, "componentType": 5126, "count": 3, "type": "VEC3"}
    sparse = {
        "count": 1,
        "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": new},
    }
    uv = {"bufferView": view, "byteOffset": 12, "componentType": 5123, "count": 3, "type": "VEC2", "normalized": True}
    attributes = {
        "POSITION": gltf.add("accessors", position | {"sparse": sparse}),
        "TEXCOORD_0": gltf.add("accessors", uv),
    }
    mesh = load_quietly(one_mesh(gltf, {"attributes": attributes})).instances[0].mesh
    assert mesh.positions.tolist() == [[0, 0, 0], [1, 0, 0], [0, 5, 0]]
    assert mesh.uvs.tolist() == [[0, 0], [1, 0], [0, 1]]


def test_external_buffers_and_images_by_relative_and_escaped_names(gltf, load_quietly, write_png, tmp_path):
    material = gltf.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}})
    gltf.node(mesh=gltf.mesh(gltf.primitive(material=material)))
    gltf.add("textures", {"source": gltf.add("images", {"uri": "a%20picture.png"})})
    gltf.json["buffers"] = [{"byteLength": len(gltf.data), "uri": "data/shape.bin"}]
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "shape.bin").write_bytes(gltf.data)
    write_png("a picture.png", RED)
    scene = load_quietly(gltf.write("model.gltf"))
    assert scene.instances[0].material.base_color_texture.pixels.tolist() == RED.tolist()


def test_file_in_json_with_a_data_uri_equals_the_binary_one(gltf, load_quietly):
    import base64

    gltf.node(mesh=gltf.mesh(gltf.primitive(QUAD, np.array([0, 1, 2, 0, 2, 3], np.uint16))))
    binary = load_quietly(gltf.write()).instances[0].mesh
    uri = "data:application/octet-stream;base64," + base64.b64encode(gltf.data).decode()
    gltf.json["buffers"] = [{"byteLength": len(gltf.data), "uri": uri}]
    text = load_quietly(gltf.write("model.gltf")).instances[0].mesh
    np.testing.assert_array_equal(binary.positions, text.positions)
    np.testing.assert_array_equal(binary.triangles, text.triangles)


def test_duck_has_one_camera_and_one_texture(asset, load_quietly):
    scene = load_quietly(asset("Duck.glb"))
    assert len(scene.cameras) == 1 and scene.camera.name != "framed"
    assert scene.triangle_count == 4212
    assert scene.instances[0].material.base_color_texture.pixels.shape == (512, 512, 3)


def test_milk_truck_shares_its_wheels(asset, load_quietly):
    scene = load_quietly(asset("CesiumMilkTruck.glb"))
    wheels = [i for i in scene.instances if i.name == "Wheels"]
    assert len(scene.instances) == 5 and len(wheels) == 2
    assert wheels[0].mesh is wheels[1].mesh
    assert not np.array_equal(wheels[0].transform, wheels[1].transform)


def test_damaged_helmet_has_four_textures(asset, load_quietly):
    scene = load_quietly(asset("DamagedHelmet.glb"))
    textures = scene.instances[0].material.textures
    assert [t is not None and t.srgb for t in textures] == [True, False, True, False]
    assert {t.pixels.shape for t in textures} == {(2048, 2048, 3)}
    low, high = scene.bounds()
    # The node turns the helmet upright: it looks along +z.
    np.testing.assert_allclose(high - low, (1.89, 1.80, 2.0), atol=0.02)
