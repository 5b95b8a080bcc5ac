"""Config: every number of the algorithm, in one place, checked when it is made."""

import dataclasses
import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Config:
    """The parameters of a run. The defaults are the original notebook's.

    NumPy scalars are taken for Python's. Every field is checked: TypeError for a value of the wrong
    kind, ValueError for one out of range; the message names the field, the range and the value.
    """

    memory_size: int = 50_000
    """Transitions the replay memory keeps; the oldest give way."""
    steps_per_update: int = 4
    """Environment steps between two updates: an episode learns at its steps 0, 4, 8, ..."""
    alpha: float = 0.001
    """Adam's learning rate, in (0, 1]."""
    gamma: float = 0.95
    """Discount per environment step, in [0, 1]."""
    tau: float = 0.01
    """Share of Q that is mixed into Q-hat at each update, in (0, 1]."""
    batch_size: int = 64
    """Transitions per update; there is no update before the memory holds as many."""
    epsilon: float = 1.0
    """Probability of a random action in the first episode."""
    decay: float = 0.995
    """Factor on epsilon after each episode, in (0, 1]."""
    epsilon_min: float = 0.1
    """Where epsilon stops falling, in [0, epsilon]."""
    num_episodes: int = 2_000
    """Episodes after which training ends, solved or not."""
    max_steps: int = 1_000
    """Environment steps after which an episode is left, if the environment has not ended it."""
    solved_reward: float = 225.0
    """Training stops when the mean reward of the last `solved_window` episodes is above this."""
    solved_window: int = 50
    """Episodes in that mean; with fewer played, nothing counts as solved."""
    hidden_units: tuple[int, ...] = (64,)
    """Units of each hidden layer, all ReLU."""
    jit_compile: bool = True
    """Compile the learn step with XLA. Results are reproducible either way, but differ in the last bits."""

    def __post_init__(self) -> None:
        for name in ("memory_size", "steps_per_update", "batch_size", "num_episodes", "max_steps", "solved_window"):
            self._set(name, count(name, getattr(self, name)))
        self._set("alpha", number("alpha", self.alpha, above=0, at_most=1))
        self._set("gamma", number("gamma", self.gamma, at_least=0, at_most=1))
        self._set("tau", number("tau", self.tau, above=0, at_most=1))
        self._set("epsilon", number("epsilon", self.epsilon, at_least=0, at_most=1))
        self._set("decay", number("decay", self.decay, above=0, at_most=1))
        self._set("epsilon_min", number("epsilon_min", self.epsilon_min, at_least=0, at_most=self.epsilon))
        self._set("solved_reward", number("solved_reward", self.solved_reward))
        self._set("hidden_units", counts("hidden_units", self.hidden_units))
        if not isinstance(self.jit_compile, bool | np.bool_):
            raise TypeError(f"jit_compile must be True or False, got {self.jit_compile!r}")
        self._set("jit_compile", bool(self.jit_compile))
        if self.batch_size > self.memory_size:
            raise ValueError(
                f"batch_size must be at most memory_size={self.memory_size}, got {self.batch_size}: "
                "the memory would never hold a batch"
            )
        if self.batch_size > self.num_episodes * self.max_steps:
            raise ValueError(
                f"batch_size must be at most num_episodes * max_steps = {self.num_episodes * self.max_steps}, "
                f"got {self.batch_size}: the run would end before its first update"
            )

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)  # the dataclass is frozen; this is its making


LARGEST_COUNT = 2**31 - 1


def count(name: str, value: Any, at_least: int = 1) -> int:
    """The whole number `value` as an int, or an error that names it."""
    wanted = f"{name} must be a whole number from {at_least} to {LARGEST_COUNT}"
    if isinstance(value, bool | np.bool_) or not isinstance(value, Integral):
        raise TypeError(f"{wanted}, got {value!r}")
    if not at_least <= int(value) <= LARGEST_COUNT:
        raise ValueError(f"{wanted}, got {value!r}")
    return int(value)


def number(
    name: str, value: Any, *, above: float | None = None, at_least: float | None = None, at_most: float | None = None
) -> float:
    """The finite number `value` as a float, or an error that names it."""
    limits = [("above", above), ("at least", at_least), ("at most", at_most)]
    wanted = f"{name} must be a finite number " + ", ".join(f"{word} {x}" for word, x in limits if x is not None)
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise TypeError(f"{wanted.rstrip()}, got {value!r}")
    try:
        converted = float(value)
    except OverflowError:  # a whole number beyond the floats
        converted = math.inf
    if (
        not math.isfinite(converted)
        or (above is not None and converted <= above)
        or (at_least is not None and converted < at_least)
        or (at_most is not None and converted > at_most)
    ):
        raise ValueError(f"{wanted.rstrip()}, got {value!r}")
    return converted


def counts(name: str, values: Any) -> tuple[int, ...]:
    """A sequence of whole numbers above 0 as a tuple of ints, or an error that names it."""
    if isinstance(values, np.ndarray) and values.ndim == 1:
        values = list(values)
    if isinstance(values, str | bytes) or not isinstance(values, Sequence):
        raise TypeError(f"{name} must be a tuple of whole numbers, got {values!r}")
    if not values:
        raise ValueError(f"{name} must hold at least one whole number, got {values!r}")
    return tuple(count(f"{name}[{i}]", value) for i, value in enumerate(values))
