"""Gymnasium's classic environments once more, as functions that TensorFlow can compile."""

from dqn_keras.environments.acrobot import Acrobot
from dqn_keras.environments.cartpole import CartPole
from dqn_keras.environments.mountain_car import MountainCar

TWINS = {"CartPole-v1": CartPole, "Acrobot-v1": Acrobot, "MountainCar-v0": MountainCar}
"""By the id of the environment in Gymnasium whose dynamics they are."""

__all__ = ["TWINS", "Acrobot", "CartPole", "MountainCar"]
