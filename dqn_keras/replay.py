"""The replay memory: the last transitions, from which every update draws a random batch.

Successive transitions are strongly correlated, and a gradient step wants independent samples; a memory to
draw from at random gives those, and lets one transition be learned from more than once (Mnih et al. 2015).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import tensorflow as tf


class Experience(NamedTuple):
    """One transition, or, with a leading axis B in every field, a batch of them.

    `terminal_state` says that the environment *terminated*: nothing follows, so nothing is bootstrapped.
    A time limit (`truncated`) also ends an episode, but the state it ends in has a future, and is not marked.
    """

    state: Any  # [F] float32
    action: Any  # int32, an index: 0 <= action < A
    reward: Any  # float32
    next_state: Any  # [F] float32
    terminal_state: Any  # float32, 1 or 0


def unpack(rows: Any, num_features: int) -> Experience:
    """Rows of a ReplayMemory, [B, 2F + 3] float32, as a batch; for NumPy arrays and tensors alike."""
    f = num_features
    actions = rows[:, 2 * f]
    actions = tf.cast(actions, tf.int32) if tf.is_tensor(actions) else actions.astype(np.int32)
    return Experience(rows[:, :f], actions, rows[:, 2 * f + 1], rows[:, f : 2 * f], rows[:, 2 * f + 2])


class ReplayMemory:
    """The last `memory_size` transitions, in a ring that is allocated once.

    One transition is one row (state, next_state, action, reward, terminal_state), so that it is written, drawn
    and handed to TensorFlow as one array. float32 holds an action's index exactly up to 2^24.
    """

    def __init__(self, memory_size: int, num_features: int) -> None:
        self.num_features = num_features
        self.rows = np.zeros((memory_size, 2 * num_features + 3), np.float32)
        self.num_appended = 0
        """Transitions ever appended; the next one goes to row `num_appended % memory_size`."""

    def __len__(self) -> int:
        return min(self.num_appended, len(self.rows))

    def append(self, experience: Experience) -> None:
        """Remember one transition by value; when the memory is full, the oldest is forgotten."""
        f = self.num_features
        row = self.rows[self.num_appended % len(self.rows)]
        row[:f], row[2 * f], row[2 * f + 1], row[f : 2 * f], row[2 * f + 2] = experience
        self.num_appended += 1

    def sample_rows(self, batch_size: int, rng: np.random.Generator) -> np.ndarray:
        """A uniformly random batch without repeats, [B, 2F + 3] float32; drawn by one `rng.choice`.

        Index 0 is the oldest transition that is left, as in a deque.
        """
        indices = rng.choice(len(self), batch_size, replace=False)  # [B]
        if self.num_appended > len(self.rows):
            indices = (indices + self.num_appended) % len(self.rows)
        return self.rows.take(indices, axis=0)

    def sample(self, batch_size: int, rng: np.random.Generator) -> Experience:
        """A uniformly random batch without repeats, as arrays with a leading axis B."""
        return unpack(self.sample_rows(batch_size, rng), self.num_features)


def as_batch(experiences: Sequence[Any], state_shape: tuple[int, ...]) -> Experience:
    """Any five arrays as tensors of the right dtypes; ValueError names the field whose shape or dtype is wrong.

    A reward of shape [B, 1] would otherwise broadcast against [B] to a loss over [B, B], without a word.
    """
    if len(experiences) != len(Experience._fields):
        raise ValueError(f"experiences must be the five fields {', '.join(_PLURALS)}, got {len(experiences)}")
    fields = [tf.convert_to_tensor(field) for field in experiences]
    num_transitions = fields[0].shape[0] if fields[0].shape.rank else None
    if num_transitions == 0:
        raise ValueError("states must hold at least one transition, got none")
    vector, states = [num_transitions], [num_transitions, *state_shape]
    for name, field, shape in zip(_PLURALS, fields, [states, vector, vector, states, vector], strict=True):
        if field.shape.rank != len(shape) or not field.shape.is_compatible_with(shape):
            raise ValueError(f"{name} must have shape {shape}, got {field.shape}")
        if name == "actions" and not field.dtype.is_integer:
            raise ValueError(f"actions must be whole numbers, got dtype {field.dtype.name}")
    return Experience(*(tf.cast(x, tf.int32 if i == 1 else tf.float32) for i, x in enumerate(fields)))


def check_values(batch: Experience, num_actions: int) -> None:
    """ValueError for an action out of range or a number that is not finite; symbolic tensors cannot be looked at."""
    if not tf.executing_eagerly():
        return
    for name, values in zip(_PLURALS, (field.numpy() for field in batch), strict=True):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, got {values[~np.isfinite(values)][0]}")
        if name == "actions" and not (values.min() >= 0 and values.max() < num_actions):  # XLA would clamp it
            raise ValueError(f"actions must lie in 0..{num_actions - 1}, got {values.min()}..{values.max()}")


_PLURALS = ("states", "actions", "rewards", "next_states", "terminal_states")
