"""The heart of DQN: the targets, the loss, the gradient step on Q, and the soft update of Q-hat.

Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015), algorithm 1; the soft update
is from Lillicrap et al., "Continuous control with deep reinforcement learning" (2015), algorithm 1.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

from dqn_keras._tensorflow import keras, tf
from dqn_keras.networks import all_layers, check_network, warn_of_inference_mode
from dqn_keras.programs import Learner, bind
from dqn_keras.replay import Experience, as_batch, as_share
from dqn_keras.watching import Watch


def _takes_a_batch(formula: Callable) -> Callable:
    """Lets `formula` be called with any five arrays: they are checked, and reach it as an Experience of tensors."""

    @functools.wraps(formula)
    def checked(
        experiences: Sequence[Any], gamma: Any, q_network: keras.Model, q_hat_network: keras.Model
    ) -> tf.Tensor:
        check_network("q_network", q_network)
        check_network("q_hat_network", q_hat_network)
        batch = as_batch(experiences, q_network.input_shape[1:], q_network.output_shape[-1])
        return formula(batch, as_share("gamma", gamma), q_network, q_hat_network)

    return checked


@_takes_a_batch
def td_targets(experiences: Experience, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
    """Returns the TD targets of a batch, y = r + gamma max_a' Q_hat(s', a'), or y = r where s' is terminal.

    Mnih et al. 2015, algorithm 1.

    Args:
        experiences: states [B, *S], actions [B] (whole numbers), rewards [B], next_states [B, *S],
            terminal_states [B] (1 or 0); NumPy arrays or tensors.
        gamma: discount per step, in [0, 1].
        q_network: states [B, *S] -> Q-values [B, A]; a built Sequential or functional model. Not used here.
        q_hat_network: the same for the targets.

    Returns:
        [B] float32.

    Raises:
        TypeError, ValueError: a field's shape, dtype or value is wrong; the message names the field.
    """
    _, _, rewards, next_states, terminal_states = experiences
    max_q_hat = tf.reduce_max(q_hat_network(next_states), axis=-1)  # [B]
    return rewards + (1 - terminal_states) * gamma * max_q_hat


@_takes_a_batch
def double_td_targets(
    experiences: Experience, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model
) -> tf.Tensor:
    """Returns the targets of Double DQN: Q chooses the next action, Q-hat values it.

    y = r + gamma Q_hat(s', argmax_a' Q(s', a')), or y = r where s' is terminal. This lessens the overestimation that
    comes from a maximum over noisy values (van Hasselt, Guez and Silver 2016, "Deep Reinforcement Learning with Double
    Q-learning", equation 4). Arguments, result and errors are those of `td_targets`.
    """
    _, _, rewards, next_states, terminal_states = experiences
    best_actions = tf.argmax(q_network(next_states), axis=-1)  # [B]
    q_hat_values = tf.gather(q_hat_network(next_states), best_actions, batch_dims=1)  # [B]
    return rewards + (1 - terminal_states) * gamma * q_hat_values


@_takes_a_batch
def loss_values(experiences: Experience, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
    """Returns the original's loss of a batch, a scalar: the mean squared TD error, mean of (y - Q(s, a))^2.

    Arguments and errors are those of `td_targets`, which gives y.
    """
    y_targets = td_targets(experiences, gamma, q_network, q_hat_network)  # [B]
    q_values = tf.gather(q_network(experiences.state), experiences.action, batch_dims=1)  # [B]
    return keras.losses.mean_squared_error(y_targets, q_values)


def update_q_hat(q_network: keras.Model, q_hat_network: keras.Model, tau: Any = 0.01) -> None:
    """Moves Q-hat's weights a little towards Q's: theta_hat <- tau theta + (1 - tau) theta_hat."""
    tau = as_share("tau", tau)
    for q_weights, q_hat_weights in zip(q_network.weights, q_hat_network.weights, strict=True):
        is_float = tf.as_dtype(q_weights.dtype).is_floating  # a counter or the like is copied
        q_hat_weights.assign(tau * q_weights + (1 - tau) * q_hat_weights if is_float else q_weights)


class Formulas(NamedTuple):
    """What a gradient step computes: the targets, and the loss of them."""

    targets: Callable = td_targets
    loss: str | Callable = "mse"

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
        is_keras = isinstance(self.loss, str) and self.loss_function().__module__.startswith("keras.src.losses.")
        return self.targets in (td_targets, double_td_targets) and is_keras

    @property
    def key(self) -> Hashable:
        """Equal for equal formulas, as long as they live."""
        return tuple(self) if self.are_the_packages else tuple(map(id, self))

    def y(self, experiences: Experience, gamma: Any, q_network: keras.Model, q_hat_network: keras.Model) -> tf.Tensor:
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


DEFAULT_FORMULAS = Formulas()


class Metrics(NamedTuple):
    """What an update's batch was like, before the update; float32 scalars."""

    loss: Any
    """With the regularization losses of the network."""
    mean_q: Any
    """Mean over the batch of max_a Q(s, a), the metric of Mnih et al. 2013."""
    max_q: Any
    """The highest of them."""
    td_error: Any
    """Mean of |y - Q(s, a)|, with the targets in use."""


def gradient_step(
    experiences: Experience,
    gamma: Any,
    q_network: keras.Model,
    q_hat_network: keras.Model,
    optimizer: keras.Optimizer,
    tau: Any,
    formulas: Formulas = DEFAULT_FORMULAS,
) -> Metrics:
    """Takes one gradient step of the loss with respect to Q alone, then moves Q-hat towards Q."""
    y = formulas.y(experiences, gamma, q_network, q_hat_network)  # [B]
    with tf.GradientTape() as tape:
        q_values = q_network(experiences.state)  # [B, A]
        q = tf.gather(q_values, experiences.action, batch_dims=1)  # [B]
        loss = formulas.loss_of(y, q)
        for regularization in q_network.losses:
            loss += tf.cast(regularization, tf.float32)
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

    Networks, optimizer, targets and loss are used as the objects they are. The call is compiled once for these objects
    and each size of the batch, and again when one of them has been changed (an attribute, a closure, a global name that
    a function reads). Networks of `make_networks` with a plain Adam share what is compiled.

    Args:
        experiences: an Experience, or any five arrays in its order: states [B, *S], actions [B] (whole numbers),
            rewards [B], next_states [B, *S], terminal_states [B] (1 or 0).
        gamma: discount per step, in [0, 1].
        q_network: a built Sequential or functional model, states [B, *S] -> Q-values [B, A] float32; changed in place.
            Its layers are called in inference mode, and its regularization losses are added to the loss.
        q_hat_network: a second one with weights of the same shapes; changed in place.
        optimizer: any Keras optimizer; built here if it is not.
        tau: share of Q in the soft update, in [0, 1].
        targets: a function like `td_targets`: (experiences, gamma, q_network, q_hat_network) -> y [B]. No gradient
            flows through it.
        loss: what Keras takes in `compile`: a name, a `keras.losses.Loss`, or a function of (y, q), both [B] -> a
            scalar or [B], which is averaged.
        jit_compile: compile with XLA (faster; its results differ from TensorFlow's own in the last bits).

    Returns:
        The loss of the batch before the step, a scalar float32 tensor.

    Raises:
        TypeError, ValueError: a wrong shape or dtype, an action that is not one, a number that is not finite,
            networks that do not match; nothing is changed then.
    """
    check_network("q_network", q_network)
    check_network("q_hat_network", q_hat_network)
    learner, formulas = Learner(q_network, q_hat_network, optimizer), Formulas(targets, loss)
    if not tf.executing_eagerly():  # in a tf.function of the caller's, which then compiles it
        formulas.check()
        with tf.init_scope():
            learner.prepare()
        batch = as_batch(experiences, q_network.input_shape[1:], q_network.output_shape[-1])
        return gradient_step(batch, as_share("gamma", gamma), *learner, tau, formulas).loss
    step = _compiled_step(learner, formulas, jit_compile)
    batch = as_batch(experiences, q_network.input_shape[1:], q_network.output_shape[-1])
    return step(*batch, as_share("gamma", gamma), as_share("tau", tau))[0]


class _Step(NamedTuple):
    """A compiled step, and what it was compiled for."""

    parts: tuple[Any, ...]
    watch: Watch
    call: Callable[..., list[tf.Tensor]]


@dataclasses.dataclass
class _Steps:
    """The compiled steps of one network. The network holds them, so that they go when it goes."""

    kept: list[_Step] = dataclasses.field(default_factory=list)
    num_compiled: int = 0


_MOST_KEPT = 8


def _compiled_step(learner: Learner, formulas: Formulas, jit_compile: bool) -> Callable[..., list[tf.Tensor]]:
    """The compiled `gradient_step` for these, found at once from the second call on if none of them has changed."""
    parts = (*learner, *formulas, jit_compile)
    steps: _Steps = vars(learner.q_network).setdefault("_dqn_keras_steps", _Steps())
    for step in steps.kept:
        if all(a is b or (isinstance(a, str) and a == b) for a, b in zip(step.parts, parts, strict=True)):
            if step.watch.is_unchanged():
                return step.call
            steps.kept.remove(step)
            break
    formulas.check()
    learner.prepare()
    if not steps.num_compiled:
        warn_of_inference_mode(learner.q_network)
    call = _bind_step(learner, formulas, jit_compile)
    steps.kept = [*steps.kept[1 - _MOST_KEPT :], _Step(parts, _watch(learner, parts), call)]
    steps.num_compiled += 1
    if steps.num_compiled == _MOST_KEPT:
        warnings.warn(
            f"learn was compiled {_MOST_KEPT} times for {learner.q_network.name!r}, which takes time and memory: pass "
            "the same optimizer, targets and loss at each call, instead of new ones",
            stacklevel=3,
        )
    return call


def _watch(learner: Learner, parts: Sequence[Any]) -> Watch:
    return Watch(*parts, *all_layers(learner.q_network), *all_layers(learner.q_hat_network))


def _bind_step(learner: Learner, formulas: Formulas, jit_compile: bool) -> Callable[..., list[tf.Tensor]]:
    states = tf.TensorSpec((None, *learner.q_network.input_shape[1:]))  # a batch of any size
    vector, scalar = tf.TensorSpec((None,)), tf.TensorSpec(())
    specs = (states, tf.TensorSpec((None,), tf.int32), vector, states, vector, scalar, scalar)

    def make_step(learner: Learner, _: Any) -> Callable[..., tf.Tensor]:
        def step(*tensors: tf.Tensor) -> tf.Tensor:
            *batch, gamma, tau = tensors
            return gradient_step(Experience(*batch), gamma, *learner, tau, formulas).loss

        return step

    key = ("learn", formulas.key)
    own = not formulas.are_the_packages
    return bind(make_step, specs, learner, key=key, has_own_parts=own, jit_compile=jit_compile)
