"""Imports the folder `bench` for tests: the root is off the path, where it would hide the installed package."""

import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

if "bench" not in sys.modules:
    path = ROOT / "bench" / "__init__.py"
    spec = importlib.util.spec_from_file_location("bench", path, submodule_search_locations=[str(path.parent)])
    sys.modules["bench"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["bench"])
