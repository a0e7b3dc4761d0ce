"""Which passes a plan runs, in which order, and why: core passes, effects and the user's own, as one frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from . import effects
from .channels import OUTPUTS
from .checks import check_choice, input_error
from .debug_views import DEBUG_VIEWS
from .errors import Error
from .passes.base import Buffer, Pass, Request
from .passes.image import all_reads, all_writes, link_images
from .views import ViewLayout

__all__ = ["PassReport", "check_passes", "select", "verify", "with_passes"]

#: Order of the scopes in a frame of several samples.
ORDER = {"frame_start": 0, "sample": 1, "accumulate": 2, "average": 3, "frame_end": 4}


@dataclasses.dataclass(frozen=True)
class PassReport:
    """One line of `explain`."""

    name: str
    runs: bool
    reason: str
    rung: str
    milliseconds: float | None = None
    bytes: int | None = None
    #: Whether the device let the last frame run it; None for a pass without such a condition.
    active: bool | None = None


@dataclasses.dataclass
class _Entry:
    """A place in the frame: a pass that may run, or an effect that is not called for and was not imported."""

    name: str
    reason: str
    stage: Pass | None = None
    #: What it was put behind; None for the passes every frame is made of.
    after: str | None = None
    #: Whether it stays although nobody reads what it writes: the user's own pass.
    asked: bool = False
    quiet: bool = False


def select(request: Request, layout: ViewLayout, core: Sequence[type[Pass]]) -> tuple[list[Pass], list[PassReport]]:
    """Keep what is called for and wanted, in the order it runs, and report on every pass.

    From the outputs asked for, backwards: a pass stays if something it writes is read by a pass that stays or was
    asked for. A user's own pass was asked for itself.

    Args:
        request: What is to be rendered.
        layout: Where views lie.
        core: The passes every frame is made of, in frame order.
    """
    entries = _frame(request, layout, core)
    if any(e.stage is not None and e.stage.scope == "accumulate" for e in entries):
        entries.sort(key=lambda e: ORDER[e.stage.scope if e.stage is not None else "sample"])
    link_images([e.stage for e in entries if e.stage is not None])
    needed = set(request.outputs)
    kept: list[Pass] = []
    reports: list[PassReport] = []
    for entry in reversed(entries):
        stage = entry.stage
        if stage is not None and (entry.asked or set(all_writes(stage)) & needed):
            kept.append(stage)
            needed |= set(all_reads(stage))
            reports.append(PassReport(entry.name, True, entry.reason, stage.rung(), bytes=stage.bytes_moved()))
        elif not entry.quiet:
            reason = entry.reason if stage is None else "no output asked for reads what it writes"
            reports.append(PassReport(entry.name, False, reason, "off"))
    return kept[::-1], reports[::-1]


def _frame(request: Request, layout: ViewLayout, core: Sequence[type[Pass]]) -> list[_Entry]:
    """Every pass in frame order, effects and the user's own behind the pass they name."""
    entries: list[_Entry] = []
    for kind in core:
        entries.append(_entry(kind().bound(request, layout)))
    for effect in effects.EFFECTS:
        verdict = effect.verdict(request)
        stage = effect.load()().bound(request, layout) if verdict.runs else None
        entry = _Entry(effect.name, verdict.reason, stage, effect.after, quiet=effect.quiet)
        if effect.before:
            place = next((k for k, e in enumerate(entries) if e.name == effect.before), len(entries))
            entries.insert(place, dataclasses.replace(entry, after=None))
        else:
            _insert(entries, entry)
    for given in request.passes:
        entry = _entry(given.bound(request, layout))
        _insert_own(entries, dataclasses.replace(entry, after=given.after, asked=True))
    return entries


def _entry(stage: Pass) -> _Entry:
    reason = stage.called_for()
    return _Entry(stage.name, reason or stage.why_not(), stage if reason else None)


def _insert_own(entries: list[_Entry], entry: _Entry) -> None:
    """Put a user's own pass behind the pass it names, in the part of the frame it says, but no earlier part than that.

    Which part a pass belongs to is known from its place, be it called for or not, and in frames of one sample as well:
    so passes come in the same order whether a frame takes one sample a pixel or several.
    """
    names = [e.name for e in entries]
    named, average = names.index(entry.after), names.index("average")
    if entry.stage is not None:
        other, scope = entries[named], entry.stage.scope
        begins = other.name in ("points", "start_samples") or getattr(other.stage, "scope", "") == "frame_start"
        if named >= average:
            scope = "frame_end"
        elif scope == "frame_start" and not begins:
            scope = "sample"
        # A user's pass may be a frozen dataclass.
        object.__setattr__(entry.stage, "scope", scope)
    place = _place(entries, entry)
    late = entry.stage is not None and entry.stage.scope == "frame_end"
    entries.insert(max(place, average + 1) if late else place, entry)


def _insert(entries: list[_Entry], entry: _Entry) -> None:
    entries.insert(_place(entries, entry), entry)


def _place(entries: list[_Entry], entry: _Entry) -> int:
    """Where to put an entry: behind the pass it names and what was put there before and runs in no later part."""
    place = next((k + 1 for k, e in enumerate(entries) if e.name == entry.after), len(entries) if entry.after else 0)
    passed = {entry.after}
    while place < len(entries) and entries[place].after in passed and not _later(entries[place], entry):
        passed.add(entries[place].name)
        place += 1
    return place


def _later(one: _Entry, other: _Entry) -> bool:
    """Whether the first runs in a later part of the frame than the second."""
    return one.stage is not None and other.stage is not None and ORDER[one.stage.scope] > ORDER[other.stage.scope]


def check_passes(passes: Any, core: Sequence[type[Pass]]) -> tuple[Pass, ...]:
    """Return a user's own passes as objects; a class is made without arguments.

    Raises:
        InputError: If one is no pass, bears a name that is taken, or names a pass that is not there to come after.
    """
    names = [kind.name for kind in core] + [effect.name for effect in effects.EFFECTS]
    result: list[Pass] = []
    for k, given in enumerate(passes):
        label = f"Renderer.passes[{k}]"
        stage = given() if isinstance(given, type) and issubclass(given, Pass) else given
        if not isinstance(stage, Pass):
            raise input_error(label, "a warp_deferred.Pass, or a class of them", given)
        name = getattr(stage, "name", None)
        if not isinstance(name, str) or not name.isidentifier() or name in names:
            mend = f"taken are {', '.join(names)}"
            raise input_error(f"{label}.name", "a name of its own, such as 'vignette'", name, mend)
        check_choice(f"{label}.after", stage.after, names)
        check_choice(f"{label}.image", stage.image, ("", "turn", "rewrite", "read"))
        check_choice(f"{label}.scope", stage.scope, ("frame_start", "sample", "frame_end"))
        names.append(name)
        result.append(stage)
    return tuple(result)


def with_passes(request: Request, passes: tuple[Pass, ...]) -> Request:
    """Add a user's own passes; outputs that they or a debug view read are made as if they were asked for."""
    read: set[str] = set()
    if passes:
        request = dataclasses.replace(request, passes=passes)
        layout = ViewLayout(request.sizes, 16)
        read = {name for stage in passes for name in stage.bound(request, layout).reads() if name in OUTPUTS}
    view = DEBUG_VIEWS.get(request.settings.display.view)
    if view is not None and "display" in request.outputs:
        read |= {name for name in view.reads if name in OUTPUTS}
    return dataclasses.replace(request, outputs=request.outputs | read, hidden=frozenset(read - request.outputs))


def verify(stages: Sequence[Pass], outputs: frozenset[str]) -> None:
    """Check that every channel read or asked for is written, and by earlier passes that agree what it is.

    Raises:
        Error: If not; names the pass, the channel and the mend.
    """
    writers: dict[str, list[Pass]] = {}
    for stage in stages:
        for name in all_writes(stage):
            writers.setdefault(name, []).append(stage)
    written: dict[str, Buffer] = {}
    for stage in stages:
        sums = stage.scope in ("accumulate", "average")
        if stage.image in ("turn", "rewrite", "read") and not stage.source and not sums:
            raise Error(_unread(stage, "", []))
        for name in all_reads(stage):
            if name not in written:
                raise Error(_unread(stage, name, writers.get(name, []), sorted(written)))
        for name, buffer in all_writes(stage).items():
            known = written.setdefault(name, buffer)
            if (known.dtype, known.count) != (buffer.dtype, buffer.count):
                raise Error(
                    f"{type(stage).__name__} writes {name!r}: expected {known.count} elements of {known.dtype}, as the "
                    f"pass before it, got {buffer.count} of {buffer.dtype}; give the channel another name"
                )
    missing = outputs - set(written)
    if missing:
        raise Error(f"outputs: expected names some pass writes, got {sorted(missing)}; leave them out")


def _unread(stage: Pass, name: str, later: list[Pass], known: Sequence[str] = ()) -> str:
    """Say that nobody writes a channel, or the HDR image where there is no name, in time."""
    special, mend = stage.mend(name), "add the pass or ask for another output"
    if later and ORDER[later[0].scope] > ORDER[stage.scope]:
        mend = f"{later[0].name} writes it once all samples are taken: set scope = 'frame_end'"
    elif later:
        mend = f"{later[0].name} writes it later: set after = {later[0].name!r}"
    elif special:
        mend = special
    elif known:
        mend += f"; written before it are {', '.join(known)}"
    what = repr(name) if name else "the image"
    return f"{type(stage).__name__} reads {what}: expected an earlier pass that writes it, got none; {mend}"
