"""Keras callbacks in a run: each episode is an epoch of one batch."""

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import TYPE_CHECKING

from dqn_keras._engine.tensorflow import keras
from dqn_keras.agent import DivergedError
from dqn_keras.metrics import LOGGED, Episode, Log

if TYPE_CHECKING:
    from dqn_keras.training import Run


def with_callbacks(
    episodes: Iterator[Episode],
    run: "Run",
    callbacks: Sequence[keras.callbacks.Callback],
    before_end: Callable[[], None],
) -> Generator[Episode, None, None]:
    """Yields the same episodes and reports each to the callbacks, until one of them asks to stop.

    If learning diverges, TerminateOnNaN asks to stop, and then there is no error. `before_end` is called before the
    callbacks' `on_train_end`.
    """
    network, log, num_episodes = run.q_network, Log(run.config), run.config.num_episodes
    network.stop_training = False
    listeners = keras.callbacks.CallbackList(callbacks, model=network, epochs=num_episodes, steps=1, verbose=0)
    for episode, speed in zip(run.episodes, run.steps_per_second, strict=True):
        log.add(episode, speed)
    listeners.on_train_begin()
    for callback in listeners.callbacks:
        if isinstance(callback, keras.callbacks.CSVLogger):
            callback.keys = sorted(LOGGED)  # or it adds an empty column val_NAME for each, at the same cost
    try:
        for number in range(len(run.episodes), num_episodes):
            try:
                yield _told(episodes, number, log, run, listeners.callbacks)
            except DivergedError:
                if not network.stop_training:
                    raise
                run.diverged = True
                return
            if network.stop_training:
                return
    finally:
        before_end()
        listeners.on_train_end()


def _told(
    episodes: Iterator[Episode], number: int, log: Log, run: "Run", callbacks: Sequence[keras.callbacks.Callback]
) -> Episode:
    """Plays the next episode and reports it to the callbacks."""

    def tell(event: str, number: int, logs: dict[str, float]) -> None:
        for callback in callbacks:  # a CallbackList's own methods take 50 us: they look for tensors in the logs
            getattr(callback, event)(number, logs)

    tell("on_epoch_begin", number, {})
    tell("on_train_batch_begin", 0, {})
    try:
        episode = next(episodes)
    except DivergedError:
        tell("on_train_batch_end", 0, {"loss": math.nan})
        raise
    logs = log.add(episode, run.steps_per_second[number])
    tell("on_train_batch_end", 0, {} if math.isnan(episode.loss) else {"loss": episode.loss})
    for callback in callbacks:
        if type(callback) is keras.callbacks.CSVLogger and callback.writer:
            # The same row as its on_epoch_end writes, without a search for arrays in the logs.
            callback.writer.writer.writerow([number, *map(logs.get, callback.keys)])
            callback.csv_file.flush()
        else:
            callback.on_epoch_end(number, logs)
    return episode
