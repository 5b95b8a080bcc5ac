"""Gymnasium's classic environments, written as functions that TensorFlow can compile."""

from dqn_keras.environments.acrobot import Acrobot
from dqn_keras.environments.cartpole import CartPole
from dqn_keras.environments.mountain_car import MountainCar

TWINS = {"CartPole-v1": CartPole, "Acrobot-v1": Acrobot, "MountainCar-v0": MountainCar}
"""The functional twins, each under the id of the Gymnasium environment with the same dynamics."""

__all__ = ["TWINS", "Acrobot", "CartPole", "MountainCar"]
