"""What a pass is: it names what it reads and writes, says when it is called for, prepares once, launches every frame.

A pass is bound to a request and lives with its plan. `writes` names the buffers it fills with their element type and
count; the plan allocates them, shares memory between those whose lives do not overlap, and verifies that every name a
pass reads is written by an earlier one. The HDR image is a chain: a pass says what it does with it (`image`), and the
planner gives it the names of the channels (`source`, `target`); `image.py` has the format. A pass of a user's own is
a subclass like any other, see docs/custom-pass.md.
"""

from __future__ import annotations

import abc
import copy
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from ..debug_views import DEBUG_VIEWS
from ..features import Features
from ..settings import Settings
from ..views import ViewLayout, ViewSize

if TYPE_CHECKING:
    import warp as wp

    from ..resources import Resources

__all__ = ["LIT_OUTPUTS", "Buffer", "Lens", "Pass", "Request"]

#: Outputs that hold light.
LIT_OUTPUTS = ("color", "display", "diffuse", "specular", "light_count")


@dataclasses.dataclass(frozen=True)
class Lens:
    """What the lenses of the cameras call for; true if any camera of the batch has it.

    Attributes:
        aperture: An opening wider than a pinhole.
        shutter: A shutter that stays open.
        bloom: A lens that scatters light.
    """

    aperture: bool = False
    shutter: bool = False
    bloom: bool = False

    @classmethod
    def of(cls, flags: int) -> Lens:
        """Read the bits of `Camera.lens_flags`, of one camera or of several joined by `|`."""
        return cls(bool(flags & 1), bool(flags & 2), bool(flags & 4))


@dataclasses.dataclass(frozen=True)
class Request:
    """Everything that selects a plan; equal requests share one.

    Attributes:
        outputs: Names asked for.
        sizes: Size of each view.
        settings: All settings.
        features: What the scene declares.
        pairs: (view, instance) pairs the buffers hold.
        candidates: (view, cluster) entries the work list holds.
        instances_per_view: Most instances a view may see.
        clusters_per_view: Most cluster slots a view may see.
        scene_key: Identity of the device scene the structs point to.
        threads: Host threads on the CPU; 0 on CUDA.
        share_memory: Let buffers whose lives do not overlap share memory.
        lens: What the cameras' lenses call for.
        passes: The user's own passes, in order; compared as they compare themselves, by identity unless they say how.
        moving: What is declared to move, in words; empty where nothing is or no shutter is open.
        hidden: Outputs that only those passes or a debug view read: made, and not shown in frames.
        shadow_slots: Shadow maps: the last views, of depth only.
    """

    outputs: frozenset[str]
    sizes: tuple[ViewSize, ...]
    settings: Settings
    features: Features
    pairs: int
    candidates: int
    instances_per_view: int
    clusters_per_view: int
    scene_key: int
    threads: int
    share_memory: bool = True
    lens: Lens = Lens()
    passes: tuple[Pass, ...] = ()
    hidden: frozenset[str] = frozenset()
    shadow_slots: int = 0
    moving: str = ""

    @property
    def cameras(self) -> int:
        """Views that the caller asked for."""
        return len(self.sizes) - self.shadow_slots

    @property
    def lit(self) -> bool:
        """Whether something that holds light is wanted."""
        view = DEBUG_VIEWS.get(self.settings.display.view)
        unlit = {"display"} if view is not None and not view.lit else set()
        wanted = self.outputs - unlit
        return any(name in wanted for name in LIT_OUTPUTS) or any(stage.image for stage in self.passes)


@dataclasses.dataclass(frozen=True)
class Buffer:
    """A flat device array a pass writes: element type, count, and whether it keeps its memory to the frame's end."""

    dtype: Any
    count: int
    lasting: bool = False
    #: It keeps its memory, and so what it holds, from frame to frame.
    persistent: bool = False
    #: Its memory must be free one pass earlier already: its pass clears it beside the pass before.
    early: bool = False
    #: Element type users see, where kernels see another one of the same size.
    public: Any = None
    #: It carries its content from one sample to the next, so nothing may share its memory during the sample part.
    carried: bool = False


class Pass(abc.ABC):
    """One stage of the frame; of its methods only `run` has to be written."""

    #: Name in plans, settings and benches.
    name: ClassVar[str]
    #: One line for `explain`.
    doc: ClassVar[str] = ""
    #: What it does with the HDR image: begins the chain, turns `source` into `target`, rewrites it in place, reads it.
    image: ClassVar[Literal["", "write", "turn", "rewrite", "read"]] = ""
    #: When it runs where a frame takes several samples a pixel: once before them, in each, or once after them. A user's
    #: own pass runs in no earlier part than the pass it comes after, whatever it says.
    #: `accumulate` and `average` are the mechanism's own: last in each sample, and first after them.
    scope: ClassVar[Literal["frame_start", "sample", "accumulate", "average", "frame_end"]] = "sample"
    #: Name of the pass it comes after; read of a user's own passes only.
    after: str = "shade"
    #: Names of passes that may run at the same time on CUDA where they come right behind it: they and it read nothing
    #: that the other writes, which plans check.
    beside: ClassVar[tuple[str, ...]] = ()
    #: What the device array of `active` says, in words: "some pixel exceeds the threshold".
    active_if: ClassVar[str] = ""
    #: Whether its kernels look at the array of `active` themselves and leave at once while it is 0: its launches then
    #: take no conditional node of the graph, which costs as much as some four launches that leave. Without effect on a
    #: pass that turns the image, for which a copy stands in while it is skipped.
    leaves_early: bool = False

    request: Request
    layout: ViewLayout
    #: Channel of the HDR image it reads; empty if nothing wants it.
    source: str = ""
    #: Channel of the HDR image it writes.
    target: str = ""

    def bound(self, request: Request, layout: ViewLayout) -> Pass:
        """Return a copy that belongs to a plan."""
        stage = copy.copy(self)
        # A user's pass may be a frozen dataclass, which is the shortest way to compare by parameters.
        object.__setattr__(stage, "request", request)
        object.__setattr__(stage, "layout", layout)
        return stage

    def called_for(self) -> str | None:
        """Reason why the scene, the cameras or the settings call for it, or None; effects' rules are in effects.py."""
        return "handed in with passes="

    def why_not(self) -> str:
        """Reason why it is not called for."""
        return "no output asked for needs it"

    def reads(self) -> tuple[str, ...]:
        """Names of the channels it reads, the HDR image apart."""
        return ()

    def mend(self, name: str) -> str:
        """What to do where nobody writes a channel it reads; empty for the usual advice."""
        return ""

    def writes(self) -> dict[str, Buffer]:
        """Channels it writes, the HDR image apart: name -> buffer."""
        return {}

    def rung(self) -> str:
        """Rung of its ladder, or an empty text."""
        return ""

    def prepare(self, resources: Resources) -> None:
        """Fetch kernels and build structs; may allocate what no other pass sees."""
        # A pass of module-level kernels has nothing to build.
        return

    @abc.abstractmethod
    def run(self, resources: Resources) -> None:
        """Add the launches to the program, in algorithm order."""

    def active(self, resources: Resources) -> wp.array | None:
        """Device array of one int32: what `run` added is skipped while it is 0. None: it always runs.

        It must be written by an earlier pass of the frame. A pass that turns the image is replaced by a copy of it
        while it is skipped; other channels it writes keep what they held, so whoever reads them reads the array, too.
        At most two passes of a plan may have one, and on CUDA their launches run one after another; those that
        `leaves_early` is true of do not count.
        """
        return None

    def bytes_moved(self) -> int:
        """Fewest bytes the pass must move through memory for one frame."""
        return 0
