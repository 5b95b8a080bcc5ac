"""The two networks: Q learns, and Q-hat, its slow copy, gives the targets."""

from collections.abc import Sequence

import numpy as np

from dqn_keras._engine.made_here import _made_here
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.checks.numbers import check_count, check_counts, shown


def make_q_network(
    num_features: int,
    num_actions: int,
    hidden_units: Sequence[int] = (64,),
    seed: int | np.random.SeedSequence | None = None,
    name: str = "q_network",
) -> keras.Sequential:
    """Returns a feed-forward Q-network: states [B, num_features] -> Q-values [B, num_actions], float32.

    Hidden layers use ReLU; the output is linear. Kernels start Glorot uniform (Keras' default), biases at zero. `seed`
    (a whole number, a SeedSequence, or None for a random one) determines the kernels. No global random state is read or
    set.
    """
    num_features, num_actions = check_count("num_features", num_features), check_count("num_actions", num_actions)
    hidden_units = check_counts("hidden_units", hidden_units)
    if not isinstance(name, str) or not name or "/" in name:
        raise ValueError(f"name must be a string of at least one character, without '/', got {shown(name)}")
    if not (seed is None or isinstance(seed, np.random.SeedSequence)):
        seed = check_count("seed", seed, at_least=0)
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
    """Returns the initializer of each layer's kernel, from the first layer to the last."""
    seeds = np.random.default_rng(seed).integers(2**31, size=num_layers)
    return [keras.initializers.GlorotUniform(seed=int(s)) for s in seeds]


def start_weights(network: keras.Sequential, seed: int | np.random.SeedSequence | None) -> list[tf.Tensor]:
    """Returns the initial weights that `make_q_network` gives a network of these sizes for `seed`."""
    weights = []
    for layer, initializer in zip(network.layers, _initializers(len(network.layers), seed), strict=True):
        weights += [initializer(layer.kernel.shape), tf.zeros([layer.units])]
    return weights


def make_networks(
    num_features: int,
    num_actions: int,
    hidden_units: Sequence[int] = (64,),
    seed: int | np.random.SeedSequence | None = None,
) -> tuple[keras.Sequential, keras.Sequential]:
    """Returns Q and Q-hat: two networks of `make_q_network` with equal weights."""
    q_network = make_q_network(num_features, num_actions, hidden_units, seed)
    q_hat_network = make_q_network(num_features, num_actions, hidden_units, seed, name="q_hat_network")
    q_hat_network.set_weights(q_network.get_weights())
    return q_network, q_hat_network
