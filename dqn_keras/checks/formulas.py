"""The two formulas of a gradient step, targets and loss, and what they must return."""

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

from dqn_keras._engine.tensorflow import keras, tf


class Formulas(NamedTuple):
    """What a gradient step computes: the targets, and the loss of them."""

    targets: Callable
    loss: str | Callable

    def check(self) -> None:
        """Raises TypeError or ValueError if one of them is not what `learn` takes."""
        if not callable(self.targets):
            raise TypeError(f"targets must be a function like td_targets, got {self.targets!r}")
        if isinstance(self.loss, str):
            self.loss_function()
        elif not callable(self.loss) or isinstance(self.loss, type):
            raise TypeError(
                f"loss must be a name that Keras knows, a keras.losses.Loss or a function of (y, q), got {self.loss!r}"
            )

    def loss_function(self) -> Callable:
        """The loss as something to call; ValueError if Keras does not know its name."""
        if not isinstance(self.loss, str):
            return self.loss
        try:
            return keras.losses.get(self.loss)
        except ValueError:
            raise ValueError(f"loss must be a name that Keras knows, such as 'mse', got {self.loss!r}") from None

    @property
    def are_the_packages(self) -> bool:
        """Whether both are parts of this package or of Keras, which do not change while a process lives."""
        return getattr(self.targets, "__module__", None) == "dqn_keras.learn" and isinstance(self.loss, str)

    @property
    def key(self) -> Hashable:
        """Equal for equal formulas, as long as they live."""
        return tuple(self) if self.are_the_packages else tuple(map(id, self))

    def y(self, experiences: Any, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
        """The targets [B], to which no gradient flows."""
        y = self.targets(experiences, gamma, q_network, q_hat_network)
        batch_shape = experiences.reward.shape
        is_vector = tf.is_tensor(y) and y.shape.rank == 1 and y.shape.is_compatible_with(batch_shape)
        if not (is_vector and y.dtype == tf.float32):
            got = f"{y.dtype.name} of shape {y.shape}" if tf.is_tensor(y) else repr(y)
            raise ValueError(f"targets must return a float32 tensor of shape [B] = {batch_shape}, got {got}")
        return tf.stop_gradient(y)

    def loss_of(self, y: tf.Tensor, q: tf.Tensor) -> tf.Tensor:
        """The loss of targets [B] and values [B], a scalar. One value for each transition counts as their mean."""
        loss = self.loss_function()
        if isinstance(loss, keras.losses.Loss):  # which takes the last axis for that of a sample
            y, q = y[:, None], q[:, None]
        value = loss(y, q)
        if not tf.is_tensor(value) or not (value.shape.rank == 0 or value.shape.is_compatible_with(y.shape[:1])):
            got = f"shape {value.shape}" if tf.is_tensor(value) else repr(value)
            raise ValueError(f"loss must return a scalar tensor, or one value for each transition, got {got}")
        return tf.cast(tf.reduce_mean(value), tf.float32)
