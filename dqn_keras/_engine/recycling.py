"""Keeps the networks and optimizers of finished runs for the next run with the same sizes: new ones take 25 ms."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dqn_keras._engine.programs import Learner, bind
from dqn_keras._engine.tensorflow import tf
from dqn_keras.networks import start_weights

_kept: dict[tuple[int, ...], Learner] = {}


def recycle(learner: Learner) -> None:
    """Keeps a learner that is no longer used, if the package made all of it."""
    if sizes := learner.sizes():
        _kept[sizes] = learner


def recycled(sizes: tuple[int, ...], alpha: float, seed: np.random.SeedSequence) -> Learner | None:
    """Returns a kept learner, reset to equal a new one for `alpha` and `seed`; None if there is none."""
    learner = _kept.pop(sizes, None)
    if learner:
        numbers = [*start_weights(learner.q_network, seed), tf.constant(alpha)]
        specs = [tf.TensorSpec(x.shape) for x in numbers]
        bind(_make_reset, specs, learner, key="reset", has_own_parts=False, jit_compile=False)(*numbers)
    return learner


def _make_reset(learner: Learner, _: Any) -> Callable[..., tf.Tensor]:
    def reset(*numbers: tf.Tensor) -> tf.Tensor:
        *weights, alpha = numbers
        for network in (learner.q_network, learner.q_hat_network):
            for variable, value in zip(network.variables, weights, strict=True):
                variable.assign(value)
        for variable in learner.optimizer.variables:
            variable.assign(tf.zeros(variable.shape, variable.dtype))
        learner.optimizer.learning_rate.assign(alpha)
        return alpha

    return reset
