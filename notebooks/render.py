"""Render every notebook: NAME.py (the source) -> NAME.ipynb, run from top to bottom, with its outputs.

The same source on the same machine gives the same bytes: cells are numbered, timing is left out. An output picture of
a cell tagged `save-NAME` also goes to results/NAME.png, where the README shows it. If a cell fails, nothing is
written.

    python notebooks/render.py [NAME ...]
"""

import base64
import copy
import sys
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent
RESULTS = NOTEBOOKS.parent / "results"


def sources() -> list[Path]:
    """The notebooks' scripts: all but this one."""
    return sorted(path for path in NOTEBOOKS.glob("*.py") if path != Path(__file__))


def convert(source: Path) -> nbformat.NotebookNode:
    """The script as a notebook without outputs."""
    notebook = jupytext.read(source)
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number:02}"
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return notebook


def render(source: Path) -> Path:
    """Run one notebook and write it beside its script, and the pictures that it saves."""
    notebook = convert(source)
    metadata = copy.deepcopy(notebook.metadata)
    NotebookClient(
        notebook, timeout=1200, record_timing=False, coalesce_streams=True, resources={"metadata": {"path": NOTEBOOKS}}
    ).execute()
    notebook.metadata = metadata  # without the versions that the run has put in
    for cell in notebook.cells:
        for tag in (tag for tag in cell.metadata.get("tags", []) if tag.startswith("save-")):
            pictures = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", {})]
            (RESULTS / f"{tag.removeprefix('save-')}.png").write_bytes(base64.b64decode(pictures[0]))
    target = source.with_suffix(".ipynb")
    nbformat.write(notebook, target)
    return target


if __name__ == "__main__":
    names = sys.argv[1:]
    if unknown := set(names) - {path.stem for path in sources()}:
        sys.exit(f"no such notebook: {', '.join(sorted(unknown))}")
    for path in sources():
        if not names or path.stem in names:
            print(f"rendering {path.name} ...", flush=True)
            print(f"the result is {render(path)}: open it in Jupyter, VS Code or any viewer of notebooks")
