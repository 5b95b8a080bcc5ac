"""TensorFlow and Keras, imported without log output, after a check that Keras runs on TensorFlow.

All other modules import `keras` and `tf` from here, so that the order in which they are imported does not matter.
"""

import contextlib
import functools
import os
from collections.abc import Iterator


@contextlib.contextmanager
def _native_stderr_silenced() -> Iterator[None]:
    """Discards output to file descriptor 2: TensorFlow's C++ code logs there before it reads its log level."""
    try:
        saved = os.dup(2)
    except OSError:  # a process without standard error has nothing to silence
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


def require_tensorflow_backend(name: str) -> None:
    """Raises ImportError, with the remedy, if the backend `name` is not TensorFlow."""
    if name != "tensorflow":
        raise ImportError(
            f"dqn_keras needs Keras on TensorFlow, not on {name!r}: "
            "unset KERAS_BACKEND, or set it to 'tensorflow' before Keras is imported"
        )


os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # errors still show
# If pygame opens a window with OpenGL, a process with TensorFlow crashes: each of the two loads its own LLVM.
os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
require_tensorflow_backend(os.environ.get("KERAS_BACKEND", "tensorflow"))
with _native_stderr_silenced():
    import keras
    import tensorflow as tf

    tf.config.list_physical_devices()  # TensorFlow looks for GPUs once, and logs errors if there is none
require_tensorflow_backend(keras.backend.backend())

__all__ = ["keras", "require_xla", "tf"]


@functools.cache
def require_xla() -> None:
    """Raises RuntimeError, with the remedy, if TensorFlow has no XLA compiler for this machine."""
    try:
        _compile_something()
    except tf.errors.OpError as error:
        raise RuntimeError(
            "XLA cannot compile on this machine; Config(jit_compile=False), or learn(..., jit_compile=False), does "
            f"without it in the Gymnasium loop ({error.message.splitlines()[0]})"
        ) from error


def _compile_something() -> None:
    tf.function(tf.identity, jit_compile=True)(tf.constant(0.0))
