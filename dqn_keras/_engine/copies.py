"""Copies of a network that compute what it does."""

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
    """Leaves Python's global random state as it is: Keras draws from it for initializers without a seed."""
    state = random.getstate()
    try:
        yield
    finally:
        random.setstate(state)


def copy(network: keras.Model, states: np.ndarray | None = None) -> keras.Model:
    """A second network that computes what the first does, with weights of its own.

    Keras copies what a layer's configuration says. What was set on a layer later, such as the mean that
    `Normalization.adapt` finds, is carried over, and the outputs for `states` [B, *S] are compared.

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
    """Lets layers that keep something beside their weights, as Normalization does, find it from the weights."""
    for layer in all_layers(network):
        if hasattr(layer, "finalize_state"):
            layer.finalize_state()


def _check_methods(network: keras.Model, second: keras.Model) -> None:
    """ValueError if a `call` of the user's would be lost, which outputs for a few states may not show."""
    layers = [network, *all_layers(network)], [second, *all_layers(second)]
    for layer, copied in zip(*layers, strict=False):
        if type(layer) is not type(copied) or "call" in vars(layer):
            raise ValueError(
                f"q_network cannot be copied for Q-hat: {layer.name!r} ({type(layer).__name__}) has a `call` of its "
                "own that its copy would not have; put it into a layer of its own class"
            )


def _check_is_independent(network: keras.Model, second: keras.Model, states: np.ndarray | None) -> None:
    """ValueError if the copy uses weights of the original, as by the closure of a Lambda layer."""
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
        if type(layer) is keras.layers.Lambda:  # whose from_config wants code from a file to be trusted; this is none
            names = {key: x for key, x in config.items() if key in ("name", "trainable", "dtype")}
            return keras.layers.Lambda(
                layer.function, output_shape_of_lambda(layer), layer.mask, layer.arguments, **names
            )
        by_name = {key: getattr(layer, key, None) for key in config}  # Keras writes functions down as names
        return type(layer).from_config(config | {key: x for key, x in by_name.items() if isinstance(x, _BY_NAME)})
    except Exception as error:  # whatever a layer's own code says
        why = " ".join(str(error).split())
        raise ValueError(
            f"q_network cannot be copied for Q-hat: layer {layer.name!r} ({type(layer).__name__}) needs a get_config() "
            f"that returns what its __init__ takes ({why[:200]})"
        ) from error


@contextlib.contextmanager
def _quiet_about_lambdas() -> Iterator[None]:
    """Keras warns of every lambda in a configuration, because a file with one is unsafe; this is no file."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The object being serialized includes a `lambda`")
        yield


_BY_NAME = (FunctionType, keras.regularizers.Regularizer, keras.constraints.Constraint)


def _own_names(network: keras.Model) -> dict[str, Any]:
    """Functions and classes that the layers use and Keras may not know, by name."""
    parts = [x for layer in all_layers(network) for x in (type(layer), *vars(layer).values())]
    parts = [x if isinstance(x, FunctionType | type) else type(x) for x in parts]
    return {x.__name__: x for x in parts if not (x.__module__ or "").startswith(("keras.", "builtins"))}


def _carry_attributes(layer: keras.layers.Layer, copied: keras.layers.Layer) -> None:
    """What a configuration does not hold: numbers, arrays and functions that were set on the layer."""
    for name, value in vars(layer).items():
        is_plain = value is None or isinstance(value, bool | int | float | str | np.ndarray | np.generic | FunctionType)
        is_variable = isinstance(value, keras.Variable | tf.Variable)  # the copy has its own
        is_an_array = tf.is_tensor(value) and hasattr(value, "numpy") and not is_variable
        is_its_own = name.lstrip("_") in ("name", "path", "build", "quantize", "auto_name")
        code = getattr(value, "__code__", None)  # of a function that the copy has made for itself, over its own weights
        is_its_own |= code is not None and getattr(vars(copied).get(name), "__code__", None) is code
        if (is_plain or is_an_array) and not is_its_own:
            vars(copied)[name] = value


def check_is_equal(problem: str, network: keras.Model, second: keras.Model, states: np.ndarray | None = None) -> None:
    """ValueError that begins with `problem` if the two networks give other values for `states` (by default random)."""
    if states is None:
        states = np.random.default_rng(0).normal(size=(8, *network.input_shape[1:])).astype(np.float32)
    try:
        outputs, again = network(states), network(states)
    except tf.errors.OpError:  # numbers that it does not take, as an Embedding takes no negative ones
        states = np.zeros_like(states)
        outputs, again = network(states), network(states)
    if not np.array_equal(outputs, again, equal_nan=True):
        return  # it is random, so that no copy can be told from it
    if np.allclose(outputs, second(states), rtol=1e-4, atol=1e-5, equal_nan=True):
        return
    name, kind = _first_difference(network, second, states)
    raise ValueError(
        f"{problem}: the copy of layer {name!r} ({kind}) computes something else; its get_config() must hold all that "
        "it computes with"
    )


def _first_difference(network: keras.Model, second: keras.Model, states: np.ndarray) -> tuple[str, str]:
    """Name and class of the first layer whose outputs differ."""
    for layer, copied in zip(network.layers, second.layers, strict=True):
        try:
            values = [
                keras.tree.flatten(keras.Model(n.inputs, x.output)(states))
                for n, x in ((network, layer), (second, copied))
            ]
        except (AttributeError, ValueError):  # a layer that is used twice has no one output
            continue
        if not all(np.allclose(a, b, rtol=1e-4, atol=1e-5, equal_nan=True) for a, b in zip(*values, strict=True)):
            return layer.name, type(layer).__name__
    return network.name, type(network).__name__
