"""TensorFlow and Keras, imported without log output, after a check that Keras runs on TensorFlow.

All other modules import `keras` and `tf` from here, so that the order in which they are imported does not matter.
"""

import contextlib
import functools
import gc
import os
import sys
from collections.abc import Iterator

from dqn_keras._engine.cache import use_cache


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


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Stops Python's garbage collector for the block, and excludes what exists at its end from later collections.

    TensorFlow's import makes 700,000 objects and hardly any garbage. Python would look at all of them in each
    full collection, and twice when the process ends, which takes a second.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_enabled:
            gc.enable()


def _set_up_xla() -> None:
    """Sets how XLA compiles in this process, unless the user has.

    XLA compiles a small loop into one function. An undocumented option raises the limit for this from 1 to 100 kB,
    which makes compiled episodes about 1.2 times as fast, with identical results. XLA reads its options when it
    compiles for the first time.

    DQN_KERAS_CACHE is 1 for a cache of compiled programs in the user's cache folder, 0 for no cache, or a folder for
    the cache. Notebooks and the command line have a cache by default. If TensorFlow was imported before the package,
    there is none: TensorFlow would log errors at each program that it reads.
    """
    if "xla_backend_extra_options" not in (flags := os.environ.get("XLA_FLAGS", "")):
        option = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000"
        os.environ["XLA_FLAGS"] = f"{flags} {option}".strip()
    if "tensorflow" not in sys.modules:
        use_cache(os.environ.get("DQN_KERAS_CACHE", "1" if "ipykernel" in sys.modules else "0"))


def require_tensorflow_backend(name: str) -> None:
    """Raises ImportError if the backend `name` is not TensorFlow; the message says what to do."""
    if name != "tensorflow":
        raise ImportError(
            f"dqn_keras needs Keras on TensorFlow, not on {name!r}: "
            "unset KERAS_BACKEND, or set it to 'tensorflow' before Keras is imported"
        )


# If pygame opens a window with OpenGL, a process with TensorFlow crashes: each of the two loads its own LLVM.
os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
require_tensorflow_backend(os.environ.get("KERAS_BACKEND", "tensorflow"))
_set_up_xla()
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # errors still show
with _native_stderr_silenced(), _no_garbage_collection():
    import keras
    import tensorflow as tf

    tf.config.list_physical_devices()  # TensorFlow looks for GPUs once, and logs errors without one
require_tensorflow_backend(keras.backend.backend())

__all__ = ["keras", "require_xla", "tf"]


@functools.cache
def require_xla() -> None:
    """Raises RuntimeError if TensorFlow has no XLA compiler for this machine; the message says what to do.

    If TensorFlow was imported before this package, its log is not silenced. The lines that its first compilation logs
    are discarded here, so that they do not mix with the output of `train`.
    """
    try:
        with _native_stderr_silenced():
            _compile_something()
    except tf.errors.OpError as error:
        raise RuntimeError(
            "XLA cannot compile on this machine; Config(jit_compile=False), or learn(..., jit_compile=False), works "
            f"without it in the Gymnasium loop ({error.message.splitlines()[0]})"
        ) from error


def _compile_something() -> None:
    tf.function(tf.nn.relu, jit_compile=True, autograph=False)(tf.constant(0.0))  # logs what a gradient step logs
