"""Ctrl-C and SIGTERM as requests to stop at a safe point, instead of exceptions at any point."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dqn_keras.training import Run


class TrainingInterrupted(KeyboardInterrupt):
    """Raised by `train` at the end of an episode, after Ctrl-C, an interrupted notebook cell or SIGTERM.

    It is a KeyboardInterrupt, so that it also ends the loop or the script around `train`.
    """

    run: "Run"
    """The run up to its last episode."""

    def __init__(self, run: "Run", folder: Path | None) -> None:
        super().__init__(run, folder)
        self.run, self._folder = run, folder

    def __str__(self) -> str:
        after = f"after {len(self.run.episodes)} episodes"
        if self._folder is None:
            return f"{after}; the exception's `run` has them (in a notebook: sys.last_value.run)"
        return f"{after}, which are saved in {self._folder}; train(..., resume=True) continues"


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Yields a function that returns whether Ctrl-C or SIGTERM has come. A second one raises KeyboardInterrupt at once.

    Interrupting a notebook cell is a Ctrl-C. Handlers that other code has set stay in place. Python handles signals in
    the main thread alone, so in another thread the function always returns False.
    """
    requests: list[int] = []

    def note(number: int, _: Any) -> None:
        requests.append(number)
        if len(requests) > 1:
            raise KeyboardInterrupt

    previous = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                previous[number] = signal.signal(number, note)
    try:
        yield lambda: bool(requests)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
