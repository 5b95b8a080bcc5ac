import os
import subprocess
import sys

import keras
import pytest

import dqn_keras
from dqn_keras._tensorflow import require_tensorflow_backend


def test_learn_is_one_function_under_both_spellings():
    from dqn_keras import learn
    from dqn_keras.learn import learn as same
    from dqn_keras.learn import loss_values, update_q_hat

    assert learn is same
    assert (loss_values, update_q_hat) == (dqn_keras.loss_values, dqn_keras.update_q_hat)


def test_importing_prints_nothing():
    environment = {k: v for k, v in os.environ.items() if k != "TF_CPP_MIN_LOG_LEVEL"}
    done = subprocess.run([sys.executable, "-c", "import dqn_keras"], env=environment, capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_all_is_public_and_there():
    assert sorted(dqn_keras.__all__) == dqn_keras.__all__
    for name in dqn_keras.__all__:
        assert getattr(dqn_keras, name) is not None


def test_another_keras_backend_is_refused(monkeypatch):
    monkeypatch.setattr(keras.backend, "backend", lambda: "jax")
    with pytest.raises(ImportError, match=r"^dqn_keras needs Keras on TensorFlow, not on 'jax'"):
        require_tensorflow_backend()
