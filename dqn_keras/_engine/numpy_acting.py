"""Acting in NumPy, without TensorFlow's cost per call."""

from collections.abc import Callable, Sequence

import numpy as np

from dqn_keras._engine.tensorflow import keras, tf


def q_values(weights: Sequence[np.ndarray], state: np.ndarray) -> np.ndarray:
    """Returns Q(s, .) of a network of `make_q_network`, computed in NumPy.

    Args:
        weights: kernel [F, U] and bias [U] of each layer in order, as returned by `network.get_weights()`.
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
    """Returns a function from one state [F] to its Q-values [A].

    A network of dense layers and ReLU, as made by `make_q_network`, runs in NumPy, with the weights that `q_network`
    has now. Any other network runs in TensorFlow (about 30 times slower).
    """
    if is_relu_mlp(q_network):
        weights = q_network.get_weights()
        return lambda state: q_values(weights, state)
    compiled = tf.function(q_network, autograph=False)
    return lambda state: compiled(tf.constant(state[None])).numpy()[0]


def q_values_now(q_network: keras.Model, state: np.ndarray) -> np.ndarray:
    """Returns Q(s, .) [A] of one state [*S] with the weights that `q_network` has now.

    A call takes about 0.2 ms for a network that NumPy can compute, most of it for reading the weights. Any other
    network takes about 0.5 ms in Keras' own compiled function, which the first call makes.
    """
    if is_relu_mlp(q_network):
        return q_values(q_network.get_weights(), state)
    return q_network.predict_on_batch(state[None])[0]


def is_relu_mlp(q_network: keras.Model) -> bool:
    """Returns whether `q_values` can compute this network: dense layers with ReLU, and a linear last layer."""
    if type(q_network) is not keras.Sequential or "call" in vars(q_network):
        return False
    if not all(
        type(x) is keras.layers.Dense and len(x.weights) == 2 and x.compute_dtype == "float32" and "call" not in vars(x)
        for x in q_network.layers
    ):
        return False
    *hidden, output = [layer.activation for layer in q_network.layers]
    return all(x is keras.activations.relu for x in hidden) and output is keras.activations.linear
