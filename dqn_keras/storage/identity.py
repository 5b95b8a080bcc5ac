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
from types import FunctionType
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
    arrays = {name: _plain(x) for name, x in vars(layer).items() if isinstance(x, np.ndarray) or hasattr(x, "numpy")}
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
    if isinstance(part, FunctionType | type):
        return _describe_code(argument, part)
    if isinstance(part, keras.Variable):
        return _plain(part.numpy())
    if isinstance(part, list | tuple | set | frozenset):
        return [_describe_part(argument, x) for x in (sorted(part) if isinstance(part, set | frozenset) else part)]
    if isinstance(part, dict):
        return {str(name): _describe_part(argument, x) for name, x in part.items()}
    if isinstance(part, keras.Optimizer):
        settings = {name: x for name, x in vars(part).items() if _is_a_setting(name, x)}
    elif hasattr(part, "__dict__"):
        is_library = is_of_a_library(type(part).__module__)
        settings = {name: x for name, x in vars(part).items() if _is_data(x) or not is_library}
    else:
        return _plain(part)
    settings = {name: _describe_part(argument, x) for name, x in sorted(settings.items())}
    return {"class": _describe_code(argument, type(part)), **settings}


def _is_data(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_is_data, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_is_data, value))
    return value is None or isinstance(value, bool | int | float | str | np.ndarray | np.generic)


def _is_a_setting(name: str, value: Any) -> bool:
    """Of an optimizer's attributes: not its name, its variables and the books that it keeps of them."""
    if isinstance(value, set | list | tuple):  # names excluded from weight decay; variables are excluded by their ids
        return "exclude" in name and all(isinstance(x, str) for x in value)
    is_part = name in ("_learning_rate", "inner_optimizer")
    return is_part or (_is_data(value) and name not in ("name", "built", "_lock"))


def _describe_code(argument: str, code: Any) -> Any:
    """The name of a function or class, and if it is the user's a digest of its source and the numbers it reads."""
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
    try:
        source = inspect.getsource(code)
    except (OSError, TypeError):  # typed in where no source is kept
        source = repr(_bytecode(code))
    reads = {}
    if isinstance(code, FunctionType):
        reads = {name: x for name, x in read_by(code).items() if isinstance(x, bool | int | float | str)}
    return [full_name, hashlib.sha256(source.encode()).hexdigest()[:12], reads]


def _bytecode(code: Any) -> Any:
    if isinstance(code, FunctionType):
        return (
            code.__code__.co_code,
            code.__code__.co_names,
            [repr(x) for x in code.__code__.co_consts if not hasattr(x, "co_code")],
        )
    return {name: _bytecode(x) for name, x in sorted(vars(code).items()) if isinstance(x, FunctionType)}


def describe(env: gym.Env | FuncEnv) -> dict[str, Any]:
    """What makes it this environment, as far as can be seen; `render_mode` does not.

    Of a registered one its id and arguments, of any other the constructor's arguments that it keeps under their names.
    """
    wrappers: list[Any] = []
    if isinstance(env, FuncEnv):
        name, arguments = f"{type(env).__name__} (functional)", vars(env)
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


def _plain(value: Any) -> Any:
    """Something that JSON holds, equal for equal values; of what has no plain value, its type."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, dict):
        return {str(key): _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(x) for x in value]
    if isinstance(value, functools.partial):
        return [_plain(value.func), _plain(value.args), _plain(value.keywords)]
    if tf.is_tensor(value) or isinstance(value, np.ndarray):
        array = np.asarray(value)
        return [str(array.dtype), list(array.shape), hashlib.sha256(array.tobytes()).hexdigest()]
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
