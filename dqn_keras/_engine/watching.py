"""Whether something that a compiled program was traced from has been changed since.

A trace reads attributes, closures and global names once. `Watch` remembers what they were: a look at it takes a few
microseconds, where tracing again takes a second.
"""

import argparse
import dis
import functools
import inspect
import sys
from collections import UserDict, UserList, deque
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, MappingProxyType, MethodType, ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from dqn_keras._engine.libraries import is_of_a_library
from dqn_keras._engine.tensorflow import keras

_KERAS_PARTS = (
    keras.layers.Layer,
    keras.losses.Loss,
    keras.optimizers.Optimizer,
    keras.optimizers.schedules.LearningRateSchedule,
    keras.regularizers.Regularizer,
    keras.constraints.Constraint,
)
_MAPPINGS = (dict, UserDict, MappingProxyType)
_SEQUENCES = (list, tuple, set, frozenset, deque, UserList)
_NAMESPACES = (SimpleNamespace, argparse.Namespace)


_LARGEST_CONTAINER = 1_000  # beyond, what is in it is not looked at


class _Look(NamedTuple):
    name: str
    """Of what is looked at, for a message."""
    look: Callable[[], Any]
    seen: Any


class Watch:
    """The state of some objects, as far as a trace can have read it.

    Seen are the attributes of Keras' objects and of the user's own, methods and attributes of the user's classes, and
    of the user's functions the code, the closure and the global names they use, through any number of such steps. Of
    the object of a bound method, the attributes count that the method and those it calls name.
    Containers and arrays of more than a thousand items are taken for the same as long as they are the same object, and
    so are those in private attributes of Keras' objects, and a whole number is for an equal float.
    """

    def __init__(self, *parts: Any) -> None:
        self._looks: list[_Look] = []
        self._visited: dict[int, Any] = {}
        for part in parts:
            self._visit(part)

    def is_unchanged(self) -> bool:
        """Whether all is as it was."""
        try:
            return all(look() == seen for _, look, seen in self._looks)
        except Exception:  # arrays and tensors that are other ones cannot be compared like that
            return False

    def what_changed(self) -> str:
        """The name of the first thing that has changed."""
        for name, look, seen in self._looks:
            now = look()
            if isinstance(now, dict):
                for key in now.keys() | seen.keys():
                    if not _are_equal(now.get(key, _MISSING), seen.get(key, _MISSING)):
                        return f"{key} of {name}" if key else name
            elif not _are_equal(now, seen):
                return name
        return "nothing"

    def _visit(self, value: Any) -> None:
        if id(value) in self._visited:
            return
        self._visited[id(value)] = value  # kept alive, so that no other object gets its id
        if isinstance(value, FunctionType):
            self._visit_function(value)
        elif isinstance(value, MethodType):
            self._visit_method(value)
        elif isinstance(value, functools.partial):
            self._look("a partial", lambda: [value.func, *value.args, *value.keywords.values()])
        elif isinstance(value, property | staticmethod | classmethod):
            self._visit(value.fget if isinstance(value, property) else value.__func__)
        elif is_of_a_library(type(value)) and (inner := _decorated(value)) is not None:
            self._visit(inner)
        elif isinstance(value, np.ndarray):
            if value.size <= _LARGEST_CONTAINER:
                self._looks.append(_Look("an array", value.tobytes, value.tobytes()))
        elif isinstance(value, keras.Variable):
            self._look(value.path, lambda: [value.trainable, value.regularizer, value.constraint])
        elif isinstance(value, type):
            for base in value.__mro__:
                if not is_of_a_library(base):
                    self._look(base.__qualname__, functools.partial(_of_class, base))
        elif isinstance(value, (*_MAPPINGS, *_SEQUENCES)):
            if len(value) <= _LARGEST_CONTAINER:
                kind = dict if isinstance(value, _MAPPINGS) else list
                self._look(f"a {type(value).__name__}", lambda: kind(value))
        elif isinstance(value, keras.Model):
            self._visit_model(value)
        elif isinstance(value, _KERAS_PARTS):
            self._visit_keras_part(value)
        elif isinstance(value, _NAMESPACES) or not (isinstance(value, ModuleType) or is_of_a_library(type(value))):
            self._visit(type(value))
            self._look(type(value).__qualname__, lambda: _attributes(value))

    def _visit_function(self, function: FunctionType) -> None:
        if is_of_a_library(function):
            if function.__closure__:  # a decorator's, which may hold a function of the user's
                self._look(function.__qualname__, lambda: _closure(function))
        else:
            constants = lambda: (function.__code__, function.__defaults__, function.__kwdefaults__)  # noqa: E731
            self._look(function.__qualname__, lambda: {**read_by(function), "": constants()})

    def _visit_method(self, method: MethodType) -> None:
        self._visit(method.__func__)
        names, owner = _names_reached(method), method.__self__
        if isinstance(owner, _KERAS_PARTS) or names & {"getattr", "vars", "__dict__"}:
            self._visit(owner)
        elif not is_of_a_library(type(owner)):
            for cls in type(owner).__mro__:
                self._look(cls.__qualname__, functools.partial(_of_class, cls, names))
            self._look(type(owner).__qualname__, lambda: {k: x for k, x in _attributes(owner).items() if k in names})

    def _visit_model(self, model: keras.Model) -> None:
        """A model computes what its layers do. `fit` and `predict` put other attributes into it."""
        self._visit(type(model))
        own = [f for c in type(model).__mro__ if not is_of_a_library(c) for f in vars(c).values()]
        names = {name for f in own if isinstance(f, FunctionType) for name in _names(f.__code__)} | {"call"}
        self._look(model.name, lambda: [x for name, x in vars(model).items() if name in names])
        self._look(f"the layers of {model.name}", lambda: list(model.layers))

    def _visit_keras_part(self, part: Any) -> None:
        self._visit(type(part))
        attributes = vars(part)
        self._looks.append(_Look(type(part).__qualname__, lambda: attributes, dict(attributes)))
        is_users = not is_of_a_library(type(part))
        for name, attribute in attributes.items():
            if not isinstance(attribute, list | dict | tuple | set) or (is_users and name[0] != "_"):
                self._visit(attribute)  # in other containers Keras keeps its books

    def _look(self, name: str, look: Callable[[], list | dict]) -> None:
        seen = look()
        self._looks.append(_Look(name, look, seen))
        for value in seen.values() if isinstance(seen, dict) else seen:
            self._visit(value)


_MISSING = object()


def _are_equal(now: Any, then: Any) -> bool:
    try:
        return now is then or bool(now == then)
    except Exception:  # as in `is_unchanged`
        return False


def _decorated(value: Any) -> Any:
    """The function that a library's decorator was put on, such as tf.function or tf.custom_gradient; None if none."""
    return (
        getattr(value, "python_function", None) or vars(value).get("__wrapped__")
        if hasattr(value, "__dict__")
        else None
    )


def _attributes(value: Any) -> dict[str, Any]:
    """Those of an object, in its __dict__ or in __slots__."""
    slots = [name for cls in type(value).__mro__ for name in vars(cls).get("__slots__", ())]
    return getattr(value, "__dict__", {}) | {name: getattr(value, name) for name in slots if hasattr(value, name)}


def _of_class(cls: type, names: frozenset[str] | None = None) -> dict[str, Any]:
    """A class's own attributes, all or those of `names`."""
    return {name: x for name, x in vars(cls).items() if names is None or name in names}


def _closure(function: FunctionType) -> dict[str, Any]:
    read = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            read[name] = cell.cell_contents
        except ValueError:  # not filled yet
            read[name] = None
    return read


def read_by(function: FunctionType) -> dict[str, Any]:
    """What the function's closure and global names hold now, by name, and what it reads of the user's modules."""
    read, code, globals_ = _closure(function), function.__code__, function.__globals__
    for name in _global_names(code):
        if name in globals_:
            read[name] = globals_[name]
        else:  # it may be imported within the function
            relative = f"{globals_.get('__package__')}.{name}".rstrip(".")
            read[name] = sys.modules.get(name, sys.modules.get(relative))
    modules = {name: x for name, x in read.items() if _is_users_module(x)}
    known = set(modules.values())
    while modules:
        path, module = modules.popitem()
        for name in _names(code) & vars(module).keys():
            read[f"{path}.{name}"] = value = vars(module)[name]
            if _is_users_module(value) and value not in known:
                modules[f"{path}.{name}"] = value
                known.add(value)
    return read


def _is_users_module(value: Any) -> bool:
    return isinstance(value, ModuleType) and not is_of_a_library(value)


@functools.cache
def _names(code: CodeType) -> frozenset[str]:
    """The names that the code and the functions in it use: global ones, and attributes."""
    return frozenset(code.co_names).union(*map(_names, _inner(code)))


_OPS = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS", "IMPORT_NAME")


@functools.cache
def _global_names(code: CodeType) -> frozenset[str]:
    """Of them, the global ones and those of modules that are imported within."""
    used = {x.argval for x in dis.get_instructions(code) if x.opname in _OPS}
    return frozenset(used).union(*map(_global_names, _inner(code)))


def _inner(code: CodeType) -> Iterator[CodeType]:
    return (x for x in code.co_consts if isinstance(x, CodeType))


def _names_reached(method: MethodType) -> frozenset[str]:
    """The names that a method uses, and the methods of its object that it calls."""
    names: set[str] = set()
    to_do: list[Any] = [method.__func__]
    while to_do:
        function = to_do.pop()
        function = function.fget if isinstance(function, property) else getattr(function, "__func__", function)
        if isinstance(function, FunctionType):
            new = _names(inspect.unwrap(function).__code__) - names
            names |= new
            to_do += [inspect.getattr_static(method.__self__, name, None) for name in new]
    return frozenset(names)
