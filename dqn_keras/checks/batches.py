"""Checks of a batch before a learning step."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.checks.networks import check_network
from dqn_keras.checks.numbers import check_number, shown, unwrapped
from dqn_keras.replay import Experience


def as_batch(experiences: Sequence[Any], state_shape: tuple[int, ...], num_actions: int) -> Experience:
    """Returns any five arrays as a batch of tensors with the right dtypes.

    Without the check of shapes, rewards of shape [B, 1] would silently broadcast against [B] to a loss over [B, B].
    Values are not checked inside a tf.function, where they are unknown.

    Raises:
        ValueError: a field's shape, dtype or value is wrong; the message names the field.
    """
    if not isinstance(experiences, list | tuple) or len(experiences) != len(_PLURALS):
        got = len(experiences) if isinstance(experiences, list | tuple) else shown(experiences)
        raise ValueError(f"experiences must be the five fields {', '.join(_PLURALS)}, got {got}")
    fields = []
    for name, field in zip(_PLURALS, experiences, strict=True):
        try:
            fields.append(field if isinstance(field, tf.Tensor | tf.Variable) else np.asarray(field))
        except Exception as error:  # lists of unequal lengths, or an object of any library
            raise ValueError(f"{name} must be an array, got {shown(field)}") from error
    num_transitions = fields[0].shape[0] if len(fields[0].shape) else None
    if num_transitions == 0:
        raise ValueError("states must hold at least one transition, got none")
    vector, states = [num_transitions], [num_transitions, *state_shape]
    shapes = [states, vector, vector, states, vector]
    return Experience(*(_checked(*x, num_actions) for x in zip(_PLURALS, fields, shapes, strict=True)))


def _checked(name: str, field: Any, shape: list, num_actions: int) -> tf.Tensor:
    got = tf.TensorShape(field.shape)
    if got.rank != len(shape) or not got.is_compatible_with(shape):
        raise ValueError(f"{name} must have shape {shape}, got {got}")
    try:
        dtype = tf.as_dtype(field.dtype)
    except TypeError:  # for example, dates
        dtype = tf.string
    if not (dtype.is_integer or (name != "actions" and (dtype.is_floating or dtype.is_bool))):
        raise ValueError(
            f"{name} must be {'whole numbers' if name == 'actions' else 'numbers'}, got {field.dtype.name}"
        )
    if not tf.is_tensor(field) or (tf.executing_eagerly() and hasattr(field, "numpy")):
        field = np.asarray(field)
        if name == "actions" and not (field.min() >= 0 and field.max() < num_actions):  # XLA would clamp it
            raise ValueError(f"actions must lie in 0..{num_actions - 1}, got {field.min()}..{field.max()}")
        if name == "terminal_states" and not ((field == 0) | (field == 1)).all():
            raise ValueError(f"terminal_states must be 0 or 1, got {field[(field != 0) & (field != 1)][0]}")
        with np.errstate(over="ignore"):
            field = field.astype(np.int32 if name == "actions" else np.float32)
        if not np.isfinite(field).all():
            raise ValueError(f"{name} must be finite in float32, got {field[~np.isfinite(field)][0]}")
    return tf.cast(field, tf.int32 if name == "actions" else tf.float32)


def as_share(name: str, value: Any) -> tf.Tensor:
    """Returns a number in [0, 1] as a float32 scalar."""
    is_tensor = isinstance(value, tf.Tensor | tf.Variable)
    if not is_tensor or (tf.executing_eagerly() and hasattr(value, "numpy")):
        value = check_number(name, unwrapped(value), at_least=0, at_most=1)
    elif value.shape.rank != 0 or not (value.dtype.is_floating or value.dtype.is_integer):
        raise ValueError(f"{name} must be a scalar number, got {value.dtype.name} of shape {value.shape}")
    return tf.cast(value, tf.float32)


_PLURALS = ("states", "actions", "rewards", "next_states", "terminal_states")


def takes_a_batch(formula: Callable) -> Callable:
    """Makes `formula` accept any five arrays: checks them and passes them on as an Experience of tensors."""

    @functools.wraps(formula)
    def checked(
        experiences: Sequence[Any], gamma: Any, q_network: keras.Model, q_hat_network: keras.Model
    ) -> tf.Tensor:
        check_network("q_network", q_network)
        check_network("q_hat_network", q_hat_network)
        shapes, hat_shapes = ((n.input_shape, n.output_shape) for n in (q_network, q_hat_network))
        if shapes != hat_shapes:
            raise ValueError(f"q_hat_network must have q_network's input and output {shapes}, got {hat_shapes}")
        batch = as_batch(experiences, q_network.input_shape[1:], q_network.output_shape[-1])
        return formula(batch, as_share("gamma", gamma), q_network, q_hat_network)

    return checked
