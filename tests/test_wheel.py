"""What is distributed: the wheel, built from the source distribution, works outside the repository."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
for tool in ("build", "twine"):
    pytest.importorskip(tool, reason=f"{tool} is in the extra dev")

ROOT = Path(__file__).parent.parent


def run(*command, cwd):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """The folder with both distributions."""
    source, dist = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("dqn_keras", "README.md", "LICENSE", "pyproject.toml"):
        path = ROOT / name
        (shutil.copytree if path.is_dir() else shutil.copy)(path, source / name)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(dist), str(source), cwd=dist)
    return dist


def test_both_distributions_have_what_an_index_asks_for(dist):
    names = [str(path) for path in dist.iterdir()]
    assert len(names) == 2
    assert run(sys.executable, "-m", "twine", "check", "--strict", *names, cwd=dist).count("PASSED") == 2


def test_the_wheel_holds_the_package_and_nothing_else(dist):
    [wheel] = dist.glob("*.whl")
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if not name.partition("/")[0].endswith(".dist-info")}
    package = (ROOT / "dqn_keras").rglob("*")
    assert inside == {str(path.relative_to(ROOT)) for path in package if path.suffix in {".py", ".pyi", ".typed"}}


def test_the_wheel_works_in_an_environment_of_its_own(dist, tmp_path):
    [wheel] = dist.glob("*.whl")
    run(sys.executable, "-m", "venv", str(tmp_path / "bare"), cwd=tmp_path)
    python = tmp_path / "bare" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", str(wheel), cwd=tmp_path)
    # The requirements are those of this environment, whose own .pth files, and so the repository, are not read.
    [packages] = (tmp_path / "bare").glob("lib/python*/site-packages")
    (packages / "requirements.pth").write_text(sysconfig.get_path("purelib") + "\n")

    where = run(python, "-c", "import dqn_keras; print(dqn_keras.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(packages)
    script = """from dqn_keras import Config, train
from dqn_keras.environments import CartPole
print(train(CartPole(), Config(num_episodes=2), seed=0, verbose=0))"""
    assert "2 episodes" in run(python, "-c", script, cwd=tmp_path)
    command = tmp_path / "bare" / "bin" / "dqn-keras"
    run(command, "train", "CartPole-v1", "--num-episodes", "2", "--out", "run", cwd=tmp_path)
    assert (tmp_path / "run" / "agent.keras").exists()
