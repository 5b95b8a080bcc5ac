import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


@pytest.mark.parametrize(
    "script",
    re.findall(r"```python\n(.*?)```", README, re.DOTALL),
    ids=["train", "compiled", "own env", "resume", "study", "learn"],
)
def test_the_readmes_scripts_run(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    exec(compile(script, "README.md", "exec"), {})


def test_the_readmes_links_and_map_name_what_is_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
    for module in (ROOT / "dqn_keras").glob("[!_]*.py"):
        assert module.name in README or module.name in {"version.py"}, module.name
