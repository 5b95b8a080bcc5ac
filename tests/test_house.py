"""The house rules that a machine can check: what may import what, where private API is, how long a function is."""

import ast
import re
from pathlib import Path

import dqn_keras

PACKAGE = Path(dqn_keras.__file__).parent
FILES = {path.relative_to(PACKAGE).with_suffix("").as_posix(): path for path in PACKAGE.rglob("*.py")}
TREES = {name: ast.parse(path.read_text()) for name, path in FILES.items()}
HEART = ("config", "networks", "replay", "policy", "learn")
LESSON = (*HEART, "agent", "training", "evaluation", "metrics", "seeding")


def imported_by(name):
    """Returns the package's modules that a module imports at its import, as paths."""
    modules = set()
    for node in TREES[name].body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dqn_keras"):
            base = node.module.replace(".", "/").removeprefix("dqn_keras").lstrip("/")
            modules |= {f"{base}/{x.name}".lstrip("/") for x in node.names} | {base}
    return {module for module in modules if module in FILES}


def reached_from(name):
    seen, to_do = set(), [name]
    while to_do:
        module = to_do.pop()
        if module not in seen:
            seen.add(module)
            to_do += imported_by(module)
    return seen - {name}


def test_the_lessons_heart_imports_nothing_of_loops_storage_and_cli():
    for name in HEART:
        wings = {module for module in reached_from(name) if module.startswith(("loops/", "storage/", "cli/"))}
        assert not wings, (name, wings)


def test_nothing_imports_the_command_line():
    for name in FILES:
        if not name.startswith("cli/") and name != "__main__":
            assert not {module for module in imported_by(name) if module.startswith("cli/")}, name


def test_imports_run_one_way():
    for name in FILES:
        assert name not in {x for module in imported_by(name) for x in {module, *reached_from(module)}}, name


def test_nothing_imports_a_file_of_tests():
    root = Path(__file__).parent.parent
    for path in [*root.glob("tests/**/*.py"), *root.glob("benchmarks/*.py")]:
        assert not re.search(r"^(from|import) tests\.test_", path.read_text(), re.MULTILINE), path


def test_private_api_of_tensorflow_and_keras_is_only_in_the_engine():
    private = re.compile(
        r"\b(inference_fn|call_flat|gradient_registry|tensorflow\.python|keras\.src\.|value\.handle)\b"
        r"|\b(layer|network|optimizer|model|q_network|tf|keras)\._[a-z]\w*"
    )
    for name, path in FILES.items():
        if not name.startswith("_engine/"):
            assert not private.findall(path.read_text()), name


def length(function):
    """Returns the number of lines of a function's body, without the docstring."""
    first, *rest = function.body
    is_docstring = isinstance(first, ast.Expr) and isinstance(getattr(first, "value", None), ast.Constant)
    start = rest[0].lineno if is_docstring and rest else first.lineno
    return function.end_lineno - start + 1


def test_no_function_is_long():
    for name, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                assert length(node) <= (40 if name in LESSON else 50), (name, node.name, length(node))
