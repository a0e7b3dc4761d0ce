"""The float64 twin: the tests' reference renderer, which knows no tiles, no codecs and no shortcuts, as a ladder's top.

It is read from `tests/`, beside which the benches stand, and imports nothing of the package; it has no shadows and no
effects, so that ladders of light against it leave them out.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np

from warp_deferred import Scene
from warp_deferred.errors import LoadError

__all__ = ["twin_outputs"]

TESTS = Path(__file__).resolve().parents[1] / "tests"


def twin_outputs(scene: Scene, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Render the scene's camera in float64: outputs by their names, (height, width) or (height, width, 3).

    Raises:
        LoadError: If the tests are not there.
    """
    if not (TESTS / "reference_bridge.py").is_file():
        raise LoadError(f"{TESTS}: expected the float64 renderer of the tests, got no such file; run in a checkout")
    if str(TESTS) not in sys.path:
        sys.path.append(str(TESTS))
    return importlib.import_module("reference_bridge").render_reference(scene, None, *size, edges=False)
