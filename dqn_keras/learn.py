"""The heart of DQN: the targets, the loss, the gradient step on Q, and the soft update of Q-hat.

DQN is from Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015), algorithm 1. The
soft update is from Lillicrap et al., "Continuous control with deep reinforcement learning" (2015), algorithm 1.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from dqn_keras._engine.programs import Learner
from dqn_keras._engine.steps import compiled_step
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.checks.batches import as_batch, as_share, takes_a_batch
from dqn_keras.checks.formulas import Formulas
from dqn_keras.checks.networks import check_network, check_pair
from dqn_keras.checks.numbers import check_flag
from dqn_keras.replay import Experience


@takes_a_batch
def td_targets(experiences: Experience, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
    """Returns the TD targets of a batch, y = r + gamma max_a' Q_hat(s', a'), or y = r where s' is terminal.

    Mnih et al. 2015, algorithm 1.

    Args:
        experiences: states [B, *S], actions [B] (whole numbers), rewards [B], next_states [B, *S],
            terminal_states [B] (1 or 0); NumPy arrays or tensors.
        gamma: discount factor per step, in [0, 1].
        q_network: states [B, *S] -> Q-values [B, A]; a built Sequential or functional model. Not used here.
        q_hat_network: a network with the same input and output, which gives Q_hat.

    Returns:
        The targets y, [B] float32.

    Raises:
        TypeError, ValueError: the shape, dtype or value of a field is wrong; the message names the field.
    """
    _, _, rewards, next_states, terminal_states = experiences
    max_q_hat = tf.reduce_max(q_hat_network(next_states), axis=-1)  # [B]
    return rewards + (1 - terminal_states) * gamma * max_q_hat


@takes_a_batch
def double_td_targets(
    experiences: Experience, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model
) -> tf.Tensor:
    """Returns the targets of Double DQN: Q chooses the next action, Q-hat values it.

    y = r + gamma Q_hat(s', argmax_a' Q(s', a')), or y = r where s' is terminal. This reduces the overestimation that a
    maximum over noisy values causes (van Hasselt, Guez and Silver 2016, "Deep Reinforcement Learning with Double
    Q-learning", equation 4). Arguments, result and errors are as in `td_targets`.
    """
    _, _, rewards, next_states, terminal_states = experiences
    best_actions = tf.argmax(q_network(next_states), axis=-1)  # [B]
    q_hat_values = tf.gather(q_hat_network(next_states), best_actions, batch_dims=1)  # [B]
    return rewards + (1 - terminal_states) * gamma * q_hat_values


@takes_a_batch
def loss_values(experiences: Experience, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
    """Returns the original's loss of a batch, a scalar: the mean squared TD error, mean of (y - Q(s, a))^2.

    `td_targets` gives y. Arguments and errors are as in `td_targets`.
    """
    y_targets = td_targets(experiences, gamma, q_network, q_hat_network)  # [B]
    q_values = tf.gather(q_network(experiences.state), experiences.action, batch_dims=1)  # [B]
    return keras.losses.mean_squared_error(y_targets, q_values)


def update_q_hat(q_network: keras.Model, q_hat_network: keras.Model, tau: Any = 0.01) -> None:
    """Moves Q-hat's weights a little towards Q's: theta_hat <- tau theta + (1 - tau) theta_hat.

    Args:
        q_network: the network Q.
        q_hat_network: a second network with weights of the same shapes; changed in place.
        tau: share of Q, in [0, 1].

    Raises:
        TypeError, ValueError: the networks do not match, or `tau` is not in [0, 1].
    """
    check_pair(q_network, q_hat_network)
    tau = as_share("tau", tau)
    for q_weights, q_hat_weights in zip(q_network.weights, q_hat_network.weights, strict=True):
        is_float = tf.as_dtype(q_weights.dtype).is_floating  # integers, such as a counter, are copied
        q_hat_weights.assign(tau * q_weights + (1 - tau) * q_hat_weights if is_float else q_weights)


DEFAULT_FORMULAS = Formulas(td_targets, "mse")


def known_formulas(formulas: Formulas) -> Formulas | None:
    """Returns the formulas if they are the package's or Keras' own, which never change in a process; else None."""
    are_known = any(formulas.targets is x for x in (td_targets, double_td_targets)) and isinstance(formulas.loss, str)
    return formulas if are_known else None


class Metrics(NamedTuple):
    """Metrics of an update, measured on its batch before the update; float32 scalars."""

    loss: Any
    """Loss of the batch, including the network's regularization losses."""
    mean_q: Any
    """Mean over the batch of max_a Q(s, a), the metric of Mnih et al. 2013."""
    max_q: Any
    """Maximum over the batch of max_a Q(s, a)."""
    td_error: Any
    """Mean over the batch of |y - Q(s, a)|, with the targets in use."""


def gradient_step(
    experiences: Experience,
    gamma: Any,
    q_network: keras.Model,
    q_hat_network: keras.Model,
    optimizer: keras.Optimizer,
    tau: Any,
    formulas: Formulas = DEFAULT_FORMULAS,
) -> Metrics:
    """Takes one gradient step on the loss, with respect to Q alone, then moves Q-hat towards Q."""
    y = formulas.y(experiences, gamma, q_network, q_hat_network)  # [B]
    with tf.GradientTape() as tape:
        q_values = q_network(experiences.state)  # [B, A]
        q = tf.gather(q_values, experiences.action, batch_dims=1)  # [B]
        loss = formulas.loss_of(y, q) + sum(tf.cast(x, tf.float32) for x in q_network.losses)  # regularization
        scaled_loss = optimizer.scale_loss(loss)
    weights = q_network.trainable_variables
    optimizer.apply_gradients(zip(tape.gradient(scaled_loss, weights), weights, strict=True))
    update_q_hat(q_network, q_hat_network, tau)

    max_q_values = tf.reduce_max(q_values, axis=-1)  # [B]
    return Metrics(
        loss=loss,
        mean_q=tf.reduce_mean(max_q_values),
        max_q=tf.reduce_max(max_q_values),
        td_error=tf.reduce_mean(tf.abs(y - q)),
    )


def learn(
    experiences: Sequence[Any],
    gamma: float,
    q_network: keras.Model,
    q_hat_network: keras.Model,
    optimizer: keras.Optimizer,
    tau: float = 0.01,
    *,
    targets: Callable = td_targets,
    loss: str | Callable = "mse",
    jit_compile: bool = True,
) -> tf.Tensor:
    """Learns from one batch: a gradient step on Q and a soft update of Q-hat, compiled into one call.

    `learn` uses the networks, optimizer, targets and loss that you pass, not copies of them. It compiles the call once
    for these objects and each batch size, and again if you change one of them (an attribute, a closure, a global name
    that a function reads). Networks of `make_networks` with a plain Adam share compiled programs.

    Args:
        experiences: an Experience, or any five arrays in its order: states [B, *S], actions [B] (whole numbers),
            rewards [B], next_states [B, *S], terminal_states [B] (1 or 0).
        gamma: discount factor per step, in [0, 1].
        q_network: a built Sequential or functional model, states [B, *S] -> Q-values [B, A] float32; changed in place.
            Its layers are called in inference mode, and its regularization losses are added to the loss.
        q_hat_network: a second network with weights of the same shapes; changed in place.
        optimizer: any Keras optimizer; `learn` builds it if necessary.
        tau: share of Q in the soft update, in [0, 1].
        targets: a function like `td_targets`: (experiences, gamma, q_network, q_hat_network) -> y [B]. No gradient
            flows through it.
        loss: any loss that Keras takes in `compile`: a name, a `keras.losses.Loss`, or a function of (y, q), both [B].
            The function returns a scalar, or [B], which is averaged.
        jit_compile: compile with XLA, which is faster. Its results differ from TensorFlow's own in the last bits.

    Returns:
        The loss of the batch before the step, a scalar float32 tensor.

    Raises:
        TypeError, ValueError: a shape or dtype is wrong, an action does not exist, a number is not finite, or the
            networks do not match. Nothing is changed in that case.
    """
    check_network("q_network", q_network)
    check_network("q_hat_network", q_hat_network)
    batch = as_batch(experiences, q_network.input_shape[1:], q_network.output_shape[-1])
    gamma, tau = as_share("gamma", gamma), as_share("tau", tau)
    jit_compile = check_flag("jit_compile", jit_compile)
    learner, formulas = Learner(q_network, q_hat_network, optimizer), Formulas(targets, loss)
    if not tf.executing_eagerly():  # inside the caller's tf.function, which compiles it
        formulas.check()
        with tf.init_scope():
            learner.prepare()
        return gradient_step(batch, gamma, *learner, tau, formulas).loss
    make_step, batch_size = partial(_make_step, formulas), batch.reward.shape[0]
    step = compiled_step(make_step, learner, formulas, known_formulas(formulas), batch_size, jit_compile)
    return step(*batch, gamma, tau)[0]


def _make_step(formulas: Formulas, learner: Learner) -> Callable[..., tf.Tensor]:
    """Returns `gradient_step` as a function of tensors only: the five fields of a batch, gamma, tau -> the loss."""

    def step(*tensors: tf.Tensor) -> tf.Tensor:
        *batch, gamma, tau = tensors
        return gradient_step(Experience(*batch), gamma, *learner, tau, formulas).loss

    return step
