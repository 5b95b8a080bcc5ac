"""Dense layers with few inputs or few outputs that XLA compiles to faster code than Keras' own.

XLA compiles a product with a narrow matrix to a call or to a slow separate loop. If the product is written as a sum
over the few columns, it becomes part of the elementwise code around it.
"""

from collections.abc import Callable

from dqn_keras._engine.tensorflow import keras, tf


class FewInputsDense(keras.layers.Dense):
    """Computes the same as Keras' Dense, with a product that is fast for few inputs, such as a small state."""

    def call(self, inputs: tf.Tensor, training: bool | None = None) -> tf.Tensor:
        x, kernel = tf.convert_to_tensor(inputs), tf.convert_to_tensor(self.kernel)
        return self.activation(_product_of_few_inputs(x, kernel) + self.bias)


@tf.custom_gradient
def _product_of_few_inputs(x: tf.Tensor, kernel: tf.Tensor) -> tuple[tf.Tensor, Callable]:
    """Returns the product of x [B, F] and kernel [F, U] as a sum over the F inputs, and its usual gradient."""

    def gradient(dy: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:  # [B, U]
        return tf.matmul(dy, kernel, transpose_b=True), tf.matmul(x, dy, transpose_a=True)

    return sum(x[:, f, None] * kernel[f] for f in range(kernel.shape[0])), gradient


class FewOutputsDense(keras.layers.Dense):
    """Computes the same as Keras' Dense, with a gradient that is fast for few outputs, such as a few actions.

    TensorFlow's gradient is two products with a transposed matrix. Compiled by XLA, they take a third of a learning
    step of the 4-64-2 network.
    """

    def call(self, inputs: tf.Tensor, training: bool | None = None) -> tf.Tensor:
        return _product_of_few_outputs(tf.convert_to_tensor(inputs), tf.convert_to_tensor(self.kernel)) + self.bias


@tf.custom_gradient
def _product_of_few_outputs(x: tf.Tensor, kernel: tf.Tensor) -> tuple[tf.Tensor, Callable]:
    """Returns the product of x [B, U] and kernel [U, A], and its gradient as a sum over the A outputs."""

    def gradient(dy: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:  # [B, A]
        outputs = range(kernel.shape[1])
        dx = sum(dy[:, a, None] * kernel[None, :, a] for a in outputs)  # [B, U]
        return dx, tf.stack([tf.reduce_sum(x * dy[:, a, None], axis=0) for a in outputs], axis=1)

    return x @ kernel, gradient
