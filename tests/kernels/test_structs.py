"""What host and device must agree on: struct sizes, the packing of cameras, the options of every kernel."""

from __future__ import annotations

import functools
import importlib
import pkgutil
import re

import numpy as np
import pytest
import reference
import warp as wp
import warp_deferred.kernels
from warp_deferred.kernels import structs

import warp_deferred as wd
from warp_deferred.views import ViewLayout, ViewPacker, ViewSize

KERNEL_FILES = sorted(info.name for info in pkgutil.iter_modules(warp_deferred.kernels.__path__))


def stated_sizes() -> dict[str, int]:
    """The sizes that the module's docstring tells its readers."""
    text = structs.__doc__.partition("(asserted by")[2].partition("\n\n")[0]
    return {name: int(size) for name, size in re.findall(r"([A-Z][A-Za-z]+) (\d+)", text)}


@pytest.mark.parametrize("name", sorted(stated_sizes()))
def test_struct_sizes_are_as_documented(name):
    kind = getattr(structs, name)
    assert np.dtype(kind.numpy_dtype()).itemsize == wp.types.type_size_in_bytes(kind)
    if name != "Material":  # its handles differ by device
        assert wp.types.type_size_in_bytes(kind) == stated_sizes()[name]


def test_documented_structs_are_those_held_in_arrays():
    assert {"View", "Transform", "Instance", "Pair", "Cluster", "LargeTriangle"} <= set(stated_sizes())


def test_view_packer_fills_every_field():
    sizes = (ViewSize(40, 30), ViewSize(17, 33, depth_only=True), ViewSize(40, 30))
    layout = ViewLayout(sizes, 16)
    packer = ViewPacker(layout, "front")
    cameras = [
        wd.Camera.look_at((1e7, 2.0, 3.0), (0.0, 0.0, 0.0), vertical_fov_deg=40.0, exposure=2.0, near=0.25, world=3),
        wd.Camera(projection="orthographic", vertical_extent=7.0, near=-2.0, far=9.0),
        wd.Camera.look_at((0.0, 5.0, 0.0), (1.0, 0.0, 0.0)),
    ]
    ranges = [tuple(range(10 * v + 1, 10 * v + 8)) for v in range(3)]
    buffer = bytearray(packer.size * 3)
    packer.write(memoryview(buffer), cameras, ranges, depth_clamp=True)
    rows = np.frombuffer(buffer, dtype=np.dtype(structs.View.numpy_dtype()))
    for v, (row, size, camera) in enumerate(zip(rows, sizes, cameras, strict=True)):
        fx, fy, cx, cy = camera.pixel_projection(size.width, size.height)
        assert np.array_equal(row["origin"], camera.position)
        assert np.allclose(row["rotation"].reshape(-1), np.ravel(camera.rotation), atol=1e-7)
        assert np.allclose([*row["scale"], *row["center"]], [fx, -fy, cx, cy], rtol=1e-6)
        assert (row["width"], row["height"], row["row_pitch"]) == (size.width, size.height, size.width)
        assert (row["near"], row["far"]) == (np.float32(camera.near), np.float32(camera.far))
        assert row["exposure"] == 2.0**camera.exposure and row["world"] == camera.world
        assert row["projection"] == (camera.projection == "orthographic")
        assert row["cull_mode"] == structs.CULL_FRONT and row["depth_clamp"] == 1
        assert row["depth_only"] == size.depth_only
        names = ("pair_offset", "shared_instances", "own_first", "own_count")
        names += ("shared_clusters", "own_cluster_first", "own_cluster_count")
        assert tuple(int(row[name]) for name in names) == ranges[v]
    # The two that keep ids lie one after the other; the depth-only one has an arena of its own.
    assert rows["pixel_offset"].tolist() == [0, 0, 1200]
    assert rows["tile_offset"].tolist()[2] == 6 and rows["tiles_x"].tolist() == [3, 2, 3]
    assert rows["bin_offset"].tolist() == [0, 6, 12] and rows["bins_x"].tolist() == [3, 2, 3]


@pytest.mark.parametrize("tile_size", [8, 16, 32, 64])
def test_layout_tables_cover_each_pixel_once(tile_size):
    sizes = (ViewSize(1, 1), ViewSize(257, 65), ViewSize(16, 200))
    layout = ViewLayout(sizes, tile_size)
    coarse = tile_size << layout.coarse_shift
    for table, side in ((layout.blocks, 8), (layout.tiles, tile_size), (layout.coarse_tiles, coarse)):
        for v, size in enumerate(sizes):
            count = np.zeros((size.height, size.width), int)
            for _, x, y, _ in table[table[:, 0] == v]:
                count[y : y + side, x : x + side] += 1
            assert (count == 1).all()
    parent = layout.coarse_tiles[layout.tiles[:, 3]]
    assert np.array_equal(parent[:, 0], layout.tiles[:, 0])
    assert np.array_equal(parent[:, 1:3], layout.tiles[:, 1:3] // coarse * coarse)


@functools.cache
def all_kernels(file: str) -> tuple[wp.Kernel, ...]:
    """Every kernel of a file: those at module level and those of each listed variant."""
    module = importlib.import_module(f"warp_deferred.kernels.{file}")
    found = [value for value in vars(module).values() if isinstance(value, wp.Kernel)]
    for name, make in vars(module).items():
        if name.startswith("make_") and name.endswith(("_kernel", "_kernels")) and make.__module__ == module.__name__:
            for variant in module.VARIANTS:
                made = make(*variant)
                found += made if isinstance(made, tuple) else [made]
    return tuple(found)


@pytest.mark.parametrize("file", KERNEL_FILES)
def test_e9_no_kernel_fuses_multiply_and_add(file):
    # A specialised kernel is a module of its own and does not inherit its file's options.
    for kernel in all_kernels(file):
        options = kernel.module.options
        assert options["enable_backward"] is False, kernel.key
        if kernel in asked_for(file):
            continue
        assert options["fuse_fp"] is False and options["fast_math"] is False, kernel.key


def asked_for(file):
    """Kernels of a file that a setting has round otherwise: lighting's, whose last argument says so."""
    module = importlib.import_module(f"warp_deferred.kernels.{file}")
    return [module.make_shade_kernel(*v) for v in module.VARIANTS if len(v) == 11] if file == "shade" else []


def test_lighting_fuses_only_where_a_setting_says_so():
    rounding = [kernel.module.options for kernel in asked_for("shade")]
    assert [(options["fuse_fp"], options["fast_math"]) for options in rounding] == [
        (True, False),
        (True, True),
        (True, True),
    ]


def test_every_kernel_is_found():
    found = {file for file in KERNEL_FILES if all_kernels(file)}
    assert {"bins", "clusters", "display", "light_culling", "lights", "merge", "raster", "resolve", "shade"} <= found


def test_min_roughness_agrees_with_the_reference():
    brdf = importlib.import_module("warp_deferred.kernels.brdf")
    assert np.isclose(float(brdf.MIN_ROUGHNESS), reference.MIN_ROUGHNESS)
