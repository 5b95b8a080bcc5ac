import importlib.util
import inspect
import re
from pathlib import Path

import pytest

import dqn_keras

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
BLOCK = re.compile(
    r"^```(python|\{\.python \.no-run\})\n(.*?)^```", re.DOTALL | re.MULTILINE
)  # no-run: cannot run here
BLOCKS = [
    pytest.param(block, kind == "python", id=f"{page.relative_to(DOCS)}-{number}")
    for page in PAGES
    for number, (kind, block) in enumerate(BLOCK.findall(page.read_text()), start=1)
]
OPTIONAL = ("onnxruntime", "optuna", "tf2onnx", "wandb")  # a block that names one runs only if it is installed
MADE = {  # by docs/hooks.py, from where it is in the repository
    *(path.relative_to(ROOT) for path in [*ROOT.glob("results/**/*.*"), *ROOT.glob("notebooks/*.ipynb")]),
    *(path.relative_to(ROOT).with_suffix(".md") for path in ROOT.glob("notebooks/*.ipynb")),
}


@pytest.mark.slow
@pytest.mark.parametrize(("block", "runs"), BLOCKS)
@pytest.mark.usefixtures("script_folder")
def test_the_code_in_the_docs_runs(block, runs):
    for package in OPTIONAL:
        if re.search(rf"\b{package}\b", block):
            pytest.importorskip(package)
    code = compile(block, "docs", "exec")
    if runs:
        exec(code, {})


def anchors(page):
    headings = re.findall(r"^#+ (.*?)(?: \{.*\})?$", page.read_text(), re.MULTILINE)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_links_of_the_docs_lead_somewhere(page):
    for link in re.findall(
        r"\]\(([^)\s]+)\)", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    ):
        path, _, fragment = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if "://" not in link and target.relative_to(DOCS) not in MADE:  # whose anchors the check in the browser knows
            assert target.exists(), link
            assert not fragment or fragment in anchors(target), link


def documented():
    """Yields the objects that the reference documents, as named in its directives."""
    for page in (DOCS / "reference").glob("*.md"):
        for path in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE):
            try:
                yield importlib.import_module(path)
            except ModuleNotFoundError:
                module, _, name = path.rpartition(".")
                yield getattr(importlib.import_module(module), name)


def test_every_public_name_is_in_the_reference():
    there = list(documented())
    for module in (dqn_keras, dqn_keras.environments):
        for name in module.__all__:
            thing = getattr(module, name)
            if not inspect.ismodule(thing) and name != "__version__":
                assert any(thing is other for other in there), f"{name} is missing in docs/reference"
    assert "`dqn_keras.__version__`" in (DOCS / "reference" / "index.md").read_text()


def test_every_cross_reference_names_what_is_in_the_reference():
    reference = "\n".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    paths = re.findall(r"^::: (\S+)$", reference, re.MULTILINE)
    for page in PAGES:
        for name in re.findall(r"\]\[(dqn_keras[\w.]*)\]", page.read_text()):
            assert any(name == path or name.startswith(f"{path}.") for path in paths), name


def test_the_first_mention_of_a_public_name_on_a_page_links_to_the_reference():
    pytest.importorskip("latex2mathml")  # of the extra docs, like the two below
    pytest.importorskip("mkdocs")
    pytest.importorskip("nbformat")
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = """# `train`
[`sweep`][dqn_keras.study.sweep] and [`study`](page.md), `sweep` and `train(env)`, `train` and `Config(tau=1)`.
```
`Run`
```
`Run` and `run` and `evaluated`
"""
    train, config = "[`train(env)`][dqn_keras.training.train]", "[`Config(tau=1)`][dqn_keras.config.Config]"
    expected = page.replace("`train(env)`", train).replace("`Config(tau=1)`", config)
    expected = expected.replace("`Run` and", "[`Run`][dqn_keras.training.Run] and")
    assert hooks.link_public_names(page) == expected
    paths = {
        path
        for page in (DOCS / "reference").glob("*.md")
        for path in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE)
    }
    assert set(hooks.PUBLIC.values()) <= paths


def test_the_design_names_every_module():
    design = (DOCS / "design" / "index.md").read_text()
    for module in (ROOT / "dqn_keras").rglob("[!_]*.py"):
        is_known = module.name in {"version.py", "made_here.py", "layers.py", "tensorflow.py"}
        assert f"`{module.name}`" in design or module.parent.name == "environments" or is_known, module


def test_every_result_and_notebook_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text()
    for page in MADE:
        if page.suffix == ".md":
            assert re.search(rf"^ +- .*: {page}$", navigation, re.MULTILINE), page
