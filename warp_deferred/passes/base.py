"""What a pass is: it names what it reads and writes, says when it is called for, prepares once, launches every frame.

A pass is made for a request and lives with its plan. `channels` names the buffers it writes with their element type
and count; the plan allocates them, shares memory between those whose lives do not overlap, and verifies that every
name a pass reads is written by an earlier one.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

from ..features import Features
from ..settings import Settings
from ..views import ViewLayout, ViewSize

if TYPE_CHECKING:
    from ..resources import Resources

__all__ = ["Buffer", "Pass", "Request"]


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
    shadow_slots: int = 0

    @property
    def cameras(self) -> int:
        """Views that the caller asked for."""
        return len(self.sizes) - self.shadow_slots


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


class Pass(abc.ABC):
    """One stage of the frame."""

    #: Name in plans, settings and benches.
    name: ClassVar[str]
    #: One line for `explain`.
    doc: ClassVar[str]

    def __init__(self, request: Request, layout: ViewLayout) -> None:
        self.request, self.layout = request, layout

    @abc.abstractmethod
    def called_for(self) -> str | None:
        """Reason why the scene, the cameras or the settings call for the pass, or None."""

    @abc.abstractmethod
    def reads(self) -> tuple[str, ...]:
        """Names of the channels it reads."""

    @abc.abstractmethod
    def writes(self) -> dict[str, Buffer]:
        """Channels it writes: name -> buffer."""

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

    def bytes_moved(self) -> int:
        """Fewest bytes the pass must move through memory for one frame."""
        return 0
