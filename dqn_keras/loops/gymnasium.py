"""Plays any gymnasium.Env with Box observations and Discrete actions, one step at a time.

A TensorFlow call costs more than a step of CartPole and the forward pass of its network together. Therefore the loop
makes few such calls: acting runs in NumPy if NumPy can compute the network, and each update is one compiled call.
"""

import math
from collections.abc import Callable, Generator
from typing import Any

import numpy as np

from dqn_keras._engine.numpy_acting import is_relu_mlp, q_values
from dqn_keras._engine.private import tensor_maker
from dqn_keras._engine.programs import Learner, bind
from dqn_keras._engine.tensorflow import tf
from dqn_keras.agent import Agent, DivergedError
from dqn_keras.checks.environments import CheckedEnv
from dqn_keras.checks.formulas import Formulas
from dqn_keras.config import Config
from dqn_keras.learn import DEFAULT_FORMULAS, Metrics, known_formulas
from dqn_keras.loops.updates import checked_step, num_before_updates, sum_up
from dqn_keras.metrics import Episode
from dqn_keras.policy import epsilon_at, epsilon_greedy, epsilon_of_next_episode
from dqn_keras.replay import Experience, unpack
from dqn_keras.seeding import episode_seed


def episodes(
    env: CheckedEnv, agent: Agent, config: Config, formulas: Formulas = DEFAULT_FORMULAS
) -> Generator[Episode, None, None]:
    """Plays and learns until the run's last episode, and yields each episode; `agent` is changed in place."""
    kind = _InNumPy if is_relu_mlp(agent.q_network) else _InTensorFlow
    q = kind(agent, config, formulas)
    while not agent.is_done(config):
        agent.episodes.append(_play_episode(env, agent, config, q))
        yield agent.episodes[-1]


def _play_episode(env: CheckedEnv, agent: Agent, config: Config, q: "_InNumPy | _InTensorFlow") -> Episode:
    number, epsilon, memory = len(agent.episodes), agent.epsilon, agent.memory
    total_reward, max_reward, metrics, t, is_over, terminated = 0.0, -math.inf, [], 0, False, False
    first_step = memory.num_appended  # of the run; t counts from it
    before = first_step if config.steps_count_from == "run" else 0
    q.read_weights()

    state = env.reset(episode_seed(agent.seed, number), number)
    most_steps = config.max_steps if config.num_steps is None else config.num_steps - first_step
    for t in range(min(config.max_steps, most_steps)):
        a = epsilon_greedy(q.values(state), epsilon_at(first_step + t, epsilon, config), agent.rng)
        next_state, reward, terminated, truncated = env.step(a)
        memory.append_unchecked(Experience(state, a, reward, next_state, terminated))
        total_reward += reward
        max_reward = max(max_reward, reward)

        if (before + t) % config.steps_per_update == 0 and memory.num_appended >= num_before_updates(config):
            for _ in range(config.gradient_steps):
                metrics.append(_update(agent, config, q))
                if not math.isfinite(metrics[-1].loss):
                    raise DivergedError(
                        f"the loss or a weight is not finite in episode {number}, step {t}: learning has diverged"
                    )

        state = next_state
        is_over = terminated or truncated or t + 1 == config.max_steps
        if is_over:
            break

    agent.epsilon = epsilon_of_next_episode(epsilon, config)
    total_reward = total_reward if is_over else math.nan  # num_steps has cut the episode short
    epsilon = epsilon_at(first_step, epsilon, config)
    return Episode(number, total_reward, t + 1, epsilon, *sum_up(metrics), max_reward, terminated)


def _update(agent: Agent, config: Config, q: "_InNumPy | _InTensorFlow") -> Metrics:
    """Takes one gradient step on a batch from the memory; updates Q-hat only if that is due."""
    agent.num_updates += 1
    is_due = agent.num_updates % config.gradient_steps_per_target == 0
    return q.update(agent.memory.sample_rows(config.batch_size, agent.rng), config.tau if is_due else 0.0)


class _InNumPy:
    """Q, computed in NumPy with the weights that the last update returned."""

    def __init__(self, agent: Agent, config: Config, formulas: Formulas) -> None:
        self._network = agent.q_network
        self._shapes = [tuple(w.shape) for w in agent.q_network.weights]
        num_metrics = len(Metrics._fields)
        self._ends = np.cumsum([num_metrics] + [math.prod(shape) for shape in self._shapes]).tolist()
        self._step = _bind_step(agent, config, formulas, gives_weights=True)
        self._as_tensor = tensor_maker()

    def read_weights(self) -> None:
        """Reads the weights at the start of each episode, because a callback may have changed them."""
        self._weights = self._network.get_weights()

    def values(self, state: np.ndarray) -> np.ndarray:
        """Returns Q(s, .), [A]."""
        return q_values(self._weights, state)

    def update(self, rows: np.ndarray, tau: float) -> Metrics:
        """Takes a gradient step on rows of the memory and returns its metrics."""
        flat = self._step(self._as_tensor(rows), tau)[0].numpy()
        parts = zip(self._ends, self._ends[1:], self._shapes, strict=False)
        self._weights = [flat[i:j].reshape(shape) for i, j, shape in parts]
        return Metrics(*flat[: self._ends[0]].tolist())


class _InTensorFlow:
    """Q of any other network, computed with one TensorFlow call per step."""

    def __init__(self, agent: Agent, config: Config, formulas: Formulas) -> None:
        def make_values(learner: Learner, _: Any) -> Callable[[tf.Tensor], tf.Tensor]:
            return lambda state: learner.q_network(state[None])[0]

        state = tf.TensorSpec(agent.memory.state_shape, agent.memory.rows.dtype)
        jit = config.jit_compile
        self._values = bind(make_values, [state], agent.learner, key="values", has_own_parts=False, jit_compile=jit)
        self._step = _bind_step(agent, config, formulas, gives_weights=False)
        self._as_tensor = tensor_maker()

    def read_weights(self) -> None:
        """Does nothing: the weights are in the network."""

    def values(self, state: np.ndarray) -> np.ndarray:
        """Returns Q(s, .), [A]."""
        return self._values(self._as_tensor(state))[0].numpy()

    def update(self, rows: np.ndarray, tau: float) -> Metrics:
        """Takes a gradient step on rows of the memory and returns its metrics."""
        return Metrics(*self._step(self._as_tensor(rows), tau)[0].numpy().tolist())


def _bind_step(
    agent: Agent, config: Config, formulas: Formulas, gives_weights: bool
) -> Callable[[tf.Tensor, float], list[tf.Tensor]]:
    """Returns the gradient step: rows of the memory -> a vector of its metrics and, if wanted, Q's new weights.

    It also takes tau, which is `config.tau` or 0. The compiled step has only two inputs and one output, because each
    additional array costs time.
    """
    rows, state_shape = agent.memory.rows, agent.memory.state_shape

    def make_step(learner: Learner, _: Any) -> Callable[..., tf.Tensor]:
        def step(rows: tf.Tensor, numbers: tf.Tensor) -> tf.Tensor:
            gamma, tau = tf.unstack(numbers)
            metrics = checked_step(unpack(rows, state_shape), learner, gamma, tau, formulas)
            weights = learner.q_network.weights if gives_weights else ()
            return tf.concat([tf.stack(metrics), *(tf.reshape(w, [-1]) for w in weights)], axis=0)

        return step

    specs = [tf.TensorSpec((config.batch_size, rows.shape[1]), rows.dtype), tf.TensorSpec((2,))]
    step = bind(
        make_step,
        specs,
        agent.learner,
        key=("update", known_formulas(formulas), gives_weights),
        has_own_parts=known_formulas(formulas) is None,
        jit_compile=config.jit_compile,
    )
    numbers = {tau: tf.constant([config.gamma, tau], tf.float32) for tau in (config.tau, 0.0)}
    return lambda rows, tau: step(rows, numbers[tau])
