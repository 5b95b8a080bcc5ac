import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import dqn_keras
from dqn_keras._engine.tensorflow import require_tensorflow_backend


def test_learn_is_one_function_under_both_spellings():
    from dqn_keras import learn
    from dqn_keras.learn import learn as same
    from dqn_keras.learn import loss_values, update_q_hat

    assert learn is same
    assert (loss_values, update_q_hat) == (dqn_keras.loss_values, dqn_keras.update_q_hat)


@pytest.mark.slow
@pytest.mark.parametrize(
    "first",
    [
        "import dqn_keras.learn",
        "import dqn_keras.study",
        "from dqn_keras import train",
        "from dqn_keras.environments import CartPole",
    ],
)
def test_an_import_prints_nothing_and_a_name_is_the_function_whichever_module_came_first(first):
    script = f"""
{first}
from dqn_keras import learn, study
assert callable(learn) and callable(study)
import tensorflow as tf
tf.constant(1) + 1
"""
    environment = {k: v for k, v in os.environ.items() if k != "TF_CPP_MIN_LOG_LEVEL"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        capture_output=True,
        check=True,
        timeout=600,
    )
    assert (done.stdout, done.stderr) == (b"", b"")


def test_tensorflow_is_imported_when_a_name_needs_it():
    script = (
        "import sys, dqn_keras; dqn_keras.Config(); assert not {'keras', 'tensorflow', 'gymnasium'} & {*sys.modules}"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=600)


def test_every_public_name_is_there():
    for name in dqn_keras.__all__:
        assert getattr(dqn_keras, name) is not None


def test_another_keras_backend_is_refused():
    with pytest.raises(ImportError, match=r"^dqn_keras needs Keras on TensorFlow, not on 'jax'"):
        require_tensorflow_backend("jax")
    environment = {**os.environ, "KERAS_BACKEND": "jax"}
    command = [sys.executable, "-c", "from dqn_keras import learn"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert "ImportError: dqn_keras needs Keras on TensorFlow, not on 'jax'" in done.stderr


def test_the_lowest_versions_that_are_tested_are_the_lowest_that_are_allowed():
    root = Path(__file__).parent.parent
    pinned = dict(line.lower().split("==") for line in (root / "constraints-lowest.txt").read_text().split())
    for requirement in tomllib.loads((root / "pyproject.toml").read_text())["project"]["dependencies"]:
        name, lowest = re.match(r"(\w+)(?:\[.*\])? >=([\d.]+)", requirement).groups()
        version = pinned[name.replace("_", "-")]
        assert version == lowest or re.fullmatch(rf"{re.escape(lowest)}(\.0)+", version), requirement


def test_the_page_install_names_every_requirement_but_tensorflow():
    root = Path(__file__).parent.parent
    command = re.search(
        r"^pip install tensorflow-cpu (.*)$", (root / "docs/how_to/install.md").read_text(), re.MULTILINE
    )
    named = {re.match(r"[\w-]+", word)[0] for word in command[1].replace('"', "").split()}
    required = tomllib.loads((root / "pyproject.toml").read_text())["project"]["dependencies"]
    assert named == {re.match(r"[\w-]+", requirement)[0] for requirement in required} - {"tensorflow"}
