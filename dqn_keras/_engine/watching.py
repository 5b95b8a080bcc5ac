"""Finds out whether an object that `learn` was compiled for has changed since.

A trace reads attributes, closures and global names once. `ChangeWatch` remembers their values: a comparison takes a few
microseconds, while a new trace takes a second.
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


_LARGEST_CONTAINER = 1_000  # the contents of a larger one are not compared


class _Look(NamedTuple):
    name: str
    """Name of the object, for a message."""
    look: Callable[[], Any]
    seen: Any


class ChangeWatch:
    """Remembers the state of some objects, as far as a trace can read it.

    The state contains, recursively:
    - the attributes of Keras objects, and of the user's objects and classes, with their methods;
    - the code, the closure and the used global names of the user's functions;
    - for a bound method, only those attributes of its object that the method, or a method it calls, names.

    Some changes are not noticed: inside a container or array of more than a thousand items; inside a container in a
    private attribute of a Keras object; and the change of a whole number to an equal float.
    """

    def __init__(self, *parts: Any) -> None:
        self._looks: list[_Look] = []
        self._visited: dict[int, Any] = {}
        for part in parts:
            self._visit(part)

    def is_unchanged(self) -> bool:
        """Returns whether nothing has changed."""
        try:
            return all(look() == seen for _, look, seen in self._looks)
        except Exception:  # arrays and tensors that were replaced cannot be compared in this way
            return False

    def what_changed(self) -> str:
        """Returns the name of the first thing that has changed."""
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
            if function.__closure__:  # a decorator's closure may hold a function of the user
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
        """Visits the layers, and the attributes that the model's own code uses; `fit` and `predict` add others."""
        self._visit(type(model))
        own = [f for c in type(model).__mro__ if not is_of_a_library(c) for f in vars(c).values()]
        names = {name for f in own if isinstance(f, FunctionType) for name in _names(f.__code__)} | {"call"}
        self._look(model.name, lambda: [x for name, x in vars(model).items() if name in names])
        self._look(f"the layers of {model.name}", lambda: list(model.layers))

    def _visit_keras_part(self, part: Any) -> None:
        self._visit(type(part))
        attributes = vars(part)
        self._looks.append(_Look(type(part).__qualname__, lambda: attributes, dict(attributes)))
        for name, attribute in attributes.items():
            if name[0] != "_" or not isinstance(attribute, list | dict | tuple | set):
                self._visit(attribute)  # the other containers hold Keras' own records

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
    """Returns the function inside a library's decorator, such as tf.function or tf.custom_gradient; None if none."""
    return (
        getattr(value, "python_function", None) or vars(value).get("__wrapped__")
        if hasattr(value, "__dict__")
        else None
    )


def _attributes(value: Any) -> dict[str, Any]:
    """Returns the attributes of an object, from its __dict__ and its __slots__."""
    slots = [name for cls in type(value).__mro__ for name in vars(cls).get("__slots__", ())]
    return getattr(value, "__dict__", {}) | {name: getattr(value, name) for name in slots if hasattr(value, name)}


def _of_class(cls: type, names: frozenset[str] | None = None) -> dict[str, Any]:
    """Returns a class's own attributes; with `names`, only these."""
    return {name: x for name, x in vars(cls).items() if names is None or name in names}


def _closure(function: FunctionType) -> dict[str, Any]:
    read = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            read[name] = cell.cell_contents
        except ValueError:  # an empty cell
            read[name] = None
    return read


def read_by(function: FunctionType) -> dict[str, Any]:
    """Returns by name the current values of the function's closure, globals and names in the user's modules."""
    read, code, globals_ = _closure(function), function.__code__, function.__globals__
    for name in _global_names(code):
        if name in globals_:
            read[name] = globals_[name]
        else:  # it may be imported inside the function
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
    """Returns the names of globals and attributes that the code and its inner functions use."""
    return frozenset(code.co_names).union(*map(_names, _inner(code)))


_OPS = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS", "IMPORT_NAME")


@functools.cache
def _global_names(code: CodeType) -> frozenset[str]:
    """Returns the names of globals and of imported modules that the code and its inner functions use."""
    used = {x.argval for x in dis.get_instructions(code) if x.opname in _OPS}
    return frozenset(used).union(*map(_global_names, _inner(code)))


def _inner(code: CodeType) -> Iterator[CodeType]:
    return (x for x in code.co_consts if isinstance(x, CodeType))


def _names_reached(method: MethodType) -> frozenset[str]:
    """Returns the names that are used by a method and by the methods of its object that it calls."""
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
