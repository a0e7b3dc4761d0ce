"""The command line: render, explain, compare, scenes.

Heavy modules (Warp, OpenImageIO, loaders) are imported inside the commands, so that `--help` and a typing mistake
answer at once. Reports meant for programs (`--json`) are all that goes to stdout; notes and progress go to stderr.
Exit codes: 0 done, 1 images differ, 2 an error in what was asked, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .errors import Error, LoadError

if TYPE_CHECKING:
    from .scene import Scene
    from .settings import Settings

__all__ = ["main"]

app = typer.Typer(
    name="warp-deferred",
    help="Render lit images, depth, normals and ids from a model file or a built-in scene.",
    epilog="Start here: [bold]warp-deferred scenes[/] lists what can be rendered without any file.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)

Input = Annotated[
    str, typer.Argument(metavar="INPUT", help="A .glb, .gltf, .obj, .ply, .stl or .toml file, or a built-in scene.")
]
Size = Annotated[str, typer.Option("--size", metavar="WxH", help="Size of the picture in pixels.")]
Device = Annotated[
    str | None, typer.Option("--device", metavar="D", help="cpu, cuda:0, ...; left out: cuda:0 if there is one.")
]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="STAGE.FIELD=VALUE", help="Change a setting; may be repeated."),
]
Preset = Annotated[
    str | None,
    typer.Option("--preset", metavar="NAME", help="draft, balanced, high or reference; --set goes before it."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON on stdout, and nothing else there.")]


def _examples(*lines: str) -> str:
    """Lay out an epilog: one example a line, which rich keeps apart only with blank lines between."""
    return "\n\n".join(["[bold]Examples[/]", *(line.replace("[", r"\[") for line in lines)])


@app.command(
    epilog=_examples(
        "warp-deferred render hundred_lights -o hall.png",
        "warp-deferred render helmet.glb -o helmet.png -o helmet.exr --layers normal,albedo,instance_id",
        "warp-deferred render duck.glb -o duck.png --size 640x360 --eye 0,1.5,4 --target 0,0.8,0",
        "warp-deferred render 'terrain?triangles=20000' -o terrain.png --set display.tone_mapping=aces",
        "warp-deferred render hundred_lights -o tiles.png --view tiles",
        "warp-deferred render hundred_lights -o hall.png --budget-ms 1.0",
        "warp-deferred render hundred_lights -o out/hall.%04d.png --frames 0:120 --fps 30",
    )
)
def render(
    source: Input,
    out: Annotated[
        list[str],
        typer.Option(
            "--out", "-o", metavar="OUT", help="File to write: .png (picture) or .exr (linear layers); may be repeated."
        ),
    ],
    size: Size = "1280x720",
    device: Device = None,
    set_: Sets = None,
    layers: Annotated[
        str | None,
        typer.Option("--layers", metavar="A,B", help="Outputs the .exr keeps beside color, alpha and depth."),
    ] = None,
    camera: Annotated[
        str | None, typer.Option("--camera", metavar="N|NAME", help="Which of the scene's cameras: number or name.")
    ] = None,
    eye: Annotated[
        str | None, typer.Option("--eye", metavar="X,Y,Z", help="Stand here, in metres; needs --target.")
    ] = None,
    target: Annotated[
        str | None, typer.Option("--target", metavar="X,Y,Z", help="Look at this point, in metres.")
    ] = None,
    vertical_fov_deg: Annotated[
        float | None, typer.Option("--vertical-fov-deg", metavar="F", help="Vertical angle of view in degrees.")
    ] = None,
    exposure: Annotated[
        float | None, typer.Option("--exposure", metavar="EV", help="Brighten the picture by 2^EV; the .exr stays.")
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option("--frames", metavar="A:B", help="Render frames A to B-1; OUT needs %04d or {frame} in its name."),
    ] = None,
    fps: Annotated[float, typer.Option("--fps", metavar="F", help="Frames per second: time = frame / F.")] = 30.0,
    view: Annotated[
        str | None,
        typer.Option("--view", metavar="NAME", help="Show a buffer in the .png: normal, depth, tiles, wireframe, ..."),
    ] = None,
    check_finite: Annotated[
        bool, typer.Option("--check-finite", help="Fail where a pass writes NaN or Inf; names pass, output, pixel.")
    ] = False,
    preset: Preset = None,
    budget_ms: Annotated[
        float | None,
        typer.Option("--budget-ms", metavar="F", help="Buy the accuracy that a frame of F ms allows, and tell what."),
    ] = None,
    max_error: Annotated[
        float | None,
        typer.Option("--max-error", metavar="E", help="Buy the fastest frame off by at most E (RMSE, such as 0.02)."),
    ] = None,
    no_cache: Annotated[
        bool, typer.Option("--no-cache", help="Measure prices for the budget anew, and keep none.")
    ] = False,
    plan: Annotated[bool, typer.Option("--plan", help="Print what runs, why, and what it costs.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Render a scene to picture files."""
    from . import cli_arguments as arguments
    from .checks import check_range

    started = time.perf_counter()
    width, height = arguments.parse_size(size)
    wanted_frames = arguments.parse_frames(frames) if frames is not None else None
    rate = check_range("--fps", fps, 1e-6, unit="frames per second")
    files = arguments.check_outs(out, moving=wanted_frames is not None)
    outputs = arguments.wanted_outputs(files, arguments.parse_layers(layers))
    if view is not None:
        set_ = [*(set_ or ()), f"display.view={arguments.check_view(view, outputs)}"]
    arguments.check_wishes(budget_ms, max_error, preset, view, outputs)
    points = arguments.parse_points(eye, target)
    scene, settings, chosen = _open(source, set_, device, quiet, preset)
    if wanted_frames is not None:
        arguments.check_moves(scene, source)
    scene.camera = arguments.choose_camera(scene, camera, *points, vertical_fov_deg, exposure)
    if check_finite:
        settings = settings.replace(check_finite=True)

    from .renderer import Renderer

    if budget_ms is not None or max_error is not None:
        settings = _buy(
            scene, quiet, budget_ms=budget_ms, max_error=max_error, width=width, height=height, device=chosen,
            outputs=outputs, settings=settings, cache=not no_cache,
            time_s=wanted_frames[0] / rate if wanted_frames is not None else 0.0,
        )  # fmt: skip
    renderer = Renderer(scene, width=width, height=height, device=chosen, outputs=outputs, settings=settings)
    _prepare(renderer, quiet)
    ready = time.perf_counter()
    written = _write(renderer, files, wanted_frames, rate, quiet)
    done = time.perf_counter()
    if quiet:
        return
    if plan:
        typer.echo(str(renderer.explain()))
    names = ", ".join(map(str, written)) if len(written) <= 4 else f"{written[0]} ... {written[-1]}"
    if view is not None:
        typer.echo(arguments.view_legend(view))
    typer.echo(
        f"wrote {names} ({width}x{height}, {chosen}): {ready - started:.1f} s to load and compile, "
        f"{done - ready:.2f} s to render and write"
    )


def _buy(scene: Scene, quiet: bool, **wishes: Any) -> Settings:
    """Have settings bought for a budget, and tell what was bought."""
    from .fitting import fit

    with _bar("measuring", quiet) as advance:
        bought = fit(scene, progress=advance, **wishes)
    if not quiet:
        typer.echo(str(bought))
    return bought.settings


def _write(renderer: Any, files: list[Path], frames: range | None, rate: float, quiet: bool) -> list[Path]:
    """Render one frame, or each of several at its own time, into the files; returns those written."""
    from .cli_arguments import frame_path

    written, scene = [], renderer.scene
    if scene.animate is not None and (scene.camera.shutter > 0.0 or "motion" in renderer.outputs):
        first = frames[0] if frames is not None else 0  # nothing moves in it unless a frame comes before
        scene.animate(scene, (first - 1) / rate)
        renderer.render()
        scene.animate(scene, first / rate)
    if frames is None:
        frame = renderer.render()
        for file in files:
            written += frame.save(file)
        return written
    for number in _track(frames, "rendering", quiet):
        scene.animate(scene, number / rate)
        frame = renderer.render()
        for file in files:
            written += frame.save(frame_path(file, number))
    return written


@app.command(
    epilog=_examples(
        "warp-deferred explain hundred_lights",
        "warp-deferred explain truck.glb --device cpu --set light_culling.rung=brute_force",
        "warp-deferred explain truck.glb --layers depth,normal --json --no-measure",
    )
)
def explain(
    source: Input,
    size: Size = "1280x720",
    device: Device = None,
    set_: Sets = None,
    preset: Preset = None,
    layers: Annotated[
        str | None, typer.Option("--layers", metavar="A,B", help="Outputs asked for; left out: display.")
    ] = None,
    as_json: Json = False,
    measure: Annotated[bool, typer.Option("--measure/--no-measure", help="Whether to time each pass.")] = True,
    memory: Annotated[bool, typer.Option("--memory", help="Print the memory of every buffer, too.")] = False,
) -> None:
    """Tell which passes a scene calls for, why, and what each costs."""
    from . import cli_arguments as arguments

    width, height = arguments.parse_size(size)
    outputs = arguments.parse_layers(layers) or ("display",)
    scene, settings, chosen = _open(source, set_, device, quiet=True, preset=preset)

    from .renderer import Renderer

    renderer = Renderer(scene, width=width, height=height, device=chosen, outputs=outputs, settings=settings)
    _prepare(renderer, quiet=as_json)
    explanation = renderer.explain(measure=measure)
    if as_json:
        report = explanation.to_dict()
        if memory:
            report["memory"] = renderer.memory_report().to_dict()
        typer.echo(json.dumps(report, indent=2))
        return
    typer.echo(str(explanation))
    if memory:
        typer.echo(f"\n{renderer.memory_report()}")


@app.command(
    epilog=_examples(
        "warp-deferred compare new.exr golden.exr --threshold 1e-3 --tolerance 0.0001",
        "warp-deferred compare new.png old.png --difference difference.png",
    )
)
def compare(
    actual: Annotated[str, typer.Argument(metavar="A", help="The image to judge.")],
    reference: Annotated[str, typer.Argument(metavar="B", help="What it should be.")],
    threshold: Annotated[
        float,
        typer.Option("--threshold", metavar="T", help="Largest difference a pixel may have; 1/255 = 0.0039 is a code."),
    ] = 0.0,
    tolerance: Annotated[
        float, typer.Option("--tolerance", metavar="SHARE", help="Share of pixels that may exceed it, 0 to 1.")
    ] = 0.0,
    difference: Annotated[
        str | None, typer.Option("--difference", metavar="OUT.png", help="Write an amplified picture of it.")
    ] = None,
    gain: Annotated[
        float | None, typer.Option("--gain", metavar="G", help="Factor of that picture; left out: as fits.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare two images; exit code 1 says that they differ beyond the tolerance.

    NaN, infinities out of place and ids that differ fail whatever the tolerance.
    """
    from .cli_reports import comparison_text
    from .compare import compare as compare_images
    from .compare import write_difference
    from .images import check_target, read_image

    if difference is not None and check_target(difference).suffix.lower() != ".png":
        raise LoadError(f"{difference}: expected a name that ends in .png, got {Path(difference).suffix!r}; rename it")
    first, second = read_image(actual), read_image(reference)
    result = compare_images(first, second, threshold=threshold, tolerance=tolerance)
    used = None if difference is None else write_difference(difference, first, second, gain)
    if as_json:
        typer.echo(json.dumps(result.to_dict() | {"difference_gain": used}, indent=2))
    else:
        typer.echo(comparison_text(result, actual, reference))
        if used is not None:
            typer.echo(f"wrote {difference}: difference times {used:g}")
    raise typer.Exit(0 if result.ok else 1)


@app.command(epilog=_examples("warp-deferred scenes", "warp-deferred render 'many_lights?lights=1000' -o lights.png"))
def scenes(as_json: Json = False) -> None:
    """List the built-in scenes and their parameters."""
    from .cli_reports import scene_list, scene_text

    listed = scene_list()
    typer.echo(json.dumps(listed, indent=2) if as_json else scene_text(listed))


def _open(
    source: str, sets: Sequence[str] | None, device: str | None, quiet: bool, preset: str | None = None
) -> tuple[Scene, Settings, str]:
    """Check settings and device, which is quick, then load the scene; its notes go to stderr."""
    from . import cli_arguments as arguments
    from .loading import load
    from .settings import Settings

    assignments = list(sets or ())
    fields = {} if preset is None else {"preset": preset}
    Settings(**fields).with_values(assignments)
    chosen = arguments.choose_device(device)
    with warnings.catch_warnings():
        # What a loader warns of is among the notes as well.
        warnings.simplefilter("ignore")
        scene = load(source)
    if not quiet:
        for note in scene.notes:
            typer.echo(f"note: {note}", err=True)
    return scene, scene.settings.replace(**fields).with_values(assignments), chosen


def _prepare(renderer: Any, quiet: bool) -> None:
    """Compile everything the plan needs, with a bar."""
    with _bar("compiling", quiet) as advance:
        renderer.prepare(advance)


@contextlib.contextmanager
def _bar(title: str, quiet: bool) -> Iterator[Callable[[str, int, int], None] | None]:
    """Yield a function of (name, done, total) that moves a bar on stderr, or None."""
    if quiet:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(title, total=None)

        def advance(name: str, done: int, total: int) -> None:
            progress.update(task, description=f"{title} {name}", completed=done, total=total)

        yield advance
        total = progress.tasks[0].total or 1
        progress.update(task, description=title, completed=total, total=total)


def _track(frames: range, title: str, quiet: bool) -> Iterator[int]:
    """Yield the frames while a bar moves."""
    with _bar(title, quiet) as advance:
        for done, frame in enumerate(frames):
            if advance:
                advance(f"frame {frame}", done, len(frames))
            yield frame


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    Every error of the package's own kinds and every usage error becomes one line on stderr.
    """
    try:
        result = app(args=None if argv is None else list(argv), prog_name="warp-deferred", standalone_mode=False)
        if result == 130:  # typer turns Ctrl-C into this by itself
            raise KeyboardInterrupt
        return result if isinstance(result, int) else 0
    except Error as error:
        return _fail(str(error))
    except (KeyboardInterrupt, typer.Abort):
        typer.echo("interrupted", err=True)
        return 130
    except MemoryError:
        return _fail("memory: expected enough for the images asked for, got too little; choose a smaller --size")
    except BrokenPipeError:
        # Whoever read our output has gone, as `| head` does; Python would complain once more while it closes stdout.
        sys.stderr.close()
        return 1
    except Exception as error:
        # Usage errors belong to click, which typer carries along under changing names.
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            return 2  # the help is on the screen already
        return _fail(f"{error.format_message().rstrip('.')}; see warp-deferred --help")


def _fail(message: str) -> int:
    typer.echo("error: " + " ".join(message.split()), err=True)
    return 2
