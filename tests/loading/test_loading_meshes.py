"""OBJ with MTL, PLY and STL files."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest

import warp_deferred as wd
from warp_deferred.loading import LoadWarning

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def srgb(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def write(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def repaired(path, *words):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = wd.load(path)
    found = [w for w in caught if issubclass(w.category, LoadWarning)]
    assert len(found) == 1
    for word in words:
        assert word in str(found[0].message), found[0].message
    return scene


def corners(mesh):
    return mesh.positions[mesh.triangles] + mesh.origin


def test_l3_negative_obj_indices_count_back_from_the_face(tmp_path, load_quietly):
    text = SQUARE + "f -4 -3 -2\nv 5 5 5\nf -5 -3 -1\n"
    mesh = load_quietly(write(tmp_path, "a.obj", text)).instances[0].mesh
    assert corners(mesh).tolist() == [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [5, 5, 5]]]


@pytest.mark.parametrize("face", ["0 1 2", "1/0/1 2/1/1 3/1/1", "1//0 2//1 3//1"])
def test_l3_obj_index_zero_is_an_error(tmp_path, face):
    path = write(tmp_path, "a.obj", SQUARE + "vt 0 0\nvn 0 0 1\nf " + face + "\n")
    with pytest.raises(wd.LoadError, match=r"a\.obj line 7: expected .* indices from 1.*got 0 in") as caught:
        wd.load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("bad", ["1 2 9", "1 2 -9", "1 2 3 9"])
def test_l2_obj_faces_with_indices_out_of_range_are_dropped(tmp_path, bad):
    scene = repaired(write(tmp_path, "a.obj", SQUARE + f"f 1 2 3\nf {bad}\nf 1 3 4\n"), "dropped 1 face")
    assert corners(scene.instances[0].mesh).tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
    ]


@pytest.mark.parametrize("word", ["nan", "inf", "-1.#IND", "1.#QNAN"])
def test_l4_obj_positions_that_are_not_finite(tmp_path, word):
    scene = repaired(write(tmp_path, "a.obj", SQUARE.replace("0 1 0", f"0 {word} 0") + "f 1 2 3\nf 1 3 4\n"), "1 face")
    assert corners(scene.instances[0].mesh).tolist() == [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]]


def test_l5_obj_colours_that_are_not_finite_become_white(tmp_path):
    text = "v 0 0 0 1 0 0\nv 1 0 0 nan 0 0\nv 0 1 0 0 0.5 0\nf 1 2 3\n"
    colors = repaired(write(tmp_path, "a.obj", text), "1 colour").instances[0].mesh.colors
    np.testing.assert_allclose(colors, [[1, 0, 0, 1], [1, 1, 1, 1], [0, srgb(0.5), 0, 1]], atol=1e-6)


def test_l8_obj_partial_colours_uvs_and_normals_get_defaults(tmp_path, load_quietly):
    text = "v 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.25 0.75\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1 3 4\n"
    mesh = load_quietly(write(tmp_path, "a.obj", text)).instances[0].mesh
    assert mesh.colors[mesh.triangles[0]].tolist() == [[1, 0, 0, 1], [1, 1, 1, 1], [1, 1, 1, 1]]
    assert mesh.uvs[mesh.triangles[0]].tolist() == [[0.25, 0.25]] * 3
    assert mesh.uvs[mesh.triangles[1]].tolist() == [[0, 0]] * 3
    assert mesh.normals[mesh.triangles[0]].tolist() == [[0, 0, 1]] * 3
    assert mesh.normals[mesh.triangles[1]].tolist() == [[0, 0, 0]] * 3


def covered(triangles, points):
    """Count for each point how many triangles it lies strictly inside of, by signs of areas."""
    count = np.zeros(len(points), int)
    for a, b, c in triangles[:, :, :2]:
        signs = [
            (q[0] - p[0]) * (points[:, 1] - p[1]) - (q[1] - p[1]) * (points[:, 0] - p[0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        count += (np.min(signs, axis=0) > 0) | (np.max(signs, axis=0) < 0)
    return count


def inside_polygon(polygon, points):
    """Even-odd rule, by crossings of a ray to the right."""
    odd = np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        straddles = (ay > points[:, 1]) != (by > points[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = ax + (points[:, 1] - ay) * (bx - ax) / (by - ay)
        odd ^= straddles & (points[:, 0] < x)
    return odd


POLYGONS = {
    "dart": [(0, 0), (2, 1), (0, 2), (0.5, 1)],
    "arrow": [(0.5, 1), (0, 0), (2, 1), (0, 2)],
    "comb": [(0, 0), (5, 0), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)],
    "collinear": [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)],
    "spiral": [
        (0, 0),
        (6, 0),
        (6, 6),
        (1, 6),
        (1, 2),
        (4, 2),
        (4, 4),
        (3, 4),
        (3, 3),
        (2, 3),
        (2, 5),
        (5, 5),
        (5, 1),
        (0, 1),
    ],
    "hole": [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)],
}


@pytest.mark.parametrize("name", POLYGONS)
@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_l9_polygons_are_covered_exactly_once(tmp_path, load_quietly, name, clockwise, kind):
    polygon = np.array(POLYGONS[name], float)[:: -1 if clockwise else 1]
    count = len(polygon)
    if kind == "obj":
        text = "".join(f"v {x} {y} 0\n" for x, y in polygon) + "f " + " ".join(map(str, range(1, count + 1)))
    else:
        text = (
            f"ply\nformat ascii 1.0\nelement vertex {count + 1}\nproperty float x\nproperty float y\nproperty float z\n"
            "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
            + "".join(f"{x} {y} 0\n" for x, y in polygon)
            + "9 9 9\n"
            + f"{count} {' '.join(map(str, range(count)))}\n3 {count} {count} {count}\n"
        )
    mesh = load_quietly(write(tmp_path, f"{name}.{kind}", text)).instances[0].mesh
    points = np.random.default_rng(1).uniform(-0.5, 6.5, (4000, 2))
    faces = corners(mesh)
    np.testing.assert_array_equal(covered(faces, points), inside_polygon(polygon, points))
    area = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])[:, 2]
    assert (area * (-1 if clockwise else 1) >= 0).all()
    # Corners on straight edges belong to triangles with an area, so that neighbours meet at them.
    assert set(mesh.triangles[area != 0].reshape(-1)) >= set(mesh.triangles[area == 0].reshape(-1)) - {count}


MTL = """
newmtl red paint
Kd 0.5 0 0
Ks 0.25 0.25 0.25
Ns 20
Ke 0 0.5 0
d 0.5
newmtl board
Kd 1 1 1
illum 1
Ks 1 1 1
map_Kd -s 1 1 1 -clamp on sub/my picture.png
map_Bump bump.png
newmtl gone
map_Kd absent.png
Tr 0.25
"""


def test_obj_materials(tmp_path, load_quietly, write_png):
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    (tmp_path / "sub").mkdir()
    write_png("sub/my picture.png", picture)
    write(tmp_path, "paints.mtl", MTL)
    faces = "usemtl red paint\nf 1/1 2/2 3/3\nusemtl board\nf 1/1 3/3 4/4\nusemtl gone\nf 1/1 2/2 4/4\n"
    uvs = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    path = write(tmp_path, "a.obj", "mtllib paints.mtl\no thing\n" + SQUARE + uvs + faces)
    scene = repaired(path, "absent.png")
    red, board, gone = (i.material for i in scene.instances)
    assert [i.mesh.name for i in scene.instances] == ["thing_red paint", "thing_board", "thing_gone"]
    assert (red.name, red.model, red.shininess, red.alpha_mode) == ("red paint", "blinn_phong", 20.0, "blend")
    np.testing.assert_allclose(red.base_color, (srgb(0.5), 0, 0, 0.5), rtol=1e-12)
    np.testing.assert_allclose(red.specular, [srgb(0.25)] * 3, rtol=1e-12)
    np.testing.assert_allclose(red.emissive, (0, srgb(0.5), 0), rtol=1e-12)
    assert board.model == "lambert" and board.base_color_texture.wrap == ("clamp", "clamp")
    assert board.base_color_texture.pixels.tolist() == picture.tolist() and board.base_color_texture.srgb
    assert gone.base_color_texture is None and gone.base_color[3] == 0.75
    assert any("map_bump" in note for note in scene.notes)
    # v counts from the bottom in OBJ and from the top here: the corner at (0, 1, 0) shows the image's top left.
    mesh = scene.instances[1].mesh
    by_position = {tuple(p): tuple(t) for p, t in zip(mesh.positions.tolist(), mesh.uvs.tolist(), strict=True)}
    assert by_position == {(0, 0, 0): (0, 1), (1, 1, 0): (1, 0), (0, 1, 0): (0, 0)}


def test_obj_without_its_material_file_is_grey_with_a_warning(tmp_path):
    scene = repaired(write(tmp_path, "a.obj", "mtllib no.mtl\nusemtl x\n" + SQUARE + "f 1 2 3\n"), "no.mtl")
    assert scene.instances[0].material.base_color == (0.8, 0.8, 0.8, 1.0)


@pytest.mark.parametrize(
    "name", ["/etc/hostname", "../paints.mtl", "http://127.0.0.1:9/a.mtl", "`touch x`", "$HOME/a.mtl"]
)
def test_obj_material_files_outside_the_folder_are_not_read(tmp_path, name):
    write(tmp_path, "paints.mtl", "newmtl x\nKd 1 0 0\n")
    inside = tmp_path / "inside"
    inside.mkdir()
    path = write(inside, "a.obj", f"mtllib {name}\nusemtl x\n" + SQUARE + "f 1 2 3\n")
    assert repaired(path, "is left out").instances[0].material.base_color[:3] == (0.8, 0.8, 0.8)


def test_l8_obj_without_normals_is_smooth_across_texture_seams(tmp_path, load_quietly):
    # A roof whose ridge (vertices 1 and 2) has different uvs on both sides.
    text = "v 0 1 0\nv 0 1 1\nv -1 0 0\nv -1 0 1\nv 1 0 0\nv 1 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    text += "f 1/1 3/1 4/1\nf 1/1 4/1 2/1\nf 1/2 2/2 6/2\nf 1/2 6/2 5/2\n"
    mesh = load_quietly(write(tmp_path, "a.obj", text)).instances[0].mesh
    ridge = mesh.positions[:, 1] == 1.0
    assert ridge.sum() == 4 and mesh.smooth
    first, second = (mesh.normals[ridge & (mesh.positions[:, 2] == z)] for z in (0.0, 1.0))
    np.testing.assert_allclose(first[0], first[1], atol=1e-6)
    np.testing.assert_allclose(second[0], second[1], atol=1e-6)
    assert first[0][1] > 0.9


@pytest.mark.parametrize("text", ["", "# nothing\n", "v 0 0 0\n", "o thing\n"])
def test_l1_obj_without_faces(tmp_path, load_quietly, text):
    scene = load_quietly(write(tmp_path, "a.obj", text))
    assert scene.instances == () and any("no triangles" in note for note in scene.notes)


@pytest.mark.parametrize(
    "text",
    [b"solid x", b"\x00\x01\x02", b"<html>", b"v 1 2\nf 1 1 1", b"v a b c\nf 1 1 1", SQUARE.encode() + b"f 1 2 x"],
)
def test_obj_text_that_is_none(tmp_path, text):
    with pytest.raises(wd.LoadError, match=r"a\.obj.*expected"):
        wd.load(write(tmp_path, "a.obj", text))


def test_capsule_has_its_texture_the_right_way_up(asset, load_quietly):
    scene = load_quietly(asset("capsule.obj"))
    mesh, material = scene.instances[0].mesh, scene.instances[0].material
    assert material.base_color_texture.pixels.shape == (1024, 2048, 3) and material.base_color == (1, 1, 1, 1)
    assert len(mesh.triangles) == 10200
    # The first vt lines go with the pole at z = -1.5 and have v near 0 in the file: near 1, the bottom row, here.
    raw = [line.split() for line in asset("capsule.obj").read_text().splitlines() if line[:2] in ("v ", "vt")]
    points = np.array([row[1:4] for row in raw if row[0] == "v"], float)
    uvs = np.array([row[1:3] for row in raw if row[0] == "vt"], float)
    assert len(points) == len(uvs)
    low, high = points[:, 2] < -1.4, points[:, 2] > points[:, 2].max() - 0.1
    expected = 1.0 - uvs[low, 1].mean(), 1.0 - uvs[high, 1].mean()
    z = mesh.positions[:, 2]
    found = mesh.uvs[z < -1.4, 1].mean(), mesh.uvs[z > z.max() - 0.1, 1].mean()
    np.testing.assert_allclose(found, expected, atol=0.02)
    assert abs(found[0] - found[1]) > 0.5


PLY = (
    "ply\nformat ascii 1.0\n{comment}element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "{extra}element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)


def test_ply_colours_are_made_linear_and_normals_are_smooth(tmp_path, load_quietly):
    extra = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue", "alpha"))
    rows = "0 0 0 255 0 0 255\n1 0 0 0 128 0 51\n1 1 0 0 0 0 255\n0 1 0 255 255 255 255\n"
    text = PLY.format(comment="", extra=extra, faces=1) + rows + "4 0 1 2 3\n"
    scene = load_quietly(write(tmp_path, "a.ply", text))
    mesh = scene.instances[0].mesh
    assert mesh.normals is None and mesh.smooth and len(mesh.triangles) == 2
    expected = [[1, 0, 0, 1], [0, srgb(128 / 255), 0, 0.2], [0, 0, 0, 1], [1, 1, 1, 1]]
    np.testing.assert_allclose(mesh.colors, expected, atol=1e-6)
    assert scene.instances[0].material.base_color == (1.0, 1.0, 1.0, 1.0)


def test_ply_texture_and_binary_form(tmp_path, load_quietly, write_png):
    write_png("a.png", np.full((2, 2, 3), 9, np.uint8))
    header = PLY.format(comment="comment TextureFile a.png\n", extra="property float s\nproperty float t\n", faces=2)
    rows = np.array([[0, 0, 0, 0, 0], [1, 0, 0, 1, 0], [1, 1, 0, 1, 1], [0, 1, 0, 0, 1]], "<f4")
    data = header.replace("ascii", "binary_little_endian").encode() + rows.tobytes()
    data += struct.pack("<Biii", 3, 0, 1, 2) + struct.pack("<Biii", 3, 0, 2, 3)
    scene = load_quietly(write(tmp_path, "a.ply", data))
    mesh = scene.instances[0].mesh
    assert mesh.uvs.tolist() == [[0, 1], [1, 1], [1, 0], [0, 0]]
    assert scene.instances[0].material.base_color_texture.pixels.max() == 9
    with pytest.raises(wd.LoadError, match=r"cut\.ply.*expected the elements"):
        wd.load(write(tmp_path, "cut.ply", data[:-4]))


def test_l2_l4_ply_bad_faces_are_dropped(tmp_path):
    rows = "0 0 0\n1 0 0\n1 1 0\nnan 1 0\n"
    text = PLY.format(comment="", extra="", faces=4) + rows + "3 0 1 2\n3 0 1 7\n3 0 -1 2\n3 0 2 3\n"
    scene = repaired(write(tmp_path, "a.ply", text), "2 faces with an index", "1 face with a vertex", "'a'")
    assert scene.instances[0].mesh.triangles.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("text", [b"", b"ply\n", b"hello", b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n"])
def test_ply_files_that_are_none(tmp_path, text):
    with pytest.raises(wd.LoadError, match=r"a\.ply.*expected"):
        wd.load(write(tmp_path, "a.ply", text))


def test_l1_ply_without_vertices_or_faces(tmp_path, load_quietly):
    text = PLY.format(comment="", extra="", faces=0).replace("vertex 4", "vertex 0")
    assert load_quietly(write(tmp_path, "a.ply", text)).instances == ()
    text = PLY.format(comment="", extra="", faces=0) + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
    assert load_quietly(write(tmp_path, "b.ply", text)).instances == ()


def test_bunny_has_no_normals_and_gets_smooth_ones(asset, load_quietly):
    scene = load_quietly(asset("bunny.ply"))
    mesh = scene.instances[0].mesh
    assert mesh.normals is None and mesh.smooth and mesh.uvs is None and len(mesh.triangles) > 10000
    assert scene.camera.name == "framed" and len(scene.lights) == 3


def stl(triangles):
    data = bytes(80) + struct.pack("<I", len(triangles))
    for t in triangles:
        data += struct.pack("<12fH", 0, 0, 0, *np.ravel(t), 0)
    return data


def test_l7_stl_is_flat_and_keeps_degenerate_faces(tmp_path, load_quietly):
    faces = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 0, 0], [0, 1, 0]]]
    mesh = load_quietly(write(tmp_path, "a.stl", stl(faces))).instances[0].mesh
    assert corners(mesh).tolist() == faces and not mesh.smooth and mesh.normals is None
    points = "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    text = f"solid box\nfacet normal 0 0 1\nouter loop\n{points}endloop\nendfacet\nendsolid box\n"
    scene = load_quietly(write(tmp_path, "b.stl", text))
    assert corners(scene.instances[0].mesh).tolist() == faces[:1]


def test_l4_stl_positions_that_are_not_finite(tmp_path):
    faces = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [np.inf, 0, 0], [0, 1, 0]]]
    scene = repaired(write(tmp_path, "a.stl", stl(faces)), "1 face", "'a'")
    assert corners(scene.instances[0].mesh).tolist() == faces[:1]


def test_stl_files_that_are_empty_or_none(tmp_path, load_quietly):
    assert load_quietly(write(tmp_path, "a.stl", stl([]))).triangle_count == 0
    assert load_quietly(write(tmp_path, "b.stl", "solid x\nendsolid x\n")).triangle_count == 0
    whole = stl([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    for content in (b"", whole[:-3], whole[:50], b"solid x\nfacet", b"hello"):
        with pytest.raises(wd.LoadError, match=r"c\.stl.*expected"):
            wd.load(write(tmp_path, "c.stl", content))
