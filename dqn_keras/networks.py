"""The two networks: Q, which learns, and Q-hat, its slow copy that the targets are computed from."""

import contextlib
import json
import random
from collections.abc import Callable, Iterator, Sequence
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
    return keras.Sequential(layers, name=name)


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
    """Leave Python's global random state as it is: Keras draws from there for initializers without a seed."""
    state = random.getstate()
    try:
        yield
    finally:
        random.setstate(state)


def clone(network: keras.Model, clone_layer: Callable[[keras.Layer], keras.Layer] | None = None) -> keras.Model:
    """A network of the same configuration, its weights its own."""
    with python_random_kept():
        return keras.models.clone_model(network, clone_function=clone_layer)


def structure(network: keras.Model) -> str:
    """Equal for networks of one configuration, but for names and for initializers, which have done their work."""
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


def copy(network: keras.Model) -> keras.Model:
    """A second network, equal to the first."""
    second = clone(network)
    second.set_weights(network.get_weights())
    return second


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
    if not isinstance(q_network, keras.Sequential):
        return False
    if not all(
        type(x) is keras.layers.Dense and len(x.weights) == 2 and x.compute_dtype == "float32" for x in q_network.layers
    ):
        return False
    *hidden, output = [layer.activation for layer in q_network.layers]
    return all(x is keras.activations.relu for x in hidden) and output is keras.activations.linear


def check_network(name: str, network: keras.Model) -> None:
    """TypeError or ValueError if it is not a Sequential or functional model that has been built."""
    if not isinstance(network, keras.Sequential | keras.models.Model):
        raise TypeError(f"{name} must be a Keras model, got {network!r}")
    if not network.built or not hasattr(network, "input_shape"):
        raise ValueError(f"{name} must be a Sequential or functional model with an Input layer")


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
    if (dtype := q_network.outputs[0].dtype) != "float32":
        raise ValueError(f"q_network must give float32 values, got {dtype}")
    if not all(np.isfinite(w).all() for w in q_network.get_weights()):
        raise ValueError("q_network must have finite weights, got NaN or infinity among them")


def is_all_finite(*tensors: tf.Tensor) -> tf.Tensor:
    """A boolean scalar. Whole numbers are."""
    floats = [x for x in map(tf.convert_to_tensor, tensors) if x.dtype.is_floating]
    return tf.reduce_all([tf.reduce_all(tf.math.is_finite(x)) for x in floats])


def _without_batch(shape: Any) -> Any:
    return shape[1:] if isinstance(shape, tuple) and shape[0] is None else shape
