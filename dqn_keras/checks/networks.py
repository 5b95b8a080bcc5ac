"""Checks of a network and an optimizer before they are used."""

import inspect
import warnings
from typing import Any

import numpy as np

from dqn_keras._engine.private import all_layers
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.checks.numbers import shown


def check_network(name: str, network: keras.Model) -> None:
    """Raises TypeError or ValueError unless `network` maps states [B, *S] to Q-values [B, A].

    It must be a built Sequential or functional model.
    """
    if not isinstance(network, keras.Sequential | keras.models.Model):
        raise TypeError(f"{name} must be a Keras model, got {shown(network)}")
    if not network.built or not hasattr(network, "input_shape"):
        raise ValueError(f"{name} must be a Sequential or functional model with an Input layer, got {shown(network)}")
    for kind, tensors in ("input", network.inputs), ("output", network.outputs):
        if len(tensors) != 1:
            raise ValueError(f"{name} must have one {kind}, got {len(tensors)}")
    output = network.outputs[0] if isinstance(network, keras.Sequential) else network.output
    is_tensor = isinstance(output, keras.KerasTensor)  # not a list or dictionary that holds one
    if not is_tensor or len(output.shape) != 2 or output.shape[1] is None:
        got = output.shape if is_tensor else f"a {type(output).__name__}"
        raise ValueError(f"{name} must give Q-values of shape [B, A], got output {got}")
    if output.dtype != "float32":
        raise ValueError(f"{name} must give float32 values, got {output.dtype}")


def check_pair(q_network: keras.Model, q_hat_network: keras.Model) -> None:
    """Raises TypeError or ValueError unless the two are different networks with weights of the same shapes."""
    check_network("q_network", q_network)
    check_network("q_hat_network", q_hat_network)
    if q_network is q_hat_network:
        raise ValueError("q_hat_network must be a second network, got q_network itself")
    shapes, hat_shapes = ([tuple(w.shape) for w in n.weights] for n in (q_network, q_hat_network))
    if shapes != hat_shapes:
        raise ValueError(f"q_hat_network must have weights of q_network's shapes {shapes}, got {hat_shapes}")


def check_fits(q_network: keras.Model, state_shape: tuple[int, ...], num_actions: int) -> None:
    """Raises ValueError if the network does not fit the environment, or if its weights are not finite."""
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


def _without_batch(shape: Any) -> Any:
    return shape[1:] if isinstance(shape, tuple) and shape[0] is None else shape


def check_optimizer(optimizer: Any) -> None:
    """Raises TypeError if `optimizer` is not a Keras optimizer."""
    if not isinstance(optimizer, keras.Optimizer):
        raise TypeError(
            f"optimizer must be a Keras optimizer such as keras.optimizers.Adam(1e-3), got {shown(optimizer)}"
        )


def warn_of_inference_mode(network: keras.Model) -> None:
    """Warns of layers that behave differently in training, because a Q-network is always called in inference mode."""
    if names := [f"{x.name} ({type(x).__name__})" for x in all_layers(network) if _differs_in_training(x)]:
        warnings.warn(
            f"q_network is called in inference mode, also while it learns: {', '.join(names)} will not behave as in "
            "model.fit",
            stacklevel=5,
        )


def _differs_in_training(layer: keras.layers.Layer) -> bool:
    if isinstance(layer, keras.layers.BatchNormalization | keras.layers.SpectralNormalization):
        return True
    if type(layer).__name__.endswith("Cell"):  # the RNN around it is one of the layers too
        return False
    if not type(layer).__module__.startswith("keras."):
        return "training" in inspect.signature(type(layer).call).parameters
    rates = (getattr(layer, name, 0) for name in ("rate", "stddev", "dropout", "recurrent_dropout", "_dropout"))
    return any(isinstance(rate, int | float) and rate > 0 for rate in rates)
