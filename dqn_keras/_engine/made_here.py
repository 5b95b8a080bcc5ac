"""A record of the networks that the package made itself."""

import weakref

from dqn_keras._engine.numpy_acting import is_relu_mlp
from dqn_keras._engine.tensorflow import keras

_made_here: weakref.WeakSet[keras.Model] = weakref.WeakSet()


def units_if_made_here(network: keras.Model) -> tuple[int, ...] | None:
    """Returns the layer sizes, from states to actions, of an unchanged network of `make_q_network`; else None.

    A network counts as changed if a layer has another activation, a regularizer, a constraint or its own `call`, or
    if a layer is frozen.
    """
    if network not in _made_here or not is_relu_mlp(network):
        return None
    if any(not w.trainable or w.regularizer or w.constraint for w in network.weights):
        return None
    for layer in network.layers:
        added = (layer.kernel_regularizer, layer.bias_regularizer, layer.activity_regularizer)
        if any(added) or layer.kernel_constraint or layer.bias_constraint or not layer.trainable:
            return None
    return (network.input_shape[-1], *(layer.units for layer in network.layers))
