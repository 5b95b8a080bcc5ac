"""Gymnasium's classic environments once more, as functions that TensorFlow can compile."""

from dqn_keras.environments.acrobot import Acrobot
from dqn_keras.environments.cartpole import CartPole
from dqn_keras.environments.mountain_car import MountainCar

__all__ = ["Acrobot", "CartPole", "MountainCar"]
