"""TensorFlow and Keras, imported without a word, and Keras checked to run on TensorFlow.

The other modules take `keras` and `tf` from here, so that it does not matter which of them is imported first.
"""

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


def require_tensorflow_backend(name: str) -> None:
    """ImportError, with what to do, if `name` is not the backend that the package needs."""
    if name != "tensorflow":
        raise ImportError(
            f"dqn_keras needs Keras on TensorFlow, not on {name!r}: "
            "unset KERAS_BACKEND, or set it to 'tensorflow' before Keras is imported"
        )


os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # errors still show
# A window that pygame opens with OpenGL kills a process that has TensorFlow in it: both bring an LLVM of their own.
os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
require_tensorflow_backend(os.environ.get("KERAS_BACKEND", "tensorflow"))
with _native_stderr_silenced():
    import keras
    import tensorflow as tf

    tf.config.list_physical_devices()  # it looks for GPUs once, and complains where there is none
require_tensorflow_backend(keras.backend.backend())

__all__ = ["keras", "require_xla", "tf"]


@functools.cache
def require_xla() -> None:
    """RuntimeError, with what to do, where TensorFlow has no XLA compiler for this machine."""
    try:
        _compile_something()
    except tf.errors.OpError as error:
        raise RuntimeError(
            "XLA cannot compile on this machine; Config(jit_compile=False), or learn(..., jit_compile=False), does "
            f"without it in the Gymnasium loop ({error.message.splitlines()[0]})"
        ) from error


def _compile_something() -> None:
    tf.function(tf.identity, jit_compile=True)(tf.constant(0.0))
