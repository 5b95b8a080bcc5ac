"""Calls Keras callbacks in a run, in the order of `model.fit`: each episode is an epoch of one batch."""

import math
from collections.abc import Generator, Iterator, Sequence
from typing import TYPE_CHECKING

from dqn_keras._engine.tensorflow import keras
from dqn_keras.agent import DivergedError
from dqn_keras.evaluation import Evaluation
from dqn_keras.metrics import LOGGED, Episode, Log

if TYPE_CHECKING:
    from dqn_keras.training import Run


_NAMES = sorted(LOGGED)


class Listeners:
    """The callbacks of a run. As in `fit`, none is called after an exception."""

    def __init__(self, run: "Run", callbacks: Sequence[keras.callbacks.Callback]) -> None:
        self._run, self._network = run, run.q_network
        # An Evaluation comes first, so that all others find its mean return in the logs.
        self.callbacks = sorted(callbacks, key=lambda callback: not isinstance(callback, Evaluation))
        self._list = keras.callbacks.CallbackList(
            self.callbacks, model=self._network, epochs=run.config.num_episodes, steps=1, verbose=0
        )
        self._log = Log(run.config)
        self._last_logs: dict[str, float] | None = None
        for episode, speed in zip(run.episodes, run.steps_per_second, strict=True):
            self._log.add(episode, speed)
        for callback in self.callbacks:
            if isinstance(callback, Evaluation):
                callback.num_steps = sum(episode.steps for episode in run.episodes)

    def begin(self) -> None:
        """Calls `on_train_begin`."""
        self._network.stop_training = False
        self._list.on_train_begin()

    def end(self) -> None:
        """Calls `on_train_end`."""
        self._list.on_train_end(self._last_logs)

    def reported(self, episodes: Iterator[Episode]) -> Generator[Episode, None, None]:
        """Yields the same episodes and reports each to the callbacks, until a callback stops the run.

        If learning diverges and TerminateOnNaN stops the run, no error is raised.
        """
        agent, number = self._run.agent, len(self._run.episodes)
        while number < len(agent.episodes) or not agent.is_done(self._run.config):
            self._call("on_epoch_begin", number, {})
            self._call("on_train_batch_begin", 0, {})
            try:
                episode = next(episodes)
            except DivergedError:
                self._call("on_train_batch_end", 0, {"loss": math.nan})
                if not self._network.stop_training:
                    raise
                self._run.diverged = True
                self._end_epoch(number, dict.fromkeys(LOGGED, math.nan))
                return
            logs = self._log.add(episode, self._run.steps_per_second[number])
            self._call("on_train_batch_end", 0, {} if math.isnan(episode.loss) else {"loss": episode.loss})
            self._end_epoch(number, logs)
            yield episode
            if self._network.stop_training:
                return
            number += 1

    def _call(self, event: str, number: int, logs: dict[str, float]) -> None:
        for callback in self.callbacks:  # a CallbackList's own methods take 50 us: they look for tensors
            getattr(callback, event)(number, logs)

    def _end_epoch(self, number: int, logs: dict[str, float]) -> None:
        self._last_logs = logs
        for callback in self.callbacks:
            if isinstance(callback, keras.callbacks.CSVLogger) and not callback.writer:
                callback.keys = sorted(logs)  # otherwise it also writes an empty column val_NAME for each
            if type(callback) is keras.callbacks.CSVLogger and callback.writer and callback.keys == _NAMES:
                # Writes the same row as its on_epoch_end, without a search for arrays in the logs.
                callback.writer.writer.writerow([number, *map(logs.get, callback.keys)])
                callback.csv_file.flush()
            else:
                callback.on_epoch_end(number, logs)
        for name in logs.keys() - LOGGED.keys():  # for `run.history`, as in Keras' History
            values = self._run.added_logs.setdefault(name, [])
            values += [math.nan] * (number - len(values)) + [logs[name]]
