"""Writes docs/performance.md: this renderer beside others, and how time and memory grow.

No figure is typed: they are results, and so are the peers' own words, which bench/peers/ has.
"""

from __future__ import annotations

from pathlib import Path

from . import tables
from .record import Record

__all__ = ["BENCHES", "performance_page"]

#: Benches whose results the page shows, in order: heading, what the reader is told first.
BENCHES = {
    "peers": (
        "Beside others",
        "The same triangles, cameras and lights handed to each renderer in one run on one device. Times are medians of "
        "repeated frames with nothing in between; scenes, trees and textures are made before, outside the clock. What "
        "each computes differs, and is told below the tables: a ratio means something only beside that. Rows where "
        "another is faster stand like all others. OpenGL and WebGPU run on units that data-centre cards have few of: "
        "what they take there says little of a graphics card.",
    ),
    "scaling": (
        "Growth",
        "One thing is varied, the rest stays fixed. The exponent is the slope of log(time) over log(n) by least "
        "squares over the upper half of the points; the model is fixed cost + price of one more, by least squares of "
        "relative errors over all points, with the root mean square of what it is off by.",
    ),
}
INTRODUCTION = """# Performance

Written by `python -m bench report` from `bench/results/peers*.json` and `scaling*.json`; do not edit. Single passes,
effects and what accuracy costs: [benchmarks.md](benchmarks.md), [effects.md](effects.md), [accuracy.md](accuracy.md).
To measure anew:

```
pip install -e '.[peers]'      # Newton and moderngl; nvdiffrast is built from its own repository
python -m bench peers --device cuda:0 --json bench/results/peers.json --preview out/peers
python -m bench scaling --device cuda:0 --json bench/results/scaling.json
python -m bench report
```

A peer that is not there is named, with the reason, and the others are timed. A run that is interrupted leaves what is
finished in its file."""


def performance_page(records: dict[str, Record], images: Path) -> str:
    """Lay out the page.

    Args:
        records: Results of the benches of `BENCHES` by file name.
        images: Folder of the plots.
    """
    parts = [INTRODUCTION]
    for bench, (heading, text) in BENCHES.items():
        for name, record in records.items():
            if record["bench"] != bench:
                continue
            suffix = name.removeprefix(bench).strip("_-")
            parts.append(f"## {heading}{f' ({suffix})' if suffix else ''}")
            parts.append(text)
            parts.append(f"![{heading.lower()}]({images.name}/bench_{name}.png)")
            parts.append(tables.full_table(record))
            parts.append(f"Measured on {tables.provenance(record)}.")
    return "\n\n".join(parts) + "\n"
