"""Interruption: Ctrl-C and SIGTERM stop a run at a safe point, instead of raising an exception at any point."""

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

    It is a KeyboardInterrupt, so it also ends a loop or a script around `train`.
    """

    run: "Run"
    """The run up to its last episode."""

    def __init__(self, run: "Run", folder: Path | None) -> None:
        super().__init__(run, folder)
        self.run, self._folder = run, folder

    def __reduce__(self) -> tuple:
        return KeyboardInterrupt, (str(self),)  # pickling the run would lose its optimizer's state

    def __str__(self) -> str:
        after = f"after {len(self.run.episodes)} episodes"
        if not self.run.interrupted:
            return f"{after}, the last of the run; the exception's `run` has them"
        if self._folder is None:
            return f"{after}; the exception's `run` has them (in a notebook: sys.last_value.run)"
        return f"{after}, which are saved in {self._folder}; train(..., resume=True) continues"


class _Requests:
    """A signal handler that notes the first signal and raises KeyboardInterrupt at the second."""

    def __init__(self) -> None:
        self.signals: list[int] = []

    def __call__(self, number: int, _: Any) -> None:
        self.signals.append(number)
        if len(self.signals) > 1:
            raise KeyboardInterrupt


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Yields a function that returns whether Ctrl-C or SIGTERM has come. A second one raises KeyboardInterrupt at once.

    Interrupting a notebook cell counts as Ctrl-C. Handlers that other code has set stay in place. Python handles
    signals only in the main thread, so in another thread the function always returns False.
    """
    requests = _Requests()
    with _handled_by(requests, signal.SIGINT, signal.SIGTERM):
        yield lambda: bool(requests.signals)


def sigterm_interrupts() -> contextlib.AbstractContextManager[None]:
    """Makes SIGTERM raise KeyboardInterrupt in the block, as Ctrl-C does, unless other code handles it."""
    return _handled_by(signal.default_int_handler, signal.SIGTERM)


@contextlib.contextmanager
def _handled_by(handler: Callable, *numbers: int) -> Iterator[None]:
    """Sets the handler of these signals, unless other code has set one; restores the earlier handler at the end."""
    previous = {}
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            before = signal.getsignal(number)
            if before in (signal.SIG_DFL, signal.default_int_handler) or isinstance(before, _Requests):
                previous[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)
