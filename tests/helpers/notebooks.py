"""Imports notebooks/render.py, which is not in a package."""

import importlib.util
from pathlib import Path

NOTEBOOKS = Path(__file__).parent.parent.parent / "notebooks"
spec = importlib.util.spec_from_file_location("render", NOTEBOOKS / "render.py")
render = importlib.util.module_from_spec(spec)
spec.loader.exec_module(render)
