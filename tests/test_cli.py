"""The command line: what it asks of the renderer, what it writes, and one line for every error.

Most tests put a stand-in in the renderer's place, so that they need neither kernels nor time; those marked `slow` at
the end run the real one.
"""

import json
import subprocess
import sys
from typing import ClassVar

import numpy as np
import pytest
import warp as wp

import warp_deferred as wd
from warp_deferred import cli, cli_arguments, fitting, loading, renderer
from warp_deferred.channels import OUTPUTS
from warp_deferred.frame import Frame
from warp_deferred.images import read_image, read_png, write_exr, write_png


class FakeExplanation:
    def __str__(self):
        return "THE PLAN"

    def to_dict(self):
        return {"passes": []}


class FakeRenderer:
    """Fills every output with the number of the frame and remembers how it was made."""

    made: ClassVar[list] = []

    def __init__(self, scene, *, width, height, device, outputs, settings):
        self.scene, self.size, self.device = scene, (width, height), device
        self.outputs, self.settings, self.count, self.times = outputs, settings, 0, []
        FakeRenderer.made.append(self)

    def prepare(self, progress=None):
        if progress:
            progress("shade", 0, 2)
            progress("display", 1, 2)

    def render(self, camera=None):
        self.count += 1
        self.camera = self.scene.camera
        shape = (1, self.size[1], self.size[0])
        arrays = {n: wp.full(shape, 1, getattr(wp, OUTPUTS[n].dtype), device="cpu") for n in self.outputs}
        return Frame(arrays, [self.camera])

    def explain(self, *, measure=True):
        self.measured = measure
        return FakeExplanation()

    def memory_report(self):
        return FakeExplanation()


@pytest.fixture
def scene():
    scene = wd.Scene("fake")
    scene.cameras = [wd.Camera(name="left", near=0.5), wd.Camera(name="right", position=(1.0, 2.0, 3.0))]
    scene.notes.append("one face dropped")
    return scene


@pytest.fixture
def fake(monkeypatch, scene):
    FakeRenderer.made = []
    monkeypatch.setattr(renderer, "Renderer", FakeRenderer)

    def load(source):
        scene._camera = None  # as if read from the file again
        return scene

    monkeypatch.setattr(loading, "load", load)
    return FakeRenderer


def run(capfd, *argv):
    code = cli.main([str(a) for a in argv])
    out, err = capfd.readouterr()
    return code, out, err


def test_render_writes_every_file_and_asks_for_what_they_need(fake, tmp_path, capfd):
    code, out, err = run(
        capfd, "render", "x", "-o", tmp_path / "a.png", "-o", tmp_path / "a.exr", "--layers", "normal,instance_id",
        "--size", "8x4", "--device", "cpu", "--set", "light_culling.tile_size=32",
    )  # fmt: skip
    assert code == 0 and read_png(tmp_path / "a.png").shape == (4, 8, 4)
    assert set(read_image(tmp_path / "a.exr")[0]) >= {"R", "G", "B", "A", "Z", "normal.X", "instance_id"}
    made = fake.made[0]
    assert made.outputs == ("color", "display", "alpha", "depth", "normal", "instance_id")
    assert made.size == (8, 4) and made.device == "cpu" and made.settings.light_culling.tile_size == 32
    assert "note: one face dropped" in err and "compiling" in err
    assert str(tmp_path / "a.png") in out.replace("\n", "") and "8x4" in out


def test_render_asks_for_nothing_a_png_does_not_need(fake, tmp_path, capfd):
    assert run(capfd, "render", "x", "-o", tmp_path / "a.png", "--size", "2x2", "--plan")[1].startswith("THE PLAN")
    assert fake.made[0].outputs == ("display",)


def test_a_view_is_a_setting_with_a_legend(fake, tmp_path, capfd):
    code, out, _ = run(capfd, "render", "x", "-o", tmp_path / "a.png", "--size", "2x2", "--view", "tiles")
    assert code == 0 and fake.made[0].settings.display.view == "tiles"
    assert out.startswith("tiles: lights in the mask")


def test_numbers_are_checked_where_asked_for(fake, tmp_path, capfd):
    for flags, expected in (((), wd.Settings().check_finite), (("--check-finite",), True)):
        assert run(capfd, "render", "x", "-o", tmp_path / "a.png", "--size", "2x2", *flags)[0] == 0
        assert fake.made[-1].settings.check_finite is expected


@pytest.mark.parametrize("quiet", [False, True])
def test_a_budget_is_spent_before_the_frame_and_told(fake, scene, tmp_path, capfd, monkeypatch, quiet):
    wishes = {}

    class Bought:
        settings = wd.Settings(preset="draft")

        def __str__(self):
            return "BOUGHT"

    def fit(given, **wish):
        wish.pop("progress")("shadow pcf", 0, 3) if wish["progress"] else wish.pop("progress")
        wishes.update(wish, camera=given.camera.name)
        return Bought()

    monkeypatch.setattr(fitting, "fit", fit)
    scene.animate = lambda s, time: None
    code, out, err = run(
        capfd, "render", "x", "-o", tmp_path / "a.%d.png", "--size", "4x2", "--budget-ms", "1.5", "--max-error", "0.03",
        "--device", "cpu", "--set", "shadow.rung=off", "--camera", "right", "--frames", "30:31", "--no-cache",
        *["-q"] * quiet,
    )  # fmt: skip
    assert code == 0 and ("BOUGHT" in out, "measuring" in err) == (not quiet, not quiet)
    assert wishes.pop("settings").shadow.rung == "off"
    assert wishes == {"budget_ms": 1.5, "max_error": 0.03, "width": 4, "height": 2, "device": "cpu", "cache": False,
                      "outputs": ("display",), "time_s": 1.0, "camera": "right"}  # fmt: skip
    assert fake.made[0].settings is Bought.settings


def test_a_preset_goes_behind_what_is_set(fake, tmp_path, capfd):
    argv = ["x", "--size", "2x2", "--preset", "draft", "--set", "anti_aliasing.rung=samples_4"]
    assert run(capfd, "render", *argv, "-q", "-o", tmp_path / "a.png")[0] == 0
    assert run(capfd, "explain", *argv)[0] == 0
    for made in fake.made:
        assert made.settings == wd.Settings(preset="draft").with_values(["anti_aliasing.rung=samples_4"])


def test_quiet_prints_nothing(fake, tmp_path, capfd):
    assert run(capfd, "render", "x", "-o", tmp_path / "a.png", "--size", "2x2", "-q", "--plan") == (0, "", "")


def test_cameras_are_chosen_and_changed(fake, tmp_path, capfd):
    def camera(*argv):
        assert run(capfd, "render", "x", "-q", "-o", tmp_path / "a.png", "--size", "2x2", *argv)[0] == 0
        return fake.made[-1].camera

    assert camera().name == "left"
    assert camera("--camera", "1").name == camera("--camera", "right").name == "right"
    assert camera("--exposure", "1.5").exposure == 1.5
    moved = camera("--eye", "0,1,5", "--target=-1,0,0", "--vertical-fov-deg", "60")
    assert moved.position == (0.0, 1.0, 5.0) and moved.near == 0.5
    assert moved.vertical_fov == pytest.approx(np.pi / 3)
    assert moved.rotation == wd.Camera.look_at((0, 1, 5), (-1, 0, 0)).rotation


def test_frames_are_rendered_at_their_times(fake, scene, tmp_path, capfd):
    times = []
    scene.animate = lambda s, time: times.append(time)
    code, _, err = run(
        capfd, "render", "x", "-o", tmp_path / "a.%04d.png", "-o", tmp_path / "b.{frame}.exr", "--frames", "3:6",
        "--fps", "10", "--size", "2x2",
    )  # fmt: skip
    assert code == 0 and times == pytest.approx([0.3, 0.4, 0.5]) and "rendering" in err
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["a.0003.png", "a.0004.png", "a.0005.png", "b.3.exr", "b.4.exr", "b.5.exr"]


@pytest.mark.parametrize(
    ("more", "shutter", "before"),
    [(["-o", "a.png"], 0.5, True), (["-o", "a.exr", "--layers", "motion"], 0.0, True), (["-o", "a.exr"], 0.0, False)],
)
def test_what_moves_is_seen_moving_in_a_still_and_in_the_first_of_many(
    fake, scene, tmp_path, capfd, monkeypatch, more, shutter, before
):
    monkeypatch.chdir(tmp_path)
    times = []
    scene.cameras = [wd.Camera(shutter=shutter)]
    scene.animate = lambda s, time: times.append(time)
    assert run(capfd, "render", "x", "--size", "2x2", "--fps", "10", *more)[0] == 0
    assert times == pytest.approx([-0.1, 0.0] if before else []) and fake.made[0].count == 1 + before
    many = [word.replace("a.", "%d.") for word in more]
    times.clear()
    assert run(capfd, "render", "x", "--size", "2x2", "--fps", "10", "--frames", "3:5", *many)[0] == 0
    assert times == pytest.approx([*([0.2, 0.3] if before else []), 0.3, 0.4]) and fake.made[1].count == 2 + before


@pytest.mark.parametrize(
    ("pattern", "name"),
    [("%d", "7"), ("%04d", "0007"), ("{frame}", "7"), ("{frame:03d}", "007"), ("{frame:03}", "007"), ("%dx%d", "7x7")],
)
def test_frame_numbers_in_names(tmp_path, pattern, name):
    assert cli_arguments.frame_path(tmp_path / f"a{pattern}.png", 7) == tmp_path / f"a{name}.png"


BAD = {
    "no input": (["render", "-o", "a.png"], "Missing argument"),
    "no command": (["rendr"], "Did you mean 'render'"),
    "no such flag": (["render", "x", "-o", "a.png", "--wrong"], "No such option"),
    "size zero": (["render", "x", "-o", "a.png", "--size", "0x0"], "--size: expected WIDTHxHEIGHT"),
    "size word": (["explain", "x", "--size", "big"], "--size: expected"),
    "size too large": (["render", "x", "-o", "a.png", "--size", "16385x1"], "--size: expected"),
    "device": (["render", "x", "-o", "a.png", "--device", "cuda:99"], "--device: expected one of cpu"),
    "stage": (["render", "x", "-o", "a.png", "--set", "shadw.rung=off"], "Settings: expected one of"),
    "field": (["explain", "x", "--set", "display.tonemapping=aces"], "did you mean 'tone_mapping'"),
    "value": (["explain", "x", "--set", "light_culling.tile_size=12"], "tile_size"),
    "no equals": (["explain", "x", "--set", "shade"], "--set: expected stage.field=value"),
    "folder": (["render", "x", "-o", "missing/a.png"], "create it first"),
    "suffix": (["render", "x", "-o", "a.jpg"], "ends in .exr"),
    "view": (["render", "x", "-o", "a.png", "--view", "norml"], "did you mean 'normal'"),
    "view without png": (["render", "x", "-o", "a.exr", "--view", "normal"], "add -o NAME.png"),
    "twice": (["render", "x", "-o", "a.png", "-o", "./a.png"], "each file once"),
    "layer": (["render", "x", "-o", "a.exr", "--layers", "dpth"], "did you mean 'depth'"),
    "layer without exr": (["render", "x", "-o", "a.png", "--layers", "depth"], "add -o NAME.exr"),
    "layer no exr keeps": (["render", "x", "-o", "a.exr", "--layers", "display"], "write a .png"),
    "eye alone": (["render", "x", "-o", "a.png", "--eye", "0,0,1"], "add --target"),
    "eye at target": (["render", "x", "-o", "a.png", "--eye", "1,1,1", "--target", "1,1,1"], "other than the eye"),
    "eye word": (["render", "x", "-o", "a.png", "--eye", "1,1", "--target", "1,1,1"], "--eye: expected three"),
    "eye nan": (
        ["render", "x", "-o", "a.png", "--eye", "1,1,nan", "--target", "1,1,1"],
        "--eye: expected three finite",
    ),
    "fov": (["render", "x", "-o", "a.png", "--vertical-fov-deg", "180"], "--vertical-fov-deg: expected"),
    "exposure": (["render", "x", "-o", "a.png", "--exposure", "nan"], "exposure"),
    "camera": (["render", "x", "-o", "a.png", "--camera", "middle"], "--camera: expected one of 'left', 'right'"),
    "frames order": (["render", "x", "-o", "a%d.png", "--frames", "5:5"], "--frames: expected FIRST:END"),
    "frames name": (["render", "x", "-o", "a.png", "--frames", "0:2"], "such as a.%04d.png"),
    "frames still": (["render", "x", "-o", "a%d.png", "--frames", "0:2"], "expected a scene that moves"),
    "fps": (["render", "x", "-o", "a%d.png", "--frames", "0:2", "--fps", "0"], "--fps"),
    "budget of zero": (["render", "x", "-o", "a.png", "--budget-ms", "0"], "--budget-ms: expected a number > 0, got 0"),
    "budget below": (["render", "x", "-o", "a.png", "--budget-ms", "-1"], "--budget-ms: expected a number > 0, got -1"),
    "budget none": (
        ["render", "x", "-o", "a.png", "--budget-ms", "nan"],
        "--budget-ms: expected a number > 0, got nan",
    ),
    "error of zero": (["render", "x", "-o", "a.png", "--max-error", "0"], "such as --max-error 0.02"),
    "budget, preset": (
        ["render", "x", "-o", "a.png", "--budget-ms", "1", "--preset", "draft"],
        "none beside --budget-ms",
    ),
    "budget, view": (["render", "x", "-o", "a.png", "--max-error", "1", "--view", "depth"], "none beside --max-error"),
    "budget, exr": (["render", "x", "-o", "a.exr", "--budget-ms", "1"], "a .png among the outputs"),
    "preset": (["render", "x", "-o", "a.png", "--preset", "dratf"], "Settings.preset: expected 'none', 'draft'"),
    "compare missing": (["compare", "a.exr", "b.exr"], "no such file"),
    "compare png": (["compare", "a.exr", "b.exr", "--difference", "d.exr"], "ends in .png"),
}


@pytest.mark.parametrize("case", BAD)
def test_every_mistake_is_one_line_before_any_work(fake, tmp_path, monkeypatch, capfd, case):
    argv, words = BAD[case]
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capfd, *argv)
    lines = [line for line in err.splitlines() if not line.startswith("note: ")]
    assert code == 2 and out == ""
    assert len(lines) == 1 and lines[0].startswith("error: ") and words in lines[0], err
    assert not fake.made and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("failure", "code", "words"),
    [
        (KeyboardInterrupt, 130, "interrupted"),
        (MemoryError, 2, "smaller --size"),
        (wd.DeviceError("gone"), 2, "error: gone"),
    ],
)
def test_failures_while_rendering_leave_nothing(fake, tmp_path, monkeypatch, capfd, failure, code, words):
    def fail(self, camera=None):
        raise failure

    monkeypatch.setattr(FakeRenderer, "render", fail)
    got, _, err = run(capfd, "render", "x", "-q", "-o", tmp_path / "a.png", "--size", "2x2")
    assert got == code and words in err and "Traceback" not in err and not list(tmp_path.iterdir())


def test_explain_prints_a_table_or_json_alone(fake, capfd):
    assert run(capfd, "explain", "x", "--device", "cpu")[:2] == (0, "THE PLAN\n")
    code, out, err = run(capfd, "explain", "x", "--json", "--no-measure", "--memory", "--layers", "depth")
    assert code == 0 and json.loads(out) == {"passes": [], "memory": {"passes": []}} and err == ""
    assert fake.made[1].measured is False and fake.made[1].outputs == ("depth",)


def test_compare_exit_codes_and_picture(tmp_path, capfd):
    codes = np.full((4, 4, 4), 100, np.uint8)
    write_png(tmp_path / "a.png", codes)
    codes[1, 2, 0] += 1
    write_png(tmp_path / "b.png", codes)
    assert run(capfd, "compare", tmp_path / "a.png", tmp_path / "a.png")[0] == 0
    code, out, _ = run(capfd, "compare", tmp_path / "a.png", tmp_path / "b.png", "--difference", tmp_path / "d.png")
    assert code == 1 and "DIFFERENT" in out and "(2, 1)" in out and "times 128" in out
    assert read_png(tmp_path / "d.png")[1, 2, 0] == 128
    assert run(capfd, "compare", tmp_path / "a.png", tmp_path / "b.png", "--threshold", "0.004")[0] == 0
    assert run(capfd, "compare", tmp_path / "a.png", tmp_path / "b.png", "--tolerance", "0.0625")[0] == 0
    code, out, _ = run(capfd, "compare", tmp_path / "a.png", tmp_path / "b.png", "--json")
    assert code == 1 and json.loads(out)["ok"] is False


def test_compare_names_a_nan(tmp_path, capfd, monkeypatch):
    import OpenImageIO as oiio

    good = np.ones((3, 3), np.float32)
    write_exr(tmp_path / "a.exr", [{"R": good}])
    # Our own writer never lets NaN out, so the bad file comes from OpenImageIO.
    bad = good.copy()
    bad[2, 1] = np.nan
    buffer = oiio.ImageBuf(oiio.ImageSpec(3, 3, 1, "float"))
    buffer.specmod().channelnames = ("R",)
    buffer.set_pixels(buffer.roi, bad[..., None])
    assert buffer.write(str(tmp_path / "b.exr"))
    code, out, _ = run(capfd, "compare", tmp_path / "b.exr", tmp_path / "a.exr", "--tolerance", "1")
    assert code == 1 and "NaN in the image, first at (1, 2)" in out


def test_scenes_lists_names_lines_and_parameters(monkeypatch, capfd):
    import types

    def build(*, lights=100, seed=1):
        pass

    module = types.SimpleNamespace(build=build)
    monkeypatch.setattr(loading, "built_in_scenes", lambda: {"hall": "A hall full of lights."})
    monkeypatch.setitem(sys.modules, "warp_deferred.scenes.hall", module)
    code, out, _ = run(capfd, "scenes")
    assert (
        code == 0
        and "hall: A hall full of lights." in out
        and "lights=100  seed=1" in out
        and "'hall?lights=100'" in out
    )
    (listed,) = json.loads(run(capfd, "scenes", "--json")[1])
    assert listed["parameters"] == {"lights": 100, "seed": 1}


@pytest.mark.parametrize("command", [[], ["render"], ["explain"], ["compare"], ["scenes"]])
def test_help_teaches_by_example(capfd, command):
    code, out, _ = run(capfd, *command, "--help")
    assert code == 0 and f"warp-deferred {command[0] if command else 'scenes'}" in out
    assert "Examples" in out or not command


def test_help_imports_nothing_heavy():
    program = (
        "import sys; from warp_deferred.cli import main; main(['render', '--help']); "
        "print([m for m in ('warp', 'OpenImageIO', 'trimesh') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0 and result.stdout.rstrip().endswith("[]")


TRIANGLE = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n"


@pytest.mark.slow
def test_a_file_becomes_pictures_end_to_end(tmp_path):
    (tmp_path / "t.obj").write_text(TRIANGLE)
    command = [
        sys.executable,
        "-m",
        "warp_deferred",
        "render",
        "t.obj",
        "-o",
        "t.png",
        "-o",
        "t.exr",
        "--size",
        "33x17",
    ]
    command += ["--device", "cpu", "--eye", "0,0,4", "--target", "0,0,0", "--plan"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    (layers,) = read_image(tmp_path / "t.exr")
    picture = read_png(tmp_path / "t.png")
    covered = layers["A"] == 1.0
    assert covered[8, 16] and not covered[0, 0] and picture.shape == (17, 33, 4)
    assert np.allclose(layers["Z"][covered], 4.0, rtol=1e-6) and np.isposinf(layers["Z"][~covered]).all()
    assert picture[8, 16, :3].min() > 0 and "raster" in result.stdout
