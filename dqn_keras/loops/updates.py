"""Updates in both loops: a gradient step with a check for finite weights, and the means over an episode."""

import math
from collections.abc import Sequence
from typing import Any

from dqn_keras._engine.programs import Learner
from dqn_keras._engine.tensorflow import tf
from dqn_keras.checks.formulas import Formulas
from dqn_keras.config import Config
from dqn_keras.learn import Metrics, gradient_step
from dqn_keras.replay import Experience


def checked_step(experiences: Experience, learner: Learner, gamma: Any, tau: Any, formulas: Formulas) -> Metrics:
    """Takes a `gradient_step` and returns its metrics, with a loss of NaN if a weight is no longer finite."""
    metrics = gradient_step(experiences, gamma, *learner, tau, formulas)
    loss = tf.where(is_all_finite(*learner.q_network.weights), metrics.loss, math.nan)
    return metrics._replace(loss=loss)


def num_before_updates(config: Config) -> int:
    """Returns the number of transitions that a run must have before it updates."""
    return max(config.batch_size, config.learning_starts + 1)


def sum_up(metrics: Sequence[Metrics]) -> Metrics:
    """Returns the means over an episode's updates, and the highest max_q; NaN if there are no updates."""
    if not metrics:
        return Metrics(*[math.nan] * len(Metrics._fields))
    loss, mean_q, max_q, td_error = zip(*metrics, strict=True)
    n = len(metrics)
    return Metrics(sum(loss) / n, sum(mean_q) / n, max(max_q), sum(td_error) / n)


def is_all_finite(*tensors: tf.Tensor) -> tf.Tensor:
    """Returns whether all numbers are finite, as a boolean scalar; integers always are."""
    floats = [x for x in map(tf.convert_to_tensor, tensors) if x.dtype.is_floating]
    if not floats:
        return tf.constant(True)
    dtype = floats[0].dtype if len({x.dtype for x in floats}) == 1 else tf.float64
    numbers = tf.concat([tf.reshape(tf.cast(x, dtype), [-1]) for x in floats], axis=0)
    return tf.reduce_all(tf.math.is_finite(numbers))
