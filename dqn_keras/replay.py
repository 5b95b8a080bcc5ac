"""The replay memory: it keeps the last transitions, and every update draws a random batch from it.

Successive transitions are strongly correlated, but a gradient step needs independent samples. Random draws from a
memory break the correlation, and a transition can be used in more than one update (Mnih et al. 2015).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from dqn_keras._engine.tensorflow import tf
from dqn_keras.checks.numbers import check_count, check_counts, check_rng, shown
from dqn_keras.checks.transitions import check_transition


class Experience(NamedTuple):
    """One transition, or a batch of transitions with a leading axis B in every field.

    `terminal_state` is 1 if the environment *terminated*: no state follows, so there is no bootstrapping. A time limit
    (`truncated`) also ends an episode, but its last state has a future, so `terminal_state` is 0.

    Transitions are made in two places: `loops/gymnasium.py`, `_play_episode`, and `loops/compiled.py`, `_Loop._step`.
    """

    state: Any  # [*S] float32, or uint8 for images
    action: Any  # int32, an index: 0 <= action < A
    reward: Any  # float32
    next_state: Any  # [*S], same dtype as state
    terminal_state: Any  # float32, 1 or 0


class ReplayMemory:
    """The last `memory_size` transitions, in a ring buffer that is allocated once.

    The Gymnasium loop uses `append_unchecked` and `sample_rows`. Compiled episodes write and draw the same rows inside
    their program (`loops/compiled.py`).

    One transition is one row: state, next_state, then action, reward and terminal_state as float32. A batch is
    therefore one array, both when it is drawn and when TensorFlow gets it. float32 is exact for actions up to 2^24.

    Args:
        memory_size: number of transitions.
        state_shape: shape of one state, such as (4,), or (84, 84, 4) for images.
        dtype: dtype of the states: float32, or uint8, which needs a quarter of the space.
    """

    def __init__(self, memory_size: int, state_shape: tuple[int, ...], dtype: Any = np.float32) -> None:
        memory_size, self.state_shape = (
            check_count("memory_size", memory_size),
            check_counts("state_shape", state_shape),
        )
        if not isinstance(dtype, type | np.dtype) or dtype not in (np.float32, np.uint8):
            raise ValueError(f"dtype must be np.float32 or np.uint8, got {shown(dtype)}")
        size = math.prod(self.state_shape)
        self.rows = np.zeros((memory_size, 2 * size + 12 // np.dtype(dtype).itemsize), dtype)
        self.num_appended = 0
        """Number of transitions appended so far. The next one goes to row `num_appended % memory_size`."""
        self._view_rows()

    def _view_rows(self) -> None:
        size, shape = math.prod(self.state_shape), (len(self.rows), *self.state_shape)
        self._states = self.rows[:, :size].reshape(shape)
        self._next_states = self.rows[:, size : 2 * size].reshape(shape)
        self._scalars = self.rows[:, 2 * size :].view(np.float32)  # [memory_size, 3]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._view_rows()  # a copy has its own rows

    def __len__(self) -> int:
        return min(self.num_appended, len(self.rows))

    def append(self, experience: Experience) -> None:
        """Stores a copy of one transition; when the memory is full, it replaces the oldest.

        Raises:
            TypeError, ValueError: a field is wrong; the message names it.
        """
        fields = check_transition(experience, self.state_shape, self.rows.dtype)
        self.append_unchecked(Experience(*fields))

    def append_unchecked(self, experience: Experience) -> None:
        """Does the same as `append`, without checks: training has checked the environment's values already."""
        i = self.num_appended % len(self.rows)
        scalars = self._scalars[i]
        self._states[i], scalars[0], scalars[1], self._next_states[i], scalars[2] = experience
        self.num_appended += 1

    def sample_rows(self, batch_size: int, rng: np.random.Generator) -> np.ndarray:
        """Draws a uniformly random batch without repeats, with one `rng.choice`, and returns it as rows.

        Index 0 is the oldest transition in the memory, as in a deque.

        Raises:
            TypeError: `batch_size` is not a whole number, or `rng` is not a NumPy generator.
            ValueError: the memory holds fewer transitions than `batch_size`.
        """
        check_rng(rng)
        num_kept = len(self)
        if check_count("batch_size", batch_size) > num_kept:
            raise ValueError(f"batch_size must be at most {num_kept}, what the memory holds so far, got {batch_size}")
        indices = rng.choice(num_kept, batch_size, replace=False)  # [B]
        if self.num_appended > len(self.rows):
            indices = (indices + self.num_appended) % len(self.rows)
        return self.rows.take(indices, axis=0)

    def sample(self, batch_size: int, rng: np.random.Generator) -> Experience:
        """Does the same as `sample_rows`, but returns the batch as arrays with a leading axis B."""
        return unpack(self.sample_rows(batch_size, rng), self.state_shape)


def unpack(rows: Any, state_shape: tuple[int, ...]) -> Experience:
    """Converts B rows of a ReplayMemory (a NumPy array or a tensor) to a batch."""
    size, shape = math.prod(state_shape), (-1, *state_shape)
    states, next_states, scalars = rows[:, :size], rows[:, size : 2 * size], rows[:, 2 * size :]
    if tf.is_tensor(rows):
        if rows.dtype != tf.float32:
            scalars = tf.bitcast(tf.reshape(scalars, [-1, 3, 4]), tf.float32)
        states, next_states = tf.reshape(states, shape), tf.reshape(next_states, shape)
        actions = tf.cast(scalars[:, 0], tf.int32)
    else:
        scalars = np.ascontiguousarray(scalars).view(np.float32)
        states, next_states = states.reshape(shape), next_states.reshape(shape)
        actions = scalars[:, 0].astype(np.int32)
    return Experience(states, actions, scalars[:, 1], next_states, scalars[:, 2])


def pack(experience: Experience) -> tf.Tensor:
    """Converts one transition, given as tensors, to a row of a ReplayMemory."""
    state, action, reward, next_state, terminal_state = experience
    scalars = tf.stack([tf.cast(x, tf.float32) for x in (action, reward, terminal_state)])
    if state.dtype != tf.float32:
        scalars = tf.bitcast(scalars, state.dtype)  # [3, 4]
    return tf.concat([tf.reshape(x, [-1]) for x in (state, next_state, scalars)], axis=0)
