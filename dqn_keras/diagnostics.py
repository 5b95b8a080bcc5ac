"""What is measured on the way, so that one can see why a run learns or does not."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

from dqn_keras._tensorflow import tf
from dqn_keras.agent import Episode
from dqn_keras.config import Config
from dqn_keras.learn import Formulas, Metrics, gradient_step
from dqn_keras.networks import is_all_finite
from dqn_keras.programs import Learner
from dqn_keras.replay import Experience


def checked_step(experiences: Experience, learner: Learner, gamma: Any, tau: Any, formulas: Formulas) -> Metrics:
    """`gradient_step`, its loss NaN if the update has left a weight that is not finite."""
    metrics = gradient_step(experiences, gamma, *learner, tau, formulas)
    loss = tf.where(is_all_finite(*learner.q_network.weights), metrics.loss, math.nan)
    return metrics._replace(loss=loss)


def sum_up(metrics: Sequence[Metrics]) -> Metrics:
    """Of an episode's updates: the means, and the highest max_q; NaN if there are none."""
    if not metrics:
        return Metrics(*[math.nan] * len(Metrics._fields))
    loss, mean_q, max_q, td_error = zip(*metrics, strict=True)
    n = len(metrics)
    return Metrics(sum(loss) / n, sum(mean_q) / n, max(max_q), sum(td_error) / n)


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
