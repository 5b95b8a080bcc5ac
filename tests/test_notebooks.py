import base64

import nbformat
import pytest

from tests.helpers.notebooks import NOTEBOOKS, render


def rendered(source):
    return nbformat.read(source.with_suffix(".ipynb"), as_version=4)


def saved_pictures(path):
    """The pictures of the cells tagged `save-NAME`, by NAME."""
    return {
        tag.removeprefix("save-"): base64.b64decode(picture)
        for cell in nbformat.read(path, 4).cells
        for tag in cell.metadata.get("tags", [])
        if tag.startswith("save-")
        for (picture,) in [[x.data["image/png"] for x in cell.outputs if "image/png" in x.get("data", {})]]
    }


def inputs(notebook):
    return [(cell.cell_type, cell.source, cell.metadata.get("tags", [])) for cell in notebook.cells]


CONVERTED = {path: notebook for source in render.sources() for path, notebook in render.convert(source).items()}
IS_RUN = [path for source in render.sources() for path in [*render.convert(source)][-1:]]


def test_every_notebook_has_its_script():
    assert set(NOTEBOOKS.glob("*.ipynb")) == set(CONVERTED)
    assert set(CONVERTED) - set(IS_RUN) == {NOTEBOOKS / "exercises.ipynb"}


@pytest.mark.parametrize("path", CONVERTED, ids=lambda path: path.stem)
def test_the_rendered_notebook_has_the_cells_of_its_script(path):
    assert inputs(nbformat.read(path, 4)) == inputs(CONVERTED[path]), f"run: make notebook ({path.name} is stale)"


@pytest.mark.parametrize("path", IS_RUN, ids=lambda path: path.stem)
def test_the_rendered_notebook_is_whole_quiet_and_small(path):
    cells = [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    assert path.stat().st_size < 1_500_000


def test_the_main_notebook_shows_a_solved_run_and_a_moving_pole():
    path = NOTEBOOKS / "deep_q_network.ipynb"
    cells = nbformat.read(path, 4).cells
    assert any("Solved with" in output.get("text", "") for cell in cells for output in cell.get("outputs", []))
    assert set(saved_pictures(path)) == {"rewards", "pole"}
    assert b"acTL" in saved_pictures(path)["pole"][:200]  # the chunk that marks an animated PNG


@pytest.mark.parametrize("path", IS_RUN, ids=lambda path: path.stem)
def test_a_picture_in_results_is_the_notebooks(path):
    for name, picture in saved_pictures(path).items():
        assert (NOTEBOOKS.parent / "results" / f"{name}.png").read_bytes() == picture, f"run: make notebook ({name})"


def test_every_picture_that_is_compared_is_saved_by_one_notebook():
    names = [name for path in IS_RUN for name in saved_pictures(path)]
    assert len(names) == len(set(names)) >= 8


def test_the_rendered_notebook_does_not_depend_on_the_python_that_rendered_it():
    assert rendered(NOTEBOOKS / "deep_q_network.py").metadata["language_info"] == {"name": "python"}


@pytest.mark.slow
def test_a_cell_that_is_run_twice_does_no_harm(capsys, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(NOTEBOOKS)
    cells = [cell.source for cell in rendered(NOTEBOOKS / "deep_q_network.py").cells if cell.cell_type == "code"]
    assert sum("config = Config()" in cell for cell in cells) == 1
    cells = [cell.replace("Config()", "Config(solved_reward=120)") for cell in cells]  # for shorter runs
    namespace, lines = {}, []
    for cell in cells[: next(i for i, cell in enumerate(cells) if "sweep(" in cell)]:
        for _ in range(2):
            exec(compile(cell, "notebook", "exec"), namespace)
        lines += [line for line in capsys.readouterr().out.splitlines() if line.startswith("Solved")]
    assert len(lines) == 2
    assert lines[::2] == lines[1::2]


SCRIPT = """# %% tags=["student"]
# your code here

# %% tags=["solution"]
answer = 42

# %% tags=["save-line"]
import matplotlib.pyplot as plt

_ = plt.plot([1, 2])

# %%
import ipywidgets
from IPython.display import display

display(ipywidgets.FloatSlider())
print(answer)
"""


@pytest.mark.slow
def test_a_script_is_rendered_for_students_and_with_solutions_and_without_widgets(tmp_path, monkeypatch):
    monkeypatch.setattr(render, "NOTEBOOKS", tmp_path)
    monkeypatch.setattr(render, "RESULTS", tmp_path)
    script = tmp_path / "example.py"
    script.write_text(SCRIPT)
    paths = render.render(script)
    assert [path.name for path in paths] == ["example.ipynb", "example_solutions.ipynb"]
    students, solutions = (nbformat.read(path, 4).cells for path in paths)
    assert students[0].source == "# your code here"
    assert not any(cell.outputs for cell in students)
    assert solutions[0].source == "answer = 42"
    (picture,) = (output.data["image/png"] for output in solutions[1].outputs)
    assert base64.b64decode(picture) == (tmp_path / "line.png").read_bytes()
    assert [output.get("text") for output in solutions[2].outputs] == ["42\n"]
    before = [path.read_bytes() for path in paths]
    render.render(script)
    assert [path.read_bytes() for path in paths] == before
