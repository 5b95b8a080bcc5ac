"""The epsilon-greedy policy, and how epsilon falls during a run."""

from typing import Any

import numpy as np

from dqn_keras.checks.numbers import check_array, check_instance, check_number, check_rng, shown
from dqn_keras.config import Config


def action(q_values: np.ndarray, epsilon: float, rng: np.random.Generator) -> int:
    """Chooses a random action with probability `epsilon`, else the action with the highest Q-value.

    Args:
        q_values: Q(s, .) of one state, [A] or [1, A], without NaN; an array or a tensor.
        epsilon: probability of a random action, in [0, 1].
        rng: the random generator. One draw, `random()`, decides; a random action takes a second draw, `integers(A)`.

    Returns:
        The action's index, 0 <= a < A. Of several highest Q-values, the first is chosen.

    Raises:
        TypeError, ValueError: an argument is wrong; the message names it.
    """
    check_rng(rng)
    return epsilon_greedy(_one_states(q_values), check_number("epsilon", epsilon, at_least=0, at_most=1), rng)


def epsilon_greedy(q_values: np.ndarray, epsilon: float, rng: np.random.Generator) -> int:
    """Does the same as `action`, without checks, because training calls it at every step."""
    if rng.random() < epsilon:
        return int(rng.integers(q_values.shape[-1]))
    return int(q_values.argmax())


def _one_states(q_values: Any) -> np.ndarray:
    """Returns the Q-values of one state as an array [A]."""
    array = check_array("q_values", q_values)
    if array.shape not in ((array.size,), (1, array.size)) or not array.size:
        raise ValueError(f"q_values must be the values of one state, [A] or [1, A], got shape {array.shape}")
    if np.isnan(array).any():
        raise ValueError(f"q_values must not be NaN, got {shown(q_values)}")
    return array.reshape(-1)


def decay_epsilon(epsilon: float, config: Config) -> float:
    """Returns epsilon for the next episode: `epsilon` times `decay`, but not below `epsilon_min`."""
    epsilon = check_number("epsilon", epsilon, at_least=0, at_most=1)
    check_instance("config", config, Config, "a Config")
    return epsilon_of_next_episode(epsilon, config)


def epsilon_of_next_episode(epsilon: float, config: Config) -> float:
    """Does the same as `decay_epsilon`, without checks; with `epsilon_steps`, returns epsilon unchanged."""
    return epsilon if config.epsilon_steps is not None else max(epsilon * config.decay, config.epsilon_min)


def epsilon_at(step: int, epsilon: float, config: Config) -> float:
    """Returns the probability of a random action at one environment step of the run, counted from 0.

    It is 1 before `learning_starts`. After that, it falls linearly with `epsilon_steps`; without `epsilon_steps`, it is
    `epsilon`, the value of the whole episode.
    """
    if step < config.learning_starts:
        return 1.0
    if config.epsilon_steps is None:
        return epsilon
    return config.epsilon_min + (config.epsilon - config.epsilon_min) * max(0.0, 1 - step / config.epsilon_steps)
