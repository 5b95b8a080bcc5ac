"""Upper bounds for processes that a test waits for."""

import contextlib
import threading


@contextlib.contextmanager
def killed_after(seconds, process):
    """Kills a process that is still running when the time is over, so that no test waits forever."""
    timer = threading.Timer(seconds, process.kill)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
