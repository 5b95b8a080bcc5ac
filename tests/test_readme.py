import re
import shlex
from pathlib import Path

import pytest

from dqn_keras.cli.options import parse

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    "script",
    re.findall(r"```python\n(.*?)```", README, re.DOTALL),
    ids=["train", "own parts", "compiled", "resume", "study", "learn"],
)
@pytest.mark.usefixtures("script_folder")
def test_the_readmes_scripts_run(script):
    exec(compile(script, "README.md", "exec"), {})
    assert ("plot" in script) == bool(list(Path.cwd().glob("*.png"))), "a script shows its picture, or saves it"


def test_the_readmes_commands_exist():
    commands = re.findall(r"^dqn-keras (.*)$", README, re.MULTILINE)
    assert len(commands) == 6
    for command in commands:
        parse(shlex.split(command))


def test_the_readmes_links_and_map_name_what_is_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
    for module in (ROOT / "dqn_keras").glob("[!_]*.py"):
        assert module.name in README or module.name in {"version.py"}, module.name
    for folder in (ROOT / "dqn_keras").glob("*/__init__.py"):
        assert f"  {folder.parent.name}/" in README, folder
