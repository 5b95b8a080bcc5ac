"""Descriptions of the parts of a run: name, source of the user's code, and computation."""

import functools
import hashlib
import inspect
import operator
import sys
from collections.abc import Iterator
from types import FunctionType, MethodType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.graphs import Computation, computation
from dqn_keras._engine.libraries import is_of_a_library
from dqn_keras._engine.private import all_layers
from dqn_keras._engine.tensorflow import keras, tf


class Part(NamedTuple):
    """One part of a run: the network, the optimizer, a formula or the environment."""

    words: Any
    """Name and named settings, as JSON values."""
    source: str = ""
    """Digest of the source of the user's code in the part."""
    computes: str = ""
    """Digest of the traced graph, which differs if parts compute different things; empty if there is no graph."""


def words_for(part: Any) -> str:
    """Returns the name of a network, an optimizer or a formula, and the settings that differ from the defaults."""
    if part is None:
        return "the default"
    if isinstance(part, str):
        return part
    if isinstance(part, keras.Model):
        layers = ", ".join(type(layer).__name__ for layer in part.layers)
        return f"{layers} ({part.count_params()} weights)"
    if isinstance(part, functools.partial):
        return f"partial of {words_for(part.func)}"
    if hasattr(part, "__qualname__"):
        return f"{part.__module__}.{part.__qualname__}"
    settings = _chosen_settings(part)
    if isinstance(rate := getattr(part, "learning_rate", None), keras.Variable):
        settings["learning_rate"] = f"{float(rate):.6g}"
    return f"{type(part).__module__}.{type(part).__qualname__}({', '.join(f'{k}={x}' for k, x in settings.items())})"


def _chosen_settings(part: Any) -> dict[str, Any]:
    """Returns the settings of a Keras object that differ from the defaults; empty if it has no configuration."""
    try:
        config, usual = part.get_config(), type(part)().get_config()
    except Exception:  # a user's class can raise anything
        return {}
    chosen = {name: x for name, x in config.items() if name != "name" and x != usual.get(name)}
    return {name: x["class_name"] if isinstance(x, dict) and "class_name" in x else x for name, x in chosen.items()}


def source_of(part: Any) -> str:
    """Returns a digest of the source of the user's functions and classes in a part."""
    sources = []
    for code in _own_code(part, set()):
        try:
            sources.append(inspect.getsource(code))
        except (OSError, TypeError):  # typed into a console that keeps no source
            sources.append(code.__qualname__)
    return hashlib.sha256("".join(sources).encode()).hexdigest()[:12] if sources else ""


def check_can_be_imported(argument: str, part: Any) -> None:
    """Raises ValueError if a function or class of the user cannot be imported by its name."""
    for code in _own_code(part, set()):
        try:
            is_importable = operator.attrgetter(code.__qualname__)(sys.modules[code.__module__]) is code
        except (AttributeError, KeyError):
            is_importable = False
        if not is_importable:
            raise ValueError(
                f"{argument} must have a name that can be imported, because the checkpoint keeps it; "
                f"{code.__module__}.{code.__qualname__} has none: "
                "define it with `def` or `class` at the top level of a module, a script or a notebook"
            )


def _own_code(part: Any, met: set[int]) -> Iterator[Any]:
    """Yields the user's functions and classes in a part: the part itself, its class, and what its attributes hold."""
    if id(part) in met:
        return
    met.add(id(part))
    held: list[Any] = []
    if isinstance(part, FunctionType | type):
        if not is_of_a_library(part):
            yield part
    elif isinstance(part, functools.partial):
        held = [part.func, *part.args, *part.keywords.values()]
    elif isinstance(part, MethodType):
        held = [part.__func__, part.__self__]
    elif isinstance(part, keras.Model):
        held = all_layers(part)
    elif isinstance(part, list | tuple):
        held = list(part)
    elif isinstance(part, dict):
        held = list(part.values())
    elif hasattr(part, "python_function"):  # a tf.function
        held = [part.python_function]
    elif hasattr(part, "__dict__") and not isinstance(part, keras.Variable):
        of_keras = is_of_a_library(type(part))  # the other attributes hold its internal records
        held = [type(part), *(x for x in vars(part).values() if not of_keras or isinstance(x, _MAY_BE_OWN))]
    for x in held:
        yield from _own_code(x, met)


_MAY_BE_OWN = (
    FunctionType,
    functools.partial,
    MethodType,
    keras.Optimizer,
    keras.optimizers.schedules.LearningRateSchedule,
    keras.losses.Loss,
    keras.regularizers.Regularizer,
    keras.constraints.Constraint,
)


def describe(env: gym.Env | FuncEnv) -> tuple[Part, *tuple[Computation, ...]]:
    """Returns what identifies an environment: a Part and, if it is functional, its Computation.

    A registered environment is described by its id and arguments, any other by the constructor arguments that it keeps
    as attributes of the same name. `render_mode` is left out.
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
    words = {
        "name": name,
        "arguments": _plain({key: value for key, value in sorted(arguments.items()) if key != "render_mode"}),
        "wrappers": wrappers,
        "observation_space": str(env.observation_space),
        "action_space": str(env.action_space),
    }
    if not isinstance(env, FuncEnv):
        return (Part(words),)

    def play(rng: tf.Tensor, action: tf.Tensor) -> list[Any]:
        state = env.initial(rng)
        next_state = env.transition(state, action, rng)
        reward, terminal = env.reward(state, action, next_state, rng), env.terminal(next_state, rng)
        return [state, env.observation(state, rng), next_state, reward, terminal]

    computes = computation(play, [tf.TensorSpec((2,), tf.int64), tf.TensorSpec((), tf.int32)])
    return Part(words, source_of(type(env)), computes.digest), computes


def _plain(value: Any, depth: int = 3) -> Any:
    """Returns a JSON value that is equal for equal values; the name of the type if there is no such value."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, dict):
        return {str(key): _plain(x, depth) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x, depth) for x in value]
    if isinstance(value, set | frozenset):  # its order differs between processes
        return sorted((_plain(x, depth) for x in value), key=repr)
    if isinstance(value, functools.partial):
        return [_plain(value.func, depth), _plain(value.args, depth), _plain(value.keywords, depth)]
    if tf.is_tensor(value) or isinstance(value, np.ndarray):
        array = np.asarray(value)
        return [str(array.dtype), list(array.shape), hashlib.sha256(array.tobytes()).hexdigest()]
    if not hasattr(value, "__qualname__") and not is_of_a_library(type(value)) and depth:
        return [type(value).__qualname__, _plain(getattr(value, "__dict__", {}), depth - 1)]
    return getattr(value, "__qualname__", type(value).__qualname__)
