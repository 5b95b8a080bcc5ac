"""TensorFlow, imported without a word, and checked to be the backend that Keras runs on."""

import contextlib
import functools
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
    advice = "unset KERAS_BACKEND, or set it to 'tensorflow' before Keras is imported"
    if os.environ.get("KERAS_BACKEND", "tensorflow") != "tensorflow":
        raise ImportError(f"dqn_keras needs Keras on TensorFlow, not on {os.environ['KERAS_BACKEND']!r}: {advice}")
    with _native_stderr_silenced():
        import keras
        import tensorflow  # noqa: F401
    if keras.backend.backend() != "tensorflow":
        raise ImportError(f"dqn_keras needs Keras on TensorFlow, not on {keras.backend.backend()!r}: {advice}")


@functools.cache
def require_xla() -> None:
    """RuntimeError, with what to do, where TensorFlow has no XLA compiler for this machine."""
    import tensorflow as tf

    try:
        _compile_something()
    except tf.errors.OpError as error:
        raise RuntimeError(
            "XLA cannot compile on this machine; Config(jit_compile=False), or learn(..., jit_compile=False), does "
            f"without it in the Gymnasium loop ({error.message.splitlines()[0]})"
        ) from error


def _compile_something() -> None:
    import tensorflow as tf

    tf.function(tf.identity, jit_compile=True)(tf.constant(0.0))
