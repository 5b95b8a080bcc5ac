"""TensorFlow, imported without a word, and checked to be the backend that Keras runs on."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def _native_stderr_silenced() -> Iterator[None]:
    """Send descriptor 2 to nowhere: TensorFlow's C++ code logs there before its log level is read."""
    try:
        saved = os.dup(2)
    except OSError:  # a process without a standard error has nothing to silence
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


def require_tensorflow_backend() -> None:
    """Import TensorFlow and Keras quietly; ImportError if Keras was told to run on something else."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # errors still show
    with _native_stderr_silenced():
        import keras
        import tensorflow  # noqa: F401
    if keras.backend.backend() != "tensorflow":
        raise ImportError(
            f"dqn_keras needs Keras on TensorFlow, but Keras runs on {keras.backend.backend()!r}; "
            "unset KERAS_BACKEND or set it to 'tensorflow' before Keras is imported"
        )
