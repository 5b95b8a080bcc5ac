"""Greedy episodes of a functional environment in one program that XLA compiles, without learning."""

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.programs import Actor, bind
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.checks.environments import Spaces
from dqn_keras.environments import key_of_twin
from dqn_keras.loops.draws import episode_key, reset_rng, step_rng
from dqn_keras.loops.updates import is_all_finite
from dqn_keras.seeding import evaluation_key


def greedy_returns(
    env: FuncEnv, spaces: Spaces, q_network: keras.Model, num_episodes: int, seed: int, max_steps: int
) -> np.ndarray:
    """Plays greedy episodes and returns the undiscounted return of each, [num_episodes] float64."""

    def make_program(actor: Actor, _: Any) -> Callable:
        def play(key: tf.Tensor, max_steps: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:
            def play_one(i: tf.Tensor, returns: tf.Tensor, fault: tf.Tensor) -> tuple[tf.Tensor, ...]:
                total, steps, is_finite = _play_episode(env, spaces, actor, episode_key(key, i), max_steps)
                fault = tf.where(is_finite, fault, tf.stack([i, steps]))
                return i + 1, tf.tensor_scatter_nd_update(returns, [[i]], [total]), fault

            start = tf.constant(0), tf.zeros([num_episodes], tf.float64), tf.constant([-1, 0])
            is_left = lambda i, _, fault: (i < num_episodes) & (fault[0] < 0)  # noqa: E731
            return tf.while_loop(is_left, play_one, start)[1:]

        return play

    twin = key_of_twin(env)
    numbers = evaluation_key(seed), np.int32(min(max_steps, getattr(env, "max_episode_steps", max_steps)))
    program = bind(
        make_program,
        [tf.TensorSpec((), tf.int64), tf.TensorSpec((), tf.int32)],
        Actor(q_network),
        key=("greedy", twin, num_episodes),
        has_own_parts=twin is None,
        jit_compile=True,
    )
    returns, (episode, step) = (x.numpy() for x in program(*map(tf.constant, numbers)))
    if episode >= 0:
        where = f"step {step - 1}" if step else "at the reset"
        raise ValueError(
            f"env {type(env).__name__}: an observation or a reward was not finite in episode {episode}, {where}"
        )
    return returns


def _play_episode(
    env: FuncEnv, spaces: Spaces, actor: Actor, key: tf.Tensor, max_steps: tf.Tensor
) -> tuple[tf.Tensor, tf.Tensor, tf.Tensor]:
    """Plays an episode -> its return, its number of steps, whether all numbers were finite."""

    def observe(state: Any, rng: tf.Tensor) -> tf.Tensor:
        return tf.cast(env.observation(state, rng), spaces.state_dtype)

    def step(state: Any, observation: tf.Tensor, total: tf.Tensor, t: tf.Tensor, *_: tf.Tensor) -> tuple[Any, ...]:
        rng = step_rng(key, t)
        a = tf.argmax(actor.q_network(observation[None])[0], output_type=tf.int32) + spaces.first_action
        next_state = env.transition(state, a, rng)
        reward = tf.cast(env.reward(state, a, next_state, rng), tf.float32)
        terminated = tf.cast(env.terminal(next_state, rng), tf.bool)
        next_observation = observe(next_state, rng)
        is_finite = is_all_finite(next_observation, reward)
        is_over = terminated | (t + 1 >= max_steps) | ~is_finite
        return next_state, next_observation, total + tf.cast(reward, tf.float64), t + 1, is_over, is_finite

    rng = reset_rng(key)
    state = env.initial(rng)
    observation = observe(state, rng)
    is_finite = is_all_finite(observation)
    start = (state, observation, tf.constant(0, tf.float64), tf.constant(0), ~is_finite, is_finite)
    _, _, total, steps, _, is_finite = tf.while_loop(lambda *x: ~x[4], step, start)
    return total, steps, is_finite
