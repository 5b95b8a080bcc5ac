"""The replay memory: the last transitions, from which every update draws a random batch.

Successive transitions are strongly correlated, and a gradient step wants independent samples; a memory to
draw from at random gives those, and lets one transition be learned from more than once (Mnih et al. 2015).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import tensorflow as tf

from dqn_keras.config import count, number


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
        memory_size, num_features = count("memory_size", memory_size), count("num_features", num_features)
        self.num_features = num_features
        self.rows = np.zeros((memory_size, 2 * num_features + 3), np.float32)
        self.num_appended = 0
        """Transitions ever appended; the next one goes to row `num_appended % memory_size`."""

    def __len__(self) -> int:
        return min(self.num_appended, len(self.rows))

    def append(self, experience: Experience) -> None:
        """Remember one transition by value; when the memory is full, the oldest is forgotten.

        It stands in the innermost loop and checks nothing; `train` checks what comes out of the environment.
        """
        f = self.num_features
        row = self.rows[self.num_appended % len(self.rows)]
        row[:f], row[2 * f], row[2 * f + 1], row[f : 2 * f], row[2 * f + 2] = experience
        self.num_appended += 1

    def sample_rows(self, batch_size: int, rng: np.random.Generator) -> np.ndarray:
        """A uniformly random batch without repeats, [B, 2F + 3] float32; drawn by one `rng.choice`.

        Index 0 is the oldest transition that is left, as in a deque. ValueError if the memory holds fewer.
        """
        indices = rng.choice(len(self), batch_size, replace=False)  # [B]
        if self.num_appended > len(self.rows):
            indices = (indices + self.num_appended) % len(self.rows)
        return self.rows.take(indices, axis=0)

    def sample(self, batch_size: int, rng: np.random.Generator) -> Experience:
        """A uniformly random batch without repeats, as arrays with a leading axis B."""
        return unpack(self.sample_rows(batch_size, rng), self.num_features)


def as_batch(experiences: Sequence[Any], state_shape: tuple[int, ...], num_actions: int) -> Experience:
    """Any five arrays as tensors of the right dtypes; an error that names the field if one cannot be that.

    A reward of shape [B, 1] would otherwise broadcast against [B] to a loss over [B, B], without a word. Values are
    checked where there are any: inside a tf.function there are not.
    """
    if len(experiences) != len(_PLURALS):
        raise ValueError(f"experiences must be the five fields {', '.join(_PLURALS)}, got {len(experiences)}")
    fields = []
    for name, field in zip(_PLURALS, experiences, strict=True):
        try:
            fields.append(field if tf.is_tensor(field) else np.asarray(field))
        except ValueError as error:
            raise ValueError(f"{name} must be an array: {error}") from None
    num_transitions = fields[0].shape[0] if len(fields[0].shape) else None
    if num_transitions == 0:
        raise ValueError("states must hold at least one transition, got none")
    vector, states = [num_transitions], [num_transitions, *state_shape]
    shapes = [states, vector, vector, states, vector]
    return Experience(*(_checked(*x, num_actions) for x in zip(_PLURALS, fields, shapes, strict=True)))


def _checked(name: str, field: Any, shape: list, num_actions: int) -> tf.Tensor:
    got = tf.TensorShape(field.shape)
    if got.rank != len(shape) or not got.is_compatible_with(shape):
        raise ValueError(f"{name} must have shape {shape}, got {got}")
    dtype = tf.as_dtype(field.dtype) if field.dtype != object else tf.string
    if not (dtype.is_integer or (name != "actions" and (dtype.is_floating or dtype.is_bool))):
        raise ValueError(f"{name} must be {'whole numbers' if name == 'actions' else 'numbers'}, got {dtype.name}")
    if not tf.is_tensor(field) or (tf.executing_eagerly() and hasattr(field, "numpy")):
        field = np.asarray(field)
        if name == "actions" and not (field.min() >= 0 and field.max() < num_actions):  # XLA would clamp it
            raise ValueError(f"actions must lie in 0..{num_actions - 1}, got {field.min()}..{field.max()}")
        if name == "terminal_states" and not ((field == 0) | (field == 1)).all():
            raise ValueError(f"terminal_states must be 0 or 1, got {field[(field != 0) & (field != 1)][0]}")
        with np.errstate(over="ignore"):
            field = field.astype(np.int32 if name == "actions" else np.float32)
        if not np.isfinite(field).all():
            raise ValueError(f"{name} must be finite in float32, got {field[~np.isfinite(field)][0]}")
    return tf.cast(field, tf.int32 if name == "actions" else tf.float32)


def as_share(name: str, value: Any) -> tf.Tensor:
    """A number in [0, 1] as a float32 scalar."""
    if not tf.is_tensor(value) or (tf.executing_eagerly() and hasattr(value, "numpy")):
        value = number(name, np.asarray(value)[()], at_least=0, at_most=1)
    elif value.shape.rank != 0:
        raise ValueError(f"{name} must be a scalar, got shape {value.shape}")
    return tf.cast(value, tf.float32)


_PLURALS = ("states", "actions", "rewards", "next_states", "terminal_states")
