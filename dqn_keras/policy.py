"""The epsilon-greedy policy, and how epsilon falls from episode to episode."""

import numpy as np

from dqn_keras.config import Config


def action(q_values: np.ndarray, epsilon: float, rng: np.random.Generator) -> int:
    """A random action with probability `epsilon`, else one of the highest Q-value.

    Args:
        q_values: Q(s, .) of one state, [A] or [1, A]; an array or a tensor.
        epsilon: in [0, 1].
        rng: drawn from once, `random()`, and if that explores once more, `integers(A)`.

    Returns:
        The action's index, 0 <= a < A; of equal Q-values the first.
    """
    if q_values.shape[:-1] not in ((), (1,)):
        raise ValueError(f"q_values must be those of one state, [A] or [1, A], got shape {q_values.shape}")
    if rng.random() < epsilon:
        return int(rng.integers(q_values.shape[-1]))
    return int(np.argmax(q_values))


def decay_epsilon(epsilon: float, config: Config) -> float:
    """Epsilon for the next episode: `decay` times this one's, but not below `epsilon_min`."""
    return max(epsilon * config.decay, config.epsilon_min)
