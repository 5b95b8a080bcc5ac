"""The heart of DQN: the loss, the gradient step on Q, and the soft update of Q-hat.

Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015); the soft update is
that of Lillicrap et al., "Continuous control with deep reinforcement learning" (2015), equation in section 7.
"""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import keras
import tensorflow as tf

from dqn_keras.replay import Experience, as_batch, check_values


def loss_values(
    experiences: Sequence[Any], gamma: Any, q_network: keras.Model, q_hat_network: keras.Model
) -> tf.Tensor:
    """Mean squared temporal-difference error of a batch: mean of (y - Q(s, a))^2, a scalar.

    The target is y = r + gamma max_a' Q_hat(s', a'), or y = r where s' is terminal (Mnih et al. 2015, algorithm 1).

    Args:
        experiences: states [B, *S], actions [B] (whole numbers), rewards [B], next_states [B, *S],
            terminal_states [B] (1 or 0); NumPy arrays or tensors.
        gamma: discount per step.
        q_network: states [B, *S] -> Q-values [B, A]; a Sequential or functional model, built.
        q_hat_network: the same for the targets.

    Raises:
        ValueError: a field's shape or dtype is wrong; the message names the field.
    """
    states, actions, rewards, next_states, terminal_states = as_batch(experiences, q_network.input_shape[1:])
    max_q_hat = tf.reduce_max(q_hat_network(next_states), axis=-1)  # [B]
    targets = rewards + (1 - terminal_states) * gamma * max_q_hat  # [B]
    q_of_actions = tf.gather(q_network(states), actions, batch_dims=1)  # [B]
    return tf.reduce_mean(tf.square(targets - q_of_actions))


def update_q_hat(q_network: keras.Model, q_hat_network: keras.Model, tau: Any = 0.01) -> None:
    """Move Q-hat's weights a little towards Q's: theta_hat <- tau theta + (1 - tau) theta_hat."""
    tau = tf.convert_to_tensor(tau, tf.float32)
    for q_weights, q_hat_weights in zip(q_network.weights, q_hat_network.weights, strict=True):
        q_hat_weights.assign(tau * q_weights + (1 - tau) * q_hat_weights)


def gradient_step(
    experiences: Sequence[Any],
    gamma: Any,
    q_network: keras.Model,
    q_hat_network: keras.Model,
    optimizer: keras.Optimizer,
    tau: Any,
) -> tf.Tensor:
    """One gradient step of the loss with respect to Q alone, then the soft update; returns the loss before it."""
    with tf.GradientTape() as tape:
        loss = loss_values(experiences, gamma, q_network, q_hat_network)
    gradients = tape.gradient(loss, q_network.trainable_variables)
    optimizer.apply_gradients(zip(gradients, q_network.trainable_variables, strict=True))
    update_q_hat(q_network, q_hat_network, tau)
    return loss


def learn(
    experiences: Sequence[Any],
    gamma: float,
    q_network: keras.Model,
    q_hat_network: keras.Model,
    optimizer: keras.Optimizer,
    tau: float = 0.01,
    *,
    jit_compile: bool = True,
) -> tf.Tensor:
    """Learn from one batch: a gradient step on Q and a soft update of Q-hat, compiled into one call.

    It is compiled at the first call for these two networks and this optimizer, and never again. All three are
    changed in place; any number of agents can live side by side, and what was compiled goes when they go.

    Args:
        experiences: as for `loss_values`: an Experience, or any five arrays in its order.
        gamma: discount per step.
        q_network: a built Sequential or functional model, states [B, *S] -> Q-values [B, A].
        q_hat_network: a second one of the same shape.
        optimizer: any Keras optimizer; built here if it is not.
        tau: share of Q in the soft update.
        jit_compile: compile with XLA (faster; its results differ from TensorFlow's own in the last bits).

    Returns:
        The loss of the batch before the step, a scalar float32 tensor.

    Raises:
        ValueError: a wrong shape or dtype, an action that is not one, networks that do not match.
    """
    step = _compiled_step(q_network, q_hat_network, optimizer, jit_compile)
    batch = as_batch(experiences, q_network.input_shape[1:])
    check_values(batch, q_network.output_shape[-1])
    return step(batch, tf.convert_to_tensor(gamma, tf.float32), tf.convert_to_tensor(tau, tf.float32))


_compiled_steps: dict[tuple[int, int, int, bool], Callable[..., tf.Tensor]] = {}


def _compiled_step(
    q_network: keras.Model, q_hat_network: keras.Model, optimizer: keras.Optimizer, jit_compile: bool
) -> Callable[..., tf.Tensor]:
    """`gradient_step` for these three, compiled once; forgotten when one of them is garbage."""
    key = (id(q_network), id(q_hat_network), id(optimizer), jit_compile)
    if key not in _compiled_steps:
        prepare(q_network, q_hat_network, optimizer)
        # what is compiled must not keep the agent alive, so it holds the three by weak references
        q, q_hat, adam = weakref.ref(q_network), weakref.ref(q_hat_network), weakref.ref(optimizer)

        def step(batch: Experience, gamma: tf.Tensor, tau: tf.Tensor) -> tf.Tensor:
            return gradient_step(batch, gamma, q(), q_hat(), adam(), tau)

        state, scalar = tf.TensorSpec((None, *q_network.input_shape[1:])), tf.TensorSpec(())
        vector, indices = tf.TensorSpec((None,)), tf.TensorSpec((None,), tf.int32)
        signature = (Experience(state, indices, vector, state, vector), scalar, scalar)  # a batch of any size
        _compiled_steps[key] = tf.function(step, signature, jit_compile=jit_compile, autograph=False)
        for owner in (q_network, q_hat_network, optimizer):
            weakref.finalize(owner, _compiled_steps.pop, key, None).atexit = False
    return _compiled_steps[key]


def prepare(q_network: keras.Model, q_hat_network: keras.Model, optimizer: keras.Optimizer) -> None:
    """Check that the networks belong together, and build the optimizer: a tf.function may not create variables."""
    if not (q_network.built and q_hat_network.built):
        raise ValueError("q_network and q_hat_network must have weights: give them an Input layer, or call build()")
    if q_network is q_hat_network:
        raise ValueError("q_hat_network must be a second network, got q_network itself")
    shapes, hat_shapes = ([tuple(w.shape) for w in n.weights] for n in (q_network, q_hat_network))
    if shapes != hat_shapes:
        raise ValueError(f"q_hat_network must have weights of q_network's shapes {shapes}, got {hat_shapes}")
    if not optimizer.built:
        optimizer.build(q_network.trainable_variables)
