import importlib
import os
import signal

import gymnasium as gym
import numpy as np
import pytest

os.environ.setdefault("DQN_KERAS_CACHE", "0")  # tests leave nothing in the user's folders
importlib.import_module("dqn_keras.learn")  # before a test imports Keras, as the cache needs it
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in a background job; tests and their processes are interrupted
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def cartpole():
    env = gym.make("CartPole-v1")
    yield env
    env.close()


@pytest.fixture
def script_folder(tmp_path, monkeypatch):
    """Prepares for scripts of the README and the docs: an empty folder, no window, and studies in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setattr(importlib.import_module("dqn_keras.study"), "cpu_count", lambda: 1)
    return tmp_path


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def random_batch(rng):
    """Returns a function: (batch size, features, actions) -> five arrays for `learn`."""

    def make(batch_size=64, num_features=4, num_actions=2):
        return (
            rng.normal(size=(batch_size, num_features)).astype(np.float32),
            rng.integers(num_actions, size=batch_size).astype(np.int32),
            rng.normal(size=batch_size).astype(np.float32),
            rng.normal(size=(batch_size, num_features)).astype(np.float32),
            rng.integers(2, size=batch_size).astype(np.float32),
        )

    return make
