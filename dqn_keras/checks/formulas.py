"""The two formulas of a gradient step, targets and loss, and checks of what they return."""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.checks.numbers import shown


class Formulas(NamedTuple):
    """The formulas of a gradient step: the targets and the loss."""

    targets: Callable
    loss: str | Callable

    def check(self) -> None:
        """Raises TypeError or ValueError if `learn` cannot use one of them."""
        if not callable(self.targets) or isinstance(self.targets, type | keras.Model):
            raise TypeError(f"targets must be a function like td_targets, got {shown(self.targets)}")
        if isinstance(self.loss, str):
            self.loss_function()
        elif not callable(self.loss) or isinstance(self.loss, type | keras.metrics.Metric | keras.Model):
            raise TypeError(
                "loss must be a name that Keras knows, a keras.losses.Loss or a function of (y, q), "
                f"got {shown(self.loss)}"
            )
        check_takes("targets", self.targets, ("experiences", "gamma", "q_network", "q_hat_network"))
        if not isinstance(self.loss, str):
            check_takes("loss", self.loss, ("y", "q"))

    def loss_function(self) -> Callable:
        """Returns the loss as a function; raises ValueError if Keras does not know its name."""
        if not isinstance(self.loss, str):
            return self.loss
        try:
            return keras.losses.get(self.loss)
        except ValueError:
            raise ValueError(f"loss must be a name that Keras knows, such as 'mse', got {shown(self.loss)}") from None

    def y(self, experiences: Any, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
        """Returns the targets [B], through which no gradient flows."""
        y = called("targets", self.targets, experiences, gamma, q_network, q_hat_network)
        batch_shape = experiences.reward.shape
        is_vector = tf.is_tensor(y) and y.shape.rank == 1 and y.shape.is_compatible_with(batch_shape)
        if not (is_vector and y.dtype == tf.float32):
            got = f"{y.dtype.name} of shape {y.shape}" if tf.is_tensor(y) else shown(y)
            raise ValueError(f"targets must return a float32 tensor of shape [B] = {batch_shape}, got {got}")
        return tf.stop_gradient(y)

    def loss_of(self, y: tf.Tensor, q: tf.Tensor) -> tf.Tensor:
        """Returns the loss of targets [B] and Q-values [B], a scalar. A loss per transition is averaged."""
        loss = self.loss_function()
        is_the_originals = loss is keras.losses.mean_squared_error  # called with two vectors, as in the original
        if isinstance(loss, keras.losses.Loss) or (isinstance(self.loss, str) and not is_the_originals):
            y, q = y[:, None], q[:, None]  # [B, 1], as in `fit`: Keras reduces over the last axis
        value = called("loss", loss, y, q)
        if not tf.is_tensor(value) or not (value.shape.rank == 0 or value.shape.is_compatible_with(y.shape[:1])):
            got = f"shape {value.shape}" if tf.is_tensor(value) else shown(value)
            raise ValueError(f"loss must return a scalar tensor, or one value for each transition, got {got}")
        return tf.cast(tf.reduce_mean(value), tf.float32)


def called(name: str, function: Callable, *arguments: Any) -> Any:
    """Calls the user's function; adds a note to its errors, which says that the function raised them."""
    try:
        return function(*arguments)
    except Exception as error:
        error.add_note(f"raised by {name} {shown(function)}")
        raise


def check_takes(name: str, function: Callable, arguments: tuple[str, ...]) -> None:
    """Raises TypeError if the function cannot be called with this number of arguments."""
    try:
        inspect.signature(function, follow_wrapped=False).bind(*arguments)
    except ValueError:  # Python does not know its signature
        pass
    except TypeError as error:
        raise TypeError(
            f"{name} must be a function of ({', '.join(arguments)}), got {shown(function)}: {error}"
        ) from None
