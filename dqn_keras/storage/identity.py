"""What makes two runs the same run, in words and numbers that a file can hold."""

import dataclasses
import functools
import hashlib
import inspect
import json
import operator
import platform
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.copies import _quiet_about_lambdas
from dqn_keras._engine.private import all_layers
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras._engine.watching import is_of_a_library, read_by
from dqn_keras.checks.formulas import Formulas
from dqn_keras.config import Config
from dqn_keras.learn import DEFAULT_FORMULAS
from dqn_keras.version import __version__


def identity(
    env: gym.Env | FuncEnv,
    config: Config,
    q_network: keras.Model | None = None,
    optimizer: keras.Optimizer | None = None,
    formulas: Formulas = DEFAULT_FORMULAS,
) -> dict[str, Any]:
    """What must be the same for a saved run to be resumed, as a file holds it (versions may differ).

    Raises:
        ValueError: a function or class of the user's has no name that can be imported.
    """
    facts = {
        "config": dataclasses.asdict(config),
        "environment": describe(env),
        "q_network": "the default" if q_network is None else _describe_network(q_network),
        "optimizer": "the default" if optimizer is None else _in_words("optimizer", optimizer),
        "targets": _in_words("targets", formulas.targets),
        "loss": _in_words("loss", formulas.loss),
        "versions": versions(),
    }
    return json.loads(json.dumps(facts))  # tuples become lists


def check_is_same(path: Path, theirs: dict[str, Any], ours: dict[str, Any], but_for: Sequence[str] = ()) -> None:
    """ValueError that begins with the argument of `train`, or field of Config, in which `path` is of another run."""
    theirs, ours = (
        {
            **x["config"],
            "env": x["environment"],
            **{name: x.get(name) for name in ("q_network", "optimizer", "targets", "loss", "seed")},
        }
        for x in (theirs, ours)
    )
    for name in [name for name in ours if name not in but_for]:
        if name not in theirs or theirs[name] != ours[name]:
            raise ValueError(f"{name} is {theirs.get(name)!r} in {path}, got {ours[name]!r}")


def warn_of_other_versions(path: Path, theirs: dict[str, Any], ours: dict[str, Any], stacklevel: int) -> None:
    """One warning of all versions that differ."""
    theirs, ours = theirs["versions"], ours["versions"]
    others = [f"{name} {theirs.get(name)} (here {ours[name]})" for name in ours if theirs.get(name) != ours[name]]
    if others:
        warnings.warn(
            f"{path} was saved with {', '.join(others)}: what is added may differ in its last bits",
            stacklevel=stacklevel,
        )


def _describe_network(network: keras.Model) -> str:
    """The kinds of its layers, and a digest of all that is known of them."""
    layers = ", ".join(type(layer).__name__ for layer in network.layers)
    own = [_describe_layer(layer) for layer in all_layers(network)]
    digest = hashlib.sha256(json.dumps([structure(network), own]).encode())
    return f"{layers} ({digest.hexdigest()[:12]})"


def _describe_layer(layer: keras.layers.Layer) -> Any:
    """What the layer's configuration does not hold: arrays, as Normalization keeps them, and what is the user's."""
    arrays = {
        name: _plain(x)
        for name, x in vars(layer).items()
        if isinstance(x, np.ndarray) or (tf.is_tensor(x) and not isinstance(x, keras.Variable | tf.Variable))
    }
    functions = {
        name: _describe_part("q_network", value)
        for name, value in vars(layer).items()
        if isinstance(value, FunctionType)
        and name not in ("build", "quantize")
        and not is_of_a_library(value.__module__)
    }
    if is_of_a_library(type(layer).__module__):
        return [arrays, functions]
    numbers = {name: x for name, x in vars(layer).items() if name[0] != "_" and isinstance(x, int | float | str)}
    return [arrays, functions, {**numbers, "built": True, "name": ""}, _describe_code("q_network", type(layer))]


def _in_words(argument: str, part: Any) -> str:
    description = _describe_part(argument, part)
    return description if isinstance(description, str) else json.dumps(description)


def _describe_part(argument: str, part: Any) -> Any:
    """A function, a class of Keras' or the user's with its settings, or anything else that JSON can hold."""
    if isinstance(part, functools.partial):
        return [_describe_part(argument, x) for x in (part.func, list(part.args), part.keywords)]
    if isinstance(part, MethodType):
        return [_describe_code(argument, part.__func__), _describe_part(argument, part.__self__)]
    if hasattr(part, "python_function"):  # a tf.function
        return _describe_part(argument, part.python_function)
    if isinstance(part, FunctionType | type):
        return _describe_code(argument, part)
    if isinstance(part, keras.Variable):
        return _plain(part.numpy())
    if isinstance(part, list | tuple):
        return [_describe_part(argument, x) for x in part]
    if isinstance(part, dict):
        return {str(name): _describe_part(argument, x) for name, x in part.items()}
    if not hasattr(part, "__dict__"):
        return _plain(part)
    settings = {
        name: _describe_part(argument, x)
        for name, x in sorted(vars(part).items())
        if name not in ("name", "built", "_lock") and _is_a_setting(name, x)
    }
    return {"class": _describe_code(argument, type(part)), **settings}


def _is_a_setting(name: str, value: Any) -> bool:
    """Of an object's attributes: numbers and the like, and what is the user's; not the books that Keras keeps."""
    if isinstance(value, FunctionType | type):
        return not is_of_a_library(value.__module__)
    is_users = not is_of_a_library(type(value).__module__)
    return name in ("_learning_rate", "inner_optimizer") or is_users or _is_data(value)


def _is_data(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_is_data, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_is_data, value))
    return value is None or isinstance(value, bool | int | float | str | np.ndarray | np.generic)


def _describe_code(argument: str, code: Any) -> Any:
    """The name of a function or class; if it is the user's, its source and what it reads, too.

    Raises:
        ValueError: it has no name by which it could be imported.
    """
    module, name = code.__module__ or "", code.__qualname__
    full_name = f"{module}.{name}"
    if is_of_a_library(module):
        return full_name
    try:
        is_importable = operator.attrgetter(name)(sys.modules[module]) is code
    except (AttributeError, KeyError):
        is_importable = False
    if not is_importable:
        raise ValueError(
            f"{argument} must have a name that can be imported, since the checkpoint keeps it; {full_name} has none: "
            "define it with `def` or `class` at the top level of a module, a script or a notebook"
        )
    digest, read = _read_in(code, {})
    return [full_name, digest, read]


def _read_in(code: Any, met: dict[Any, str]) -> tuple[str, dict[str, Any]]:
    """A digest of the source of a user's function or class and all such that it uses; the numbers they read."""
    met[code] = ""
    try:
        source = inspect.getsource(code)
    except (OSError, TypeError):  # typed in where no source is kept
        source = repr(_bytecode(code))
    is_class = isinstance(code, type)
    functions = [x for x in vars(code).values() if isinstance(x, FunctionType)] if is_class else [code]
    used: list[Any] = list(code.__bases__) if is_class else []
    numbers = {k: _plain(x) for k, x in vars(code).items() if k[:2] != "__" and _is_data(x)} if is_class else {}
    for function in functions:
        values = {**read_by(function), "defaults": function.__defaults__}
        numbers |= {name: _plain(x) for name, x in values.items() if x is not None and _is_data(x)}
        used += [x for x in values.values() if isinstance(x, FunctionType | type)]
    for other in used:
        if other not in met and not is_of_a_library(other.__module__):
            more, read = _read_in(other, met)
            source, numbers = source + more, {**read, **numbers}
    return hashlib.sha256(source.encode()).hexdigest()[:12], numbers


def _bytecode(code: Any) -> Any:
    if isinstance(code, FunctionType):
        constants = [repr(x) for x in code.__code__.co_consts if not hasattr(x, "co_code")]
        return code.__code__.co_code, code.__code__.co_names, constants
    return {name: _bytecode(x) for name, x in sorted(vars(code).items()) if isinstance(x, FunctionType)}


def describe(env: gym.Env | FuncEnv) -> dict[str, Any]:
    """What makes it this environment, as far as can be seen; `render_mode` does not.

    Of a registered one its id and arguments, of any other the constructor's arguments that it keeps under their names.
    """
    wrappers: list[Any] = []
    if isinstance(env, FuncEnv):
        name, arguments = f"{type(env).__name__} (functional)", {**_class_attributes(env), **vars(env)}
    else:
        wrapper = env
        while isinstance(wrapper, gym.Wrapper):
            wrappers.append(type(wrapper).__name__)
            wrapper = wrapper.env
        if env.spec:
            wrappers += [[w.name, _plain(w.kwargs)] for w in env.spec.additional_wrappers]
            name, arguments = env.spec.id, {**env.spec.kwargs, "max_episode_steps": env.spec.max_episode_steps}
        else:
            parameters = inspect.signature(type(env.unwrapped).__init__).parameters
            kept = vars(env.unwrapped)
            name, arguments = type(env.unwrapped).__name__, {k: kept[k] for k in parameters if k in kept}
    return {
        "name": name,
        "arguments": _plain({key: value for key, value in sorted(arguments.items()) if key != "render_mode"}),
        "wrappers": wrappers,
        "observation_space": str(env.observation_space),
        "action_space": str(env.action_space),
    }


def _class_attributes(env: FuncEnv) -> dict[str, Any]:
    """Numbers and the like that the classes of a user's environment hold."""
    classes = [cls for cls in reversed(type(env).__mro__) if not is_of_a_library(cls.__module__)]
    return {name: x for cls in classes for name, x in vars(cls).items() if name[:2] != "__" and _is_data(x)}


def _plain(value: Any, depth: int = 3) -> Any:
    """Something that JSON holds, equal for equal values; of what has no plain value, its type."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, dict):
        return {str(key): _plain(x, depth) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x, depth) for x in value]
    if isinstance(value, set | frozenset):  # whose order differs from process to process
        return sorted((_plain(x, depth) for x in value), key=repr)
    if isinstance(value, functools.partial):
        return [_plain(value.func, depth), _plain(value.args, depth), _plain(value.keywords, depth)]
    if tf.is_tensor(value) or isinstance(value, np.ndarray):
        array = np.asarray(value)
        return [str(array.dtype), list(array.shape), hashlib.sha256(array.tobytes()).hexdigest()]
    if not hasattr(value, "__qualname__") and not is_of_a_library(type(value).__module__) and depth:
        return [type(value).__qualname__, _plain(getattr(value, "__dict__", {}), depth - 1)]
    return getattr(value, "__qualname__", type(value).__qualname__)


def versions() -> dict[str, str]:
    """What the last bits of a result may depend on."""
    modules = {"tensorflow": tf, "keras": keras, "numpy": np, "gymnasium": gym}
    versions = {name: module.__version__ for name, module in modules.items()}
    return {"dqn_keras": __version__, "python": platform.python_version(), **versions, "processor": _processor()}


def _processor() -> str:
    """Its kind, with the vector instructions where the system tells them."""
    try:
        flags = re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        flags = None
    vector = sorted(x for x in flags[1].split() if x.startswith(("sse4", "avx", "fma", "amx"))) if flags else []
    return " ".join([platform.machine(), *vector])


def structure(network: keras.Model) -> str:
    """Equal for networks of one configuration, but for names and for initializers, which have done their work."""
    with _quiet_about_lambdas():
        return json.dumps(_without_names(network.get_config(), {}), sort_keys=True, default=repr)


def _without_names(config: Any, numbers: dict[str, int]) -> Any:
    """`numbers` are those of the layers, which refer to each other by name in a functional model."""
    if isinstance(config, list | tuple):
        return [_without_names(x, numbers) for x in config]
    if not isinstance(config, dict):
        return config
    if isinstance(layers := config.get("layers"), list):
        numbers = {layer.get("name", layer["config"].get("name")): i for i, layer in enumerate(layers)}
    kept = {key: x for key, x in config.items() if key != "name" and not key.endswith("_initializer")}
    for key, value in kept.items():
        if key in ("keras_history", "input_layers", "output_layers"):
            kept[key] = _numbered(value, numbers)
        elif key != "dtype":
            kept[key] = _without_names(value, numbers)
    return kept


def _numbered(reference: Any, numbers: dict[str, int]) -> Any:
    if isinstance(reference, list | tuple):
        return [_numbered(x, numbers) for x in reference]
    return numbers.get(reference, reference) if isinstance(reference, str) else reference
