"""What is measured on the way, so that one can see why a run learns or does not."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from dqn_keras._tensorflow import tf
from dqn_keras.agent import Episode
from dqn_keras.config import Config
from dqn_keras.learn import gradient_step, td_errors
from dqn_keras.networks import is_all_finite
from dqn_keras.programs import Learner
from dqn_keras.replay import Experience


class Measures(NamedTuple):
    """Of one update's batch, before the update; float32 scalars."""

    loss: Any
    """NaN also if the update has left a weight that is not finite."""
    mean_q: Any
    """Mean over the batch of max_a Q(s, a), the metric of Mnih et al. 2013."""
    max_q: Any
    """The highest of them."""
    td_error: Any
    """Mean of |y - Q(s, a)|."""


def measured_step(batch: Experience, learner: Learner, config: Config, loss: Callable) -> Measures:
    """`gradient_step`, and what it was like. XLA finds that both ask for the same values, and computes them once."""
    q = tf.reduce_max(learner.q_network(batch.state), axis=-1)  # [B]
    errors = td_errors(batch, config.gamma, learner.q_network, learner.q_hat_network)  # [B]
    value = gradient_step(batch, config.gamma, *learner, config.tau, loss)
    value = tf.where(is_all_finite(*learner.q_network.weights), value, math.nan)
    return Measures(value, tf.reduce_mean(q), tf.reduce_max(q), tf.reduce_mean(tf.abs(errors)))


def sum_up(measures: Sequence[Measures]) -> Measures:
    """Of an episode's updates: the means, and the highest max_q; NaN if there are none."""
    if not measures:
        return Measures(*[math.nan] * len(Measures._fields))
    loss, mean_q, max_q, td_error = zip(*measures, strict=True)
    n = len(measures)
    return Measures(sum(loss) / n, sum(mean_q) / n, max(max_q), sum(td_error) / n)


class Logged(NamedTuple):
    """What callbacks are told of an episode, and `run.history` holds."""

    reward: float
    """Sum of the episode's rewards, undiscounted."""
    average_reward: float
    """Mean over the last `solved_window` episodes, over fewer at the start."""
    steps: int
    epsilon: float
    """With which it was played."""
    loss: float
    """Mean over the episode's updates, as are mean_q and td_error; NaN before the first."""
    mean_q: float
    """Mean over a batch of max_a Q(s, a)."""
    max_q: float
    """The highest of them in any of the episode's batches."""
    q_bound: float
    """What no return can exceed, by the rewards seen so far: the highest, r_max, at every step, r_max / (1 - gamma);
    or, where even r_max is negative, r_max once and then the end."""
    td_error: float
    """Mean over a batch of |y - Q(s, a)|."""
    terminal_share: float
    """Of the transitions in the memory."""
    steps_per_second: float
    """Environment steps, learning included; NaN if the episode was played before a resume."""


class Log:
    """The record of a run, episode by episode, as Keras' callbacks are told of it."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._rewards: deque[float] = deque(maxlen=config.solved_window)
        self._memory: deque[tuple[int, bool]] = deque()
        """Of every episode that the memory holds transitions of: steps, and whether it terminated."""
        self._steps = self._terminated = 0
        self._max_reward = -math.inf

    def add(self, episode: Episode, steps_per_second: float) -> Logged:
        """What is known at the end of the next episode."""
        config = self._config
        self._rewards.append(episode.reward)
        self._max_reward = max(self._max_reward, episode.max_reward)
        self._memory.append((episode.steps, episode.terminated))
        self._steps += episode.steps
        self._terminated += episode.terminated
        while self._steps - self._memory[0][0] >= config.memory_size:  # none of the oldest's is left
            steps, terminated = self._memory.popleft()
            self._steps -= steps
            self._terminated -= terminated
        return Logged(
            episode.reward,
            sum(self._rewards) / len(self._rewards),
            episode.steps,
            episode.epsilon,
            episode.loss,
            episode.mean_q,
            episode.max_q,
            _highest_return(self._max_reward, config.gamma),
            episode.td_error,
            self._terminated / min(self._steps, config.memory_size),
            steps_per_second,
        )


def _highest_return(max_reward: float, gamma: float) -> float:
    if max_reward <= 0:
        return max_reward
    return max_reward / (1 - gamma) if gamma < 1 else math.inf


def history(episodes: Sequence[Episode], config: Config, steps_per_second: Sequence[float]) -> dict[str, list[float]]:
    """What `Log` tells of these episodes, name by name, as Keras' `History.history`."""
    log = Log(config)
    rows = [log.add(*x) for x in zip(episodes, steps_per_second, strict=True)]
    columns = zip(*rows, strict=True) if rows else [()] * len(Logged._fields)
    return {name: list(column) for name, column in zip(Logged._fields, columns, strict=True)}
