"""Networks and optimizers of finished runs, kept for the next run with the same sizes: new ones take 25 ms."""

import numpy as np

from dqn_keras._engine.programs import Learner
from dqn_keras.networks import renew_weights

_kept: dict[tuple[int, ...], Learner] = {}


def recycle(learner: Learner) -> None:
    """Keeps a learner that is no longer used, if the package made all of it."""
    if sizes := learner.sizes():
        _kept[sizes] = learner


def recycled(sizes: tuple[int, ...], alpha: float, seed: np.random.SeedSequence) -> Learner | None:
    """Returns a kept learner, reset to equal a new one for `alpha` and `seed`; None if there is none."""
    learner = _kept.pop(sizes, None)
    if learner:
        renew_weights(learner.q_network, seed)
        learner.q_hat_network.set_weights(learner.q_network.get_weights())
        for variable in learner.optimizer.variables:
            variable.assign(np.zeros(variable.shape, variable.dtype))
        learner.optimizer.learning_rate = alpha
    return learner
