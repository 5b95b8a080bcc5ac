"""Episodes in any gymnasium.Env with a flat observation and discrete actions, one step at a time.

Acting runs in NumPy and learning is one compiled call per update: a TensorFlow call costs more than a step of
CartPole and the forward pass of its network together, so the loop makes as few of them as it can.
"""

import math
from collections.abc import Callable, Generator
from typing import Any

import numpy as np
import tensorflow as tf

from dqn_keras.agent import Agent, Episode, episode_seed
from dqn_keras.config import Config
from dqn_keras.environment import CheckedEnv
from dqn_keras.learn import gradient_step
from dqn_keras.networks import q_values
from dqn_keras.policy import action, decay_epsilon
from dqn_keras.programs import Learner, bind
from dqn_keras.replay import Experience, unpack


def episodes(env: CheckedEnv, agent: Agent, config: Config) -> Generator[Episode, None, None]:
    """Play and learn, episode after episode, until the run's last; `agent` is changed in place."""
    update = _bind_update(agent, config)
    while len(agent.episodes) < config.num_episodes:
        agent.episodes.append(_play_episode(env, agent, config, update))
        yield agent.episodes[-1]


def _play_episode(env: CheckedEnv, agent: Agent, config: Config, update: Callable) -> Episode:
    number, epsilon, memory, rng = len(agent.episodes), agent.epsilon, agent.memory, agent.rng
    weights = agent.q_network.get_weights()  # anew each episode: a callback may have changed them
    total_reward, losses, t = 0.0, [], 0

    state = env.reset(episode_seed(agent.seed, number), number)
    for t in range(config.max_steps):
        a = action(q_values(weights, state), epsilon, rng)
        next_state, reward, terminated, truncated = env.step(a)
        memory.append(Experience(state, a, reward, next_state, terminated))
        total_reward += reward

        if t % config.steps_per_update == 0 and len(memory) >= config.batch_size:
            loss, weights = update(memory.sample_rows(config.batch_size, rng))
            if not math.isfinite(loss):
                raise ValueError(
                    f"the loss or a weight is not finite in episode {number}, step {t}: learning has diverged"
                )
            losses.append(loss)

        state = next_state
        if terminated or truncated:
            break

    agent.num_updates += len(losses)
    agent.epsilon = decay_epsilon(epsilon, config)
    return Episode(number, total_reward, t + 1, epsilon, sum(losses) / len(losses) if losses else math.nan)


def _bind_update(agent: Agent, config: Config) -> Callable[[np.ndarray], tuple[float, list[np.ndarray]]]:
    """The gradient step on rows of the memory, [B, 2F + 3] -> its loss and Q's new weights, ready to act with.

    One array goes in and one comes out: each further one costs as much as its share of the arithmetic.
    """
    num_features = agent.memory.num_features
    shapes = [tuple(w.shape) for w in agent.q_network.weights]
    ends = np.cumsum([1] + [math.prod(shape) for shape in shapes]).tolist()

    def make_step(learner: Learner, _: Any) -> Callable[[tf.Tensor], tf.Tensor]:
        def step(rows: tf.Tensor) -> tf.Tensor:
            loss = gradient_step(unpack(rows, num_features), config.gamma, *learner, config.tau)
            return tf.concat([loss[None], *(tf.reshape(w, [-1]) for w in learner.q_network.weights)], axis=0)

        return step

    rows_spec = tf.TensorSpec((config.batch_size, agent.memory.rows.shape[1]))
    key = ("update", config.gamma, config.tau)
    step = bind(key, make_step, [rows_spec], agent.learner, jit_compile=config.jit_compile)

    def update(rows: np.ndarray) -> tuple[float, list[np.ndarray]]:
        flat = step(tf.constant(rows))[0].numpy()
        weights = [flat[i:j].reshape(shape) for i, j, shape in zip(ends, ends[1:], shapes, strict=False)]
        return (float(flat[0]) if np.isfinite(flat).all() else math.nan), weights

    return update
