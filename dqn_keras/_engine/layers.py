"""Layers that XLA compiles into faster code than Keras' own."""

from collections.abc import Callable

from dqn_keras._engine.tensorflow import keras, tf


class _NarrowDense(keras.layers.Dense):
    """Keras' Dense with another form of the gradient, for few outputs, such as the values of a few actions.

    TensorFlow's gradient is two products with a transposed matrix. XLA compiles these to slow loops if the matrix is
    narrow: they take a third of a learning step of the 4-64-2 network.
    """

    def call(self, inputs: tf.Tensor, training: bool | None = None) -> tf.Tensor:
        return _narrow_product(tf.convert_to_tensor(inputs), tf.convert_to_tensor(self.kernel)) + self.bias


@tf.custom_gradient
def _narrow_product(x: tf.Tensor, kernel: tf.Tensor) -> tuple[tf.Tensor, Callable]:
    """Returns the product of x [B, U] and kernel [U, A], and its gradient as a sum over the A columns."""

    def gradient(dy: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:  # [B, A]
        columns = range(kernel.shape[1])
        dx = sum(dy[:, a, None] * kernel[None, :, a] for a in columns)  # [B, U]
        return dx, tf.stack([tf.reduce_sum(x * dy[:, a, None], axis=0) for a in columns], axis=1)

    return x @ kernel, gradient
