"""The epsilon-greedy policy, and the decay of epsilon from episode to episode."""

import numpy as np

from dqn_keras.config import Config


def action(q_values: np.ndarray, epsilon: float, rng: np.random.Generator) -> int:
    """Chooses a random action with probability `epsilon`, else the action with the highest Q-value.

    Args:
        q_values: Q(s, .) of one state, [A] or [1, A]; an array or a tensor.
        epsilon: probability of a random action, in [0, 1].
        rng: the random generator. One draw, `random()`, decides; a random action takes a second draw, `integers(A)`.

    Returns:
        The action's index, 0 <= a < A. If several Q-values are highest, it is the first of them.
    """
    if q_values.shape[:-1] not in ((), (1,)):
        raise ValueError(f"q_values must be those of one state, [A] or [1, A], got shape {q_values.shape}")
    if rng.random() < epsilon:
        return int(rng.integers(q_values.shape[-1]))
    return int(np.asarray(q_values).argmax())


def decay_epsilon(epsilon: float, config: Config) -> float:
    """Returns epsilon for the next episode: `epsilon` times `decay`, but not below `epsilon_min`."""
    return max(epsilon * config.decay, config.epsilon_min)
