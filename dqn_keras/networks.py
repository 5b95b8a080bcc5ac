"""The two networks: Q, which learns, and Q-hat, its slow copy that the targets are computed from."""

import contextlib
import inspect
import json
import random
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from types import FunctionType
from typing import Any

import numpy as np

from dqn_keras._tensorflow import keras, tf
from dqn_keras.config import count, counts


def make_q_network(
    num_features: int,
    num_actions: int,
    hidden_units: Sequence[int] = (64,),
    seed: int | np.random.SeedSequence | None = None,
    name: str = "q_network",
) -> keras.Sequential:
    """A feed-forward Q-network: states [B, num_features] -> Q-values [B, num_actions], float32.

    Hidden layers are ReLU, the output is linear. Kernels start Glorot uniform (Keras' default), drawn
    from `seed` without touching any global random state; biases start at zero.
    """
    num_features, num_actions = count("num_features", num_features), count("num_actions", num_actions)
    hidden_units = counts("hidden_units", hidden_units)
    *hidden, output = _initializers(len(hidden_units) + 1, seed)
    layers: list[keras.Layer] = [keras.Input(shape=(num_features,), dtype="float32")]
    for i, (units, initializer) in enumerate(zip(hidden_units, hidden, strict=True), start=1):
        layers.append(_dense(units, "relu", initializer, f"hidden_{i}"))
    layers.append(_dense(num_actions, "linear", output, "q_values"))
    network = keras.Sequential(layers, name=name)
    _made_here.add(network)
    return network


def _dense(units: int, activation: str, initializer: keras.initializers.Initializer, name: str) -> keras.layers.Dense:
    return keras.layers.Dense(units, activation=activation, kernel_initializer=initializer, dtype="float32", name=name)


def _initializers(num_layers: int, seed: int | np.random.SeedSequence | None) -> list[keras.initializers.Initializer]:
    """Of the kernels, first to last."""
    seeds = np.random.default_rng(seed).integers(2**31, size=num_layers)
    return [keras.initializers.GlorotUniform(seed=int(s)) for s in seeds]


def renew_weights(network: keras.Sequential, seed: int | np.random.SeedSequence | None) -> None:
    """Give a network of `make_q_network` the weights that it would be made with."""
    weights = []
    for layer, initializer in zip(network.layers, _initializers(len(network.layers), seed), strict=True):
        weights += [initializer(layer.kernel.shape), np.zeros(layer.units, np.float32)]
    network.set_weights(weights)


def make_networks(
    num_features: int,
    num_actions: int,
    hidden_units: Sequence[int] = (64,),
    seed: int | np.random.SeedSequence | None = None,
) -> tuple[keras.Sequential, keras.Sequential]:
    """Q and Q-hat, of one shape and with equal weights."""
    q_network = make_q_network(num_features, num_actions, hidden_units, seed)
    q_hat_network = make_q_network(num_features, num_actions, hidden_units, seed, name="q_hat_network")
    q_hat_network.set_weights(q_network.get_weights())
    return q_network, q_hat_network


@contextlib.contextmanager
def python_random_kept() -> Iterator[None]:
    """Leaves Python's global random state as it is: Keras draws from it for initializers without a seed."""
    state = random.getstate()
    try:
        yield
    finally:
        random.setstate(state)


_made_here: weakref.WeakSet[keras.Model] = weakref.WeakSet()


def units_if_made_here(network: keras.Model) -> tuple[int, ...] | None:
    """The sizes of all layers, states to actions, of a network that `make_q_network` made and nobody has altered.

    None for any other network, and where a layer was given another activation, a regularizer, a constraint or a method
    of its own, or was frozen.
    """
    if network not in _made_here or not is_relu_mlp(network):
        return None
    for layer in network.layers:
        added = (layer.kernel_regularizer, layer.bias_regularizer, layer.activity_regularizer)
        if any(added) or layer.kernel_constraint or layer.bias_constraint or not layer.trainable:
            return None
    return (network.input_shape[-1], *(layer.units for layer in network.layers))


def all_layers(network: keras.Model) -> list[keras.layers.Layer]:
    """The layers of the network, those in nested models and in wrappers included."""
    return network._flatten_layers(include_self=False)


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
    check_is_equal("q_network cannot be copied for Q-hat", network, second, states)
    if network in _made_here:
        _made_here.add(second)
    return second


def finalize_layers(network: keras.Model) -> None:
    """Lets layers that keep something beside their weights, as Normalization does, find it from the weights."""
    for layer in all_layers(network):
        if hasattr(layer, "finalize_state"):
            layer.finalize_state()


def _copy_layer(layer: keras.layers.Layer) -> keras.layers.Layer:
    try:
        config = layer.get_config()
        if type(layer) is keras.layers.Lambda:  # whose from_config wants code from a file to be trusted; this is none
            names = {key: x for key, x in config.items() if key in ("name", "trainable", "dtype")}
            return keras.layers.Lambda(layer.function, layer._output_shape, layer.mask, layer.arguments, **names)
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
        is_an_array = tf.is_tensor(value) and hasattr(value, "numpy")
        is_its_own = name.lstrip("_") in ("name", "path", "build", "quantize", "auto_name")
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


def warn_of_inference_mode(network: keras.Model) -> None:
    """Warns of layers that would do something else in training: a Q-network is always called in inference mode."""
    if names := [f"{x.name} ({type(x).__name__})" for x in all_layers(network) if _differs_in_training(x)]:
        warnings.warn(
            f"q_network is called in inference mode, also while it learns: {', '.join(names)} will not do there what "
            "model.fit would have it do",
            stacklevel=4,
        )


def _differs_in_training(layer: keras.layers.Layer) -> bool:
    if isinstance(layer, keras.layers.BatchNormalization | keras.layers.SpectralNormalization):
        return True
    if type(layer).__name__.endswith("Cell"):  # whose RNN is one of the layers, too
        return False
    if not type(layer).__module__.startswith("keras."):
        return "training" in inspect.signature(type(layer).call).parameters
    rates = (getattr(layer, name, 0) for name in ("rate", "stddev", "dropout", "recurrent_dropout", "_dropout"))
    return any(isinstance(rate, int | float) and rate > 0 for rate in rates)


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


def q_values(weights: Sequence[np.ndarray], state: np.ndarray) -> np.ndarray:
    """Q(s, .) in NumPy: what a network of `make_q_network` computes, without TensorFlow's cost per call.

    Args:
        weights: kernel [F, U] and bias [U] of each layer in turn, as `network.get_weights()` gives them.
        state: [F], or [B, F], float32.

    Returns:
        [A], or [B, A], float32; equal to the Keras network's output to float32 rounding.
    """
    *hidden, kernel, bias = weights
    for i in range(0, len(hidden), 2):
        state = state.dot(hidden[i])  # [U]
        state += hidden[i + 1]
        np.maximum(state, 0, out=state)
    return state.dot(kernel) + bias  # [A]


def q_function(q_network: keras.Model) -> Callable[[np.ndarray], np.ndarray]:
    """One state [F] -> its Q-values [A], with the weights that `q_network` has now.

    A network of `make_q_network`'s kind runs in NumPy, any other through TensorFlow (about 30 times slower).
    """
    if is_relu_mlp(q_network):
        weights = q_network.get_weights()
        return lambda state: q_values(weights, state)
    compiled = tf.function(q_network, autograph=False)
    return lambda state: compiled(tf.constant(state[None])).numpy()[0]


def is_relu_mlp(q_network: keras.Model) -> bool:
    """Whether `q_values` computes this network: dense layers, ReLU but for a linear last one."""
    if type(q_network) is not keras.Sequential or "call" in vars(q_network):
        return False
    if not all(
        type(x) is keras.layers.Dense and len(x.weights) == 2 and x.compute_dtype == "float32" and "call" not in vars(x)
        for x in q_network.layers
    ):
        return False
    *hidden, output = [layer.activation for layer in q_network.layers]
    return all(x is keras.activations.relu for x in hidden) and output is keras.activations.linear


def check_network(name: str, network: keras.Model) -> None:
    """TypeError or ValueError if it is no built Sequential or functional model, states [B, *S] -> Q-values [B, A]."""
    if not isinstance(network, keras.Sequential | keras.models.Model):
        raise TypeError(f"{name} must be a Keras model, got {network!r}")
    if not network.built or not hasattr(network, "input_shape"):
        raise ValueError(f"{name} must be a Sequential or functional model with an Input layer")
    for kind, tensors in ("input", network.inputs), ("output", network.outputs):
        if len(tensors) != 1:
            raise ValueError(f"{name} must have one {kind}, got {len(tensors)}")
    shape, dtype = network.output_shape, network.outputs[0].dtype
    if not isinstance(shape, tuple) or len(shape) != 2 or shape[1] is None:
        raise ValueError(f"{name} must give Q-values of shape [B, A], got output {shape}")
    if dtype != "float32":
        raise ValueError(f"{name} must give float32 values, got {dtype}")


def check_fits(q_network: keras.Model, state_shape: tuple[int, ...], num_actions: int) -> None:
    """ValueError if the network does not take this environment's states or give its actions' values, all finite."""
    check_network("q_network", q_network)
    takes, gives = q_network.input_shape, q_network.output_shape
    fits = isinstance(takes, tuple) and tf.TensorShape(takes).is_compatible_with((None, *state_shape))
    if not fits or gives != (None, num_actions):
        raise ValueError(
            f"q_network must map states of shape {state_shape} to {num_actions} actions, "
            f"got input {_without_batch(takes)} and output {_without_batch(gives)}"
        )
    if not all(np.isfinite(w).all() for w in q_network.get_weights()):
        raise ValueError("q_network must have finite weights, got NaN or infinity among them")


def is_all_finite(*tensors: tf.Tensor) -> tf.Tensor:
    """A boolean scalar. Whole numbers are."""
    floats = [x for x in map(tf.convert_to_tensor, tensors) if x.dtype.is_floating]
    return tf.reduce_all([tf.reduce_all(tf.math.is_finite(x)) for x in floats])


def _without_batch(shape: Any) -> Any:
    return shape[1:] if isinstance(shape, tuple) and shape[0] is None else shape
