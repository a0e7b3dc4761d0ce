"""The frame object: names, validity, copies, DLPack and files. Arrays are made by hand; no renderer is needed."""

import numpy as np
import pytest
import warp as wp

from warp_deferred.camera import Camera
from warp_deferred.channels import OUTPUTS
from warp_deferred.errors import Error, InputError, LoadError
from warp_deferred.frame import Frame
from warp_deferred.images import read_image, read_png


def host_arrays(names, views=2, height=3, width=5):
    rng = np.random.default_rng(7)
    arrays = {}
    for name in names:
        channel = OUTPUTS[name]
        shape = (views, height, width) + ((channel.components,) if channel.components > 1 else ())
        if channel.dtype == "vec4ub":
            arrays[name] = rng.integers(0, 256, shape, dtype=np.uint8)
        elif channel.is_integer:
            arrays[name] = rng.integers(-1, 2**31 - 1, shape, dtype=np.int32)
        else:
            arrays[name] = rng.standard_normal(shape).astype(np.float32)
    return arrays


def make_frame(host, device="cpu", **extra):
    arrays = {n: wp.array(a, dtype=getattr(wp, OUTPUTS[n].dtype), device=device) for n, a in host.items()}
    return Frame(arrays, [Camera(name=f"c{i}") for i in range(len(next(iter(host.values()))))], **extra)


def test_frame_describes_itself():
    frame = make_frame(host_arrays(["depth", "color"]))
    assert frame.outputs == ("color", "depth") and list(frame) == ["color", "depth"]
    assert (len(frame), frame.width, frame.height) == (2, 5, 3)
    assert "depth" in frame and "normal" not in frame
    assert "2 x 5 x 3" in repr(frame)


def test_every_output_reads_back(device):
    host = host_arrays(OUTPUTS)
    frame = make_frame(host, device)
    for name in OUTPUTS:
        assert np.array_equal(frame.numpy(name), host[name]), name


def test_missing_outputs_name_the_mend():
    frame = make_frame(host_arrays(["depth"]))
    with pytest.raises(InputError, match=r"outputs=\('depth', 'normal'\)"):
        frame["normal"]
    with pytest.raises(InputError, match="did you mean 'depth'"):
        frame["dept"]
    with pytest.raises(InputError):
        Frame({})
    with pytest.raises(InputError, match=r"Frame\.arrays"):
        Frame({"colour": frame["depth"]})
    with pytest.raises(InputError, match="one shape"):
        Frame({"depth": frame["depth"], "alpha": wp.zeros((1, 2, 2), dtype=wp.float32, device="cpu")})


def test_a_stale_frame_says_so_and_a_copy_lives_on(tmp_path):
    host = host_arrays(["depth"])
    valid = True
    frame = make_frame(host, generation_check=lambda: valid)
    kept = frame.copy()
    frame["depth"].fill_(9.0)
    valid = False
    for use in (
        lambda: frame["depth"],
        lambda: frame.numpy("depth"),
        frame.copy,
        lambda: frame.save(tmp_path / "a.exr"),
    ):
        with pytest.raises(Error, match=r"use frame\.copy\(\)"):
            use()
    assert np.array_equal(kept.numpy("depth"), host["depth"])
    assert kept.cameras == frame.cameras and not list(tmp_path.iterdir())


def test_numpy_is_a_copy_of_its_own():
    frame = make_frame(host_arrays(["depth"]))
    before = frame.numpy("depth")
    frame["depth"].fill_(9.0)
    assert not (before == 9.0).any()


def test_dlpack_shares_memory_with_numpy():
    host = host_arrays(OUTPUTS)
    frame = make_frame(host)
    for name in OUTPUTS:
        shared = np.from_dlpack(frame[name])
        assert shared.shape == host[name].shape and shared.dtype == host[name].dtype
        assert shared.ctypes.data == frame[name].ptr
        assert np.array_equal(shared, host[name])


def test_dlpack_shares_memory_with_torch(device):
    torch = pytest.importorskip("torch")
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("torch without CUDA")
    host = host_arrays(OUTPUTS)
    frame = make_frame(host, device)
    for name in OUTPUTS:
        shared = torch.from_dlpack(frame[name])
        assert shared.data_ptr() == frame[name].ptr
        assert np.array_equal(shared.cpu().numpy(), host[name])


def test_exr_holds_all_layers_of_all_views(tmp_path):
    host = host_arrays(OUTPUTS)
    paths = make_frame(host).save(tmp_path / "a.exr")
    parts = read_image(tmp_path / "a.exr")
    assert paths == [tmp_path / "a.exr"] and len(parts) == 2
    for view, part in enumerate(parts):
        assert set(part) == {name for channel in OUTPUTS.values() for name in channel.exr}
        for name, channel in OUTPUTS.items():
            for i, layer in enumerate(channel.exr):
                expected = host[name][view, ..., i] if channel.components > 1 else host[name][view]
                assert np.array_equal(part[layer], expected), layer


def test_exr_of_one_view_carries_its_camera(tmp_path):
    import OpenImageIO as oiio

    host = host_arrays(["depth"])
    make_frame(host).save(tmp_path / "a.exr", view=1)
    (part,) = read_image(tmp_path / "a.exr")
    assert np.array_equal(part["Z"], host["depth"][1])
    spec = oiio.ImageBuf(str(tmp_path / "a.exr")).spec()
    assert spec.getattribute("camera_name") == "c1"
    numbers = [float(x) for x in spec.getattribute("camera_fx_fy_cx_cy").split()]
    assert numbers == list(Camera().pixel_projection(5, 3))


def test_png_views_get_numbered_files(tmp_path):
    host = host_arrays(["display"])
    frame = make_frame(host)
    assert frame.save(tmp_path / "a.png") == [tmp_path / "a.0.png", tmp_path / "a.1.png"]
    for view in range(2):
        assert np.array_equal(read_png(tmp_path / f"a.{view}.png"), host["display"][view])
    assert frame.save(tmp_path / "b.png", view=1) == [tmp_path / "b.png"]
    assert np.array_equal(read_png(tmp_path / "b.png"), host["display"][1])


def test_save_refuses_what_it_cannot_write(tmp_path):
    frame = make_frame(host_arrays(["depth"]))
    with pytest.raises(InputError, match="'display'"):
        frame.save(tmp_path / "a.png")
    with pytest.raises(LoadError, match=r"ends in \.exr .* or \.png"):
        frame.save(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="from 0 to 1"):
        frame.save(tmp_path / "a.exr", view=2)
    with pytest.raises(InputError, match="an EXR file keeps"):
        make_frame(host_arrays(["display"])).save(tmp_path / "a.exr")
    assert not list(tmp_path.iterdir())
