import gymnasium as gym
import numpy as np
import pytest


@pytest.fixture
def cartpole():
    env = gym.make("CartPole-v1")
    yield env
    env.close()


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def random_batch(rng):
    """A function: (batch size, features, actions) -> five arrays as `learn` takes them."""

    def make(batch_size=64, num_features=4, num_actions=2):
        return (
            rng.normal(size=(batch_size, num_features)).astype(np.float32),
            rng.integers(num_actions, size=batch_size).astype(np.int32),
            rng.normal(size=batch_size).astype(np.float32),
            rng.normal(size=(batch_size, num_features)).astype(np.float32),
            rng.integers(2, size=batch_size).astype(np.float32),
        )

    return make
