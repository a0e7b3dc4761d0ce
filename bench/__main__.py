"""Command line of the benches: `python -m bench NAME`.

Progress goes to stderr, the names of files written to stdout. Exit codes: 0 done, 1 the generated files are out of
date (`report --check`) or something got slower (`compare`), 2 an error in what was asked.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from warp_deferred.errors import Error

__all__ = ["main"]

app = typer.Typer(
    name="bench",
    help="Time frozen cases; write results as JSON, and tables and plots made from them.",
    epilog="Device times are those of CUDA graph replays; on the CPU, wall-clock times.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Device = Annotated[str, typer.Option("--device", metavar="D", help="cpu, cuda:0, ...")]
Json = Annotated[str | None, typer.Option("--json", metavar="F", help="Write the result here.")]
Plot = Annotated[str | None, typer.Option("--plot", metavar="F.png", help="Draw the result here.")]
Check = Annotated[bool, typer.Option("--check", help="Write nothing; exit with 1 if a file is out of date.")]
Quick = Annotated[bool, typer.Option("--quick", help="Small cases and few repeats: does it run?")]
Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="STAGE.FIELD=VALUE", help="Change a setting; may be repeated.")
]


def _note(text: str) -> None:
    typer.echo(f"  {text}", err=True)


def _measure(
    name: str,
    run: Callable[..., dict[str, Any]],
    device: str,
    quick: bool,
    sets: list[str] | None,
    keep_at: str | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Run a bench and return its record; with `keep_at`, what is there is written to that file as it comes."""
    import warp as wp

    from warp_deferred.errors import DeviceError
    from warp_deferred.settings import Settings

    from . import record
    from .cases import SPINE

    # Compiler and driver remarks would mix with the progress; the library leaves this to programs.
    wp.config.log_level = wp.LOG_WARNING
    changes = [
        *(SPINE if name not in ("effects", "effect_images", "accuracy", "fit", "presets") else ()),
        *(sets or ()),
    ]
    settings = Settings().with_values(changes)
    try:
        chosen = wp.get_device(device)
    except (ValueError, RuntimeError):
        known = ", ".join(str(d) for d in wp.get_devices())
        raise DeviceError(f"--device: expected one of {known}, got {device!r}; check the name") from None
    started = time.perf_counter()
    _note(f"{name} on {chosen.name}")
    head = record.header(name, chosen, quick=quick, settings=changes)
    if keep_at is not None:
        more["keep"] = lambda part: record.write(keep_at, head | part)
    with wp.ScopedDevice(chosen):
        result = head | run(chosen, quick=quick, settings=settings, note=_note, **more)
    _note(f"{len(result['rows'])} rows in {time.perf_counter() - started:.0f} s")
    return result


def _bench(
    name: str,
    device: str,
    json_path: str | None,
    plot: str | None,
    quick: bool,
    sets: list[str] | None,
    keeps: bool = True,
    **more: Any,
) -> None:
    """Run the bench of that name and write what was asked for; the table to stdout where nothing was.

    With `keeps` the bench hands over what is there as it comes; the others have their rows at the end alone.
    """
    import importlib

    from . import record, tables

    if plot is not None:
        from . import plots

        plots.check_target(plot)  # before minutes of measuring, not after
    run = importlib.import_module(f"{__package__}.{name}").run
    result = _measure(name, run, device, quick, sets, keep_at=json_path if keeps else None, **more)
    if json_path is None and plot is None:
        typer.echo(tables.full_table(result))
    if json_path is not None:
        typer.echo(f"wrote {record.write(json_path, result)}")
    if plot is not None:
        typer.echo(f"wrote {plots.draw(result, plot)}")


@app.command()
def tiles(
    device: Device = "cuda:0", json: Json = None, plot: Plot = None, quick: Quick = False, set_: Sets = None
) -> None:
    """Tile size by number of lights by resolution: culling, shading, lights per tile."""
    _bench("tiles", device, json, plot, quick, set_)


@app.command()
def triangles(
    device: Device = "cuda:0",
    json: Json = None,
    plot: Plot = None,
    quick: Quick = False,
    set_: Sets = None,
    only: Annotated[str, typer.Option("--only", metavar="CASE", help="Run this case alone, such as quads.")] = "",
) -> None:
    """Six distributions of triangles: the G-buffer, or visibility alone."""
    from warp_deferred.checks import check_choice

    from .cases import TRIANGLE_CASES

    if only:
        check_choice("--only", only, [case.name for case in TRIANGLE_CASES])
    _bench("triangles", device, json, plot, quick, set_, only=only)


@app.command()
def lights(
    device: Device = "cuda:0", json: Json = None, plot: Plot = None, quick: Quick = False, set_: Sets = None
) -> None:
    """1 to 10 000 lights of which 5, 20 and 80 reach a pixel; brute force beside."""
    _bench("lights", device, json, plot, quick, set_)


@app.command()
def frame(
    device: Device = "cuda:0",
    json: Json = None,
    plot: Plot = None,
    quick: Quick = False,
    set_: Sets = None,
    huge: Annotated[bool, typer.Option("--huge", help="Render 16384x16384 pixels, too (about 10 GB).")] = False,
) -> None:
    """Whole frames, pass by pass, as multiples of their memory floor."""
    _bench("frame", device, json, plot, quick, set_, huge=huge)


Case = Annotated[str, typer.Option("--only", metavar="CASE", help="Run this case alone, such as bloom.")]


@app.command()
def effects(
    device: Device = "cuda:0",
    json: Json = None,
    plot: Plot = None,
    quick: Quick = False,
    set_: Sets = None,
    only: Annotated[
        str, typer.Option("--only", metavar="CASE", help="Run this case alone, such as bloom; frames: whole frames.")
    ] = "",
) -> None:
    """What each rung of each effect costs and how far it is from its reference; frames with several effects."""
    _check_case(only, "frames")
    _bench("effects", device, json, plot, quick, set_, only=only)


@app.command()
def accuracy(
    device: Device = "cuda:0",
    json: Json = None,
    plot: Plot = None,
    quick: Quick = False,
    set_: Sets = None,
    only: Annotated[
        str, typer.Option("--only", metavar="LADDER", help="Climb this ladder alone, such as shadow, or shadow.pcf.")
    ] = "",
    images: Annotated[str, typer.Option("--images", metavar="DIR", help="Write strips of the errors here.")] = "",
) -> None:
    """What each rung of each ladder is off by, alone and in the picture, and what it costs."""
    from .ladders import narrowed

    narrowed(only)  # before minutes of measuring, not after
    _bench("accuracy", device, json, plot, quick, set_, only=only, images=images)


def _check_case(only: str, *more: str) -> None:
    from warp_deferred.checks import check_choice

    from .effect_cases import EFFECT_CASES

    if only:
        check_choice("--only", only, [*EFFECT_CASES, *more])


@app.command(name="effects-images")
def effects_images(
    out: Annotated[str, typer.Option("--out", "-o", metavar="DIR", help="Folder for the strips.")] = "docs/images",
    device: Device = "cuda:0",
    quick: Quick = False,
    set_: Sets = None,
    only: Case = "",
) -> None:
    """Write the rungs of each effect side by side, for docs/effects.md, and a sheet of all effects for README.md."""
    _check_case(only)
    _pictures("effect_images", out, device, quick, set_, only=only)


def _pictures(name: str, out: str, device: str, quick: bool, sets: list[str] | None, **more: Any) -> None:
    """Run a bench that writes pictures into a folder."""
    import importlib

    bench = importlib.import_module(f"{__package__}.{name}")

    def run(chosen: Any, **options: Any) -> dict[str, Any]:
        return {"rows": bench.run(chosen, Path(out), **options)}

    for path in _measure(name, run, device, quick, sets, **more)["rows"]:
        typer.echo(f"wrote {path}")


@app.command()
def host(
    device: Device = "cuda:0", json: Json = None, plot: Plot = None, quick: Quick = False, set_: Sets = None
) -> None:
    """What one `render` with a new camera costs the calling thread."""
    _bench("host", device, json, plot, quick, set_, keeps=False)


@app.command()
def guards(device: Device = "cuda:0", json: Json = None, quick: Quick = False, set_: Sets = None) -> None:
    """What the tests and clamps against bad input, which are always on, cost a frame."""
    _bench("guards", device, json, None, quick, set_, keeps=False)


@app.command()
def peers(
    device: Device = "cuda:0",
    json: Json = None,
    plot: Plot = None,
    quick: Quick = False,
    set_: Sets = None,
    only: Annotated[
        str, typer.Option("--only", metavar="CASE", help="Run cases with this in their names, such as lit_1000.")
    ] = "",
    preview: Annotated[str, typer.Option("--preview", metavar="DIR", help="Write a picture of each row here.")] = "",
) -> None:
    """Newton, OpenGL and nvdiffrast beside this renderer, on the same scenes in one run; who is missing is named."""
    from .peers.cases import narrowed

    narrowed(only, not device.startswith("cpu"), quick=quick)  # before minutes of measuring, not after
    _bench("peers", device, json, plot, quick, set_, only=only, images=preview)


@app.command()
def scaling(
    device: Device = "cuda:0",
    json: Json = None,
    plot: Plot = None,
    quick: Quick = False,
    set_: Sets = None,
    only: Annotated[str, typer.Option("--only", metavar="AXIS", help="Vary this alone, such as lights.")] = "",
) -> None:
    """How time and memory grow with triangles, lights, pixels and views; the CPU runs fewer and smaller points."""
    from warp_deferred.checks import check_choice

    from .scaling import AXES

    if only:
        check_choice("--only", only, [axis.name for axis in AXES])
    _bench("scaling", device, json, plot, quick, set_, only=only)


@app.command()
def preview(
    out: Annotated[str, typer.Option("--out", "-o", metavar="DIR", help="Folder for the pictures.")] = "out/bench",
    device: Device = "cuda:0",
    quick: Quick = False,
) -> None:
    """Write a picture of every case that is timed."""
    _pictures("preview", out, device, quick, None)


@app.command()
def report(
    check: Check = False,
    root: Annotated[str, typer.Option("--root", metavar="DIR", help="Folder of README.md, docs and results.")] = ".",
) -> None:
    """Write the tables and plots of docs/benchmarks.md and of README.md from bench/results/*.json."""
    from . import report as bench

    changed = bench.run(Path(root), check=check)
    for path in changed:
        typer.echo(f"{'out of date: ' if check else 'wrote '}{path}")
    if check and changed:
        raise typer.Exit(1)


@app.command()
def fit(device: Device = "cuda:0", json: Json = None, quick: Quick = False, set_: Sets = None) -> None:
    """How long a fit takes, whether its choice keeps the budget, and how near it is to the best there is."""
    _bench("fit", device, json, None, quick, set_)


@app.command()
def presets(
    from_: Annotated[
        str | None,
        typer.Option("--from", metavar="F.json", help="Result of `accuracy`; left out: the GPU's, or a CPU's."),
    ] = None,
    out: Annotated[str | None, typer.Option("--out", "-o", metavar="F.py", help="Write the module here.")] = None,
    check: Check = False,
    measure: Annotated[bool, typer.Option("--measure", help="Time presets on scenes, as --json does.")] = False,
    device: Device = "cuda:0",
    json: Json = None,
    quick: Quick = False,
) -> None:
    """Write `warp_deferred/presets.py` from what accuracy costs; or measure what the presets cost and leave."""
    from . import presets as bench
    from .record import ROOT

    if measure or json is not None:
        _bench("presets", device, json, None, quick, None)
        return
    changed = bench.write(ROOT, from_, None if out is None else Path(out), check=check)
    if changed is not None:
        typer.echo(f"{'out of date: ' if check else 'wrote '}{changed}")
    if check and changed is not None:
        raise typer.Exit(1)


@app.command()
def compare(
    old: Annotated[str, typer.Argument(metavar="OLD.json", help="Result to measure by.")],
    new: Annotated[str, typer.Argument(metavar="NEW.json", help="Result of the same bench on the same device.")],
    everything: Annotated[bool, typer.Option("--all", help="Show what stayed the same, too.")] = False,
    factor: Annotated[float, typer.Option("--factor", metavar="F", help="Multiply the noise by this.")] = 1.0,
) -> None:
    """What changed between two results beyond their noise; exit with 1 if something got slower."""
    from . import compare as bench
    from . import record

    result = bench.compare(record.read(old), record.read(new), factor=factor)
    typer.echo(bench.table(result, everything=everything))
    if result.count("slower"):
        raise typer.Exit(1)


@app.command()
def merge(
    files: Annotated[
        list[str], typer.Argument(metavar="A.json B.json", help="Results of one bench, older ones first.")
    ],
    json: Annotated[str, typer.Option("--json", metavar="F", help="Write the joined result here; may be one of them.")],
) -> None:
    """Join results, such as those of --only: rows of later files take the place of those of the same name."""
    from . import merge as bench
    from . import record

    typer.echo(f"wrote {record.write(json, bench.merge([record.read(name) for name in files], files))}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a bench; errors of the package's kinds and usage errors become one line on stderr."""
    try:
        result = app(args=None if argv is None else list(argv), prog_name="python -m bench", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except Error as error:
        message = str(error)
    except (KeyboardInterrupt, typer.Abort):
        message = "interrupted"
    except Exception as error:
        # Usage errors belong to click, which typer carries along under changing names.
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            return 2  # the help is on the screen already
        message = f"{error.format_message().rstrip('.')}; see python -m bench --help"
    typer.echo("error: " + " ".join(message.split()), err=True)
    return 2


if __name__ == "__main__":
    sys.exit(main())
