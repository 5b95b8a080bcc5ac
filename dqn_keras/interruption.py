"""Ctrl-C and SIGTERM as a request to stop at a good moment, instead of an exception at any."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """A function that tells whether Ctrl-C or SIGTERM came since; a second one raises KeyboardInterrupt at once.

    An interrupted notebook cell is a Ctrl-C. Handlers that someone else has set stay; in a thread other than the
    main one, which Python sends no signals to, nothing ever comes.
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
