"""Short runs and single steps with own parts, and the weights after them."""

import gymnasium as gym
import keras
import numpy as np
import pytest

from dqn_keras import Config, learn, make_networks, train
from dqn_keras.environments import CartPole

QUICK = Config(num_episodes=5, batch_size=8, max_steps=20, solved_reward=1e6)
BOTH_LOOPS = pytest.mark.parametrize(
    "make_env", [lambda: gym.make("CartPole-v1"), CartPole], ids=["Gymnasium", "compiled"]
)


def weights_of(*networks):
    return np.concatenate([w.ravel() for network in networks for w in network.get_weights()])


def trained(make_env=CartPole, config=QUICK, **own):
    """Returns the weights after a short run with the same seed."""
    run = train(make_env(), config, seed=0, verbose=0, **own)
    return weights_of(run.q_network, run.q_hat_network)


def learned(batch, networks, optimizer, **own):
    """Returns the weights after one more step of these networks."""
    learn(batch, 0.9, *networks, optimizer, **own)
    return networks[0].get_weights()


def sgd():
    return keras.optimizers.SGD(0.1)


def fresh(seed=0):
    return make_networks(4, 2, (8,), seed=seed)


class Settings:
    factor = 1.0
