"""Metrics: the record of an episode and the logged values."""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dqn_keras.config import Config


class Episode(NamedTuple):
    """The record of one episode."""

    number: int
    """Number of the episode, from 0."""
    reward: float
    """Undiscounted sum of its rewards; NaN if `num_steps` cut the episode short."""
    steps: int
    epsilon: float
    """Probability of a random action; if it changes within the episode, its value at the first step."""
    loss: float
    """Mean loss over its updates. This and the next three are NaN if it had no updates."""
    mean_q: float
    """Mean over its batches of max_a Q(s, a)."""
    max_q: float
    """Highest Q-value in its batches."""
    td_error: float
    """Mean over its batches of |y - Q(s, a)|."""
    max_reward: float
    """Highest reward of a single step."""
    terminated: bool
    """Whether the environment terminated the episode; False after a time limit."""


class Outcome(NamedTuple):
    """The result of one seed of a study."""

    seed: int
    rewards: np.ndarray
    """Reward of each episode, [num_episodes] float64, as in `Run.rewards`."""
    steps: np.ndarray
    """Environment steps of each episode, [num_episodes] int64."""
    solved_at: int | None
    """Number of the episode after which the stop rule held, as in `Run.solved_at`; None if it never did."""
    greedy_return: float
    """Mean return of 100 greedy episodes after the run; NaN without `evaluate_on`."""
    seconds: float
    """Time that the training took, without the evaluation."""
    digest: bytes
    """SHA-256 of the final weights of both networks; equal if the weights are equal, bit for bit."""


LOGGED = {
    "reward": "Undiscounted sum of the episode's rewards; NaN if `num_steps` cut the episode short.",
    "average_reward": "Mean reward of the last `solved_window` episodes, or of all so far if they are fewer.",
    "steps": "Number of environment steps.",
    "epsilon": "Probability of a random action; at the first step, if it changes within the episode.",
    "loss": "Mean loss over the episode's updates. Without one, loss, mean_q, max_q and td_error are NaN.",
    "mean_q": "Mean over the episode's batches of max_a Q(s, a).",
    "max_q": "Highest Q-value in the episode's batches.",
    "q_bound": "Highest possible return if no reward exceeds the highest so far, r_max. It is r_max / (1 - gamma), the "
    "return of r_max at every step; if r_max is negative, it is r_max, the return of a single step.",
    "td_error": "Mean over the episode's batches of |y - Q(s, a)|.",
    "terminal_share": "Share of terminal transitions in the memory.",
    "steps_per_second": "Environment steps per second, learning included; NaN for episodes from before a resume.",
}
"""The values that are logged for each episode, for callbacks, `run.history` and log.csv; `Log.add` computes them."""


class Log:
    """The logged values of a run, computed episode by episode."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._rewards: deque[float] = deque(maxlen=config.solved_window)
        self._memory: deque[tuple[int, bool]] = deque()
        """Steps of each episode that has transitions in the memory, and whether it terminated."""
        self._steps = self._terminated = 0
        self._max_reward = -math.inf

    def add(self, episode: Episode, steps_per_second: float) -> dict[str, float]:
        """Adds the next episode and returns its logged values."""
        config = self._config
        if not math.isnan(episode.reward):
            self._rewards.append(episode.reward)
        self._max_reward = max(self._max_reward, episode.max_reward)
        self._memory.append((episode.steps, episode.terminated))
        self._steps += episode.steps
        self._terminated += episode.terminated
        while self._steps - self._memory[0][0] >= config.memory_size:  # no transition of the oldest is left
            steps, terminated = self._memory.popleft()
            self._steps -= steps
            self._terminated -= terminated
        return {
            "reward": episode.reward,
            "average_reward": sum(self._rewards) / len(self._rewards) if self._rewards else math.nan,
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
    """Returns the logged values of these episodes, one list for each name, like Keras' `History.history`."""
    log = Log(config)
    rows = [log.add(*x) for x in zip(episodes, steps_per_second, strict=True)]
    return {name: [row[name] for row in rows] for name in LOGGED}
