"""Copies of a network that compute the same values."""

import contextlib
import random
import warnings
from collections.abc import Iterator
from types import FunctionType
from typing import Any

import numpy as np

from dqn_keras._engine.made_here import _made_here
from dqn_keras._engine.private import all_layers, output_shape_of_lambda
from dqn_keras._engine.tensorflow import keras, tf


@contextlib.contextmanager
def python_random_kept() -> Iterator[None]:
    """Restores Python's global random state after the block: Keras draws from it for initializers without a seed."""
    state = random.getstate()
    try:
        yield
    finally:
        random.setstate(state)


def copy(network: keras.Model, states: np.ndarray | None = None) -> keras.Model:
    """Returns a copy of the network that computes the same values and has its own weights.

    Keras copies only the configuration of a layer. This function also copies values that were set on a layer later,
    such as the mean from `Normalization.adapt`. It then compares the outputs of both networks for `states` [B, *S].

    Raises:
        ValueError: a layer cannot be copied, or its copy computes something else; the message names the layer.
    """
    with python_random_kept(), _quiet_about_lambdas(), keras.saving.custom_object_scope(_own_names(network)):
        second = keras.models.clone_model(network, clone_function=_copy_layer, recursive=True)
    second.set_weights(network.get_weights())
    finalize_layers(second)
    for layer, copied in zip(all_layers(network), all_layers(second), strict=False):
        _carry_attributes(layer, copied)
    _check_methods(network, second)
    check_is_equal("q_network cannot be copied for Q-hat", network, second, states)
    _check_is_independent(network, second, states)
    if network in _made_here:
        _made_here.add(second)
    return second


def finalize_layers(network: keras.Model) -> None:
    """Calls `finalize_state` of the layers that derive values from their weights, such as Normalization."""
    for layer in all_layers(network):
        if hasattr(layer, "finalize_state"):
            layer.finalize_state()


def _check_methods(network: keras.Model, second: keras.Model) -> None:
    """Raises ValueError if the copy lacks a user's own `call`, which the outputs for a few states may not show."""
    layers = [network, *all_layers(network)], [second, *all_layers(second)]
    for layer, copied in zip(*layers, strict=False):
        if type(layer) is not type(copied) or "call" in vars(layer):
            raise ValueError(
                f"q_network cannot be copied for Q-hat: {layer.name!r} ({type(layer).__name__}) has a `call` of its "
                "own that its copy would not have; define it in a class"
            )


def _check_is_independent(network: keras.Model, second: keras.Model, states: np.ndarray | None) -> None:
    """Raises ValueError if the copy uses weights of the original, for example through the closure of a Lambda layer."""
    states = np.zeros((1, *network.input_shape[1:]), np.float32) + 0.5 if states is None else states
    weights, before = network.get_weights(), second(states)
    network.set_weights([w + 1 if np.issubdtype(w.dtype, np.floating) else w for w in weights])
    after = second(states)
    network.set_weights(weights)
    again = second(states)
    if not np.array_equal(before, after, equal_nan=True) and np.array_equal(before, again, equal_nan=True):
        raise ValueError(
            "q_network cannot be copied for Q-hat: a layer uses weights that are not its own, such as those in the "
            "closure of a Lambda layer, so that Q-hat would follow Q"
        )


def _copy_layer(layer: keras.layers.Layer) -> keras.layers.Layer:
    try:
        config = layer.get_config()
        if type(layer) is keras.layers.Lambda:  # its from_config rejects code that may be from a file
            names = {key: x for key, x in config.items() if key in ("name", "trainable", "dtype")}
            return keras.layers.Lambda(
                layer.function, output_shape_of_lambda(layer), layer.mask, layer.arguments, **names
            )
        by_name = {key: getattr(layer, key, None) for key in config}  # a configuration only names functions
        return type(layer).from_config(config | {key: x for key, x in by_name.items() if isinstance(x, _BY_NAME)})
    except Exception as error:  # a layer's own code can raise anything
        why = " ".join(str(error).split())
        raise ValueError(
            f"q_network cannot be copied for Q-hat: layer {layer.name!r} ({type(layer).__name__}) needs a get_config() "
            f"that returns what its __init__ takes ({why[:200]})"
        ) from error


@contextlib.contextmanager
def _quiet_about_lambdas() -> Iterator[None]:
    """Silences Keras' warning about lambdas in a configuration: they are unsafe only in a file."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The object being serialized includes a `lambda`")
        yield


_BY_NAME = (FunctionType, keras.regularizers.Regularizer, keras.constraints.Constraint)


def _own_names(network: keras.Model) -> dict[str, Any]:
    """Returns, by name, the functions and classes that the layers use and Keras may not know."""
    parts = [x for layer in all_layers(network) for x in (type(layer), *vars(layer).values())]
    parts = [x if isinstance(x, FunctionType | type) else type(x) for x in parts]
    return {x.__name__: x for x in parts if not (x.__module__ or "").startswith(("keras.", "builtins"))}


def _carry_attributes(layer: keras.layers.Layer, copied: keras.layers.Layer) -> None:
    """Copies the numbers, arrays and functions that were set on a layer and are not in its configuration."""
    for name, value in vars(layer).items():
        is_plain = value is None or isinstance(value, bool | int | float | str | np.ndarray | np.generic | FunctionType)
        is_variable = isinstance(value, keras.Variable | tf.Variable)  # the copy has its own
        is_an_array = tf.is_tensor(value) and hasattr(value, "numpy") and not is_variable
        is_its_own = name.lstrip("_") in ("name", "path", "build", "quantize", "auto_name")
        code = getattr(value, "__code__", None)  # the copy has its own closure of this code, over its own weights
        is_its_own |= code is not None and getattr(vars(copied).get(name), "__code__", None) is code
        if (is_plain or is_an_array) and not is_its_own:
            vars(copied)[name] = value


def check_is_equal(problem: str, network: keras.Model, second: keras.Model, states: np.ndarray | None = None) -> None:
    """Raises ValueError, beginning with `problem`, if the outputs differ for `states` (default: random states)."""
    if states is None:
        states = np.random.default_rng(0).normal(size=(8, *network.input_shape[1:])).astype(np.float32)
    try:
        outputs, again = network(states), network(states)
    except tf.errors.OpError:  # the network rejects these states, as an Embedding rejects negative numbers
        states = np.zeros_like(states)
        outputs, again = network(states), network(states)
    if not np.array_equal(outputs, again, equal_nan=True):
        return  # its outputs are random, so a comparison shows nothing
    if np.allclose(outputs, second(states), rtol=1e-4, atol=1e-5, equal_nan=True):
        return
    name, kind = _first_difference(network, second, states)
    raise ValueError(
        f"{problem}: the copy of layer {name!r} ({kind}) computes something else; its get_config() must hold every "
        "value that it computes with"
    )


def _first_difference(network: keras.Model, second: keras.Model, states: np.ndarray) -> tuple[str, str]:
    """Returns the name and class of the first layer whose outputs differ."""
    for layer, copied in zip(network.layers, second.layers, strict=True):
        try:
            values = [
                keras.tree.flatten(keras.Model(n.inputs, x.output)(states))
                for n, x in ((network, layer), (second, copied))
            ]
        except (AttributeError, ValueError):  # a layer that is used twice has no single output
            continue
        if not all(np.allclose(a, b, rtol=1e-4, atol=1e-5, equal_nan=True) for a, b in zip(*values, strict=True)):
            return layer.name, type(layer).__name__
    return network.name, type(network).__name__
