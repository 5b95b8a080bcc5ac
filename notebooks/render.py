"""Render every notebook: NAME.py (the source) -> NAME.ipynb, run from top to bottom, with its outputs.

The same source on the same machine gives the same bytes: cells are numbered, timing is left out. An output picture of
a cell tagged `save-NAME` also goes to results/NAME.png, for the README and the docs. If a cell fails, nothing is
written.

A script with cells tagged `solution` gives two notebooks. NAME.ipynb is the student's: without these cells, and not
run. NAME_solutions.ipynb is without the cells tagged `student`, and run.

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
WIDGET = "application/vnd.jupyter.widget-view+json"


def sources() -> list[Path]:
    """The notebooks' scripts: all but this one."""
    return sorted(path for path in NOTEBOOKS.glob("*.py") if path != Path(__file__))


def convert(source: Path) -> dict[Path, nbformat.NotebookNode]:
    """The script as a notebook without outputs, or as two, by their paths; the last one is to be run."""
    if not any("solution" in tags(cell) for cell in jupytext.read(source).cells):
        return {source.with_suffix(".ipynb"): without(source, "")}
    solutions = source.with_name(f"{source.stem}_solutions.ipynb")
    return {source.with_suffix(".ipynb"): without(source, "solution"), solutions: without(source, "student")}


def without(source: Path, tag: str) -> nbformat.NotebookNode:
    """The script as a notebook that leaves out the cells with a tag."""
    notebook = jupytext.read(source)
    notebook.cells = [cell for cell in notebook.cells if tag not in tags(cell)]
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number:02}"
        if "folded" in tags(cell):
            cell.metadata["jupyter"] = {"source_hidden": True}  # JupyterLab folds it
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return notebook


def tags(cell: nbformat.NotebookNode) -> list[str]:
    """The tags of a cell."""
    return cell.metadata.get("tags", [])


def render(source: Path) -> list[Path]:
    """Run one notebook and write it beside its script, with the student's version and the pictures that it saves."""
    notebooks = convert(source)
    notebook = list(notebooks.values())[-1]
    metadata = copy.deepcopy(notebook.metadata)
    NotebookClient(
        notebook,
        timeout=3600,
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": NOTEBOOKS}},
        extra_arguments=["--log-level=ERROR"],  # the kernel warns of its own way to talk to this process
    ).execute()
    notebook.metadata = metadata  # without the versions that the run has put in
    for cell in notebook.cells:
        if "outputs" in cell:  # a widget lives only as long as its kernel
            cell.outputs = [output for output in cell.outputs if WIDGET not in output.get("data", {})]
        for tag in (tag for tag in tags(cell) if tag.startswith("save-")):
            pictures = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", {})]
            (RESULTS / f"{tag.removeprefix('save-')}.png").write_bytes(base64.b64decode(pictures[0]))
    for target, notebook in notebooks.items():
        nbformat.write(notebook, target)
    return list(notebooks)


if __name__ == "__main__":
    names = sys.argv[1:]
    if unknown := set(names) - {path.stem for path in sources()}:
        sys.exit(f"no such notebook: {', '.join(sorted(unknown))}")
    for path in sources():
        if not names or path.stem in names:
            print(f"rendering {path.name} ...", flush=True)
            for target in render(path):
                print(f"the result is {target}: open it in Jupyter, VS Code or any viewer of notebooks")
