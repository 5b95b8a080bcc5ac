"""Gymnasium's classic environments, written as functions that TensorFlow can compile."""

import sys
from collections.abc import Hashable
from types import FunctionType, ModuleType
from typing import Any

from dqn_keras.environments.acrobot import Acrobot
from dqn_keras.environments.cartpole import CartPole
from dqn_keras.environments.mountain_car import MountainCar

TWINS = {"CartPole-v1": CartPole, "Acrobot-v1": Acrobot, "MountainCar-v0": MountainCar}
"""The functional twins, by the id of the Gymnasium environment with the same dynamics."""


def key_of_twin(env: Any) -> Hashable | None:
    """Returns a key that is equal for environments that compute the same; None if `env` is not an unchanged twin.

    The key includes the twin's constants, because a user may change them to try other physics.
    """
    cls = type(env)
    if cls not in TWINS.values() or vars(env) != vars(cls()):
        return None
    named = vars(sys.modules[cls.__module__]) | vars(cls)
    values = {name: x for name, x in named.items() if name[:2] != "__" and not isinstance(x, ModuleType | type)}
    return cls, tuple((name, x if isinstance(x, FunctionType) else (type(x), repr(x))) for name, x in values.items())


__all__ = ["TWINS", "Acrobot", "CartPole", "MountainCar"]
