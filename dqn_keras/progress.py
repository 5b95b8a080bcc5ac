"""The printed lines and the progress bar of a run, in a terminal or in a notebook."""

import math
import warnings
from typing import TYPE_CHECKING

import numpy as np
from tqdm import TqdmWarning

from dqn_keras.metrics import Episode

if TYPE_CHECKING:
    from dqn_keras.training import Run

with warnings.catch_warnings(action="ignore", category=TqdmWarning):  # without ipywidgets a notebook's bar is text
    from tqdm.auto import tqdm


__all__ = ["Progress", "tqdm"]


class Progress:
    """Prints the same lines as the original; with `verbose` 2, also shows a progress bar."""

    def __init__(self, run: "Run", verbose: int) -> None:
        self._run, self._verbose = run, verbose
        num_steps, num_episodes = run.config.num_steps, run.config.num_episodes
        self._counts_steps = num_steps is not None
        done = run.agent.memory.num_appended if num_steps else len(run.episodes)
        unit = "step" if num_steps else "episode"
        self._bar = tqdm(total=num_steps or num_episodes, initial=done, unit=unit, disable=verbose < 2)

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def show(self, episode: Episode) -> None:
        """Moves the bar. Every 100 episodes, also prints the last reward and the average of the last 100."""
        self._bar.update(episode.steps if self._counts_steps else 1)
        if self._verbose and episode.number % 100 == 0 and not math.isnan(episode.reward):
            last = [e.reward for e in self._run.episodes[max(0, episode.number - 99) : episode.number + 1]]
            say = self._bar.write if self._verbose == 2 else print
            average = round(float(np.mean(last)), 2)
            say(f"Episode {episode.number}, Reward: {episode.reward}, Last 100 Average: {average}")

    def show_end(self) -> None:
        """Prints a line if the run is solved."""
        run = self._run
        if self._verbose and run.solved_at is not None:
            average = round(float(np.mean(run.rewards[-run.config.solved_window :])), 2)
            print(f"Solved with {average} reward in {run.solved_at} episodes!")
