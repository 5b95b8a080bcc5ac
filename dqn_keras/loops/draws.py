"""The random draws of compiled episodes, which depend only on the run's seed, the episode and the turn."""

from typing import Any

import numpy as np

from dqn_keras._engine.tensorflow import tf


def draw_bits(num: int, key: tf.Tensor, counter: Any) -> tf.Tensor:
    """Returns random bits, [num] uint32, determined by two int64 numbers (Philox, Salmon et al. 2011)."""
    seed = tf.stack([key, tf.cast(counter, tf.int64)])
    return tf.random.stateless_uniform([num], seed, minval=None, maxval=None, dtype=tf.uint32, alg="philox")


def to_uniform(bits: tf.Tensor) -> tf.Tensor:
    """Converts bits to float32 in [0, 1), in steps of 2^-24."""
    return tf.cast(tf.bitwise.right_shift(bits, tf.constant(8, tf.uint32)), tf.float32) * 2.0**-24


def to_integer(bits: tf.Tensor, bound: Any) -> tf.Tensor:
    """Converts bits to int32 in [0, bound); the relative error of any probability is at most bound / 2^32."""
    product = tf.cast(bits, tf.uint64) * tf.cast(bound, tf.uint64)
    return tf.cast(tf.bitwise.right_shift(product, tf.constant(32, tf.uint64)), tf.int32)


def sample_indices(bits: tf.Tensor, key: tf.Tensor, counter: Any, size: Any, memory_size: int) -> tf.Tensor:
    """Draws as many different indices in [0, size) as there are bits, uniformly; `size` is at most `memory_size`.

    Repeats are drawn again. That takes many attempts if the batch is a large part of the memory, so in this case the
    indices are sorted by random bits instead. The exception is a small batch in a run's first updates, when a large
    memory is nearly empty: it is drawn again, which costs little.
    """
    batch_size = bits.shape[0]
    if 4 * batch_size > memory_size:
        return _first_in_random_order(batch_size, memory_size, key, counter, size)
    if batch_size <= _SMALL_BATCH:
        return _redraw_repeats(bits, key, counter, size)
    return tf.cond(
        tf.convert_to_tensor(size) <= 4 * batch_size,
        lambda: _first_in_random_order(batch_size, 4 * batch_size, key, counter, size),
        lambda: _redraw_repeats(bits, key, counter, size),
    )


_SMALL_BATCH = 128


def _redraw_repeats(bits: tf.Tensor, key: tf.Tensor, counter: Any, size: Any) -> tf.Tensor:
    """Draws different indices in [0, size): repeats are drawn again.

    An index is drawn again only if it equals an earlier one. This rule treats all values alike, so by symmetry all sets
    of different indices are equally likely.
    """
    batch_size = bits.shape[0]
    is_earlier = tf.constant(np.triu(np.ones((batch_size, batch_size), bool), 1))  # [i, j]: i < j

    def repeats(indices: tf.Tensor) -> tf.Tensor:
        return tf.reduce_any((indices[:, None] == indices[None, :]) & is_earlier, axis=0)  # [B]

    def redraw(indices: tf.Tensor, is_repeat: tf.Tensor, attempt: tf.Tensor) -> tuple[tf.Tensor, ...]:
        fresh = draw_bits(batch_size, key, tf.cast(counter, tf.int64) + attempt)
        indices = tf.where(is_repeat, to_integer(fresh, size), indices)
        return indices, repeats(indices), attempt + _NEXT_ATTEMPT

    indices = to_integer(bits, size)
    start = (indices, repeats(indices), tf.constant(_NEXT_ATTEMPT, tf.int64))
    return tf.while_loop(lambda _, is_repeat, __: tf.reduce_any(is_repeat), redraw, start)[0]


def _first_in_random_order(num: int, most: int, key: tf.Tensor, counter: Any, size: Any) -> tf.Tensor:
    """Returns the first `num` of the indices in [0, size), sorted by random bits; `size` is at most `most`."""
    order = draw_bits(most, key, tf.cast(counter, tf.int64) + _NEXT_ATTEMPT)
    order = tf.where(tf.range(most) < size, tf.cast(order, tf.int64), -1)
    return tf.math.top_k(order, num).indices


_NEXT_ATTEMPT = 2**32  # larger than the number of any turn


def further_draws(counter: tf.Tensor, k: tf.Tensor) -> tf.Tensor:
    """Returns the counter of the k-th gradient step of a turn that has several."""
    return tf.cast(counter, tf.int64) + k * _NEXT_GRADIENT_STEP


_NEXT_GRADIENT_STEP = 2**44  # larger than the counter of any attempt


def episode_key(key: tf.Tensor, episode: tf.Tensor) -> tf.Tensor:
    """Returns the int64 number that determines all draws of an episode."""
    return tf.bitcast(draw_bits(2, key, episode), tf.int64)


# The environment's own draws use negative counters, which turns never have.


def reset_rng(key: tf.Tensor) -> tf.Tensor:
    """Returns the seed of an episode's start state, [2] int64, for a functional environment's `initial`."""
    return tf.stack([key, tf.constant(-(2**62), tf.int64)])


def step_rng(key: tf.Tensor, step: tf.Tensor) -> tf.Tensor:
    """Returns the seed of one step of the environment, [2] int64."""
    return tf.stack([key, -1 - tf.cast(step, tf.int64)])
