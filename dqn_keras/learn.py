"""The heart of DQN: the loss, the gradient step on Q, and the soft update of Q-hat.

Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015); the soft update is
that of Lillicrap et al., "Continuous control with deep reinforcement learning" (2015), equation in section 7.
"""

import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import Any

from dqn_keras._tensorflow import keras, tf
from dqn_keras.networks import check_network
from dqn_keras.programs import Learner, bind
from dqn_keras.replay import Experience, as_batch, as_share


def td_errors(experiences: Sequence[Any], gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
    """Temporal-difference errors of a batch: y - Q(s, a) of each transition, [B].

    The target is y = r + gamma max_a' Q_hat(s', a'), or y = r where s' is terminal (Mnih et al. 2015, algorithm 1).

    Args:
        experiences: states [B, *S], actions [B] (whole numbers), rewards [B], next_states [B, *S],
            terminal_states [B] (1 or 0); NumPy arrays or tensors.
        gamma: discount per step.
        q_network: states [B, *S] -> Q-values [B, A]; a Sequential or functional model, built.
        q_hat_network: the same for the targets.

    Raises:
        TypeError, ValueError: a field's shape, dtype or value is wrong; the message names the field.
    """
    check_network("q_network", q_network)
    check_network("q_hat_network", q_hat_network)
    batch = as_batch(experiences, q_network.input_shape[1:], q_network.output_shape[-1])
    states, actions, rewards, next_states, terminal_states = batch
    gamma = as_share("gamma", gamma)
    max_q_hat = tf.reduce_max(q_hat_network(next_states), axis=-1)  # [B]
    targets = rewards + (1 - terminal_states) * gamma * max_q_hat  # [B]
    q_of_actions = tf.gather(q_network(states), actions, batch_dims=1)  # [B]
    return targets - q_of_actions


def loss_values(
    experiences: Sequence[Any], gamma: Any, q_network: keras.Model, q_hat_network: keras.Model
) -> tf.Tensor:
    """The loss: the mean of the squared `td_errors`, a scalar. A function of the same form may take its place."""
    return tf.reduce_mean(tf.square(td_errors(experiences, gamma, q_network, q_hat_network)))


def check_loss(loss: Callable) -> None:
    """TypeError if it is not a function, or something like one."""
    if not callable(loss) or getattr(loss, "__hash__", None) is None:
        raise TypeError(f"loss must be a function, or another hashable callable, got {loss!r}")


def update_q_hat(q_network: keras.Model, q_hat_network: keras.Model, tau: Any = 0.01) -> None:
    """Move Q-hat's weights a little towards Q's: theta_hat <- tau theta + (1 - tau) theta_hat."""
    tau = as_share("tau", tau)
    for q_weights, q_hat_weights in zip(q_network.weights, q_hat_network.weights, strict=True):
        q_hat_weights.assign(tau * q_weights + (1 - tau) * q_hat_weights)


def gradient_step(
    experiences: Sequence[Any],
    gamma: Any,
    q_network: keras.Model,
    q_hat_network: keras.Model,
    optimizer: keras.Optimizer,
    tau: Any,
    loss: Callable = loss_values,
) -> tf.Tensor:
    """One gradient step of the loss with respect to Q alone, then the soft update; returns the loss before it."""
    with tf.GradientTape() as tape:
        value = loss(experiences, gamma, q_network, q_hat_network)
        if not tf.is_tensor(value) or value.shape.rank != 0:
            got = f"shape {value.shape}" if tf.is_tensor(value) else repr(value)
            raise ValueError(f"loss must return a scalar tensor, got {got}")
    gradients = tape.gradient(value, q_network.trainable_variables)
    optimizer.apply_gradients(zip(gradients, q_network.trainable_variables, strict=True))
    update_q_hat(q_network, q_hat_network, tau)
    return tf.cast(value, tf.float32)


def learn(
    experiences: Sequence[Any],
    gamma: float,
    q_network: keras.Model,
    q_hat_network: keras.Model,
    optimizer: keras.Optimizer,
    tau: float = 0.01,
    *,
    loss: Callable = loss_values,
    jit_compile: bool = True,
) -> tf.Tensor:
    """Learn from one batch: a gradient step on Q and a soft update of Q-hat, compiled into one call.

    It is traced once for all agents whose networks and optimizer are configured alike, and compiled once for each
    size of the batch. The three are changed in place; any number of agents can live side by side.

    Args:
        experiences: as for `loss_values`: an Experience, or any five arrays in its order.
        gamma: discount per step.
        q_network: a built Sequential or functional model, states [B, *S] -> Q-values [B, A].
        q_hat_network: a second one of the same shape.
        optimizer: any Keras optimizer; built here if it is not.
        tau: share of Q in the soft update.
        loss: a function of `loss_values`' form: (experiences, gamma, q_network, q_hat_network) -> scalar tensor.
        jit_compile: compile with XLA (faster; its results differ from TensorFlow's own in the last bits).

    Returns:
        The loss of the batch before the step, a scalar float32 tensor.

    Raises:
        TypeError, ValueError: a wrong shape or dtype, an action that is not one, a number that is not finite,
            networks that do not match; nothing is changed then.
    """
    check_network("q_network", q_network)
    check_network("q_hat_network", q_hat_network)
    check_loss(loss)
    learner = Learner(q_network, q_hat_network, optimizer)
    if not tf.executing_eagerly():  # in a tf.function of the caller's, which then compiles it
        with tf.init_scope():
            learner.prepare()
        return gradient_step(experiences, gamma, *learner, tau, loss)
    step = _bound_step(learner, loss, jit_compile)
    batch = as_batch(experiences, q_network.input_shape[1:], q_network.output_shape[-1])
    gamma, tau = as_share("gamma", gamma), as_share("tau", tau)
    return step(*batch, gamma, tau)[0]


_bound_steps: dict[Hashable, Callable] = {}


def _bound_step(learner: Learner, loss: Callable, jit_compile: bool) -> Callable[..., list[tf.Tensor]]:
    """The compiled `gradient_step` for these; found at once from the second call on."""
    key = (*map(id, learner), loss, jit_compile, *map(id, learner.q_network.trainable_variables))
    if key not in _bound_steps:
        learner.prepare()
        state = tf.TensorSpec((None, *learner.q_network.input_shape[1:]))  # a batch of any size
        scalar, vector, indices = tf.TensorSpec(()), tf.TensorSpec((None,)), tf.TensorSpec((None,), tf.int32)
        specs = (state, indices, vector, state, vector, scalar, scalar)

        def make_step(learner: Learner, _: Any) -> Callable[..., tf.Tensor]:
            return lambda *tensors: gradient_step(Experience(*tensors[:5]), tensors[5], *learner, tensors[6], loss)

        _bound_steps[key] = bind(("learn", loss), make_step, specs, learner, jit_compile=jit_compile)
        for owner in learner:  # what is bound holds the agent's variables: it must go when the agent goes
            weakref.finalize(owner, _bound_steps.pop, key, None).atexit = False
    return _bound_steps[key]
