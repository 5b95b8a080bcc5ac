"""The two networks: Q, which learns, and Q-hat, its slow copy that the targets are computed from."""

from collections.abc import Callable, Sequence

import keras
import numpy as np
import tensorflow as tf
from keras import Sequential
from keras.initializers import GlorotUniform
from keras.layers import Dense, Input

from dqn_keras.config import count, counts


def make_q_network(
    num_features: int,
    num_actions: int,
    hidden_units: Sequence[int] = (64,),
    seed: int | np.random.SeedSequence | None = None,
    name: str = "q_network",
) -> Sequential:
    """A feed-forward Q-network: states [B, num_features] -> Q-values [B, num_actions], float32.

    Hidden layers are ReLU, the output is linear. Kernels start Glorot uniform (Keras' default), drawn
    from `seed` without touching any global random state; biases start at zero.
    """
    num_features, num_actions = count("num_features", num_features), count("num_actions", num_actions)
    hidden_units = counts("hidden_units", hidden_units)
    *hidden, output = _initializers(len(hidden_units) + 1, seed)
    layers: list[keras.Layer] = [Input(shape=(num_features,), dtype="float32")]
    for i, (units, initializer) in enumerate(zip(hidden_units, hidden, strict=True), start=1):
        layers.append(
            Dense(units, activation="relu", kernel_initializer=initializer, dtype="float32", name=f"hidden_{i}")
        )
    layers.append(Dense(num_actions, activation="linear", kernel_initializer=output, dtype="float32", name="q_values"))
    return Sequential(layers, name=name)


def _initializers(num_layers: int, seed: int | np.random.SeedSequence | None) -> list[GlorotUniform]:
    """Of the kernels, first to last."""
    return [GlorotUniform(seed=int(s)) for s in np.random.default_rng(seed).integers(2**31, size=num_layers)]


def renew_weights(network: Sequential, seed: int | np.random.SeedSequence | None) -> None:
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
) -> tuple[Sequential, Sequential]:
    """Q and Q-hat, of one shape and with equal weights."""
    q_network = make_q_network(num_features, num_actions, hidden_units, seed)
    q_hat_network = make_q_network(num_features, num_actions, hidden_units, seed, name="q_hat_network")
    q_hat_network.set_weights(q_network.get_weights())
    return q_network, q_hat_network


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
    if not isinstance(q_network, Sequential):
        return False
    if not all(type(x) is Dense and len(x.weights) == 2 and x.compute_dtype == "float32" for x in q_network.layers):
        return False
    *hidden, output = [layer.activation for layer in q_network.layers]
    return all(x is keras.activations.relu for x in hidden) and output is keras.activations.linear


def check_network(name: str, network: keras.Model) -> None:
    """TypeError or ValueError if it is not a Sequential or functional model that has been built."""
    if not isinstance(network, Sequential | keras.models.Model):
        raise TypeError(f"{name} must be a Keras model, got {network!r}")
    if not network.built or not hasattr(network, "input_shape"):
        raise ValueError(f"{name} must be a Sequential or functional model with an Input layer")


def check_fits(q_network: keras.Model, num_features: int, num_actions: int) -> None:
    """ValueError if the network does not take this environment's states or give its actions' values, all finite."""
    check_network("q_network", q_network)
    shapes = (q_network.input_shape[1:], q_network.output_shape[1:])
    if shapes != ((num_features,), (num_actions,)):
        raise ValueError(
            f"q_network must map {num_features} features to {num_actions} actions, "
            f"got input {shapes[0]} and output {shapes[1]}"
        )
    if not all(np.isfinite(w).all() for w in q_network.get_weights()):
        raise ValueError("q_network must have finite weights, got NaN or infinity among them")
