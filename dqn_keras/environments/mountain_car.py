"""MountainCar-v0 (Moore 1990) with Gymnasium's constants and dynamics."""

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.tensorflow import tf

MIN_POSITION, MAX_POSITION, GOAL = -1.2, 0.6, 0.5
MAX_SPEED = 0.07
FORCE, GRAVITY = 0.001, 0.0025


class MountainCar(FuncEnv):
    """A car that is too weak for its hill. The state, [2] float64: position, velocity.

    Every step gives a reward of -1. The episode terminates at the goal on the hill, and is truncated after 200 steps.
    """

    observation_space = spaces.Box(
        np.array([MIN_POSITION, -MAX_SPEED], np.float32), np.array([MAX_POSITION, MAX_SPEED], np.float32)
    )
    action_space = spaces.Discrete(3)
    max_episode_steps = 200

    def initial(self, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns a start state: at rest, with a position uniform in [-0.6, -0.4)."""
        position = tf.random.stateless_uniform([], rng, -0.6, -0.4, tf.float64, alg="philox")
        return tf.stack([position, tf.constant(0.0, tf.float64)])

    def transition(self, state: tf.Tensor, action: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns the next state: one step with the engine to the left (0), off (1) or to the right (2)."""
        position, velocity = tf.unstack(state)
        velocity += tf.cast(action - 1, tf.float64) * FORCE - GRAVITY * tf.cos(3 * position)
        velocity = tf.clip_by_value(velocity, -MAX_SPEED, MAX_SPEED)
        position = tf.clip_by_value(position + velocity, MIN_POSITION, MAX_POSITION)
        is_at_wall = (position == MIN_POSITION) & (velocity < 0)
        return tf.stack([position, tf.where(is_at_wall, tf.constant(0.0, tf.float64), velocity)])

    def observation(self, state: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns the state in float32."""
        return tf.cast(state, tf.float32)

    def reward(
        self, state: tf.Tensor, action: tf.Tensor, next_state: tf.Tensor, rng: tf.Tensor, params: Any = None
    ) -> tf.Tensor:
        """Returns -1."""
        return tf.constant(-1.0)

    def terminal(self, state: tf.Tensor, rng: tf.Tensor, params: Any = None) -> tf.Tensor:
        """Returns whether the car is at the goal and does not roll back."""
        return (state[0] >= GOAL) & (state[1] >= 0)
