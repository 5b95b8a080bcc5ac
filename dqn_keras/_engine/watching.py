"""Whether something that a compiled program was traced from has been changed since.

A trace reads attributes, closures and global names once. `Watch` remembers what they were: a look at it takes a few
microseconds, where tracing again takes a second.
"""

import functools
import sys
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from dqn_keras._engine.tensorflow import keras

_KERAS_PARTS = (
    keras.layers.Layer,
    keras.losses.Loss,
    keras.optimizers.Optimizer,
    keras.optimizers.schedules.LearningRateSchedule,
    keras.regularizers.Regularizer,
    keras.constraints.Constraint,
)


_LARGEST_CONTAINER = 1_000  # beyond, what is in it is not looked at


class Watch:
    """The state of some objects, as far as a trace can have read it.

    Seen are the attributes of Keras' objects and of the user's own, methods and attributes of the user's classes, and
    of the user's functions the code, the closure and the global names they use, through any number of such steps.
    Containers and arrays of more than a thousand items are taken for the same as long as they are the same object, and
    so are those in private attributes of Keras' objects, and a whole number is for an equal float.
    """

    def __init__(self, *parts: Any) -> None:
        self._looks: list[tuple[Callable[[], Any], Any]] = []
        self._visited: dict[int, Any] = {}
        self._classes: set[type] = set()
        for part in parts:
            self._visit(part)

    def is_unchanged(self) -> bool:
        """Whether all is as it was."""
        try:
            return all(look() == seen for look, seen in self._looks)  # of equal objects `==` asks only their identity
        except Exception:  # arrays and tensors that are other ones cannot be compared like that
            return False

    def _visit(self, value: Any) -> None:
        if id(value) in self._visited:
            return
        self._visited[id(value)] = value  # kept alive, so that no other object gets its id
        if isinstance(value, FunctionType):
            if not is_of_a_library(value.__module__):
                self._look(lambda: {**read_by(value), "": (value.__code__, value.__defaults__, value.__kwdefaults__)})
        elif isinstance(value, MethodType):
            self._visit(value.__func__)
            self._visit(value.__self__)
        elif isinstance(value, functools.partial):
            self._look(lambda: [value.func, *value.args, *value.keywords.values()])
        elif isinstance(value, property | staticmethod | classmethod):
            self._visit(value.fget if isinstance(value, property) else value.__func__)
        elif isinstance(value, np.ndarray):
            if value.size <= _LARGEST_CONTAINER:
                self._looks.append((value.tobytes, value.tobytes()))
        elif isinstance(value, keras.Variable):
            self._look(lambda: [value.trainable, value.regularizer, value.constraint])
        elif isinstance(value, type):
            for base in value.__mro__:
                if not is_of_a_library(base.__module__):
                    self._visit_class(base)
        elif isinstance(value, list | tuple | set | frozenset | dict):
            if len(value) <= _LARGEST_CONTAINER:
                self._look(lambda: dict(value) if isinstance(value, dict) else list(value))
        elif isinstance(value, _KERAS_PARTS):
            self._visit(type(value))
            attributes = vars(value)
            self._looks.append((lambda: attributes, dict(attributes)))
            is_users = not is_of_a_library(type(value).__module__)
            for name, attribute in attributes.items():
                if not isinstance(attribute, list | dict | tuple | set) or (is_users and name[0] != "_"):
                    self._visit(attribute)  # in other containers Keras keeps its books
        elif isinstance(value, SimpleNamespace) or not (
            isinstance(value, ModuleType) or is_of_a_library(type(value).__module__)
        ):
            self._visit(type(value))
            if hasattr(value, "__dict__"):
                self._look(lambda: dict(vars(value)))

    def _visit_class(self, value: type) -> None:
        if value not in self._classes:
            self._classes.add(value)
            self._look(lambda: dict(vars(value)))

    def _look(self, look: Callable[[], list | dict]) -> None:
        seen = look()
        self._looks.append((look, seen))
        for value in seen.values() if isinstance(seen, dict) else seen:
            self._visit(value)


@functools.cache
def is_of_a_library(module: str | None) -> bool:
    """Whether it is part of Python or was installed, so that it does not change while the process lives."""
    package = (module or "").partition(".")[0]
    if package == "__main__":
        return False
    file = getattr(sys.modules.get(package), "__file__", None)
    return file is None or package in sys.stdlib_module_names | {"dqn_keras"} or "site-packages" in file


def read_by(function: FunctionType) -> dict[str, Any]:
    """What the function's closure and global names hold now, by name."""
    code, read = function.__code__, {}
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        try:
            read[name] = cell.cell_contents
        except ValueError:  # not filled yet
            read[name] = None
    names = set(_names(code))
    for name in names & function.__globals__.keys():
        read[name] = value = function.__globals__[name]
        if isinstance(value, ModuleType) and not is_of_a_library(value.__name__):
            read |= {f"{name}.{x}": vars(value)[x] for x in names & vars(value).keys()}
    return read


def _names(code: CodeType) -> Iterator[str]:
    """The names that the code and the functions in it use: global ones, and attributes."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
