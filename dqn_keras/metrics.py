"""The agent: everything that a run changes, and the record of one of its episodes."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

from dqn_keras._engine.programs import Learner
from dqn_keras._engine.tensorflow import tf
from dqn_keras.checks.formulas import Formulas
from dqn_keras.config import Config
from dqn_keras.learn import Metrics, gradient_step
from dqn_keras.replay import Experience


class Episode(NamedTuple):
    """What happened in one episode."""

    number: int
    """Counted from 0."""
    reward: float
    """Sum of its rewards, undiscounted."""
    steps: int
    epsilon: float
    """With which it was played."""
    loss: float
    """Mean over its updates, as are the next three but for max_q; NaN if it had none."""
    mean_q: float
    """Mean over a batch of max_a Q(s, a)."""
    max_q: float
    """The highest Q-value in any of its batches."""
    td_error: float
    """Mean over a batch of |y - Q(s, a)|."""
    max_reward: float
    """The highest of one step."""
    terminated: bool
    """Whether the environment ended it, not time."""


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


LOGGED = {
    "reward": "Sum of the episode's rewards, undiscounted.",
    "average_reward": "Mean over the last `solved_window` episodes, over fewer at the start.",
    "steps": "Environment steps.",
    "epsilon": "With which it was played.",
    "loss": "Mean over the episode's updates, as are mean_q and td_error; NaN before the first.",
    "mean_q": "Mean over a batch of max_a Q(s, a).",
    "max_q": "The highest of them in any of the episode's batches.",
    "q_bound": "What no return can exceed, by the rewards seen so far: the highest, r_max, at every step, "
    "r_max / (1 - gamma); or, where even r_max is negative, r_max once and then the end.",
    "td_error": "Mean over a batch of |y - Q(s, a)|.",
    "terminal_share": "Of the transitions in the memory.",
    "steps_per_second": "Environment steps, learning included; NaN if the episode was played before a resume.",
}
"""What callbacks are told of an episode, and `run.history` holds."""


class Log:
    """The record of a run, episode by episode, as Keras' callbacks are told of it."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._rewards: deque[float] = deque(maxlen=config.solved_window)
        self._memory: deque[tuple[int, bool]] = deque()
        """Of every episode that the memory holds transitions of: steps, and whether it terminated."""
        self._steps = self._terminated = 0
        self._max_reward = -math.inf

    def add(self, episode: Episode, steps_per_second: float) -> dict[str, float]:
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
        return {
            "reward": episode.reward,
            "average_reward": sum(self._rewards) / len(self._rewards),
            "steps": episode.steps,
            "epsilon": episode.epsilon,
            "loss": episode.loss,
            "mean_q": episode.mean_q,
            "max_q": episode.max_q,
            "q_bound": _highest_return(self._max_reward, config.gamma),
            "td_error": episode.td_error,
            "terminal_share": self._terminated / min(self._steps, config.memory_size),
            "steps_per_second": steps_per_second,
        }


def _highest_return(max_reward: float, gamma: float) -> float:
    if max_reward <= 0:
        return max_reward
    return max_reward / (1 - gamma) if gamma < 1 else math.inf


def history(episodes: Sequence[Episode], config: Config, steps_per_second: Sequence[float]) -> dict[str, list[float]]:
    """What `Log` tells of these episodes, name by name, as Keras' `History.history`."""
    log = Log(config)
    rows = [log.add(*x) for x in zip(episodes, steps_per_second, strict=True)]
    return {name: [row[name] for row in rows] for name in LOGGED}


def is_all_finite(*tensors: tf.Tensor) -> tf.Tensor:
    """A boolean scalar. Whole numbers are."""
    floats = [x for x in map(tf.convert_to_tensor, tensors) if x.dtype.is_floating]
    return tf.reduce_all([tf.reduce_all(tf.math.is_finite(x)) for x in floats])
