"""The pass of docs/custom-pass.md for the bench `effects`: what is timed is what the page prints."""

from __future__ import annotations

import functools
from typing import Any

from .record import ROOT

__all__ = ["PAGE", "make_fog"]

PAGE = ROOT / "docs" / "custom-pass.md"


@functools.cache
def _definitions() -> dict[str, Any]:
    """Run the page's example up to where it builds its scene."""
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition("```python\n")
    code = rest.partition("```")[0].partition("\nscene = ")[0]
    # Lines keep their numbers and the code its file: Warp reads a kernel's source where the page has it.
    namespace: dict[str, Any] = {"__name__": __name__}
    exec(compile("\n" * (before.count("\n") + 1) + code, str(PAGE), "exec"), namespace)
    return namespace


def make_fog() -> Any:
    """Make the pass as the page does."""
    return _definitions()["Fog"](color=(0.5, 0.6, 0.7), density=0.05)
