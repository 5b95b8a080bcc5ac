import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from dqn_keras.cli.options import parse

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("script_folder")
def test_the_readmes_script_prints_what_it_says(capsys):
    [script] = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(script, "README.md", "exec"), {})
    said = re.findall(r"print\(.*\)  # (<.*>|[\d.]+)", script)
    assert len(said) == 2
    assert without_numbers(capsys.readouterr().out) == without_numbers("\n".join(said) + "\n")


def without_numbers(text):
    return re.sub(r"\d+(\.\d+)?", "#", text)  # those of another machine may differ


def test_the_readmes_commands_exist():
    commands = re.findall(r"^dqn-keras (.*)$", README, re.MULTILINE)
    assert len(commands) == 3
    for command in commands:
        parse(shlex.split(command))


def test_the_readmes_links_and_map_name_what_is_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
    for module in (ROOT / "dqn_keras").glob("[!_]*.py"):
        assert module.name in README or module.name in {"version.py"}, module.name
    for folder in (ROOT / "dqn_keras").glob("*/__init__.py"):
        assert f"  {folder.parent.name}/" in README, folder


@pytest.mark.skipif(not shutil.which("make"), reason="there is no make")
@pytest.mark.parametrize("path", ["README.md", "CONTRIBUTING.md", ".ci/run", ".github/workflows/tests.yml"])
def test_make_knows_each_target_that_is_named(path):
    text = re.sub(r"\$\{\{.*?\}\}", "lowest", (ROOT / path).read_text())
    targets = set(re.findall(r"(?:`|^|run: )make ([\w.][\w./-]*)", text, re.MULTILINE))
    assert targets
    subprocess.run(["make", "--dry-run", *targets], cwd=ROOT, check=True, capture_output=True)
